"""Running a check: stream by stream, saved as it goes, resumed where it stopped."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Iterator, Optional

from ..errors import UserError
from ..files import locked, open_own, write_json
from ..network.responses import Responses
from ..network.spec import NetworkSpec
from ..network.stream import streams_of
from ..targets.registry import answer, target_named
from .bundle import Bundle, CheckSet
from .results import result_of, versions

KEYS = {"id", "label", "prediction", "scores", "decided_at", "decisions", "spikes", "operations"}
"""What the partial file holds of each sample."""


def run_check(
    bundle: Bundle,
    target: str,
    out,
    seed: int = 0,
    advance=None,
    options: Optional[object] = None,
) -> dict:
    """Let a target answer the bundle's samples and write the result.

    After each stream its answers are appended to ``.<name>.partial`` beside the result; a run that
    was interrupted goes on from there with the next stream.  (A sample's answer depends on those
    before it in its stream, so a stream that was cut short is run again from its start.)

    Parameters
    ----------
    bundle : Bundle
    target : str
    out : path-like
        The result, JSON.
    seed : int
    advance : callable, optional
        Called with the number of samples done since the last call, resumed ones included.
    options : object, optional
        Of the target's own class, see :func:`deploy.targets.registry.options_for`.

    Returns
    -------
    dict
        The result, as written.  Of a board it says of how many samples the spikes are not those
        that ``fast`` computes: a spike that is lost on the way leaves an answer as possible as the
        right one, and nothing else tells.

    Raises
    ------
    UserError
        Unknown target, unwritable result, or another process is writing it.
    """
    with open_check(bundle, target, out, seed, advance, options) as check:
        for record in answered(check.work(check.left)):
            check.take(record)
        return check.finish()


@dataclass(frozen=True)
class Work:
    """Some streams of a check, and all it takes to answer them: here, or in another process.

    Attributes
    ----------
    spec : NetworkSpec
    streams : tuple of (int, CheckSet)
        The number of each one's first sample in the check, and what is shown.
    check : dict
        Which check it is a part of.
    saved : Path
        Where the answers to each stream are appended.
    options : object or None
        Of the target.
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


