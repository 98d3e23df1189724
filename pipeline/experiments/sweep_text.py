"""A sweep as a table, for reading and for spreadsheets."""

from __future__ import annotations

import csv
import io
import textwrap


def short_names(names) -> dict:
    """Each setting's last word, or all of its name where two settings share that."""
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
        From :func:`pipeline.experiments.sweep.summarise`.
    """
    short = short_names(sweep["names"])
    widths = {
        name: max(len(short[name]), *(len(_value(p["changes"][name])) for p in sweep["points"]))
        if sweep["points"]
        else 0
        for name in sweep["names"]
    }
    lines = []
    if sweep["points"]:
        first = sweep["points"][0]
        kind = "simulated validation samples" if first["simulated"] else "validation samples"
        lines.append(f"{len(sweep['points'])} points, each on the same {first['n_samples']} {kind}")
        header = "  ".join(f"{short[name]:>{widths[name]}}" for name in sweep["names"])
        lines.append(
            f"   #  accuracy  95 % interval   operations  shown  decided  rate-lif    cnn  {header}"
        )
    for number, point in enumerate(sweep["points"], 1):
        low, high = point["accuracy_ci95"]
        values = "  ".join(
            f"{_value(point['changes'][name]):>{widths[name]}}" for name in sweep["names"]
        )
        lines.append(
            f"{'*' if point['pareto'] else ' '}{number:>3}  {point['accuracy']:>8.3f}  "
            f"{low:.3f} to {high:.3f}  {point['operations_per_mac']:>8.2f} x  {point['steps']:>5}"
            f"  {point['decided_at_median']:>7.0f}  {point['rate_accuracy']:>8.3f}"
            f"  {point['cnn_accuracy']:>5.3f}  {values}"
        )
    if sweep["points"]:
        lines += [
            "* on the Pareto front: no other point is at least as good in accuracy, operations and",
            "steps and better in one of them",
            "operations: synaptic, an inference, in multiples of the CNN's multiply-accumulates;",
            "shown: steps of 1 ms; decided: step from which half the samples' decisions stay",
        ]
    for point in sweep["failed"]:
        what = ", ".join(f"{k}={_value(v)}" for k, v in point["changes"].items())
        lines.append(f"failed: {what}: {textwrap.shorten(point['error'], 120)}")
    return "\n".join(lines)


def sweep_csv(sweep: dict) -> str:
    """One row a point, settings first; a failed one has only those and its error."""
    figures = [
        *("pareto", "accuracy", "accuracy_low", "accuracy_high", "operations"),
        *("operations_per_mac", "steps", "decided_at_median", "rate_accuracy", "cnn_accuracy"),
        *("n_samples", "simulated"),
    ]
    text = io.StringIO()
    writer = csv.DictWriter(text, [*sweep["names"], *figures, "error"], lineterminator="\n")
    writer.writeheader()
    for point in sweep["points"]:
        low, high = point["accuracy_ci95"]
        row = {**point, "accuracy_low": low, "accuracy_high": high}
        writer.writerow({**_values(point), **{name: row[name] for name in figures}})
    for point in sweep["failed"]:
        writer.writerow({**_values(point), "error": point["error"]})
    return text.getvalue()


def _values(point):
    return {name: _value(value) for name, value in point["changes"].items()}


def _value(value):
    return ",".join(map(_value, value)) if isinstance(value, (list, tuple)) else f"{value}"
