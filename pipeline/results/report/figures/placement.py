"""A picture of the placement of the network on the chips, and the use of its cores."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from deploy.preflight.plan import CORES_PER_CHIP, Plan
from deploy.preflight.resources import LIMITS

COLUMNS = 16
COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"]
FREE = "#eeeeee"


def placement_figure(plan: Plan) -> Figure:
    """Draw a plan: the chips with the cores in use, and what each core uses of its limits.

    Parameters
    ----------
    plan : Plan

    Returns
    -------
    matplotlib.figure.Figure
    """
    names = list(dict.fromkeys(core.layer for core in plan.cores))
    colour = {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}
    height = max(3.2, 1 + 0.25 * len(plan.cores), 2.8 * plan.chips)
    figure = Figure(figsize=(11, min(height, 30)), layout="constrained")
    chips, bars = figure.subplots(1, 2, width_ratios=[1, 1.15])
    _draw_chips(chips, plan, colour)
    _draw_shares(bars, plan, colour)
    return figure


def _draw_chips(axes, plan, colour):
    rows = CORES_PER_CHIP // COLUMNS
    used = {(core.chip, core.core): core for core in plan.cores}
    for chip in range(plan.chips):
        top = chip * (rows + 1.5)
        axes.text(0, top - 0.25, f"chip {chip}", va="bottom", fontsize=9)
        for index in range(CORES_PER_CHIP):
            row, column = divmod(index, COLUMNS)
            core = used.get((chip, index))
            face = FREE if core is None else colour[core.layer]
            axes.add_patch(Rectangle((column + 0.06, top + row + 0.06), 0.88, 0.88, facecolor=face))
            if core is not None:
                axes.text(
                    column + 0.5, top + row + 0.5, str(core.part), color="white",
                    ha="center", va="center", fontsize=7,
                )  # fmt: skip
    for name, value in colour.items():
        axes.plot([], [], "s", color=value, label=name)
    axes.plot([], [], "s", color=FREE, label="free")
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, 0), ncols=4, frameon=False, fontsize=8,
        title="cores; the number is the layer's part", title_fontsize=8,
    )  # fmt: skip
    axes.set(xlim=(-0.2, COLUMNS + 0.2), ylim=(plan.chips * (rows + 1.5), -1.2), aspect="equal")
    axes.axis("off")


def _draw_shares(axes, plan, colour):
    """A table with a row per core and a column per limit; cells are filled by the share used."""
    for row, core in enumerate(plan.cores):
        for column, resource in enumerate(LIMITS):
            share = core.share(resource)
            axes.add_patch(Rectangle((column + 0.03, row + 0.08), 0.94, 0.84, facecolor=FREE))
            full = min(share, 1) * 0.94
            face = colour[core.layer] if share <= 1 else "#b00000"
            axes.add_patch(
                Rectangle((column + 0.03, row + 0.08), full, 0.84, facecolor=face, alpha=0.55)
            )
            axes.text(
                column + 0.5, row + 0.5, f"{core.used[resource]}  ({share:.0%})",
                ha="center", va="center", fontsize=7,
            )  # fmt: skip
    for column, (resource, limit) in enumerate(LIMITS.items()):
        axes.text(
            column + 0.5, -0.1, f"{resource}\nof {limit}", ha="center", va="bottom", fontsize=8
        )
    names = [f"{core.layer}[{core.part}]  {core.chip}.{core.core}" for core in plan.cores]
    axes.set_yticks([row + 0.5 for row in range(len(names))], names, fontsize=8)
    axes.set_xticks([])
    axes.tick_params(length=0)
    axes.set(xlim=(0, len(LIMITS)), ylim=(max(len(names), 8), -1.2))
    axes.spines[:].set_visible(False)
