"""The paper's figures of recordings: one over time, its events by taxel, the layout, a sheet."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from pipeline.data.events import (
    DIGITS,
    Recordings,
    TaxelMap,
)
from pipeline.data.images import aggregate, growing, normalise
from pipeline.data.words import is_written, shortened, shortened_apart
from pipeline.results.report.figures import plain

ON, OFF = "red", "black"
"""Colours of the paper's Figure 4."""

FRAMES = 8
"""Tactile images above the raster."""

NAME, CHARACTER = 24, 0.085
"""Largest number of characters of a class on a sheet, and the width of one in inches."""


def recording(recordings: Recordings, index: int) -> Figure:
    """The tactile image as it grows, above a raster of all taxels (paper, Figure 4).

    Parameters
    ----------
    recordings : Recordings
    index : int
        Index of the recording.
    """
    events, sensor = recordings[index], recordings.sensor
    duration_s = _duration_s(recordings, events)
    figure = Figure(figsize=(10, 7), layout="constrained")
    figure.suptitle(_title(recordings, index))
    frames, raster = figure.subfigures(2, 1, height_ratios=[1, 3])
    ends = np.arange(1, FRAMES + 1) * duration_s / FRAMES
    grown = growing(events, recordings.taxels, ends * 1e9, sensor=sensor)
    grown = grown / max(grown[-1].max(), 1)
    for axes, end, image in zip(frames.subplots(1, FRAMES), ends, grown, strict=True):
        _show(axes, image)
        axes.set_title(f"to {end:.2f} s", fontsize=9)
    axes = raster.subplots()
    seconds = events.time_ns * 1e-9
    for polarity, colour, label in ((1, ON, "ON"), (-1, OFF, "OFF")):
        mine = events.polarity == polarity
        axes.scatter(
            seconds[mine], events.taxel[mine] + 1, 4, colour, marker="|", linewidths=1, label=label
        )
    axes.set(xlim=(0, duration_s), ylim=(0.5, len(recordings.taxels) + 0.5))
    axes.set_xlabel("time (s)")
    axes.set_ylabel("taxel address")
    axes.legend(loc="upper right", markerscale=3, frameon=True)
    return figure


def events_by_taxel(recordings: Recordings, index: int) -> Figure:
    """Decoded events of each taxel over time, at the taxel's place (paper, Figure 2).

    Parameters
    ----------
    recordings : Recordings
    index : int
        Index of the recording.
    """
    events, taxels = recordings[index], recordings.taxels
    figure = Figure(figsize=(11, 9), layout="constrained")
    axes = figure.subplots()
    duration_s = _duration_s(recordings, events)
    # One cell per taxel: time runs to the right, zero is in the middle.
    x = taxels.column[events.taxel] - 0.5 + events.time_ns * 1e-9 / duration_s
    zero = taxels.row[events.taxel]
    for polarity, colour, label in ((1, ON, "ON, up"), (-1, OFF, "OFF, down")):
        mine = events.polarity == polarity
        tip = zero[mine] - 0.4 * polarity
        axes.vlines(x[mine], zero[mine], tip, colour, linewidth=0.6, label=label)
    for taxel, (row, column) in enumerate(zip(taxels.row, taxels.column, strict=True)):
        axes.text(column - 0.47, row - 0.3, taxel + 1, fontsize=7, color="0.5")
    _cells(axes, recordings.sensor.rows, recordings.sensor.columns, is_as_in_paper(recordings))
    axes.set(title=f"{_title(recordings, index)}: each taxel's events, 0 to {duration_s:.4g} s")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.03), ncols=2, frameon=False)
    return figure


