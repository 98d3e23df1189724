"""One command in a process with limits of memory and time, and what became of it."""

import contextlib
import os
import resource
import signal
import sys
import time
from dataclasses import dataclass

SECONDS = 20
"""Of processor time: no input takes more, however busy the machine is."""

PATIENCE = 180
"""Seconds after which a command that takes no processor time counts as blocked."""

MEMORY = 2 << 30
"""Bytes that no input takes more of, resident."""

ADDRESSES = 12 << 30
"""Of the process's address space: what is beyond is refused before the machine suffers."""

LINE = 3000
"""Characters of an error's line at most."""

MISTAKES = 16
"""Lines at most, one for each kind of mistake in a set of recordings."""


@dataclass(frozen=True)
class Outcome:
    """What a command did.

    Attributes
    ----------
    status : int
        Exit status; a signal's number with a minus.
    out, err : str
    seconds : float
        Of processor time, that of its children included.
    memory : int
        Largest resident size in bytes.
    blocked : bool, optional
        Whether it was killed because it had not ended after `PATIENCE`.
    """

    status: int
    out: str
    err: str
    seconds: float
    memory: int
    blocked: bool = False

    @property
    def finding(self):
        """What is wrong with it, in a few words, or None."""
        lines = [line for line in self.err.splitlines() if line.startswith("stmnist: ")]
        if self.blocked:
            return f"had not ended after {PATIENCE} s"
        if self.seconds > SECONDS:
            return f"took {self.seconds:.0f} s"
        if self.memory > MEMORY:
            return f"took {self.memory >> 20} MB"
        if self.status < 0:
            return f"died of signal {-self.status}"
        if "Traceback" in self.err:
            return "a traceback: " + self.err.strip().splitlines()[-1][:200]
        if self.status == 0:
            return None
        if self.status != 2:
            return f"status {self.status}: {self.err.strip()[-200:]}"
        last = self.err.rstrip().splitlines()[-max(len(lines), 1) :]
        if not lines or last != lines or len(lines) > MISTAKES:
            return f"{len(lines)} lines: {self.err.strip()[-200:]!r}"
        if len(lines) > 1 and len({line.split(": ")[1] for line in lines}) > 1:
            return f"lines of more than one source: {self.err.strip()[-200:]!r}"
        if max(map(len, lines)) > LINE:
            return f"a line of {max(map(len, lines))} characters"
        return None


CLOSED, FULL = "closed", "full"


def streams_of(rng) -> dict:
    """For one case in eight, which of the standard streams are closed or full; else empty."""
    if rng.random() > 0.125:
        return {}
    return {int(rng.integers(1, 3)): str(rng.choice([CLOSED, FULL]))}


def changed_by(streams, before, after):
    """What is wrong with a command whose streams were closed or full, beside what it was before."""
    allowed = {before.status, 2} if streams.get(1) == FULL else {before.status}
    if after.status not in allowed:
        return f"status {after.status}, not {before.status}, with {streams}"
    if "Traceback" in after.err:
        return f"a traceback with {streams}: {after.err.strip().splitlines()[-1][:200]}"
    return None


def run(arguments, folder, seconds=SECONDS, streams=None):
    """Call the command in a fork of this process, which has imported it already.

    Parameters
    ----------
    arguments : sequence
        Of ``stmnist``.
    folder : Path
        Where it works; its output, temporary files and cache are there too.
    seconds : float
        Of processor time after which the kernel ends it.
    streams : dict of int to str, optional
        Of standard output (1) and error (2): `CLOSED` or `FULL`.

    Returns
    -------
    Outcome
    """
    out, err = folder / ".out", folder / ".err"
    begun = time.monotonic()
    child = os.fork()
    if child == 0:
        _become(arguments, folder, out, err, streams or {}, seconds)
    try:
        status, usage, blocked = _wait(child, begun + max(PATIENCE, seconds))
    except BaseException:  # an interruption of the campaign: the child does not outlive it
        os.killpg(child, signal.SIGKILL)
        raise
    return Outcome(
        status=os.waitstatus_to_exitcode(status),
        out=out.read_text(errors="replace"),
        err=err.read_text(errors="replace"),
        seconds=usage.ru_utime + usage.ru_stime,
        memory=usage.ru_maxrss << 10,
        blocked=blocked,
    )


def _become(arguments, folder, out, err, streams, seconds):
    """Never returns."""
    status = 70
    try:
        os.setsid()
        for path, number in ((os.devnull, 0), (out, 1), (err, 2)):
            flags = os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC
            os.dup2(os.open(str(path), flags), number)
            if streams.get(number) == FULL:
                os.dup2(os.open("/dev/full", os.O_WRONLY), number)
        # As Python itself has them: None for what was closed before it started.
        sys.stdout = sys.__stdout__ = os.fdopen(1, "w", closefd=False)
        sys.stderr = sys.__stderr__ = os.fdopen(2, "w", closefd=False)
        if streams.get(1) == CLOSED:
            os.close(1)
            sys.stdout = sys.__stdout__ = None
        if streams.get(2) == CLOSED:
            os.close(2)
            sys.stderr = sys.__stderr__ = None
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, ADDRESSES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, int(seconds) + 2))
        os.chdir(folder)
        os.environ["STMNIST_CACHE"] = str(folder / "cache")
        from pipeline.commands.main import main

        try:
            main([str(argument) for argument in arguments])
        except SystemExit as end:
            status = int(end.code or 0)
        except BaseException:
            import traceback

            traceback.print_exc()
            status = 1
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):
                stream.flush()
        os._exit(status)


def _wait(child, end):
    while True:
        pid, status, usage = os.wait4(child, os.WNOHANG)
        if pid:
            return status, usage, False
        if time.monotonic() > end:
            os.killpg(child, signal.SIGKILL)
            _, status, usage = os.wait4(child, 0)
            return status, usage, True
        time.sleep(0.005)
