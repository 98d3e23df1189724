"""Gathering the results of a run for a report."""

from __future__ import annotations

import numpy as np

from deploy.check.bundle import read_bundle
from deploy.check.results import is_share, read_result
from deploy.errors import UserError
from deploy.files import read_json
from deploy.preflight.plan import make_plan
from pipeline.data.library import recordings_of
from pipeline.progress import progress
from pipeline.results.elsewhere import FOLDER as OTHERS
from pipeline.results.ladder import ladder_stages
from pipeline.results.report.over_time import probabilities
from pipeline.results.report.page import Inputs, browsed_samples, choose_samples, trained_title
from pipeline.results.report.replay import replay
from pipeline.results.status import outdated, status_of
from pipeline.run import RunFolder, refuse_results
from pipeline.settings import read_settings
from pipeline.training.history import read_history

REMEDY = "delete it and make it again"

MANY_CHIPS = 10_000
"""More chips than any system has: the report says how many a network needs."""

FASTEST = 1e6
"""Spikes per second, an upper bound for all neurons."""


def gather(folder: RunFolder, jobs: int, beside: RunFolder | None = None) -> Inputs:
    """Read a run, and replay the samples of the report.

    Parameters
    ----------
    folder : RunFolder
    jobs : int
        Processes for recordings that are not in the cache.
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
        histories=histories,
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
