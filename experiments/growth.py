"""Time and memory of a training, by the number of recordings.

Each training is ``stmnist convert`` with one epoch of each network in a process of its own, whose
peak of resident memory the operating system counts, including the pages of files that are mapped.
There are as many different recordings as the simulation has by default; larger sources repeat them
under other ids, since training takes the same time and memory whether they differ or not.
"""

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from deploy.errors import CheckFailed, UserError
from deploy.files import write_json
from deploy.tables import align_rows
from experiments.results import RESULTS, Store, name_processor
from pipeline import sources
from pipeline.commands import options
from pipeline.recordings import cached_recordings
from pipeline.recordings.events import EVENT_DTYPES, Events
from pipeline.recordings.recordings import Recordings
from pipeline.settings import Settings

SIZES = (7_000, 30_000, 100_000)

# One epoch of each training.
EPOCHS = {
    "image": ("cnn.epochs=1", "snn.epochs=1"),
    "events": ("events.epochs=1",),
}


def repeat_recordings(recordings: Recordings, samples_per_digit: int) -> Recordings:
    """As many recordings of each digit as asked for, which repeat those given under other ids."""
    chosen = []
    ids = []
    for digit in range(10):
        of_digit = np.flatnonzero(recordings.labels == digit)
        chosen.append(np.resize(of_digit, samples_per_digit))
        ids += [f"{digit}/{index:06d}" for index in range(samples_per_digit)]
    indices = np.concatenate(chosen)
    counts = np.diff(recordings.offsets)[indices]
    columns = []
    for name in EVENT_DTYPES:
        column = np.asarray(getattr(recordings.events, name))
        parts = np.split(column, recordings.offsets[1:-1])
        columns.append(np.concatenate([parts[index] for index in indices]))
    return replace(
        recordings,
        events=Events(*columns),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        labels=recordings.labels[indices],
        ids=tuple(ids),
        writers=recordings.writers[indices],
        parts=("",) * len(ids),
    )


def store_repeated(cache: Path, recordings: Recordings, samples_per_digit: int):
    """Store repeated recordings where a run looks for as many simulated ones."""
    settings = Settings().with_values({"data": {"samples_per_digit": samples_per_digit}})
    sha256, _ = sources.find_hash_and_split(settings)
    repeated = repeat_recordings(recordings, samples_per_digit)
    repeated = replace(repeated, source=replace(recordings.source, sha256=sha256))
    cached_recordings.store_recordings(
        cache / sources.find_path_of_simulated(sha256).name, repeated
    )


def train_once(folder: Path, kind: str, samples_per_digit: int) -> dict:
    """Train a network for one epoch in a process of its own, and measure it."""
    changes = (f"data.samples_per_digit={samples_per_digit}", *EPOCHS[kind])
    command = [sys.executable, "-m", "pipeline", "convert", str(folder / "run"), "--input", kind]
    for change in changes:
        command += ["--set", change]
    begun = time.perf_counter()
    process = subprocess.Popen(command, env={**os.environ, "STMNIST_CACHE": str(folder / "cache")})
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise CheckFailed(f"{' '.join(command)} ended with status {process.returncode}")
    return {
        "kind": kind,
        "recordings": 10 * samples_per_digit,
        "seconds": time.perf_counter() - begun,
        "processor_seconds": used.ru_utime + used.ru_stime,
        "peak_megabytes": used.ru_maxrss / (1 << 20 if sys.platform == "darwin" else 1 << 10),
    }


def measure(sizes, kinds, out: Path, say=print) -> list:
    """A row for each number of recordings and kind of network."""
    recordings = sources.load_recordings()
    rows = []
    for size in sizes:
        samples_per_digit = size // 10
        with tempfile.TemporaryDirectory(dir=out) as name:
            folder = Path(name)
            store_repeated(folder / "cache", recordings, samples_per_digit)
            for kind in kinds:
                row = train_once(folder, kind, samples_per_digit)
                say(f"{kind}, {size:,} recordings: {row['peak_megabytes']:,.0f} MB")
                rows.append(row)
    return rows


def make_cells(result: dict) -> list:
    """The rows of a result as lists of text, the heads first."""
    lines = [["network", "recordings", "processor time", "peak of resident memory"]]
    for row in result["rows"]:
        lines.append(
            [
                row["kind"],
                f"{row['recordings']:,}",
                f"{row['processor_seconds']:,.0f} s",
                f"{row['peak_megabytes'] / 1000:.2f} GB",
            ]
        )
    return lines


def format_result(result: dict) -> str:
    """The result as a table."""
    title = "One epoch of training, recordings in the cache"
    return "\n".join([title, *align_rows(make_cells(result), left=1)])


def main(
    out: Annotated[Path, typer.Option(help="Folder for caches and runs, some GB.")] = Path("runs"),
    size: Annotated[list[int] | None, typer.Option(help="Numbers of recordings.", min=100)] = None,
    kind: Annotated[list[str] | None, typer.Option(help="image or events; repeatable.")] = None,
    store: Store = "",
    as_json: options.Json = False,
):
    """Measure time and memory of a training on 7,000, 30,000 and 100,000 recordings."""
    if unknown := set(kind or ()) - set(EPOCHS):
        raise UserError(f"--kind {min(unknown)}: it is one of {', '.join(EPOCHS)}")
    out.mkdir(parents=True, exist_ok=True)
    rows = measure(size or SIZES, kind or tuple(EPOCHS), out, options.say)
    result = {"experiment": "growth", "rows": rows, "measured": {"processor": name_processor()}}
    if store:
        write_json(RESULTS / f"{store}.json", result)
    options.print_result(result, format_result, as_json)
