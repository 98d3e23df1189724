"""Measure the figures of README and docs again: the files in ``results/``.

``python -m tools.results --list`` lists which files are current, why others are not, and how long
each takes; ``python -m tools.results`` measures those that are not, quick ones first, and
``python -m tools.results losses`` only that one.  Each measurement is a command of ``stmnist`` that
continues where it was interrupted, in a folder below ``--work``.  Afterwards
``python -m tools.documentation`` writes the figures into the documents.
"""

from __future__ import annotations

import datetime
import json
import os
import platform
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from deploy.check.intervals import mcnemar
from deploy.errors import UserError
from deploy.files import read_json, sha256_of, write_json
from deploy.tables import aligned
from pipeline.artifacts import CURRENT, Artifact, Origin
from pipeline.commands.main import run_tool
from pipeline.data.library import recordings_of
from pipeline.experiments.table2_splits import WITH_SLAYER
from pipeline.settings import Settings
from tools.figures import FOLDER

IMAGES = "cnn,ann-snn,loihi,own-ann-snn,own-loihi"
ARCHITECTURES = (
    "10x10-6c4-24c3-10o,10x10-12c4s2-64-10o,10x10-12c3-2a-48-10o,10x10-8c3s2p-24c3p-10o,"
    "10x10-16c3s2p-32-10o,10x10-8c4s2-32c3-10o,10x10-12c4s3-48-10o,10x10-6c4-16c3s2-10o"
)
SEEDS = 5
"""Seeds of the networks on events."""

DRAWS = 5
"""Draws of the recordings to which a network is fitted, for each person."""

ADAPTED = "readout,wrong-labels,pes,all-layers"
"""Methods of fitting a network on events to a person."""

SMALLER = ("--set", "data.samples_per_digit=400", "--set", "events.epochs=30")
"""Recordings and epochs of networks on events that are trained for a fold of people."""

CHIP = ("tensorflow", "numpy", "nengo", "nengo-dl", "nengo-loihi")
SLAYER = ("numpy", "numba")


KEPT = FOLDER / "slayer"
"""Results of splits with SLAYER: ``random-00/slayer.json`` and so on."""


@dataclass(frozen=True)
class Work:
    """Where and how a result is measured.

    Attributes
    ----------
    folder : Path
        Folder of all measurements.
    jobs : int
        Processes.
    pen : str
        File of pen trajectories; empty if there is none.
    """

    folder: Path
    jobs: int
    pen: str = ""

    def run(self, *words):
        """Run a command of ``stmnist``.

        Raises
        ------
        UserError
            The command failed and has printed the reason.
        """
        self._run(words)

    def printed(self, *words) -> dict:
        """Run a command with the option ``--json``; return what it prints."""
        return json.loads(self._run([*words, "--json"], stdout=subprocess.PIPE).stdout)

    def _run(self, words, **options):
        words = [str(word) for word in words]
        done = subprocess.run([sys.executable, "-m", "pipeline", *words], **options)
        if done.returncode:
            raise UserError(f"stmnist {' '.join(words)}: exit status {done.returncode}")
        return done

    def summary(self, file: str, *words) -> dict:
        """Run a command with the option ``--out``; return the content of a file that it writes."""
        path = self.folder / file
        self.run(*words, "--out", path.parent, "--jobs", self.jobs)
        return read_json(path, "delete it and run the command again")

    def pen_recordings(self) -> Path:
        """The pen trajectories as recordings, simulated unless those of the same file exist."""
        path = self.folder / f"pen-{sha256_of(self.pen_file())[:8]}.zip"
        if path.exists():
            return path
        self.folder.mkdir(parents=True, exist_ok=True)
        self.run("data", "simulate", "--handwriting", self.pen_file(), "--out", path)
        return path

    def pen_file(self) -> str:
        """The file of pen trajectories.

        Raises
        ------
        UserError
            No file was given, or there is none.
        """
        if not self.pen:
            raise UserError("pen trajectories are needed: --pen pendigits-train.unipen")
        if not Path(self.pen).is_file():
            raise UserError(f"{self.pen}: no such file; check --pen")
        return self.pen


