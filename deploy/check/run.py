"""Run a check: stream by stream, saved after each, and resumed after an interruption."""

from __future__ import annotations

import contextlib
import json
import os
import time
from dataclasses import dataclass, replace
from numbers import Integral
from pathlib import Path
from typing import Callable, Dict, Iterator, List, Optional

from ..errors import UserError
from ..files import lock_file, reporting_os_errors
from ..loading import load_dataclass
from ..network.responses import Responses
from ..network.spec import NetworkSpec
from ..targets.options import Options
from ..targets.overflow import OverflowWatch, describe_overflows
from ..targets.registry import (
    Target,
    find_target,
    refuse_unfit,
    respond_to_streams,
    run_target,
)
from ..terminal import WARNING, remark
from .bundle import Bundle, CheckSet
from .results import CheckResult, write_result
from .summary import list_versions, make_result


def _is_seed(value: object) -> bool:
    return isinstance(value, Integral) and 0 <= int(value) < 2**31


@dataclass(frozen=True)
class _SavedSample:
    """A sample in the partial file."""

    id: str
    label: int
    prediction: int
    scores: List[float]
    decisions: List[int]
    spikes: Dict[str, int]
    operations: Dict[str, int]


@dataclass(frozen=True)
class _SavedStream:
    """A line of the partial file: the responses to a stream."""

    of: dict
    first: int
    seconds: float
    samples: List[_SavedSample]


def run_check(
    bundle: Bundle,
    target: str,
    out,
    seed: Optional[int] = None,
    advance=None,
    options: Optional[Options] = None,
) -> CheckResult:
    """Run a target on the bundle's samples and write the result.

    After each stream its responses are appended to ``.<name>.partial`` next to the result; an
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
    options : Options, optional
        Options of the target's own class; its defaults if it is None.

    Returns
    -------
    CheckResult
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
    with open_check(bundle, target, out, seed, advance, options) as opened:
        for record in run_streams(opened.make_job(opened.remaining_streams)):
            opened.add_record(record)
        return opened.finish()


@dataclass(frozen=True)
class StreamJob:
    """Some streams of a check with all data to run them, also in another process.

    Attributes
    ----------
    spec : NetworkSpec
    streams : tuple of (int, CheckSet)
        Index of each stream's first sample in the check, and its samples.
    identity : dict
        What distinguishes the check from others, see `OpenCheck`.
    partial : Path
        File to which the responses to each stream are appended.
    options : Options or None
        Options of the target's own class; its defaults if it is None.
    """

    spec: NetworkSpec
    streams: tuple
    identity: dict
    partial: Path
    options: Optional[Options]

    @property
    def target(self) -> str:
        """The target's name."""
        return self.identity["target"]


def run_streams(job: StreamJob) -> Iterator[dict]:
    """Run streams of a check; save and yield the record of each.

    Raises
    ------
    UserError
        The disk is full, or the network's stimulus cannot present the samples.
    """
    samples = [job.spec.flatten_samples(checks.inputs) for _, checks in job.streams]
    seed = job.identity["seed"]
    watch = OverflowWatch()
    begun = time.perf_counter()
    by_stream = watch.during(respond_to_streams(job.spec, samples, job.target, seed, job.options))
    for (first, checks), responses in zip(job.streams, by_stream):
        ended = time.perf_counter()
        record = {
            "of": job.identity,
            "first": first,
            "samples": list_sample_records(checks, responses),
            "seconds": ended - begun,
        }
        if responses.notes:
            record["notes"] = responses.notes
        if watch.names:
            record["overflows"] = sorted(watch.names)
        begun = ended
        _append_record(job.partial, record)
        yield record


def _append_record(partial: Path, record: dict):
    remedy = "free some space and run the same command again: the other streams are saved"
    reporting = reporting_os_errors(partial, "cannot write", remedy)
    with reporting, open(str(partial), "ab", buffering=0) as file:
        file.write(b"\n" + json.dumps(record).encode())
        os.fsync(file.fileno())


