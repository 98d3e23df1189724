"""Run a check: stream by stream, saved after each, and resumed after an interruption."""

from __future__ import annotations

import contextlib
import json
import os
import time
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Callable, Dict, Iterator, List, Optional

from ..errors import UserError
from ..files import lock_file, reporting_os_errors, write_json
from ..loading import load
from ..network.responses import Responses
from ..network.spec import NetworkSpec
from ..targets.overflow import OverflowWatch, overflow_text
from ..targets.registry import Target, refuse_unfit, run_target, target_named
from ..terminal import WARNING, remark
from .bundle import Bundle, CheckSet
from .results import result_of, versions


def _is_seed(value: object) -> bool:
    return isinstance(value, Integral) and 0 <= int(value) < 2**31


@dataclass(frozen=True)
class _Answer:
    """A sample in the partial file."""

    id: str
    label: int
    prediction: int
    scores: List[float]
    decisions: List[int]
    spikes: Dict[str, int]
    operations: Dict[str, int]


@dataclass(frozen=True)
class _Record:
    """A line of the partial file."""

    of: dict
    first: int
    seconds: float
    samples: List[_Answer]


def run_check(
    bundle: Bundle,
    target: str,
    out,
    seed: Optional[int] = None,
    advance=None,
    options: Optional[object] = None,
) -> dict:
    """Run a target on the bundle's samples and write the result.

    After each stream its responses are appended to ``.<name>.partial`` beside the result; an
    interrupted run resumes with the next stream.  (A sample's response depends on the previous
    samples of its stream, so an interrupted stream is repeated from its start.)

    Parameters
    ----------
    bundle : Bundle
    target : str
    out : path-like
        File of the result, JSON.
    seed : int, optional
        Seed of the simulator; default: that of the bundle's run.
    advance : callable, optional
        Called with the number of samples done since the last call, including resumed ones.
    options : object, optional
        Options of the target's own class, see :func:`deploy.targets.registry.options_for`.

    Returns
    -------
    dict
        The result, as written.  For a board it includes the number of samples whose spikes differ
        from those of ``fast``, since a lost spike cannot be recognised from the predictions.

    Raises
    ------
    UserError
        The target is unknown, the result cannot be written, or another process is writing it.
    TypeError
        The bundle is not a Bundle, such as a path.
    """
    if not isinstance(bundle, Bundle):
        kind = type(bundle).__name__
        raise TypeError(f"bundle is a Bundle, not {kind}; read_bundle reads one from its folder")
    with open_check(bundle, target, out, seed, advance, options) as check:
        for record in run_streams(check.work(check.left)):
            check.take(record)
        return check.finish()


@dataclass(frozen=True)
class Work:
    """Some streams of a check with all data to run them, also in another process.

    Attributes
    ----------
    spec : NetworkSpec
    streams : tuple of (int, CheckSet)
        Index of each stream's first sample in the check, and its samples.
    check : dict
        Identification of the check.
    saved : Path
        File to which the responses to each stream are appended.
    options : object or None
        Options of the target.
    """

    spec: NetworkSpec
    streams: tuple
    check: dict
    saved: Path
    options: Optional[object]

    @property
    def target(self) -> str:
        """The target's name."""
        return self.check["target"]


def run_streams(work: Work) -> Iterator[dict]:
    """Run streams of a check; save and yield the responses to each.

    Raises
    ------
    UserError
        The disk is full, or the network's stimulus cannot present the samples.
    """
    chosen = {} if work.options is None else {"options": work.options}
    presented = [work.spec.flatten_samples(checks.inputs) for _, checks in work.streams]
    run = target_named(work.target).run
    watch = OverflowWatch()
    begun = time.perf_counter()
    for (first, checks), responses in zip(
        work.streams, watch.during(run(work.spec, presented, work.check["seed"], **chosen))
    ):
        now = time.perf_counter()
        record = {
            "of": work.check,
            "first": first,
            "samples": records_of(checks, responses),
            "seconds": now - begun,
        }
        if responses.notes:
            record["notes"] = responses.notes
        if watch.numbers:
            record["overflows"] = sorted(watch.numbers)
        begun = now
        remedy = "free some space and run the same command again: the other streams are saved"
        reporting = reporting_os_errors(work.saved, "cannot write", remedy)
        with reporting, open(str(work.saved), "ab", buffering=0) as file:
            file.write(b"\n" + json.dumps(record).encode())
            os.fsync(file.fileno())
        yield record