@dataclass(frozen=True)
class Result:
    """A file in ``results/``.

    Attributes
    ----------
    name : str
        Name of the file without ``.json``.
    minutes : int
        Expected duration on two otherwise idle cores.
    measure : callable
        From a :class:`Work` to the content of the file.
    packages : tuple of str
        Packages on which its figures depend, in addition to this one.
    pen : bool
        True if it needs pen trajectories.
    """

    name: str
    minutes: int
    measure: Callable
    packages: tuple
    pen: bool = False

    def artifact(self, recordings: str) -> Artifact:
        """The file of the result on recordings with this hash."""
        return Artifact(self.name, FOLDER / f"{self.name}.json", self.origin(recordings))

    def origin(self, recordings: str) -> Origin:
        """Origin of the result: the built-in recordings and versions of packages."""
        versions = {f"version of {package}": version(package) for package in self.packages}
        return Origin.of(Settings(), contents={"recordings": recordings, **versions})


def _table2(models, kind="both"):
    """Measure rows of Table 2 on ten random splits, ten with new writers, or both."""

    def measure(work):
        words = ("benchmark", "table2", "--models", models, "--kind", kind)
        table = work.summary("table2/table2.json", *words)
        asked = models.split(",")
        for key, of_kind in (("rows", "random"), ("writer_rows", "writers")):
            rows = table[key] if kind in ("both", of_kind) else []
            table[key] = [row for row in rows if row["model"] in asked]
        table["comparisons"] = [
            pair
            for pair in table["comparisons"]
            if {pair["a"], pair["b"]} <= {*asked} and kind in ("both", pair["split"])
        ]
        return table

    return measure


def _slayer(kind):
    """Measure the rows with SLAYER; continues with the splits that the repository has.

    A split takes a quarter of an hour, so each is saved as soon as it is measured.
    """

    def measure(work):
        splits = work.folder / "table2" / "splits"
        for path in _of_slayer(KEPT):
            if not (splits / path).exists():
                _copy(path, KEPT, splits)
        try:
            table = _table2(",".join(WITH_SLAYER), kind)(work)
        finally:
            for path in _of_slayer(splits):
                _copy(path, splits, KEPT)
        return {**table, "last_epochs": {m: _last_epochs(splits, kind, m) for m in WITH_SLAYER}}

    return measure


def _last_epochs(splits, kind, model, count=10):
    """Means over the splits: how much the result depends on the epoch after which training ends."""
    paths = sorted(splits.glob(f"{kind}-*/{model}.json"))
    histories = [read_json(path, "delete it")["history"][-count:] for path in paths]
    tests = np.array([[epoch["test_accuracy"] for epoch in history] for history in histories])
    return {
        "test_accuracy": float(tests.mean()),
        "test_accuracy_sd_of_epochs": float(tests.std(axis=1, ddof=1).mean()),
        "training_accuracy": float(np.mean([history[-1]["accuracy"] for history in histories])),
    }


def _slayer_in_milliseconds(work):
    """The authors' time constants of 10 and 1 steps as milliseconds, on one split, 20 epochs."""
    words = ("--models", "slayer-small", "--kind", "random", "--splits", 1)
    for setting in ("epochs=20", "tau_s=0.01", "tau_r=0.001"):
        words += ("--set", f"slayer.{setting}")
    return work.summary("slayer-milliseconds/table2.json", "benchmark", "table2", *words)


def _of_slayer(folder):
    return [path.relative_to(folder) for path in folder.glob("*/slayer*.json")]


def _copy(path, source, target):
    (target / path).parent.mkdir(parents=True, exist_ok=True)
    content = read_json(source / path, "delete it and run the command again")
    write_json(target / path, content, indent=None)  # thousands of numbers, a line each otherwise