def answered(work: Work) -> Iterator[dict]:
    """Answer streams of a check, save the answers to each one, and yield them.

    Raises
    ------
    UserError
        The disk is full, or the network's stimulus cannot show the samples.
    """
    chosen = {} if work.options is None else {"options": work.options}
    shown = [work.spec.fed(checks.inputs) for _, checks in work.streams]
    run = target_named(work.target).run
    begun = time.perf_counter()
    for (first, checks), responses in zip(
        work.streams, run(work.spec, shown, work.check["seed"], **chosen)
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
        begun = now
        with _disk_errors(work.saved), open_own(work.saved) as file:
            _write_now(file, "\n" + json.dumps(record))
        yield record


class OpenCheck:
    """A check that is being done: what of it is there, and what is left; see :func:`open_check`.

    Attributes
    ----------
    target : deploy.targets.registry.Target
    """

    def __init__(self, bundle, check, out, saved, done, advance, options):
        self.target = target_named(check["target"])
        self._bundle, self._check, self._out = bundle, check, out
        self._saved, self._done, self._options = saved, done, options
        self._advance = advance or (lambda n: None)
        for record in done.values():
            self._advance(len(record["samples"]))

    @property
    def left(self) -> list:
        """The streams that have no answers yet, in order: which samples they show, as slices."""
        return [part for part in _streams(self._bundle) if part.start not in self._done]

    def work(self, parts) -> Work:
        """What it takes to answer some of the streams that are left."""
        streams = tuple((part.start, self._bundle.checks[part]) for part in parts)
        # Absolute, because a process may have been started elsewhere.
        saved = self._saved.absolute()
        return Work(self._bundle.spec, streams, self._check, saved, self._options)

    def take(self, record: dict):
        """Take what :func:`answered` yields, in any order."""
        self._done[record["first"]] = record
        self._advance(len(record["samples"]))

    def finish(self) -> dict:
        """Write the result, now that no stream is left; return it."""
        bundle, target, seed = self._bundle, self.target, self._check["seed"]
        records = [self._done[part.start] for part in _streams(bundle)]
        answers = [sample for record in records for sample in record["samples"]]
        notes = [record["notes"] for record in records if "notes" in record]
        extra = target.describe(notes) if notes and target.describe else {}
        if target.hardware:
            # NumPy's kernel: Numba's compiles five seconds in a bundle that was copied.
            expected = answer(bundle.spec, bundle.checks.inputs, "fast", seed, kernel="numpy")
            extra["samples_unlike_fast"] = sum(
                told.get("spike_hash") != str(spikes)
                for told, spikes in zip(answers, expected.spike_hashes)
            )
        seconds = sum(record["seconds"] for record in records)
        result = result_of(bundle, target.name, seed, answers, seconds, extra)
        write_json(self._out, result)
        with contextlib.suppress(OSError):
            self._saved.unlink()
        return result


def _streams(bundle):
    return streams_of(len(bundle.checks), bundle.spec.presentation.stream_length)


@contextlib.contextmanager
def open_check(
    bundle: Bundle,
    target: str,
    out,
    seed: int = 0,
    advance=None,
    options: Optional[object] = None,
) -> Iterator[OpenCheck]:
    """Open a check where it was left, for its streams to be answered in any order and process.

    Parameters
    ----------
    bundle, target, out, seed, advance, options
        As in :func:`run_check`, which answers them one after the other.

    Yields
    ------
    OpenCheck

    Raises
    ------
    UserError
        As :func:`run_check`.
    """
    target_named(target)
    if type(seed) is not int or not 0 <= seed < 2**31:  # a bundle may say anything
        raise UserError(f"seed {seed}: must be from 0 to {2**31 - 1}")
    out = Path(out)
    if out.exists() and not out.is_file():  # said now, not when the answers are there
        raise UserError(f"{out}: cannot write (not a file); choose another --out")
    saved = out.with_name("." + out.name + ".partial")
    shown = hashlib.sha256("\n".join(bundle.checks.ids).encode()).hexdigest()
    check = {"bundle": bundle.id, "target": target, "seed": seed, "versions": versions()}
    check["samples"] = shown  # other recordings may have been put in the place of the bundle's
    taken = f"{out}: another process is writing this result; wait for it or use another --out"
    with contextlib.ExitStack() as stack:
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            file = stack.enter_context(locked(saved, taken))
        except OSError as error:
            raise UserError(
                f"{out}: cannot write ({saved.name}: {error.strerror}); choose another --out"
            ) from error
        with _disk_errors(saved):
            done = _resume(file, check, _streams(bundle))
        yield OpenCheck(bundle, check, out, saved, done, advance, options)


def records_of(checks: CheckSet, responses: Responses) -> list:
    """What is kept of each sample."""
    hashes, stops = responses.spike_hashes, responses.stopped_at
    return [
        {
            "id": checks.ids[i],
            "label": int(checks.labels[i]),
            "prediction": int(responses.predictions[i]),
            "scores": [float(score) for score in responses.scores[i]],
            "decided_at": int(responses.decided_at[i]),
            "decisions": [int(decision) for decision in responses.decisions[i]],
            "spikes": {name: int(counts[i]) for name, counts in responses.spikes.items()},
            "operations": {name: int(counts[i]) for name, counts in responses.operations.items()},
            **({} if stops is None else {"stopped_at": int(stops[i])}),
            **({} if hashes is None else {"spike_hash": str(hashes[i])}),
        }
        for i in range(len(checks))
    ]


@contextlib.contextmanager
def _disk_errors(path):
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{path}: cannot write ({error.strerror}); the streams saved before are safe: "
            "free some space and run the same command again"
        ) from error


def _write_now(file, text):
    """Append without a buffer, which a file on a full disk would flush once more as it closes."""
    rest = text.encode()
    while rest:
        rest = rest[os.write(file.fileno(), rest) :]
    os.fsync(file.fileno())


def _resume(file, check, streams):
    """The records of a check that a partial file holds, by their first sample; none: empty it.

    Lines may be of another check, or damaged: each is judged by itself.  What is not UTF-8 is a
    damaged line.
    """
    lengths = {part.start: part.stop - part.start for part in streams}
    file.seek(0)
    done = {}
    for line in file.read().decode("utf-8", "replace").split("\n"):
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if _is_record(record, check) and lengths.get(record["first"]) == len(record["samples"]):
            done[record["first"]] = record
    if not done:
        file.truncate(0)
    return done


def _is_record(value, check):
    """True for what :func:`answered` appends of a check; a line may have been damaged since."""
    return (
        isinstance(value, dict)
        and value.get("of") == check
        and isinstance(value.get("first"), int)
        and isinstance(value.get("seconds"), float)
        and isinstance(value.get("samples"), list)
        and all(isinstance(sample, dict) for sample in value["samples"])
        and all(sample.keys() >= KEYS for sample in value["samples"])
    )
