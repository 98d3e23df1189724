"""The paper's figures of recordings: one over time, and a sheet of several."""

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from deploy.tables import shorten_apart, shorten_name
from pipeline.look import find_colour
from pipeline.recordings.images import make_tactile_images
from pipeline.recordings.recordings import Recordings
from pipeline.recordings.sensor import DIGITS
from pipeline.results.report.figures import SHADES, escape_formula

# Tactile images above the raster.
FRAMES = 8

# Taxels of a raster whose marks are as high as half of a row; those of more taxels are not lower.
MAX_ROWS_OF_MARKS = 100

# Intervals of time of a recording of a strip on a sheet.
BINS = 40

# Recordings in a row of a sheet, and the most rows; more classes are side by side.
SAMPLES = 16
MAX_SHEET_ROWS = 20

# Width of a recording on a sheet in points.
TILE = 43.0

# Largest number of characters of a class on a sheet, and the width of one in inches.
NAME = 24
CHARACTER = 0.085


def draw_recording(recordings: Recordings, index: int) -> Figure:
    """The tactile image as it grows, above a raster of all taxels (paper, Figure 4).

    A sensor with known positions of its taxels is drawn as it is; of taxels in one row without
    positions there is only the raster.

    Parameters
    ----------
    recordings : Recordings
    index : int
        Index of the recording.
    """
    events = recordings[index]
    sensor = recordings.sensor
    since_first = events.time_ns - events.time_ns[:1].sum()
    events = replace(events, time_ns=since_first)
    duration_s = int(events.time_ns.max(initial=0)) * 1e-9 or sensor.duration_s
    taxels = recordings.taxels
    figure = Figure(figsize=(10, 7), layout="constrained")
    figure.suptitle(_make_title(recordings, index), x=0.01, ha="left")
    if _is_strip(taxels):
        axes = figure.subplots()
    else:  # each picture is above its time
        grid = figure.add_gridspec(2, FRAMES, height_ratios=[1, 4])
        frames = [figure.add_subplot(grid[0, column]) for column in range(FRAMES)]
        axes = figure.add_subplot(grid[1, :])
        largest = _draw_growing(frames, recordings, events, duration_s)
        _draw_scale(figure, f"{largest} event{'s' * (largest > 1)}")
    seconds = events.time_ns * 1e-9
    is_grid = taxels.positions is None and not _is_strip(taxels)
    place = taxels.row * sensor.columns + taxels.column if is_grid else np.arange(len(taxels))
    height = 0.45 * max(1.0, (place.max() + 1) / MAX_ROWS_OF_MARKS)
    for polarity, name in ((1, "on"), (-1, "off")):  # the upper and lower half of a taxel's row
        chosen = events.polarity == polarity
        middle = place[events.taxel[chosen]]
        label = f"{name.upper()}: pressure {'rises' if polarity > 0 else 'falls'}"
        axes.vlines(
            seconds[chosen],
            middle,
            middle - height * polarity,
            snap=False,
            clip_on=False,  # the first and last events are at the borders
            zorder=3,  # above the frame
            colors=find_colour(name),
            linewidths=2,
            label=label,
        )
    axes.set(xlim=(0, duration_s), ylim=(place.max() + 0.5, -0.5))
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("time from the first event (s)", loc="left")
    axes.set_ylabel("taxel (ON above OFF)" + ", row by row" * is_grid)
    legend = axes.legend(loc="upper right", bbox_to_anchor=(1, -0.05), ncols=2, frameon=False)
    for line in legend.get_lines():
        line.set_linewidth(4)
    return figure


def _draw_growing(frames, recordings, events, duration_s):
    """The tactile image up to some times; returns the most events of a taxel."""
    taxels = recordings.taxels
    sensor = recordings.sensor
    ends = np.arange(1, FRAMES + 1) * duration_s / FRAMES
    grown = np.zeros((FRAMES, sensor.rows, sensor.columns))
    frame = np.minimum(events.time_ns * 1e-9 * FRAMES / duration_s, FRAMES - 1).astype(int)
    np.add.at(grown, (frame, taxels.row[events.taxel], taxels.column[events.taxel]), 1)
    largest = max(int(grown.sum(axis=0).max()), 1)
    grown = np.cumsum(grown, axis=0) / largest
    for axes, end, image in zip(frames, ends, grown, strict=True):
        _show(axes, recordings.taxels, image, 2 * TILE)
        axes.set_title(f"up to {end:.2f} s", fontsize=9)
    return largest


