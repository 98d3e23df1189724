"""The loss ladder: from CNN to chip, one row a stage, the same samples in each."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from deploy.results import compare

STAGES = ("cnn", "rate-lif", "spiking-lif", "nengo", "simreal", "emulator", "loihi")


@dataclass(frozen=True)
class Rung:
    """One stage of the ladder.

    Attributes
    ----------
    stage : str
    accuracy : float
    accuracy_ci95 : tuple of float
        Wilson interval.
    drop : float or None
        Accuracy lost from the stage above; None in the first row.
    disagreements : int or None
        Samples for which the stage above predicts another digit.
    mcnemar_p : float or None
        Exact McNemar test against the stage above.
    """

    stage: str
    accuracy: float
    accuracy_ci95: tuple
    drop: float | None
    disagreements: int | None
    mcnemar_p: float | None


def climb(results) -> list:
    """Compare each result with the one before it.

    Parameters
    ----------
    results : sequence of dict
        Check results of the same bundle, in the order of the stages.

    Returns
    -------
    list of Rung

    Raises
    ------
    UserError
        They are of different bundles or samples.
    """
    rungs, above = [], None
    for result in results:
        against = compare(above, result) if above is not None else None
        rungs.append(
            Rung(
                stage=result["target"],
                accuracy=result["accuracy"],
                accuracy_ci95=tuple(result["accuracy_ci95"]),
                drop=against and against.accuracy_drop,
                disagreements=against and len(against.disagreements),
                mcnemar_p=against and against.p_value,
            )
        )
        above = result
    return rungs


def ladder_json(results) -> dict:
    """The ladder as plain values."""
    first = results[0]
    return {
        "schema": "stmnist-ladder/1",
        "bundle": first["bundle"],
        "simulated": first["simulated"],
        "n_samples": first["n_samples"],
        "rows": [asdict(rung) for rung in climb(results)],
    }


def ladder_text(ladder: dict) -> str:
    """The ladder as a table."""
    what = "simulated samples" if ladder["simulated"] else "samples"
    lines = [
        f"Loss ladder, {ladder['n_samples']} {what}, each stage on the same ones",
        f"{'stage':<12} {'accuracy':>8}  {'95 % interval':<15} {'drop':>6}  {'disagree':>8}",
    ]
    for row in ladder["rows"]:
        low, high = row["accuracy_ci95"]
        line = f"{row['stage']:<12} {row['accuracy']:>8.3f}  {low:.3f} to {high:.3f} "
        if row["drop"] is not None:
            # "+ 0.0" keeps a rounded -0.0 from being printed as such
            line += f" {round(row['drop'], 3) + 0.0:>+6.3f}  {row['disagreements']:>8}"
        lines.append(line.rstrip())
    first, last = ladder["rows"][0], ladder["rows"][-1]
    lines.append(
        f"from {first['stage']} to {last['stage']}: "
        f"{100 * (first['accuracy'] - last['accuracy']) + 0.0:.1f} points lost"
    )
    return "\n".join(lines)
