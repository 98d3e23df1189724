"""Running a check: stream by stream, saved as it goes, resumed where it stopped."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import time
from pathlib import Path

from .bundle import Bundle
from .errors import UserError
from .files import write_json
from .presentation import Responses, streams_of
from .results import result_of, versions
from .targets import target_named


def run_check(bundle: Bundle, target: str, out, seed: int = 0, advance=None) -> dict:
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

    Returns
    -------
    dict
        The result, as written.

    Raises
    ------
    UserError
        Unknown target, unwritable result, or another process is writing it.
    """
    run = target_named(target)
    out = Path(out)
    streams = streams_of(len(bundle.checks), bundle.spec.presentation.stream_length)
    images = bundle.checks.images.reshape(len(bundle.checks), -1)
    header = {"bundle": bundle.id, "target": target, "seed": seed, "versions": versions()}
    with _partial_file(out, header) as (done, append):
        for record in done:
            _advance(advance, record)
        begun = time.perf_counter()
        remaining = streams[len(done) :]
        for part, responses in zip(
            remaining, run(bundle.spec, [images[s] for s in remaining], seed)
        ):
            now = time.perf_counter()
            record = {"samples": _records(bundle, part, responses), "seconds": now - begun}
            begun = now
            append(record)
            done.append(record)
            _advance(advance, record)
        samples = [sample for record in done for sample in record["samples"]]
        result = result_of(bundle, target, seed, samples, sum(r["seconds"] for r in done))
        write_json(out, result)
    return result


def _advance(advance, record):
    if advance is not None:
        advance(len(record["samples"]))


def _records(bundle, part, responses: Responses) -> list:
    checks = bundle.checks
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
        }
        for i, index in enumerate(range(part.start, part.stop))
    ]


@contextlib.contextmanager
def _partial_file(out: Path, header: dict):
    """The answers so far, one line a stream after a header line; locked against a second writer."""
    path = out.with_name("." + out.name + ".partial")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        file = open(str(path), "a+", encoding="utf-8")  # noqa: SIM115 - closed by "with" below
    except OSError as error:
        raise UserError(f"{out}: cannot write ({error.strerror}); choose another --out") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UserError(
                f"{out}: another process is writing this result; wait for it or use another --out"
            ) from None
        done = _resume(file, header)

        def append(record):
            try:
                file.write(json.dumps(record) + "\n")
                file.flush()
                os.fsync(file.fileno())
            except OSError as error:
                raise UserError(
                    f"{path}: cannot write ({error.strerror}); the streams before this one are "
                    "safe: free some space and run the same command again"
                ) from error

        yield done, append
        with contextlib.suppress(OSError):
            path.unlink()


def _resume(file, header):
    """Read the whole lines of a partial file of the same check; start afresh otherwise."""
    file.seek(0)
    lines = file.read().split("\n")[:-1]  # what follows the last newline was cut short
    try:
        done = [json.loads(line) for line in lines]
        sound = bool(done) and done[0] == header and all("samples" in r for r in done[1:])
    except (ValueError, TypeError):
        sound = False
    keep = lines if sound else [json.dumps(header)]
    file.seek(0)
    file.truncate()
    file.write("".join(line + "\n" for line in keep))
    file.flush()
    return done[1:] if sound else []
