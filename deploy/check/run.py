"""Running a check: stream by stream, saved as it goes, resumed where it stopped."""

from __future__ import annotations

import contextlib
import json
import os
import time
from pathlib import Path
from typing import Iterator, Optional

from ..errors import UserError
from ..files import lock, write_json
from ..network.responses import Responses
from ..network.stream import streams_of
from ..targets.registry import answer, target_named
from .bundle import Bundle
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
    with open_check(bundle, target, out, seed, advance) as check:
        for part, (responses, seconds) in zip(
            check.left.copy(),
            timed_answers(bundle.spec, target, check.samples(check.left), seed, options),
        ):
            check.add(part, responses, seconds)
        return check.finish()


def timed_answers(spec, target: str, streams, seed: int = 0, options=None) -> Iterator[tuple]:
    """A target's responses to each of some streams, and the seconds that they took.

    Parameters
    ----------
    spec : NetworkSpec
    target : str
    streams : list of ndarray
        As a target's ``run`` takes them.
    seed, options
        As in :func:`run_check`.

    Yields
    ------
    Responses, float
    """
    chosen = {} if options is None else {"options": options}
    begun = time.perf_counter()
    for responses in target_named(target).run(spec, streams, seed, **chosen):
        now = time.perf_counter()
        yield responses, now - begun
        begun = now


class OpenCheck:
    """A check that is being done: what of it is there, and what is left; see :func:`open_check`.

    Attributes
    ----------
    left : list of slice
        The streams that have no answers yet, in order: which of the check's samples they show.
    """

    def __init__(self, bundle, target, out, seed, file, done, advance):
        self._bundle, self._target, self._out, self._seed = bundle, target, out, seed
        self._file, self._done, self._advance = file, done, advance
        streams = streams_of(len(bundle.checks), bundle.spec.presentation.stream_length)
        self.left = streams[len(done) :]
        for record in done:
            self._tell(record)

    def samples(self, parts) -> list:
        """What the streams of some parts show, as a target's ``run`` takes them."""
        flat = self._bundle.spec.stimulus.flat(self._bundle.checks.inputs)
        return [flat[part] for part in parts]

    def add(self, part: slice, responses: Responses, seconds: float):
        """Keep the answers to the next stream.

        Parameters
        ----------
        part : slice
            The first of ``left``.
        responses : Responses
        seconds : float
            That the target took.

        Raises
        ------
        UserError
            The disk is full.
        """
        record = {"samples": records_of(self._bundle, part, responses), "seconds": seconds}
        if responses.notes:
            record["notes"] = responses.notes
        with _disk_errors(self._file.name):
            _write_now(self._file, json.dumps(record) + "\n")
        self.left.remove(part)
        self._done.append(record)
        self._tell(record)

    def finish(self) -> dict:
        """Write the result, now that no stream is left; return it."""
        bundle, target = self._bundle, target_named(self._target)
        answers = [sample for record in self._done for sample in record["samples"]]
        notes = [record["notes"] for record in self._done if "notes" in record]
        extra = target.describe(notes) if notes and target.describe else {}
        if target.hardware:
            # NumPy's kernel: Numba's compiles five seconds in a bundle that was copied.
            expected = answer(bundle.spec, bundle.checks.inputs, "fast", self._seed, kernel="numpy")
            extra["samples_unlike_fast"] = sum(
                told.get("spike_hash") != str(spikes)
                for told, spikes in zip(answers, expected.spike_hashes)
            )
        seconds = sum(record["seconds"] for record in self._done)
        result = result_of(bundle, self._target, self._seed, answers, seconds, extra)
        write_json(self._out, result)
        with contextlib.suppress(OSError):
            os.unlink(self._file.name)
        return result

    def _tell(self, record):
        if self._advance is not None:
            self._advance(len(record["samples"]))


@contextlib.contextmanager
def open_check(
    bundle: Bundle, target: str, out, seed: int = 0, advance=None
) -> Iterator[OpenCheck]:
    """Open a check where it was left, for its streams to be answered in any way: here or elsewhere.

    Parameters
    ----------
    bundle, target, out, seed, advance
        As in :func:`run_check`, which is one of these ways.

    Yields
    ------
    OpenCheck

    Raises
    ------
    UserError
        As :func:`run_check`.
    """
    target_named(target)
    if not 0 <= seed < 2**31:
        raise UserError(f"seed {seed}: must be from 0 to {2**31 - 1}")
    out = Path(out)
    header = {"bundle": bundle.id, "target": target, "seed": seed, "versions": versions()}
    with _partial_file(out, header) as (file, done):
        yield OpenCheck(bundle, target, out, seed, file, done, advance)


def records_of(bundle: Bundle, part: slice, responses: Responses) -> list:
    """What is kept of each sample of a part of the check."""
    checks, hashes, stops = bundle.checks, responses.spike_hashes, responses.stopped_at
    return [
        {
            "id": checks.ids[index],
            "label": int(checks.labels[index]),
            "prediction": int(responses.predictions[i]),
            "scores": [float(score) for score in responses.scores[i]],
            "decided_at": int(responses.decided_at[i]),
            "decisions": [int(decision) for decision in responses.decisions[i]],
            "spikes": {name: int(counts[i]) for name, counts in responses.spikes.items()},
            "operations": {name: int(counts[i]) for name, counts in responses.operations.items()},
            **({} if stops is None else {"stopped_at": int(stops[i])}),
            **({} if hashes is None else {"spike_hash": str(hashes[i])}),
        }
        for i, index in enumerate(range(part.start, part.stop))
    ]


@contextlib.contextmanager
def _partial_file(out: Path, header: dict):
    """The answers so far, one line a stream after a header line; locked against a second writer."""
    if out.exists() and not out.is_file():  # said now, not when the answers are there
        raise UserError(f"{out}: cannot write (not a file); choose another --out")
    path = out.with_name("." + out.name + ".partial")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        # closed by "with" below; what is not UTF-8 is a damaged line, see _resume
        file = open(str(path), "a+", encoding="utf-8", errors="replace")  # noqa: SIM115
    except OSError as error:
        raise UserError(f"{out}: cannot write ({error.strerror}); choose another --out") from error
    with file:
        lock(
            file, f"{out}: another process is writing this result; wait for it or use another --out"
        )
        with _disk_errors(path):
            done = _resume(file, header)
        yield file, done


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


def _resume(file, header):
    """Read the whole lines of a partial file of the same check; start afresh otherwise."""
    file.seek(0)
    lines = file.read().split("\n")[:-1]  # what follows the last newline was cut short
    try:
        done = [json.loads(line) for line in lines]
        sound = bool(done) and done[0] == header and all(map(_is_record, done[1:]))
    except ValueError:
        sound = False
    if sound:
        file.truncate(len("".join(line + "\n" for line in lines).encode()))
    else:
        file.truncate(0)
        _write_now(file, json.dumps(header) + "\n")
    return done[1:] if sound else []


def _is_record(value):
    """True for what :func:`run_check` appends; a line may have been damaged since."""
    return (
        isinstance(value, dict)
        and isinstance(value.get("seconds"), float)
        and isinstance(value.get("samples"), list)
        and all(isinstance(sample, dict) for sample in value["samples"])
        and all(sample.keys() >= KEYS for sample in value["samples"])
    )
