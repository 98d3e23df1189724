"""Gathering the results of a run and of a benchmark for a report."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from deploy.check.bundle import read_bundle
from deploy.check.results import is_share, read_result
from deploy.errors import UserError
from deploy.files import read_json
from deploy.preflight.plan import make_plan
from pipeline.data.library import recordings_of
from pipeline.experiments.table2_splits import WITH_SLAYER, split_file
from pipeline.progress import progress
from pipeline.results.elsewhere import FOLDER as OTHERS
from pipeline.results.ladder import ladder_stages
from pipeline.results.report.over_time import probabilities
from pipeline.results.report.page import Inputs, browsed_samples, choose_samples, trained_title
from pipeline.results.report.replay import replay
from pipeline.results.status import outdated, status_of
from pipeline.run import RunFolder, refuse_results
from pipeline.settings import Settings, read_settings
from pipeline.training.history import read_history

REMEDY = "delete it and make it again"

MANY_CHIPS = 10_000
"""More chips than any system has: the report says how many a network needs."""

FASTEST = 1e6
"""Spikes per second, an upper bound for all neurons."""


def gather(
    folder: RunFolder, benchmark: Path, jobs: int, say, beside: RunFolder | None = None
) -> Inputs:
    """Read a run and the benchmark of Table 2, and replay the samples of the report.

    Parameters
    ----------
    folder : RunFolder
    benchmark : Path
        Folder of the benchmark; it need not exist.
    jobs : int
        Processes for recordings that are not in the cache.
    say : callable
        Called with a message about results that are left out.
    beside : RunFolder, optional
        A run on images with the same recordings, to be compared with this run on events.

    Raises
    ------
    UserError
        There is no run or no check result, a file is damaged, or the recordings have changed; the
        run beside it has other recordings or is not on images.
    """
    refuse_results(folder.path)
    settings = read_settings(folder.experiment)
    bundle = read_bundle(folder.bundle)
    results = _results(folder, bundle, settings.network)
    recordings = recordings_of(settings, jobs)
    unknown = set(bundle.checks.ids) - set(recordings.ids)
    made_from = bundle.spec.provenance.get("source_sha256")
    if made_from != recordings.source.sha256 or unknown:
        raise UserError(
            f"{folder.bundle}: made from other recordings than {settings.data.source} gives now; "
            f"run 'stmnist ladder {folder.path}' again"
        )
    table, table_settings, answers, curves = _read_benchmark(benchmark, recordings, say)
    # The run may have had another kind of network before, whose files are still there.
    networks = {"snn": folder.snn}
    if settings.network == "image":
        networks = {"cnn": folder.cnn, **networks}
    titles = {"cnn": "CNN", "snn": trained_title(settings)}
    histories = {
        titles[name]: read_history(path / "history.csv")
        for name, path in networks.items()
        if settings.network != "nir" and (path / "history.csv").exists()
    }
    chosen = []
    if results[-1]["spikes"]:
        chosen = choose_samples(results[-1], bundle.spec.presentation.stream_length)
    replays = {}
    with progress("replay samples", len(chosen)) as advance:
        for index in chosen:
            replays[index] = replay(bundle, index, settings.seed)
            advance()
    browsed = browsed_samples(results[-1]) if results[-1]["spikes"] else []
    return Inputs(
        name=str(folder.path),
        settings=settings,
        recordings=recordings,
        bundle=bundle,
        results=results,
        metrics={
            name: _metrics(path / "metrics.json")
            for name, path in networks.items()
            if (path / "metrics.json").exists()
        },
        histories={**histories, **curves},
        table2=table,
        table2_settings=table_settings,
        answers=answers,
        plan=make_plan(bundle.spec, MANY_CHIPS).to_json(),
        replays=replays,
        over_time=probabilities(bundle, browsed, settings.seed) if browsed else {},
        others=_others(folder, bundle),
        rates=_rates(folder, bundle),
        beside=beside and _beside(beside, bundle, settings),
        outdated=_outdated(folder, beside),
    )


def _outdated(folder, beside):
    """Reasons why results are outdated, by their names; those of the run beside with its path."""
    reasons = outdated(status_of(folder))
    if beside is not None:
        others = outdated(status_of(beside))
        reasons |= {f"{beside.path}/{name}": why for name, why in others.items()}
    return reasons


def _rates(folder, bundle):
    """Rates of neurons in the trained network and on the chip, if the ladder is for this bundle."""
    if not folder.ladder.exists():
        return {}
    ladder = read_json(folder.ladder, REMEDY)
    if ladder.get("bundle") != bundle.id:
        return {}
    rates = ladder.get("rates", {})
    if not isinstance(rates, dict) or not all(map(_is_rates, rates.values())):
        raise UserError(f"{folder.ladder}: 'rates' is not pairs of firing rates; {REMEDY}")
    return rates


def _is_rates(pairs):
    """Whether a value of a file is a list of pairs of firing rates, in spikes per second."""
    try:
        rates = np.array(pairs, float).reshape(-1, 2)
    except (TypeError, ValueError, OverflowError):
        return False
    return (
        isinstance(pairs, list)
        and len(rates) == len(pairs)
        and bool(np.all((rates >= 0) & (rates <= FASTEST)))
    )


def _others(folder, bundle):
    """Results of the bundle on other recordings; see :mod:`pipeline.results.elsewhere`."""
    files = sorted((folder.path / "checks" / OTHERS).glob("*.json"))
    results = [read_result(path, REMEDY) for path in files]
    return [r for r in results if r["bundle"] == bundle.id and "per_class" in r and "data" in r]


def _beside(folder, bundle, settings):
    """The last result of a run on images with the recordings of a bundle on events."""
    other, kinds = read_bundle(folder.bundle), ("image", "events")
    if (read_settings(folder.experiment).input.kind, settings.input.kind) != kinds:
        raise UserError(
            f"{folder.path}: --beside needs a run on images, and a report of a run on events"
        )
    made_from = [b.spec.provenance.get("source_sha256") for b in (other, bundle)]
    if made_from[0] != made_from[1]:
        raise UserError(f"{folder.path}: its bundle was made from other recordings")
    return _results(folder, other, "image")[-1]


def _metrics(path):
    """The metrics of a training, or an error that names the file."""
    metrics = read_json(path, REMEDY)
    accuracy, count = metrics.get("accuracy"), metrics.get("n_test")
    told = isinstance(accuracy, dict) and "test" in accuracy and type(count) is int and count > 0
    if not told or not all(map(is_share, accuracy.values())):
        raise UserError(f"{path}: has no accuracy on the test split; {REMEDY}")
    return metrics


def _results(folder, bundle, kind):
    """The check results of this bundle, in the order of the ladder."""
    results = {
        stage: result
        for stage in ladder_stages(kind)
        if folder.check(stage).exists()
        and (result := read_result(folder.check(stage)))["bundle"] == bundle.id
    }
    for stage, result in results.items():
        whole = all(name in result for name in ("anytime_accuracy", "decided_at_median"))
        whole = whole and [sample["id"] for sample in result["samples"]] == list(bundle.checks.ids)
        whole = whole and result["spikes"].keys() <= set(bundle.spec.spiking_layers)
        if not whole or result["target"] != stage:
            raise UserError(
                f"{folder.check(stage)}: does not fit its name or the bundle's samples and layers; "
                f"delete it and run 'stmnist ladder {folder.path}' again"
            )
    if not results:
        raise UserError(
            f"{folder.path / 'checks'}: no check result of the present bundle; "
            f"run 'stmnist ladder {folder.path}' first"
        )
    return list(results.values())


def _read_benchmark(folder, recordings, say):
    """Existing results: table, settings, answers of the random splits, SLAYER's learning curve."""
    path = folder / "table2.json"
    if not path.exists():
        return None, None, {}, {}
    table = read_json(path, REMEDY)
    if table.get("source_sha256") != recordings.source.sha256:
        say(f"report: {path} is for other recordings and left out")
        return None, None, {}, {}
    try:
        given = table.get("settings")  # a table of an earlier version does not have them
        settings = None if given is None else Settings().with_values(given, str(path))
        answers, curves, n_others = _of_rows(folder, table["rows"])
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise UserError(f"{path}: not a complete table ({error!r}); {REMEDY}") from error
    if n_others:
        say(
            f"report: {folder / 'splits'} has other results than {path}, and {n_others} are left "
            "out of the confusion matrices and learning curves; repeat the benchmark"
        )
    return table, settings, answers, curves


def _of_rows(folder, rows):
    """Answers of the random splits by model, SLAYER's learning curves, number of other results.

    A benchmark that was interrupted has measured results after its last table.
    """
    answers, curves, n_others = {}, {}, 0
    for row in rows:
        results = {}
        for seed, *measured in zip(row["indices"], row["per_split"], row["seconds"], strict=True):
            path = folder / split_file("random", seed, row["model"])
            result = read_json(path, REMEDY) if path.exists() else {}
            if [result.get("accuracy"), result.get("seconds")] == measured:
                results[seed] = result
            else:
                n_others += 1
        if results:
            answers[row["model"]] = tuple(
                np.concatenate([result[key] for result in results.values()])
                for key in ("labels", "predictions")
            )
        if row["model"] in WITH_SLAYER and results:
            seed, result = next(iter(results.items()))
            curves[f"{row['title']}, split {seed}"] = result["history"]
    return answers, curves, n_others