@dataclass
class OpenCheck:
    """A check in progress, with finished and remaining streams; see :func:`open_check`.

    Attributes
    ----------
    bundle : Bundle
    identity : dict
        What distinguishes this check from others: bundle, target, seed, versions, samples, and the
        options that change outputs.
    out, partial : Path
        File of the result, and of the records of the finished streams.
    records : dict of int to dict
        Records of the finished streams, by their first sample.
    options : Options or None
        Options of the target's own class; its defaults if it is None.
    advance : callable
        Called with the number of samples done since the last call.
    """

    bundle: Bundle
    identity: dict
    out: Path
    partial: Path
    records: Dict[int, dict]
    options: Optional[Options]
    advance: Callable

    @property
    def target(self) -> Target:
        """The target."""
        return find_target(self.identity["target"])

    @property
    def remaining_streams(self) -> list:
        """The streams without a record in order, as slices of the samples."""
        return [stream for stream in _list_streams(self.bundle) if stream.start not in self.records]

    def make_job(self, streams) -> StreamJob:
        """The data to run some of the remaining streams."""
        samples = tuple((stream.start, self.bundle.checks[stream]) for stream in streams)
        # An absolute path, because another process may have another working directory.
        partial = self.partial.absolute()
        return StreamJob(self.bundle.spec, samples, self.identity, partial, self.options)

    def add_record(self, record: dict):
        """Add a record from :func:`run_streams`, in any order."""
        self.records[record["first"]] = record
        self.advance(len(record["samples"]))

    def finish(self) -> CheckResult:
        """Write and return the result, after the last stream."""
        bundle = self.bundle
        name = self.target.name
        records = [self.records[stream.start] for stream in _list_streams(bundle)]
        samples = [sample for record in records for sample in record["samples"]]
        notes = self._summarise_notes(records)
        overflows = {number for record in records for number in record.get("overflows", ())}
        if overflows:
            remark(WARNING + describe_overflows(bundle.spec, name, overflows))
        seconds = sum(record["seconds"] for record in records)
        versions = notes.pop("versions", {})
        result = make_result(bundle, name, self.identity["seed"], samples, seconds, versions)
        result = replace(result, target_notes=notes, options=self.identity.get("options"))
        if self.target.needs_board:
            result = replace(result, samples_unlike_fast=self._compare_with_fast(samples))
        write_result(self.out, result)
        with contextlib.suppress(OSError):
            self.partial.unlink()
        return result

    def _summarise_notes(self, records) -> dict:
        """Entries of the result that the target makes of the notes of its streams."""
        notes = [record["notes"] for record in records if "notes" in record]
        if not notes or self.target.describe is None:
            return {}
        return dict(self.target.describe(notes))

    def _compare_with_fast(self, samples) -> Optional[int]:
        """The number of samples whose spikes differ from those of ``fast``.

        None without Numba: the board's result is still written.
        """
        bundle = self.bundle
        try:
            expected = run_target(
                bundle.spec, bundle.checks.inputs, "fast", self.identity["seed"]
            ).spike_hashes
        except UserError:
            return None
        assert expected is not None  # this target gives them
        pairs = zip(samples, expected)
        return sum(sample.get("spike_hash") != str(spikes) for sample, spikes in pairs)


def _ignore(n_samples):
    """Report no progress."""


def _list_streams(bundle):
    return bundle.spec.presentation.list_streams(len(bundle.checks))


@contextlib.contextmanager
def open_check(
    bundle: Bundle,
    target: str,
    out,
    seed: Optional[int] = None,
    advance=None,
    options: Optional[Options] = None,
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
    find_target(target)
    seed = bundle.seed if seed is None else seed
    if not _is_seed(seed):  # a bundle's is not validated
        raise UserError(f"seed {seed}: must be from 0 to {2**31 - 1}")
    seed = int(seed)
    refuse_unfit(bundle.spec, target, seed)
    out = Path(out)
    if out.exists() and not out.is_file():  # before the samples are run
        raise UserError(f"{out}: cannot write (not a file); choose another --out")
    partial = out.with_name("." + out.name + ".partial")
    identity = {
        "bundle": bundle.id,
        "target": target,
        "seed": seed,
        "versions": list_versions(),
        # Other recordings may have been put in place of the bundle's, also with the same ids.
        "samples": bundle.checks.sha256,
        **_list_options(options),
    }
    is_locked = f"{out}: another process is writing this result; wait for it or use another --out"
    with lock_file(partial, is_locked, "choose another --out") as file:
        try:
            records = _read_records(file, identity, _list_streams(bundle))
            advance = advance or _ignore
            for record in records.values():
                advance(len(record["samples"]))
            yield OpenCheck(
                bundle=bundle,
                identity=identity,
                out=out,
                partial=partial,
                records=records,
                options=options,
                advance=advance,
            )
        finally:
            if os.path.exists(str(partial)) and not os.path.getsize(str(partial)):
                os.unlink(str(partial))


def _list_options(options) -> dict:
    """The options on which the outputs depend; nothing if there are none."""
    values = {} if options is None else options.list_output_values()
    return {"options": values} if values else {}


def list_sample_records(checks: CheckSet, responses: Responses) -> list:
    """The fields of each sample in a result, a list of dict."""
    return [_make_sample_record(checks, responses, index) for index in range(len(checks))]


def _make_sample_record(checks, responses, index):
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


def _read_records(file, identity, streams) -> dict:
    """The records of a check in a partial file, by their first sample.

    A damaged line is ignored.  A record of another check, such as one with another version of
    NumPy, is ignored, too, and the file keeps it until a check is complete.  A file without any
    record is emptied.
    """
    lengths = {stream.start: stream.stop - stream.start for stream in streams}
    file.seek(0)
    records = {}
    has_others = False
    for line in file.read().decode("utf-8", "replace").split("\n"):
        try:
            record = json.loads(line)
            load_dataclass(_SavedStream, record, ignore_extra=True)
        except (ValueError, RecursionError):  # cut short by an interruption
            continue
        if record["of"] != identity:
            has_others = has_others or record["of"].get("bundle") == identity["bundle"]
        elif lengths.get(record["first"]) == len(record["samples"]):
            records[record["first"]] = record
    if not records and not has_others:
        file.truncate(0)
    return records
