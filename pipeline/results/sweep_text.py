"""A sweep as a table, for reading and for spreadsheets."""

from __future__ import annotations

import csv
import io
import textwrap

from deploy.tables import in_blocks
from pipeline.paper import CNN_MACS


def short_names(names) -> dict:
    """The last word of each setting's name, or the whole name if the last word is not unique."""
    last = [name.rpartition(".")[2] for name in names]
    return {
        name: word if last.count(word) == 1 else name
        for name, word in zip(names, last, strict=True)
    }


def sweep_text(sweep: dict) -> str:
    """The points as a table, those of the Pareto front marked.

    Parameters
    ----------
    sweep : dict
        From :func:`pipeline.results.sweep.summarise`.
    """
    short, points, lines = short_names(sweep["names"]), sweep["points"], []
    if points:
        kind = "simulated validation samples" if points[0]["simulated"] else "validation samples"
        figures = ["accuracy", "95 % interval", "operations", "cores", "presented", "stable"]
        figures += ["trained", "cnn"]
        rows = [["", "#", *figures, *(short[name] for name in sweep["names"])]]
        for number, point in enumerate(points, 1):
            low, high = point["accuracy_ci95"]
            rows.append(
                [
                    "*" if point["pareto"] else "",
                    str(number),
                    f"{point['accuracy']:.3f}",
                    f"{low:.3f} to {high:.3f}",
                    f"{point['operations_per_mac']:.2f} x",
                    str(point["cores"]),
                    str(point["steps"]),
                    "" if (stable := point["stable_after_median"]) is None else f"{stable:.0f}",
                    f"{point['trained_accuracy']:.3f}",
                    "" if point["cnn_accuracy"] is None else f"{point['cnn_accuracy']:.3f}",
                    *(_value(point["changes"][name]) for name in sweep["names"]),
                ]
            )
        lines = [
            f"{len(points)} points, each on the same {points[0]['n_samples']} {kind}",
            *in_blocks(rows, left=2),
            "* on the Pareto front: no other point is at least as good in accuracy,",
            "operations, cores and steps and better in one of them",
            f"operations: synaptic, per inference, in multiples of the paper's CNN's {CNN_MACS:,}",
            "presented: steps per sample",
            "stable: median step after which the answer did not change",
        ]
    for point in sweep["failed"]:
        what = ", ".join(f"{k}={_value(v)}" for k, v in point["changes"].items())
        lines.append(f"failed: {what}: {textwrap.shorten(point['error'], 120)}")
    return "\n".join(lines)


def sweep_csv(sweep: dict) -> str:
    """A table with one row per point, settings first; a failed point has no other values."""
    figures = [
        *("pareto", "accuracy", "accuracy_low", "accuracy_high", "operations"),
        *("operations_per_mac", "cores", "steps", "stable_after_median"),
        *("trained_accuracy", "cnn_accuracy"),
        *("n_samples", "simulated"),
    ]
    text = io.StringIO()
    columns = [*sweep["names"], *figures, "error"]
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for point in [*sweep["points"], *sweep["failed"]]:
        low, high = point.get("accuracy_ci95", (None, None))
        changes = {name: _value(value) for name, value in point["changes"].items()}
        writer.writerow({**point, **changes, "accuracy_low": low, "accuracy_high": high})
    return text.getvalue()


def _value(value):
    return ",".join(map(_value, value)) if isinstance(value, (list, tuple)) else f"{value}"