def _benchmark(verb):
    return lambda work: work.summary(f"{verb}/{verb}.json", "benchmark", verb)


def _events_with_pen(work):
    words = ("benchmark", "events", "--data", work.pen_recordings())
    return work.summary("events-pen/events.json", *words)


def _adapt(kind, methods, *settings):
    """Measure networks for people to whom nothing was fitted, before and after fitting them."""

    def measure(work):
        words = ("benchmark", "adapt", "--handwriting", work.pen_file(), "--input", kind)
        words += ("--methods", methods, "--draws", DRAWS)
        return work.summary(f"adapt-{kind}/adapt.json", *words, *settings)

    return measure


def _sweep(*words):
    def measure(work):
        folder = work.folder / ("architectures" if words else "sweep")
        work.run("sweep", folder, *words, "--jobs", work.jobs)
        return read_json(folder / "sweep.json", "delete it and run the command again")

    return measure


def _events(work):
    words = ("benchmark", "events", "--seeds", SEEDS)
    return work.summary("events/events.json", *words)


def _events_over_seeds(work):
    """Each seed of the unchanged events, from the results of the two benchmarks of variants."""
    hands, pens = _events(work), _events_with_pen(work)
    runs = {
        f"simulated hands, seed {seed}": _run_on_events(work, "events", seed)
        for seed in range(SEEDS)
    }
    runs["real pen trajectories, seed 0"] = _run_on_events(work, "events-pen", 0)
    sources = {
        "simulated hands": hands["source_sha256"],
        "real pen trajectories": pens["source_sha256"],
    }
    alone = [run for name, run in runs.items() if name.startswith("simulated hands")]
    return {"simulated": True, "sha256": sources, "runs": runs, "state": _effect_of_state(alone)}


def _run_on_events(work, folder, seed):
    path = work.folder / folder / f"as-is-{seed:02d}.json"
    content = read_json(path, "delete it and run the command again")
    labels = np.array(content["labels"])
    in_stream, from_rest = (
        np.array(content[key]) == labels for key in ("predictions", "predictions_from_rest")
    )
    keys = ("trained", "operations", "agreement", "share", "accuracy_by_itself", "confidence")
    return {
        "fast": float(in_stream.mean()),
        "fast_from_rest": float(from_rest.mean()),
        "only_in_stream": int(np.sum(in_stream & ~from_rest)),
        "only_from_rest": int(np.sum(from_rest & ~in_stream)),
        **{key: content[key] for key in (*keys, "n_test")},
    }


def _effect_of_state(runs):
    """Samples that are right only in a stream or only from rest, over all runs; McNemar's p."""
    samples, first, second = (
        sum(run[key] for run in runs) for key in ("n_test", "only_in_stream", "only_from_rest")
    )
    return {
        "samples": samples,
        "in_stream": float(np.mean([run["fast"] for run in runs])),
        "from_rest": float(np.mean([run["fast_from_rest"] for run in runs])),
        "only_in_stream": first,
        "only_from_rest": second,
        "p_value": mcnemar([1] * first + [0] * second, [0] * first + [1] * second),
    }


def _speed(work):
    """Speed of ``fast`` on bundles of both kinds of input, and on networks of NengoLoihi's users.

    The ratios are of processor time, of two emulators in turns, because other work on the machine
    slows down both.
    """
    found = {}
    for kind in ("image", "events"):
        run = work.folder / f"speed-{kind}"
        work.run("convert", run, "--input", kind, "--jobs", work.jobs)
        found[kind] = work.printed("benchmark", "emulator", run / "bundle")
    networks = work.printed("benchmark", "emulator", "--networks")
    ratios = [row["ratio_emulator"] for row in networks["rows"]]
    return {**found, "networks": {**networks, "lowest": min(ratios), "highest": max(ratios)}}


