"""An animation of a sample of a check: its events, its image, and the network's probabilities."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from matplotlib import rcParams
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter
from matplotlib.figure import Figure

from deploy.check.bundle import Bundle
from deploy.errors import UserError
from deploy.files import replacing
from pipeline.data.events import Recordings
from pipeline.data.images import growing, normalise
from pipeline.data.words import shortened
from pipeline.results.report.over_time import probabilities

FRAMES, FRAMES_A_SECOND, STILL = 48, 16, 12
"""Number of frames in total, per second, and at the end, where nothing moves."""

SHOWN_CLASSES = 6
"""Number of classes whose probability is drawn: the most likely at the end, and the right one."""

LONGEST_NAME = 32


def writer_for(path) -> AbstractMovieWriter:
    """The Matplotlib writer for a file name.

    Raises
    ------
    UserError
        The name ends in neither .gif nor .mp4, or ffmpeg is missing for .mp4.
    """
    suffix = path.suffix.lower()
    if suffix == ".gif":
        return PillowWriter(fps=FRAMES_A_SECOND)
    if suffix != ".mp4":
        raise UserError(f"{path}: the name must end in .gif or .mp4")
    if not FFMpegWriter.isAvailable() and (program := _packaged_ffmpeg()):
        rcParams["animation.ffmpeg_path"] = program
    if not FFMpegWriter.isAvailable():
        raise UserError(
            f"{path}: needs ffmpeg, which is not on this machine; install it "
            "(pip install 'stmnist-loihi[video]'), or choose a .gif"
        )
    return FFMpegWriter(fps=FRAMES_A_SECOND)


def _packaged_ffmpeg():
    """The program in the package imageio-ffmpeg; None without it."""
    try:
        import imageio_ffmpeg

        return imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        return None


def animate(path, bundle: Bundle, recordings: Recordings, index: int, advance=None):
    """Write the animation of a sample of a bundle's check.

    On events the probabilities change during the recording.  An image is complete when the
    recording has ended, and the probabilities follow afterwards.

    Parameters
    ----------
    path : Path
        Ends in .gif or .mp4.
    bundle : Bundle
    recordings : Recordings
        Recordings from which the bundle was made.
    index : int
        Index of the sample in the check.
    advance : callable, optional
        Called after each frame.

    Raises
    ------
    UserError
        See :func:`writer_for`; or the file cannot be written.
    """
    writer, spec = writer_for(path), bundle.spec
    chances = probabilities(bundle, [index])[index]
    recording = recordings.ids.index(bundle.checks.ids[index])
    events, classes = recordings[recording], recordings.sensor.classes
    first = int(events.time_ns[0]) if len(events) else 0
    seconds = 1e-9 * (events.time_ns - first)
    lasts = max(float(seconds.max(initial=0)), 0.1)
    step, start = spec.stimulus.step_seconds, spec.presentation.readout_start
    on_events = not spec.stimulus.static
    answers = chances.argmax(axis=1)
    changed = np.flatnonzero(answers != answers[-1])
    decided_at = start + 1 + (int(changed[-1]) + 1 if len(changed) else 0)  # finally
    label = int(bundle.checks.labels[index])
    top = np.argsort(-chances[-1], kind="stable")[:SHOWN_CLASSES].tolist()
    if label not in top:
        top[-1] = label

    figure = Figure(figsize=(10, 4), layout="constrained")
    image, raster, scores = figure.subplots(1, 3, width_ratios=[1, 1.4, 1.6])
    kind = " (simulated)" if recordings.source.simulated else ""
    figure.suptitle(f"{shortened(classes[label], 60)}{kind}")
    raster.set(xlim=(0, lasts), ylim=(-0.5, len(recordings.taxels) - 0.5))
    raster.set(xlabel="seconds", ylabel="taxel", title="events")
    end = step * (start + len(chances))
    scores.set(xlim=(0, end), ylim=(0, 1.02), xlabel="seconds", title="probability")
    if not on_events:
        scores.set_xlabel("seconds since the start of the presentation")
    picture = image.imshow(
        np.zeros((recordings.sensor.rows, recordings.sensor.columns)), "gray_r", vmin=0, vmax=1
    )
    image.set(xticks=[], yticks=[], title="image")
    marks = {
        name: raster.plot([], [], "|", color=colour, markersize=4, label=name)[0]
        for name, colour in (("ON", "red"), ("OFF", "black"))
    }
    raster.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=8)
    lines = {
        name: scores.plot([], [], label=shortened(classes[name], LONGEST_NAME))[0] for name in top
    }
    scores.legend(loc="center right", fontsize=8)
    decided = scores.axvline(step * decided_at, color="0.5", linestyle="--", visible=False)
    moments = np.linspace(0, 1, FRAMES)
    shown_for = np.concatenate([moments, np.ones(STILL)])

    def parts(share):
        """Progress of the recording and of the probabilities, each from 0 to 1."""
        if on_events:
            return min(1.0, share * max(end, lasts) / lasts), min(
                1.0, share * max(end, lasts) / end
            )
        return min(1.0, 2 * share), max(0.0, 2 * share - 1)

    ends = [first + int(1e9 * lasts * parts(share)[0]) + 1 for share in moments]
    grown_to = growing(events, recordings.taxels, ends, "count", recordings.sensor)
    whole = max(float(normalise(grown_to[-1:], "none").max()), 1.0)
    on = events.polarity > 0
    times = step * (start + 1 + np.arange(len(chances)))
    # The writers derive the format from the name, and do not write atomically.
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / f"animation{path.suffix.lower()}"
        with writer.saving(figure, written, dpi=90):
            for number, share in enumerate(shown_for):
                far, thought = parts(share)
                picture.set_data(grown_to[min(number, FRAMES - 1)] / whole)
                seen = seconds <= lasts * far
                for name, mine in (("ON", on), ("OFF", ~on)):
                    marks[name].set_data(seconds[seen & mine], events.taxel[seen & mine])
                known = times <= end * thought
                for name, line in lines.items():
                    line.set_data(times[known], chances[known, name])
                decided.set_visible(end * thought >= step * decided_at)
                writer.grab_frame()
                if advance is not None:
                    advance()
        content = written.read_bytes()
    with replacing(path) as file:
        file.write(content)