@dataclass
class OpenCheck:
    """A check in progress, with finished and remaining streams; see :func:`open_check`.

    Attributes
    ----------
    bundle : Bundle
    identity : dict
        What distinguishes this check from others: bundle, target, seed, versions and samples.
    out, saved : Path
        File of the result, and of the responses to the finished streams.
    done : dict of int to dict
        Records of the finished streams, by their first sample.
    options : object or None
        Options of the target.
    advance : callable
        Called with the number of samples done since the last call.
    """

    bundle: Bundle
    identity: dict
    out: Path
    saved: Path
    done: Dict[int, dict]
    options: Optional[object]
    advance: Callable

    @property
    def target(self) -> Target:
        """The target."""
        return target_named(self.identity["target"])

    @property
    def left(self) -> list:
        """The remaining streams in order, as slices of the samples."""
        return [stream for stream in _streams(self.bundle) if stream.start not in self.done]

    def work(self, streams) -> Work:
        """The data to run some of the remaining streams."""
        samples = tuple((stream.start, self.bundle.checks[stream]) for stream in streams)
        # An absolute path, because another process may have another working directory.
        return Work(self.bundle.spec, samples, self.identity, self.saved.absolute(), self.options)

    def take(self, record: dict):
        """Add a record from :func:`run_streams`, in any order."""
        self.done[record["first"]] = record
        self.advance(len(record["samples"]))

    def finish(self) -> dict:
        """Write and return the result, after the last stream."""
        bundle = self.bundle
        target = self.target
        seed = self.identity["seed"]
        records = [self.done[stream.start] for stream in _streams(bundle)]
        samples = [sample for record in records for sample in record["samples"]]
        notes = [record["notes"] for record in records if "notes" in record]
        extra = target.describe(notes) if notes and target.describe else {}
        if target.hardware:
            # Without Numba the board's result is written all the same.
            with contextlib.suppress(UserError):
                expected = run_target(bundle.spec, bundle.checks.inputs, "fast", seed)
                assert expected.spike_hashes is not None  # this target gives them
                extra["samples_unlike_fast"] = sum(
                    sample.get("spike_hash") != str(spikes)
                    for sample, spikes in zip(samples, expected.spike_hashes)
                )
        overflows = {number for record in records for number in record.get("overflows", ())}
        if overflows:
            remark(WARNING + overflow_text(bundle.spec, target.name, overflows))
        seconds = sum(record["seconds"] for record in records)
        result = result_of(bundle, target.name, seed, samples, seconds, extra)
        write_json(self.out, result)
        with contextlib.suppress(OSError):
            self.saved.unlink()
        return result


def _ignore(n_samples):
    """Report no progress."""


def _streams(bundle):
    return bundle.spec.presentation.streams(len(bundle.checks))


@contextlib.contextmanager
def open_check(
    bundle: Bundle,
    target: str,
    out,
    seed: Optional[int] = None,
    advance=None,
    options: Optional[object] = None,
) -> Iterator[OpenCheck]:
    """Open a check, resuming an earlier one, for its streams to be run in any order and process.

    Parameters
    ----------
    bundle, target, out, seed, advance, options
        As in :func:`run_check`, which runs the streams in sequence.

    Yields
    ------
    OpenCheck

    Raises
    ------
    UserError
        As :func:`run_check`.
    """
    target_named(target)
    seed = bundle.seed if seed is None else seed
    if not _is_seed(seed):  # a bundle's is not validated
        raise UserError(f"seed {seed}: must be from 0 to {2**31 - 1}")
    seed = int(seed)
    refuse_unfit(bundle.spec, target, seed)
    out = Path(out)
    if out.exists() and not out.is_file():  # before the samples are run
        raise UserError(f"{out}: cannot write (not a file); choose another --out")
    saved = out.with_name("." + out.name + ".partial")
    check = {"bundle": bundle.id, "target": target, "seed": seed, "versions": versions()}
    # Other recordings may have been put in the place of the bundle's, also with the same ids.
    check["samples"] = bundle.checks.sha256
    taken = f"{out}: another process is writing this result; wait for it or use another --out"
    with lock_file(saved, taken, "choose another --out") as file:
        try:
            done = _resume(file, check, _streams(bundle))
            advance = advance or _ignore
            for record in done.values():
                advance(len(record["samples"]))
            yield OpenCheck(
                bundle=bundle,
                identity=check,
                out=out,
                saved=saved,
                done=done,
                options=options,
                advance=advance,
            )
        finally:
            if os.path.exists(str(saved)) and not os.path.getsize(str(saved)):
                os.unlink(str(saved))


def records_of(checks: CheckSet, responses: Responses) -> list:
    """The saved fields of each sample."""
    return [_record_of(checks, responses, index) for index in range(len(checks))]


def _record_of(checks, responses, index):
    record = {
        "id": checks.ids[index],
        "label": int(checks.labels[index]),
        "prediction": int(responses.predictions[index]),
        "scores": [float(score) for score in responses.scores[index]],
        "decisions": [int(decision) for decision in responses.decisions[index]],
        "spikes": {name: int(counts[index]) for name, counts in responses.spikes.items()},
        "operations": {name: int(counts[index]) for name, counts in responses.operations.items()},
    }
    if responses.stopped_at is not None:
        record["stopped_at"] = int(responses.stopped_at[index])
    if responses.spike_hashes is not None:
        record["spike_hash"] = str(responses.spike_hashes[index])
    return record


def _resume(file, check, streams):
    """The records of a check in a partial file, by their first sample.

    A damaged line is ignored, and so is a record of another check, such as one with another version
    of NumPy, which remains for that check until this one is complete.  A file without any record is
    emptied.
    """
    lengths = {stream.start: stream.stop - stream.start for stream in streams}
    file.seek(0)
    done = {}
    others = False
    for line in file.read().decode("utf-8", "replace").split("\n"):
        try:
            record = json.loads(line)
            load(_Record, record, extra=True)
        except (ValueError, RecursionError):  # cut short by an interruption
            continue
        if record["of"] != check:
            others = others or record["of"].get("bundle") == check["bundle"]
        elif lengths.get(record["first"]) == len(record["samples"]):
            done[record["first"]] = record
    if not done and not others:
        file.truncate(0)
    return done
