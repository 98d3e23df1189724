"""The paper's Table 2 from the results of splits: rows, paired comparisons, text."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from deploy.errors import UserError
from deploy.tables import aligned, p_text
from experiments.slayer import Slayer
from experiments.table2_splits import (
    LOIHI_TARGET,
    MODELS,
    ON_EVENTS,
    SECONDS_PER_SAMPLE,
    WITH_SLAYER,
    Benchmark,
    input_of,
    measure,
    split_file,
)
from pipeline.data.dataset import event_warnings, require_recordings_fit
from pipeline.data.library import recordings_of
from pipeline.data.splits import RANDOM, WRITERS, draw_check_samples, split_of
from pipeline.jobs import Failure
from pipeline.results.resampling import estimate
from pipeline.results.study import (
    Findings,
    Workers,
    begin,
    concluded,
    fitted_to_inputs,
    study,
)
from pipeline.run import RunFolder
from pipeline.settings import Settings

COMPARISONS = (
    ("cnn", "ann-snn"),
    ("cnn", "loihi"),
    ("ann-snn", "loihi"),
    ("cnn", "slayer"),
    ("slayer-small", "slayer"),
    ("cnn", "own-ann-snn"),
    ("own-ann-snn", "own-loihi"),
    ("own-loihi", "loihi"),
    ("cnn", "events-loihi"),
    ("own-loihi", "events-loihi"),
    ("events", "events-loihi"),
    ("events", "slayer"),
)
"""Pairs of models whose difference is printed."""

KINDS = (RANDOM, WRITERS)
"""Kinds of splits."""


def measure_table(
    folder: RunFolder,
    settings: Settings,
    models: tuple,
    kind: str,
    splits: int,
    workers: Workers,
    say,
) -> Findings:
    """Measure the missing results of the table, and write it.

    Parameters
    ----------
    folder : RunFolder
        Folder of the results, locked; on a cluster, if possible, a folder that all workers can
        access.
    settings : Settings
    models : tuple of str
        Keys of :data:`experiments.table2_splits.MODELS`.
    kind : str
        One of :data:`KINDS`, ``"both"``, or empty for both where the
        writers are known.
    splits : int
        Number of splits of each kind.
    workers, say
        As in :func:`pipeline.results.study.study`.

    Raises
    ------
    UserError
        There is no such kind, or too few recordings.
    """
    recordings = recordings_of(settings, workers.processes, say)
    kinds = _kinds(kind, recordings)
    settings, on_events = _fitted(settings, recordings, folder.path, models, say)
    try:
        for each, seed in itertools.product(kinds, range(settings.seed, settings.seed + splits)):
            split = split_of(recordings, seed, settings.split.test_fraction, kind=each)
            draw_check_samples(split.test, settings.check.drawn(len(split.test)), seed)
    except ValueError as error:
        raise UserError(
            f"{settings.data.source}: {error}; change --kind, check.samples or the data"
        ) from error
    sha256, path = recordings.source.sha256, folder.path.absolute()
    benchmark = Benchmark(settings, sha256, path, kinds, splits, models, on_events)
    for model in models:
        if model not in WITH_SLAYER:
            require_recordings_fit(recordings, benchmark.settings_of(model))
    begin(folder, settings, say)
    if estimate_of_slayer := _time_of_slayer(benchmark, len(recordings), workers):
        say(estimate_of_slayer)
    results = study("table 2", measure, benchmark.groups(), workers, say)
    failures = {name: found for name, found in results.items() if isinstance(found, Failure)}
    table = summarise(benchmark, failures)
    failed = f"{len(failures)} of {len(results)} results" if failures else ""
    return concluded(folder, "table2", table, failed)


def _fitted(settings, recordings, folder, models, say):
    """The settings for the recordings, and those of models on events or None without any."""
    # The presentation of events is not saved with the settings, which are also those of images.  So
    # it is chosen again for rows that were measured earlier, which stay in the table.
    earlier = [name for name in ON_EVENTS if any(folder.glob(split_file("*", "*", name)))]
    inputs = dict.fromkeys(map(input_of, (*models, *earlier)))
    fits = fitted_to_inputs(settings, inputs, recordings, say)
    for each in fits.values():  # all have the same networks
        settings = replace(settings, cnn=each.cnn, events=each.events)
    if {*models} & {*ON_EVENTS}:
        for line in event_warnings(fits["events"], recordings):
            say(line)
    return settings, fits.get("events")


def _time_of_slayer(benchmark, n_recordings, workers):
    """Estimated time of the missing trainings with SLAYER; None if none is missing."""
    tasks = [task for group in benchmark.groups() for task in group]
    missing = [
        task
        for task in tasks
        if task.subject in WITH_SLAYER and not task.artifact.state().is_current
    ]
    if not missing:
        return None
    slayer = Slayer()
    samples = n_recordings * (1 - benchmark.settings.split.test_fraction)
    seconds = SECONDS_PER_SAMPLE * samples * slayer.epochs * slayer.bins / 200
    each, number = seconds / 60, len(missing)
    line = f"table 2: trainings with SLAYER: {number}, last, about {each:.0f} minutes each"
    if workers.scheduler is not None:
        return line
    minutes = each * -(-number // workers.processes)
    total = f"{minutes:.0f} minutes" if minutes < 60 else f"{minutes / 60:.1f} hours"
    return f"{line}, {total} in all"


def _kinds(kind, recordings):
    if kind not in ("", "both", *KINDS):
        raise UserError(f"--kind {kind!r}: must be random, writers or both")
    if not kind:
        kind = "both" if recordings.writers.min(initial=0) >= 0 else "random"
    return KINDS if kind == "both" else (kind,)


def summarise(benchmark: Benchmark, failures=None) -> dict:
    """Make the table from all results that are up to date, new or existing.

    Parameters
    ----------
    benchmark : Benchmark
    failures : dict of str to Failure, optional
        By the name of the result.

    Returns
    -------
    dict
        Plain values: ``simulated``, ``settings``, ``splits`` (the requested number), ``rows``
        (those of random splits, the paper's protocol), ``writer_rows``, ``comparisons``,
        ``failures``.
    """
    results = {(kind, name): benchmark.results(kind, name) for kind in KINDS for name in MODELS}

    def rows(kind):
        asked = benchmark.models if kind in benchmark.kinds else ()
        return [
            _row(name, results[kind, name])
            for name in MODELS
            if name in asked or results[kind, name]
        ]

    everything = [result for group in results.values() for result in group]
    checked = [
        result["n_test"]
        for (_, name), group in results.items()
        if name.endswith("loihi")
        for result in group
    ]
    return {
        "schema": "stmnist-table2/1",
        "simulated": all(result["simulated"] for result in everything) if everything else None,
        "source_sha256": benchmark.source_sha256,
        "settings": benchmark.settings.to_json(),
        "splits": benchmark.splits,
        "seed": benchmark.settings.seed,
        "check_samples": min(checked, default=benchmark.settings.check.samples),
        "loihi_target": LOIHI_TARGET,
        "rows": rows("random"),
        "writer_rows": rows("writers"),
        "comparisons": [
            comparison
            for kind in KINDS
            for a, b in COMPARISONS
            if (comparison := _compare(kind, a, b, results)) is not None
        ],
        "failures": [
            {"result": name, "error": failure.error} for name, failure in (failures or {}).items()
        ],
    }


def _row(name, results):
    paper = MODELS[name].paper or (None, None)
    accuracies, n_test = [result["accuracy"] for result in results], _mean(results, "n_test")
    got = estimate(accuracies, _mean(results, "n_train"), n_test) if results else None
    low, high = got.interval if got and got.interval else (None, None)
    return {
        "model": name,
        "title": MODELS[name].title,
        "accuracy_mean": got and got.mean,
        "accuracy_sd": got and got.sd,
        "accuracy_ci95": None if low is None else [max(low, 0.0), min(high, 1.0)],
        "paper_mean": paper[0],
        "paper_sd": paper[1],
        "per_split": accuracies,
        "indices": [result["seed"] for result in results],
        "n_test": n_test,
        "seconds": [result["seconds"] for result in results],
    }


def _mean(results, size):
    """Mean of a number of samples over splits; it varies between splits by writer."""
    return float(np.mean([result[size] for result in results])) if results else None


def _compare(kind, a, b, results):
    """Accuracy of a minus that of b, on the samples of each split that both have in common."""
    of_b = {result["seed"]: result for result in results[kind, b]}
    pairs = [(r, of_b[r["seed"]]) for r in results[kind, a] if r["seed"] in of_b]
    if not pairs:
        return None
    differences, n_shared = [], []
    for one, two in pairs:
        right = [
            {s: p == y for s, p, y in zip(r["samples"], r["predictions"], r["labels"], strict=True)}
            for r in (one, two)
        ]
        shared = sorted(right[0].keys() & right[1].keys())
        n_shared.append(len(shared))
        differences.append(float(np.mean([right[0][s] - right[1][s] for s in shared])))
    n_test = float(np.mean(n_shared))
    got = estimate(differences, _mean([one for one, _ in pairs], "n_train"), n_test)
    return {
        "split": kind,
        "a": a,
        "b": b,
        "difference": got.mean,
        "ci95": got.to_json()["ci95"],
        "p_value": got.p_value,
        "n_splits": len(pairs),
        "n_samples": n_test,
    }


def table_text(table: dict) -> str:
    """The table as text, with the paper's figures next to ours."""
    what = "simulated recordings" if table["simulated"] else "recordings"
    lines = [f"Table 2 of the paper, on {what}; mean (SD) of the accuracy over splits"]
    if table["simulated"]:
        lines.append("The paper's figures are for real recordings and cannot be compared directly.")
    for key, heading in (
        ("rows", "random 80-20 splits, as in the paper"),
        ("writer_rows", "new writers in the test set"),
    ):
        if not table[key]:
            continue
        heads = [heading, "ours", "95 % interval", "splits", "paper"]
        lines += ["", *aligned([heads, *map(_cells, table[key])])]
    if table["comparisons"]:
        lines += ["", "paired differences, on the same samples of the same splits"]
        for c in table["comparisons"]:
            interval = "" if c["ci95"] is None else f"  [{_signed(c['ci95'])}]  p {_p(c)}"
            lines.append(
                f"  {c['split']:<8} {c['a']} minus {c['b']}: {c['difference']:+.3f}{interval}"
            )
    if any(row["model"].endswith("loihi") for row in (*table["rows"], *table["writer_rows"])):
        lines += [
            "",
            f"The target '{table['loihi_target']}' replaces Loihi, on {table['check_samples']} "
            "test samples per split.",
        ]
    for failure in table["failures"]:
        lines.append(f"FAILED: {failure['result']}: {failure['error']}")
    return "\n".join(lines)


def _cells(row):
    paper = "" if row["paper_mean"] is None else f"{row['paper_mean']:.2f} ({row['paper_sd']:.2f})"
    if row["accuracy_mean"] is None:
        return [row["title"], "not run", "", "0", paper]
    # A missing SD is replaced by blanks, so that the means are aligned.
    sd = " " * 8 if row["accuracy_sd"] is None else f" ({row['accuracy_sd']:.3f})"
    interval = row["accuracy_ci95"]
    interval = "" if interval is None else f"{interval[0]:.3f} to {interval[1]:.3f}"
    ours = f"{row['accuracy_mean']:.3f}{sd}"
    return [row["title"], ours, interval, str(len(row["per_split"])), paper]


def _signed(interval):
    return ", ".join(f"{bound:+.3f}" for bound in interval)


def _p(comparison):
    text = p_text(comparison["p_value"])
    return text if text.startswith("<") else f"= {text}"
