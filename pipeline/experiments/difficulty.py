"""The accuracy of the paper's CNN on recordings, under the paper's protocol.

The simulated people's variation (``parameters.toml``) was set once so that this accuracy is near
the paper's 0.89; it is not fitted to any other network.
"""

from __future__ import annotations

import numpy as np

from deploy.files import write_json
from pipeline.artifacts import Origin
from pipeline.experiments.study import (
    Experiment,
    Findings,
    Task,
    Workers,
    measure_splits,
    summary_of_splits,
)
from pipeline.paper import TABLE2
from pipeline.run import stages
from pipeline.run.folder import RunFolder
from pipeline.run.origins import cnn_origin
from pipeline.settings import Settings
from pipeline.skin.parameters import CALIBRATION

SCHEMA = "stmnist-difficulty/1"
AIM = (0.86, 0.92)
"""Mean accuracy that the built-in recordings are meant to give; the paper has 0.89 (Table 2)."""

RECORD = CALIBRATION.with_name("difficulty.json")
"""The last measurement on the built-in recordings, with their hash."""


def measure_difficulty(
    folder: RunFolder, settings: Settings, splits: int, workers: Workers, say
) -> Findings:
    """Measure the random splits that have no result yet, and write the summary of all.

    Parameters
    ----------
    folder : RunFolder
        Of the results, locked.
    settings : Settings
    splits : int
        How many, from the settings' own seed on.
    workers, say
        As in :func:`pipeline.experiments.study.study`.

    Raises
    ------
    UserError, CheckFailed
        As in :func:`pipeline.experiments.study.measure_splits`.
    """
    experiment = Experiment("difficulty", measure, summarise, result_origin)
    return measure_splits(experiment, folder, settings, splits, workers, say)


def result_origin(settings: Settings, dataset: Origin, subject: str = "") -> Origin:
    """The origin of the result of a split."""
    return Origin.of(settings, uses=[cnn_origin(settings, dataset)], contents={"schema": SCHEMA})


def measure(task: Task) -> dict:
    """Test accuracy of the CNN on a random split (paper, Section 3.2)."""
    dataset = task.dataset()
    metrics = stages.train(task.networks, task.settings, dataset, lambda line: None)
    return {
        "schema": SCHEMA,
        "seed": task.seed,
        "n_train": len(dataset.split.train),
        "n_test": metrics["n_test"],
        "accuracy": metrics["accuracy"]["test"],
    }


def summarise(results, simulated: bool) -> dict:
    """Mean and SD over splits; SD is None for one."""
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


def store(summary: dict):
    """Save a measurement with the simulation's settings, in :data:`RECORD`."""
    write_json(RECORD, summary)
