"""The figure beside the loss ladder: a confusion matrix of each stage."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure

from pipeline.results.report.figures import plain
from pipeline.results.report.matrix import confusion_shares, names_beside


def confusion_figure(ladder: dict) -> Figure:
    """A confusion matrix of counts for each stage, shaded by the share of the label's samples.

    Parameters
    ----------
    ladder : dict
        From :func:`pipeline.results.ladder.ladder_json`.
    """
    rows = ladder["rows"]
    columns = math.ceil(math.sqrt(len(rows)))
    lines = -(-len(rows) // columns)
    figure = Figure(figsize=(4 * columns, 4.1 * lines + 0.3), layout="constrained")
    kind = "simulated samples" if ladder["simulated"] else "samples"
    figure.suptitle(f"Confusion matrices, the same {ladder['n_samples']} {kind} in each")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in panels[len(rows) :]:
        axes.set_visible(False)
    for position, (axes, row) in enumerate(zip(panels, rows, strict=False)):
        _matrix(axes, np.array(row["confusion"]), ladder.get("classes"))
        axes.set_title(f"{row['stage']}: {row['accuracy']:.3f}", fontsize=11)
        if position % columns == 0:
            axes.set_ylabel("label")
        if position >= len(rows) - columns:
            axes.set_xlabel("prediction")
    return figure


def _matrix(axes, counts, names=None):
    shares = confusion_shares(counts)
    # The square root makes the few errors visible beside the many right answers.
    axes.imshow(np.sqrt(shares), cmap="Blues", vmin=0, vmax=1)
    for (label, prediction), count in np.ndenumerate(counts):
        if count:
            dark = shares[label, prediction] > 0.4
            axes.text(
                *(prediction, label, count),
                ha="center",
                va="center",
                fontsize=7.5,
                color="white" if dark else "black",
                weight="bold" if label == prediction else "normal",
            )
    classes = range(len(counts))
    names = [plain(name) for name in names_beside(names, len(counts))]
    axes.set_xticks(classes, names, rotation=90 if max(map(len, names)) > 2 else 0)
    axes.set_yticks(classes, names)
    axes.tick_params(length=0)