def draw_sheet(recordings: Recordings, seed: int = 0) -> Figure:
    """Tactile images of samples drawn at random, a row for each class with its number of samples.

    Without known positions, recordings of taxels in one row are drawn as taxels (down) over time
    (to the right).

    Parameters
    ----------
    recordings : Recordings
    seed : int
        Seed of the draw.
    """
    rng = np.random.default_rng(seed)
    digits = np.unique(recordings.labels)
    blocks = -(-len(digits) // MAX_SHEET_ROWS)
    rows = -(-len(digits) // blocks)
    per_digit = max(SAMPLES // blocks, 2)
    images = make_tactile_images(recordings)[..., 0]
    classes = recordings.sensor.classes
    numbers = np.bincount(recordings.labels)
    short = shorten_apart([classes[d] for d in digits], NAME)
    names = {d: f"{name} ({numbers[d]})" for d, name in zip(digits, short, strict=True)}
    margin = max(0.3, 0.2 + CHARACTER * max(map(len, names.values())))
    source = _name_source(recordings)
    tiles = 0.6 * per_digit + margin
    # The source and the scale are above.
    width = max(blocks * tiles + 0.1, 2.5 + CHARACTER * len(source))
    height = 0.6 * rows + 0.5
    figure = Figure(figsize=(width, height))
    figure.suptitle(source, x=0.1 / width, y=1 - 0.1 / height, ha="left", va="top", size=9)
    edges = {"bottom": 0.01, "top": 1 - 0.5 / height, "wspace": 0.06, "hspace": 0.06}
    ends = tiles * np.arange(1, blocks + 1)
    across = zip((ends - tiles + margin) / width, ends / width, strict=True)
    grids = [figure.add_gridspec(rows, per_digit, left=a, right=b, **edges) for a, b in across]
    for number, digit in enumerate(digits):
        block, down = divmod(number, rows)
        pool = np.flatnonzero(recordings.labels == digit)
        chosen = np.sort(rng.choice(pool, min(per_digit, len(pool)), replace=False))
        row = [figure.add_subplot(grids[block][down, column]) for column in range(len(chosen))]
        row[0].set_ylabel(
            escape_formula(names[digit]), rotation=0, labelpad=4, ha="right", va="center"
        )
        for axes, index in zip(row, chosen, strict=True):
            if _is_strip(recordings.taxels):
                _show_over_time(axes, recordings, index)
            else:
                _show(axes, recordings.taxels, images[index], TILE)
    is_strip = _is_strip(recordings.taxels)
    axes_note = ""
    if is_strip:
        axes_note = (
            f"; each: {recordings.sensor.duration_s:.3g} s to the right, taxels down, "
            "shade: square root of the number of events"
        )
    figure.text(
        0.1 / width, 1 - 0.4 / height, f"class (number of its recordings){axes_note}", size=8
    )
    _draw_scale(figure, "most, in each picture")
    return figure


def _draw_scale(figure, most):
    """The scale of the shades, in the upper right corner."""
    width, height = figure.get_size_inches()
    axes = figure.add_axes((1 - 2.05 / width, 1 - 0.22 / height, 0.7 / width, 0.12 / height))
    axes.imshow(np.linspace(0, 1, 64)[None], cmap=SHADES, aspect="auto")
    axes.set(xticks=[], yticks=[])
    axes.text(-0.06, 0.5, "no event", transform=axes.transAxes, ha="right", va="center", size=8)
    axes.text(1.06, 0.5, most, transform=axes.transAxes, va="center", size=8)


def _is_strip(taxels):
    """True if taxels are in one row or column, and their positions are not known."""
    return taxels.positions is None and 1 in (np.ptp(taxels.row) + 1, np.ptp(taxels.column) + 1)


def _show(axes, taxels, image, width):
    """A tactile image, [row, column], whose axes are some points wide."""
    grey = {"cmap": SHADES, "vmin": 0, "vmax": 1, "clip_on": False}
    if taxels.positions is not None:
        size = (width / (2 * np.sqrt(len(taxels)))) ** 2
        values = image[taxels.row, taxels.column]
        axes.scatter(*taxels.positions.T, size, values, edgecolors="0.7", linewidths=0.3, **grey)
        axes.set_aspect("equal", adjustable="datalim")
        axes.invert_yaxis()
        axes.margins(0.1)
    else:
        axes.imshow(image, **grey)
    axes.set(xticks=[], yticks=[])


def _show_over_time(axes, recordings, index):
    """Number of events of each taxel in each interval of time, as shades of its square root."""
    events = recordings[index]
    n = len(recordings.taxels)
    # A recording in the published layout may be longer than its sensor's two seconds.
    duration_ns = max(1e9 * recordings.sensor.duration_s, int(events.time_ns.max(initial=0)) + 1)
    ranges = ((0, n), (0, duration_ns))
    counts, _, _ = np.histogram2d(events.taxel, events.time_ns, (n, BINS), ranges)
    axes.imshow(np.sqrt(counts), aspect="auto", cmap=SHADES, vmin=0)
    axes.set(xticks=[], yticks=[])


def _name_source(recordings):
    name = escape_formula(recordings.source.name)
    if recordings.source.simulated and "simulated" not in name:
        return f"{name}, simulated"
    return name


def _make_title(recordings, index):
    name = recordings.ids[index]
    classes = recordings.sensor.classes
    of = classes[recordings.labels[index]]
    sample = f"sample {escape_formula(shorten_name(name, 60))} ({_name_source(recordings)})"
    if classes == DIGITS:
        return f"digit {of}, {sample}"
    if name.startswith(f"{of}/"):  # which names the class
        return sample
    return f"class {escape_formula(shorten_name(of, 60))}, {sample}"
