"""The accuracy of the paper's CNN on recordings, with the paper's protocol.

The variation of the simulated writers (``parameters.toml``) was set once so that this accuracy is
near the paper's 0.89; it is not fitted to any other network.

``python -m experiments difficulty``
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from deploy.errors import UserError
from deploy.files import write_json
from pipeline import stages
from pipeline.artifacts import Origin
from pipeline.commands import options
from pipeline.paper import TABLE2
from pipeline.results.study import (
    Experiment,
    Task,
    counted,
    measure_splits,
    silent,
    summary_of_splits,
)
from pipeline.roads.origins import cnn_origin
from pipeline.settings import Settings
from pipeline.skin.parameters import CALIBRATION

SCHEMA = "stmnist-difficulty/1"
AIM = (0.86, 0.92)
"""Intended mean accuracy on the built-in recordings; the paper has 0.89 (Table 2)."""

RECORD = CALIBRATION.with_name("difficulty.json")
"""The last measurement on the built-in recordings, with their hash."""


def result_origin(settings: Settings, dataset: Origin, subject: str = "") -> Origin:
    """The origin of the result of a split."""
    return Origin.of(settings, uses=[cnn_origin(settings, dataset)], contents={"schema": SCHEMA})


def measure(task: Task) -> dict:
    """Test accuracy of the CNN on a random split (paper, Section 3.2)."""
    dataset = task.dataset()
    metrics = stages.train("cnn", task.networks, task.settings, dataset, silent)
    return {
        "schema": SCHEMA,
        **counted(task, dataset),
        "accuracy": metrics["accuracy"]["test"],
    }


def summarise(results, simulated: bool) -> dict:
    """Mean and SD over splits; SD is None for one split."""
    accuracies = [result["accuracy"] for result in results]
    return {
        "schema": SCHEMA,
        **summary_of_splits(results, simulated),
        "accuracies": accuracies,
        "mean": float(np.mean(accuracies)),
        "sd": float(np.std(accuracies, ddof=1)) if len(accuracies) > 1 else None,
    }


def difficulty_text(summary: dict) -> str:
    """The summary in a line."""
    kind = "simulated" if summary["simulated"] else "recorded"
    spread = "" if summary["sd"] is None else f" (SD {summary['sd']:.4f})"
    paper = "{:.2f} ({:.2f})".format(*TABLE2["cnn"])
    return (
        f"{kind}: accuracy {summary['mean']:.4f}{spread} over {len(summary['seeds'])} splits; "
        f"paper {paper}"
    )


EXPERIMENT = Experiment("difficulty", measure, summarise, result_origin, difficulty_text)


def main(
    out: Annotated[
        Path, typer.Option(help="Folder of the results; splits with a result are not run again.")
    ] = Path("runs/difficulty"),
    splits: Annotated[int, typer.Option(help="Random 80-20 splits.", min=1)] = 10,
    *,
    given: options.DataGiven,
    store: Annotated[
        bool, typer.Option("--store", help="Save the result with the simulation's settings.")
    ] = False,
    workers: options.Workers,
    as_json: options.Json = False,
):
    """Measure the accuracy of the paper's CNN on the recordings, with the paper's protocol.

    An interrupted measurement continues with the remaining splits.
    """
    with options.opened(out, given) as (folder, resolved):
        if store and resolved != Settings():
            raise UserError(
                f"--store: keeps the accuracy on the built-in recordings, and {out} is of other "
                "settings; leave out --data and --set, or name another folder with --out"
            )
        found = measure_splits(EXPERIMENT, folder, resolved, splits, workers, options.say)
    if store and not found.failed:
        write_json(RECORD, found.summary)
    options.conclude(found, difficulty_text, as_json)
