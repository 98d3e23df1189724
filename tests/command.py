"""Ways to run the command ``stmnist``."""

import contextlib
import os
import re
import select
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# The first line of a short script that imports TensorFlow, which is a million objects: Python looks
# through them while it imports and, a second long, as it ends.
LEAVE_GARBAGE = "import atexit, gc; gc.disable(); atexit.register(gc.freeze)\n"

# Verbs with the option --jobs, those of a group with its name.
WITH_JOBS = ("train", "convert", "ladder", "sweep", "adapt", "predict")
WITH_JOBS += ("data import", "data simulate", "data stats", "data plot")


def call(*arguments, main=None) -> int:
    """Run it in this process and return its exit status; ``capsys`` has what it printed.

    It starts no other processes unless ``--jobs`` is given: each would import everything anew.
    """
    if main is None:
        from pipeline.commands.main import main

    words = [str(argument) for argument in arguments]
    has_jobs = bool(words) and (words[0] in WITH_JOBS or " ".join(words[:2]) in WITH_JOBS)
    has_jobs |= words[:2] == ["check", "run"] and "--data" in words
    if has_jobs and not {"--jobs", "--scheduler", "--help"} & {*words}:
        words += ["--jobs", "1"]
    try:
        main(words)
    except SystemExit as end:
        return int(end.code or 0)
    raise AssertionError("the command ended without an exit status")


@contextlib.contextmanager
def hurry_emulator():
    """In the block, the target ``emulator`` computes as ``fast`` does.

    Every spike is the same, which tests/deploy/targets/test_fast.py shows, in a tenth of the time.
    It is for tests of what is done with a run's results, and not for processes that they start.
    """
    from deploy.targets.registry import TARGETS

    emulator = TARGETS["emulator"]
    TARGETS["emulator"] = replace(emulator, run=TARGETS["fast"].run)
    try:
        yield
    finally:
        TARGETS["emulator"] = emulator


@contextlib.contextmanager
def without_processes():
    """In the block, what would be done in several processes is done in this one.

    A process would import everything anew.
    """
    from pipeline import jobs

    parallel = jobs.Parallel
    jobs.Parallel = lambda processes, return_as, **options: parallel(1, return_as=return_as)
    try:
        yield
    finally:
        jobs.Parallel = parallel


def missing(text: str, *facts) -> list:
    """The facts (numbers, names, options) that a text lacks; how it says them may change."""
    return [fact for fact in facts if str(fact) not in text]


def environment(**more) -> dict:
    """For a process of its own that imports this repository's packages."""
    path = os.pathsep.join(map(str, (ROOT, ROOT / "fastloihi" / "src")))
    return {**os.environ, "PYTHONPATH": path, **more}


def users_environment() -> dict:
    """The same without what tests/conftest.py chooses for TensorFlow: oneDNN, and threads."""
    chosen = ("ONEDNN", "THREADS")
    return {k: v for k, v in environment().items() if not any(part in k for part in chosen)}


def printed_by(code, *arguments, env=None, cwd=ROOT) -> str:
    """Run a script in a separate Python process, which must succeed; return its standard output."""
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=cwd, env=env or environment(), capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@contextlib.contextmanager
def started(*arguments):
    """Start it as a process of its own, in a group of its own that ends with the block.

    Ctrl-C reaches it even if these tests run in a shell's background, where it is ignored.  Its
    progress bars are drawn, so that :func:`wait_until_said` can follow them.
    """
    terminal = environment(FORCE_COLOR="1", COLUMNS="100")
    with process_of(
        "-m", "pipeline", *arguments, env=terminal, stdout=subprocess.DEVNULL
    ) as process:
        yield process


@contextlib.contextmanager
def process_of(*arguments, **options):
    """A Python of its own, in a group that Ctrl-C reaches and that ends with the block."""
    process = subprocess.Popen(
        [sys.executable, *map(str, arguments)],
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **options,
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def wait_until_said(process, pattern, patience=300) -> str:
    """Read what a process says on standard error until a pattern is in it; return all of it.

    Waits for the process's own words, however long they take on a busy machine; ``patience`` in
    seconds only ends a test that would never end.
    """
    said, end = b"", time.monotonic() + patience
    while not re.search(pattern, plain(said)):
        left = end - time.monotonic()
        assert left > 0, f"it never said {pattern!r}: {plain(said)[-2000:]}"
        if select.select([process.stderr], [], [], left)[0]:
            part = os.read(process.stderr.fileno(), 1 << 16)
            assert part, f"it ended without saying {pattern!r}: {plain(said)[-2000:]}"
            said += part
    return plain(said)


def plain(said: bytes) -> str:
    """Text without a terminal's control sequences."""
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", said.decode(errors="replace"))