RESULTS = (
    Result("losses-simulated", 10, _benchmark("losses"), CHIP),
    Result("conversion-simulated", 10, _benchmark("conversion"), CHIP),
    Result("architectures", 10, _sweep("--grid", f"cnn.architecture={ARCHITECTURES}"), CHIP),
    Result("table2-images", 12, _table2(IMAGES), CHIP),
    Result("speed", 15, _speed, (*CHIP, "numba")),
    Result("events-pen", 20, _events_with_pen, CHIP, pen=True),
    Result("adapt-images", 10, _adapt("image", "readout,wrong-labels"), CHIP, pen=True),
    Result("adapt-events", 30, _adapt("events", ADAPTED, *SMALLER), CHIP, pen=True),
    Result("sweep", 15, _sweep(), CHIP),
    Result("table2-events", 80, _table2("events,events-loihi"), CHIP),
    Result("events-simulated", 100, _events, CHIP),
    Result("events-seeds", 1, _events_over_seeds, CHIP, pen=True),
    Result("slayer-milliseconds", 4, _slayer_in_milliseconds, SLAYER),
    Result("table2-slayer-random", 150, _slayer("random"), SLAYER),
    Result("table2-slayer-writers", 150, _slayer("writers"), SLAYER),
)
"""All results, in the order of measurement: quick ones first, events-seeds after its parts."""


def states(recordings: str, results=RESULTS) -> list:
    """The results, each with its :class:`pipeline.artifacts.State`."""
    return [(result, result.artifact(recordings).state()) for result in results]


def listing(found) -> str:
    """The states as a table, with the total time for the results that are not current."""
    rows = [["result", "state", "minutes", "why"]]
    for result, state in found:
        why = state.reasons() or ("needs --pen" if result.pen and not state.is_current else "")
        first, *more = textwrap.wrap(why, 40) or [""]
        rows.append([result.name, state.state, f"{result.minutes:>7}", first])
        rows += [["", "", "", line] for line in more]
    left = sum(result.minutes for result, state in found if state.state != CURRENT)
    return "\n".join(
        [*aligned(rows, left=4), f"{left / 60:.1f} hours for those that are not current"]
    )


def measure(result: Result, work: Work, recordings: str) -> dict:
    """Measure a result and write its file, with its origin, the processor and the time."""
    begun = time.time()
    content = {key: value for key, value in result.measure(work).items() if key != "made_from"}
    content["measured"] = {
        "processor": processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "ended": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "seconds_of_this_session": round(time.time() - begun),
    }
    return result.artifact(recordings).write(content)


def processor() -> str:
    """Name of this machine's processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def main(
    names: Annotated[
        list[str] | None, typer.Argument(help="Results; default: all that are not current.")
    ] = None,
    list_: Annotated[bool, typer.Option("--list", help="Only list them and their states.")] = False,
    work: Annotated[
        Path, typer.Option(help="Folder of what is being measured; kept, to continue there.")
    ] = Path("runs/results"),
    jobs: Annotated[int, typer.Option(help="Processes.", min=1)] = 2,
    pen: Annotated[
        str, typer.Option(help="UNIPEN file of real handwriting, for results on it.")
    ] = "",
):
    """Measure the files in results/ that are missing or out of date, quick ones first."""
    known = {result.name: result for result in RESULTS}
    if unknown := [name for name in names or () if name not in known]:
        raise UserError(f"{unknown[0]}: no such result; there are {', '.join(known)}")
    recordings = recordings_of(Settings(), jobs).source.sha256
    found = states(recordings, [known[name] for name in names] if names else RESULTS)
    print(listing(found))
    if list_:
        return
    for result, state in found:
        if state.is_current:
            continue
        if result.pen and not pen:
            print(f"{result.name}: left out; it needs --pen", file=sys.stderr)
            continue
        print(f"{result.name}: about {result.minutes} minutes", flush=True)
        # Partial results of other versions must not be used.
        folder = work / result.origin(recordings).key[:16]
        measure(result, Work(folder, jobs, pen), recordings)


if __name__ == "__main__":
    run_tool(main)
