"""An animation of a sample of a check: touch, spikes of the layers and probabilities over time."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from deploy.check.bundle import Bundle
from deploy.errors import UserError
from deploy.files import replacing
from deploy.tables import shortened
from pipeline.data.dataset import positions_of
from pipeline.look import colour
from pipeline.results.report.figures import SHADES
from pipeline.results.report.samples import replay

# Number of frames, and the duration of each and of the last one in milliseconds.
FRAMES, FRAME_MS, LAST_MS = 48, 60, 3000

LONGEST_NAME = 32


def require_gif(path):
    """Refuse another ending of the name than .gif."""
    if path.suffix.lower() != ".gif":
        raise UserError(f"{path}: the name must end in .gif")


def animate(path, bundle: Bundle, index: int, advance=None):
    """Write the animation of a sample of a bundle's check.

    The input, the spikes of every layer and the probabilities are on one time axis, that of the
    presentation.  Events fill the picture of the sensor while they arrive; an image is complete
    before it is presented.

    Parameters
    ----------
    path : Path
        Ends in .gif.
    bundle : Bundle
    index : int
        Index of the sample in the check.
    advance : callable, optional
        Called after each frame.

    Raises
    ------
    UserError
        Another ending of the name, or the file cannot be written.
    """
    require_gif(path)
    spec = bundle.spec
    played = replay(bundle, [index], bundle.seed)[index]
    classes, chances = spec.provenance["classes"], played.chances
    step, start = 1000 * spec.stimulus.step_seconds, spec.presentation.readout_start
    extent = step * spec.presentation.steps
    label, answer = int(bundle.checks.labels[index]), int(chances[-1].argmax())

    heights = [1.0] * len(played.layers) + [1.4]
    figure = Figure(figsize=(10, 1.6 + 1.2 * len(heights)), layout="constrained", dpi=90)
    left, right = figure.subfigures(1, 2, width_ratios=[1, 2.4])
    picture = left.subplots()
    panels = right.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    kind = "simulated " if spec.provenance.get("simulated") else ""
    shown = f"{kind}sample {bundle.checks.ids[index]}, class {classes[label]}"
    figure.suptitle(shown, x=0.01, ha="left")
    growing = _growing(bundle.checks.inputs[index])
    draw = _picture(picture, growing, positions_of(spec))
    picture.set(xticks=[], yticks=[], title="events of each taxel" + " so far" * (len(growing) > 1))
    clocks = [axes.axvline(0, color=colour("wrong"), linewidth=1) for axes in panels]
    marks = []
    for axes, layer in zip(panels, played.layers, strict=False):
        axes.set(ylim=(layer.size - 0.5, -0.5), xlim=(0, extent), yticks=[])
        title = f"{layer.name}\n{layer.size} {layer.unit}"
        axes.set_ylabel(title, rotation=0, ha="right", va="center")
        for kind, steps, rows in layer.groups:
            (mark,) = axes.plot(
                [],
                [],
                "|",
                color=colour(kind),
                markersize=max(1, 60 / layer.size),
                label=kind.upper(),
            )
            marks.append((mark, (steps + 0.5) * step, rows))
        if len(layer.groups) > 1:
            where = {"loc": "center left", "bbox_to_anchor": (1, 0.5), "frameon": False}
            axes.legend(**where, fontsize=9, markerscale=max(1, layer.size / 7))
    scores = panels[-1]
    scores.set(ylim=(0, 102), xlabel="milliseconds of the presentation", ylabel="probability, %")
    lines = {
        c: scores.plot([], [], color=colour(f"s{n}"), label=shortened(classes[c], LONGEST_NAME))[0]
        for n, c in enumerate(played.shown(label), 1)
    }
    scores.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize=9, frameon=False)
    times = step * (start + 1 + np.arange(len(chances)))
    verdict = f"answered {classes[answer]}, which is {'right' if answer == label else 'wrong'}"
    canvas, frames = FigureCanvasAgg(figure), []
    canvas.draw()
    figure.set_layout_engine("none")  # of the first frame, for all
    for now in np.linspace(0, extent, FRAMES):
        draw(growing[min(int(now / step), len(growing) - 1)])
        for clock in clocks:
            clock.set_xdata([now, now])
        for mark, at, neurons in marks:
            mark.set_data(at[at <= now], neurons[at <= now])
        for c, line in lines.items():
            line.set_data(times[times <= now], 100 * chances[times <= now, c])
        if len(frames) == FRAMES - 1:
            figure.suptitle(f"{shown}: {verdict}", x=0.01, ha="left")
        canvas.draw()
        frames.append(Image.fromarray(np.array(canvas.buffer_rgba())).convert("RGB"))
        if advance is not None:
            advance()
    durations = [FRAME_MS] * (FRAMES - 1) + [LAST_MS]
    with replacing(path) as file:
        frames[0].save(
            file, "gif", save_all=True, append_images=frames[1:], duration=durations, loop=0
        )


def _picture(axes, growing, positions):
    """Draw an empty picture of the sensor; return the function that draws values on it."""
    shades = {"cmap": SHADES, "vmin": 0, "vmax": growing[-1].max()}
    if positions is None:
        rows, columns = growing.shape[1:3]
        image = axes.imshow(growing[0] * 0, aspect="auto", **shades)
        axes.set_box_aspect(max(0.1, rows / columns))
        axes.set_xlabel(f"{rows} x {columns} taxels")
        return image.set_data
    dots = axes.scatter(*positions.T, 120, 0 * positions[:, 0], edgecolors="0.7", **shades)
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_yaxis()
    axes.margins(0.1)
    return lambda values: dots.set_array(values[0])


def _growing(sample):
    """The events of each taxel up to each step, or the image, shape (steps, rows, columns)."""
    if sample.ndim == 3:
        return np.abs(sample).sum(-1)[None]
    return np.cumsum(sample.sum(-1, dtype=np.int64), axis=0)