def layout(taxels: TaxelMap, as_in_paper: bool = True) -> Figure:
    """The position of each taxel: address in bold, its place below it, 1-based (paper, Figure 1).

    Parameters
    ----------
    taxels : TaxelMap
    as_in_paper : bool
        True for the paper's names of rows and columns, X and Y.
    """
    figure = Figure(figsize=(7, 7), layout="constrained")
    axes = figure.subplots()
    for taxel, (x, y) in enumerate(zip(taxels.row, taxels.column, strict=True)):
        axes.text(y, x - 0.12, taxel + 1, ha="center", va="center", weight="bold", fontsize=11)
        axes.text(y, x + 0.22, f"({x + 1},{y + 1})", ha="center", va="center", fontsize=8)
    _cells(axes, int(taxels.row.max()) + 1, int(taxels.column.max()) + 1, as_in_paper)
    axes.set(aspect="equal", title=f"Taxel addresses and ({', '.join(_names(as_in_paper))})")
    return figure


def sheet(recordings: Recordings, per_digit: int = 16, seed: int = 0) -> Figure:
    """Tactile images of samples drawn at random, a row for each class.

    Parameters
    ----------
    recordings : Recordings
    per_digit : int
    seed : int
        Seed of the draw.
    """
    rng = np.random.default_rng(seed)
    digits = np.unique(recordings.labels)
    images = normalise(aggregate(recordings))
    classes = recordings.sensor.classes
    names = dict(zip(digits, shortened_apart([classes[d] for d in digits], NAME), strict=True))
    margin = max(0.3, 0.2 + CHARACTER * max(map(len, names.values())))
    width = 0.6 * per_digit + 0.1 + margin
    figure = Figure(figsize=(width, 0.6 * len(digits) + 0.5))
    figure.suptitle(_source(recordings))
    panels = figure.subplots(len(digits), per_digit, squeeze=False)
    figure.subplots_adjust(margin / width, 0.01, 0.99, 0.94, 0.06, 0.06)
    for row, digit in zip(panels, digits, strict=True):
        pool = np.flatnonzero(recordings.labels == digit)
        chosen = np.sort(rng.choice(pool, min(per_digit, len(pool)), replace=False))
        row[0].set_ylabel(plain(names[digit]), rotation=0, labelpad=4, ha="right", va="center")
        for axes in row[len(chosen) :]:
            axes.set_visible(False)
        for axes, index in zip(row, chosen, strict=False):
            _show(axes, images[index])
    return figure


def is_as_in_paper(recordings):
    """True for the paper's sensor and digits, whose figures have the paper's names."""
    sensor = recordings.sensor
    return is_written(sensor.rows, sensor.columns, sensor.classes)


def _duration_s(recordings, events):
    """Seconds to draw: a recording in the published layout may be longer than its sensor's 2 s."""
    return max(recordings.sensor.duration_s, (int(events.time_ns.max(initial=0)) + 1) * 1e-9)


def _names(as_in_paper):
    """Names of a row and a column: the paper's X goes down."""
    return ("X", "Y") if as_in_paper else ("row", "column")


def _cells(axes, rows, columns, as_in_paper):
    """A grid of taxels, numbered as in the paper."""
    axes.hlines(np.arange(rows + 1) - 0.5, -0.5, columns - 0.5, "0.8", linewidth=0.8)
    axes.vlines(np.arange(columns + 1) - 0.5, -0.5, rows - 0.5, "0.8", linewidth=0.8)
    axes.set_xticks(range(columns), range(1, columns + 1))
    axes.set_yticks(range(rows), range(1, rows + 1))
    axes.tick_params(length=0)
    down, right = _names(as_in_paper)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), xlabel=right, ylabel=down)


def _show(axes, image):
    axes.imshow(image, cmap="gray_r", vmin=0, vmax=1)
    axes.set(xticks=[], yticks=[])


def _source(recordings):
    name = plain(recordings.source.name)
    if recordings.source.simulated and "simulated" not in name:
        return f"{name}, simulated"
    return name


def _title(recordings, index):
    name, classes = recordings.ids[index], recordings.sensor.classes
    of = classes[recordings.labels[index]]
    sample = f"sample {plain(shortened(name, 60))} ({_source(recordings)})"
    if classes == DIGITS:
        return f"digit {of}, {sample}"
    if name.startswith(f"{of}/"):  # which names the class
        return sample
    return f"class {plain(shortened(of, 60))}, {sample}"
