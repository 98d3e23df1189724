"""The figure of a sweep: accuracy against synaptic operations, presentation time by colour."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter


def pareto(sweep: dict) -> Figure:
    """Draw the points with intervals; those of the front are filled and numbered as in the table.

    Parameters
    ----------
    sweep : dict
        From :func:`pipeline.results.sweep.summarise`, with at least one point.
    """
    points = sweep["points"]
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    axes = figure.subplots()
    all_steps = sorted({point["steps"] for point in points})
    shades = colormaps["viridis"](np.linspace(0, 0.85, len(all_steps)))
    for steps, shade in zip(all_steps, shades, strict=True):
        mine = [point for point in points if point["steps"] == steps]
        for point in mine:
            _point(axes, point, shade)
        front = sorted((p["per_cnn"], p["accuracy"]) for p in mine if p["pareto"])
        axes.plot(*zip(*front, strict=True) if front else ((), ()), "-", color=shade, alpha=0.6)
        axes.plot([], [], "o", color=shade, label=f"{steps} steps")
    for number, point in enumerate(points, 1):
        if point["pareto"]:
            axes.annotate(
                str(number),
                (point["per_cnn"], point["accuracy"]),
                xytext=(6, 5),
                textcoords="offset points",
                fontsize=9,
            )
    if min(point["per_cnn"] for point in points) > 0:
        axes.set_xscale("log")
    _plain_ticks(axes, [point["per_cnn"] for point in points])
    axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=None))
    kind = "simulated validation samples" if points[0]["simulated"] else "validation samples"
    axes.set(
        xlabel="synaptic operations an inference / multiply-accumulates of the paper's CNN",
        ylabel=f"accuracy on {points[0]['n_samples']} {kind}",
        title="Accuracy against cost: fast emulator, bars are 95 % intervals",
    )
    axes.plot([], [], "o", markerfacecolor="white", color="0.3", label="not on the front")
    figure.legend(loc="outside right upper", fontsize=9)
    axes.grid(alpha=0.25)
    return figure


def _point(axes, point, shade):
    low, high = point["accuracy_ci95"]
    axes.errorbar(
        point["per_cnn"],
        point["accuracy"],
        yerr=[[point["accuracy"] - low], [high - point["accuracy"]]],
        fmt="o",
        color=shade,
        markerfacecolor=shade if point["pareto"] else "white",
        elinewidth=0.7,
        alpha=1 if point["pareto"] else 0.6,
        zorder=3 if point["pareto"] else 2,
    )


def _plain_ticks(axes, values):
    """Ticks at 1, 2 and 5 in each visible decade, as plain numbers."""
    low, high = 0.8 * min(values), 1.25 * max(values)
    if low <= 0:
        return
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    ticks = [
        tick
        for decade in decades
        for tick in (m * 10.0**decade for m in (1, 1.5, 2, 3, 5, 7))
        if low <= tick <= high
    ]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlim(low, high)
