"""Long commands that are killed, interrupted, out of disk or in each other's way.

Whatever happens, the same command run again must come to the result of one that nothing happened
to, byte for byte but for times of day and seconds.
"""

import contextlib
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from dataclasses import dataclass
from pathlib import Path

from ..command import ROOT

TINY = (
    *("--set", "data.samples_per_digit=60", "--set", "cnn.epochs=3", "--set", "snn.epochs=2"),
    *("--samples", "20", "--steps", "40"),
)
TINY_EVENTS = (
    *("--input", "events", "--set", "data.samples_per_digit=60", "--set", "events.epochs=3"),
    *("--set", "input.step=40", "--set", "input.refractory=40", "--samples", "20"),
)
GRACE = 60
"""Seconds within which an interrupted command ends, and a second Ctrl-C at once."""

LONGEST = 1800
EARLY = 0.12
"""Seconds in which Python itself starts, before the first line of ours."""

TIMES = {"seconds", "wall_seconds", "connect", "run", "build", "minutes"}
SOME_TIME = re.compile(rb"\d+(\.\d+)? (s|seconds|minutes)\b|[\d-]{10} \d\d:\d\d UTC")


@dataclass(frozen=True)
class Command:
    """A long command.

    Attributes
    ----------
    name : str
    arguments : callable
        From a case's folder to the arguments.
    needs : tuple of str
        What of the base is copied into the folder first.
    """

    name: str
    arguments: object
    needs: tuple = ()


def _small(f):
    return [a for a in TINY if a not in ("--samples", "--steps", "20", "40")]


COMMANDS = (
    Command("ladder", lambda f: ["ladder", f / "run", *TINY]),
    Command("events", lambda f: ["ladder", f / "events", *TINY_EVENTS]),
    Command("train", lambda f: ["train", f / "run", *_small(f)]),
    Command("convert", lambda f: ["convert", f / "run"], ("run", "-bundle", "-checks", "-ladder")),
    Command(
        "check",
        lambda f: ["check", "run", f / "run/bundle", "--target", "emulator"],
        ("run", "-checks"),
    ),
    Command("report", lambda f: ["report", f / "run"], ("run",)),
    Command("import", lambda f: ["data", "import", f / "st.zip"], ("st.zip",)),
    Command(
        "simulate",
        lambda f: ["data", "simulate", "--out", f / "new.zip", "--samples-per-digit", 90],
    ),
    Command(
        "sweep",
        lambda f: [
            "sweep", f / "sweep", "--grid", "presentation.steps=20,30", *_small(f),
            "--set", "presentation.readout_start=5", "--set", "check.samples=20",
        ],
    ),
)  # fmt: skip
"""The commands that take long enough to be stopped."""

WEIGHTS = {"ladder": 3, "events": 2, "train": 2, "convert": 2, "check": 2}


def prepare(command, folder, base):
    """A case's folder with what the command needs, and nothing of the cache's that it makes."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in command.needs:
        if name.startswith("-"):
            for path in (folder / "run").glob(name[1:] + "*"):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        elif (base / name).is_dir():
            shutil.copytree(base / name, folder / name)
        else:
            shutil.copyfile(base / name, folder / name)
    if "run" in command.needs:
        shutil.copytree(base / "cache", folder / "cache")
    (folder / "tmp").mkdir()


def start(command, folder):
    """The command as a process and group of its own; its output goes to files."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "STMNIST_CACHE": str(folder / "cache"),
        "TMPDIR": str(folder / "tmp"),
    }
    with open(folder / ".out", "w") as out, open(folder / ".err", "w") as err:
        return subprocess.Popen(
            [sys.executable, "-m", "pipeline", *map(str, command.arguments(folder))],
            cwd=folder,
            env=environment,
            stdout=out,
            stderr=err,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )


def finish(process, seconds=LONGEST):
    """Its status, or None where it went on for too long and was killed."""
    try:
        return process.wait(seconds)
    except subprocess.TimeoutExpired:
        return None
    finally:
        with contextlib.suppress(ProcessLookupError):  # a worker that outlives its parent
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def said(folder):
    """What the command wrote to standard error."""
    return (folder / ".err").read_text(errors="replace")


def fingerprint(folder):
    """A hash of each file but for times, temporary ones included: none may be left."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and path.name not in (".lock", ".out", ".err"):
            if "/source-" in f"/{name}":  # named for the time of change of its file
                name = "cache/source"
            found[name] = hashlib.sha256(_plain(path, folder)).hexdigest()
    return found


def _plain(path, folder):
    content = path.read_bytes()
    if path.suffix == ".json":
        return json.dumps(_timeless(json.loads(content))).encode()  # the order of its keys too
    if path.suffix == ".npz":
        with zipfile.ZipFile(path) as archive:
            return b"".join(archive.read(name) for name in sorted(archive.namelist()))
    if path.suffix in (".html", ".toml", ".csv"):
        return SOME_TIME.sub(b"", content.replace(str(folder).encode(), b""))
    return content


def _timeless(value):
    if isinstance(value, dict):
        return {k: _timeless(v) for k, v in value.items() if k not in TIMES}
    if isinstance(value, list):
        return [_timeless(v) for v in value]
    return round(value, 9) if isinstance(value, float) else value


@dataclass(frozen=True)
class Whole:
    """What a command comes to when nothing happens to it.

    Attributes
    ----------
    seconds : float
    files : dict
        :func:`fingerprint` of its folder; None for what differs from run to run.
    """

    seconds: float
    files: dict


def whole(command, folder, base):
    """Run a command twice."""
    runs = []
    for name in ("first", "second"):
        prepare(command, folder / name, base)
        begun = time.monotonic()
        status = finish(start(command, folder / name))
        if status != 0:
            raise RuntimeError(f"{command.name}: status {status}: {said(folder / name)[-500:]}")
        runs.append((time.monotonic() - begun, fingerprint(folder / name)))
    (seconds, a), (_, b) = runs
    shutil.rmtree(folder)
    names = a.keys() | b.keys()
    return Whole(seconds, {n: a.get(n) if a.get(n) == b.get(n) else None for n in names})


def compared(folder, expected):
    """How a folder differs from what it should be, as lines."""
    found = fingerprint(folder)
    for name in sorted(found.keys() | expected.files.keys()):
        if name not in found:
            yield f"{name} is missing"
        elif name not in expected.files:
            yield f"{name} is left over"
        elif expected.files[name] not in (None, found[name]):
            yield f"{name} is not the same"


def broken(command, rng, folder, base, expected, how, count):
    """Kill or interrupt a command some times at random moments, then let it finish.

    Parameters
    ----------
    how : str
        ``"kill"`` or ``"interrupt"``.
    count : int
        Times, at most: a command that has finished is done with.

    Returns
    -------
    int, list of str
        How often it was stopped, and what was wrong.
    """
    prepare(command, folder, base)
    findings, stops = [], 0
    for _ in range(count):
        span = 1.0 if rng.random() < 0.2 else expected.seconds
        moment = float(rng.uniform(0, span))
        process = start(command, folder)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(moment)
        if process.poll() is not None:
            finish(process)
            break
        stops += 1
        if how == "kill":
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        else:
            findings += [
                f"after {moment:.3f} s: {x}" for x in _interrupted(process, folder, moment)
            ]
    status = finish(start(command, folder))
    if status != 0:
        findings.append(f"does not go on: status {status}: {said(folder)[-300:]}")
    else:
        findings += compared(folder, expected)
    return stops, findings


def _interrupted(process, folder, moment):
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGINT)
    try:
        status = process.wait(GRACE)
    except subprocess.TimeoutExpired:
        yield f"Ctrl-C is lost: {said(folder)[-300:]!r}"
        os.killpg(process.pid, signal.SIGINT)
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            yield "and so is a second one"
        finish(process, 0.1)
        return
    finish(process, 0.1)
    err = said(folder)
    if status == 0 or (moment < EARLY and status in (-signal.SIGINT, 1, 130)):
        return
    if status == -signal.SIGINT and not err.strip():
        return
    if status != 130:
        yield f"status {status} after Ctrl-C: {err[-300:]!r}"
    if any(word in err for word in ("Traceback", "KeyboardInterrupt", "Warning")):
        yield f"{len(err.splitlines())} lines after Ctrl-C: {err[-300:]!r}"
    elif not err.splitlines()[-1].startswith("stmnist: interrupted"):
        yield f"ends with {err.splitlines()[-1]!r} after Ctrl-C"


LINGER = 10
"""Seconds within which whatever a command started has ended after it."""

LONG_ENOUGH = 30
"""Seconds in which a command has started all of its processes."""

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)


def orphaned(command, rng, folder, base, how):
    """Signal a command alone, at a random moment; nothing that it started may outlive it.

    Returns
    -------
    list of str
        What was wrong.
    """
    prepare(command, folder, base)
    moment = float(rng.uniform(0, LONG_ENOUGH))
    process = start(command, folder)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(moment)
    process.send_signal(how)
    findings = []
    try:
        process.wait(GRACE)
    except subprocess.TimeoutExpired:
        findings.append(f"after {moment:.3f} s: does not end after {how.name}")
    else:
        end = time.monotonic() + LINGER
        while (left := _of_session(process.pid)) and time.monotonic() < end:
            time.sleep(0.05)
        if left:
            findings.append(f"after {moment:.3f} s and {how.name}: leaves {'; '.join(left)}")
    finish(process, 0.1)
    return findings


def _of_session(session):
    """What runs in a session, as a line each; ended processes that nobody has waited for do not."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            fields = (path / "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) == session and fields[0] not in "ZX":
                words = (path / "cmdline").read_bytes().split(b"\0")
                found.append(f"{path.name} {b' '.join(words).decode(errors='replace')[:100]}")
    return found


def full_disk(command, rng, folder, base, expected):
    """A disk that is full at a random point, then has room; then one that is read-only."""
    folder.mkdir(parents=True)
    size = max(64 << 10, int(rng.uniform(0.1, 1.1) * expected_size(command, base)))
    if not _mount(folder, f"size={size}"):
        return ["cannot mount a small disk here (root is needed): left out"]
    findings = []
    try:
        try:
            prepare(command, folder, base)
        except OSError:
            _mount(folder, "remount,size=1g")
            shutil.rmtree(folder / "run", ignore_errors=True)
            return []
        findings += _refused(command, folder, "on a full disk", also=0)
        _mount(folder, "remount,size=1g")
        status = finish(start(command, folder))
        if status != 0:
            findings.append(f"does not go on: status {status}: {said(folder)[-300:]}")
        else:
            findings += compared(folder, expected)
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)
    return findings


def read_only(command, rng, folder, base):
    """A folder that cannot be written to."""
    inner = folder / "disk"
    inner.mkdir(parents=True)
    if not _mount(inner, "size=1g"):
        return ["cannot mount a read-only disk here (root is needed): left out"]
    try:
        prepare(command, inner, base)
        for name in (".out", ".err"):
            (inner / name).symlink_to(folder / name)
        subprocess.run(["mount", "-o", "remount,ro", str(inner)], check=True)
        return _refused(command, inner, "on a read-only disk", also=0)
    finally:
        subprocess.run(["umount", "-l", str(inner)], check=False)


def _refused(command, folder, where, also):
    status = finish(start(command, folder))
    err = said(folder)
    if status == also:
        return []
    if status == 1 and "failed; the same command tries" in err and "Traceback" not in err:
        return []
    if status != 2 or "Traceback" in err or not err.splitlines()[-1].startswith("stmnist: "):
        return [f"{where}: status {status}: {err[-300:]!r}"]
    return []


def expected_size(command, base):
    """Bytes that a command's folder takes, about."""
    needs = [base / name for name in command.needs if not name.startswith("-")]
    files = [f for path in needs for f in ([path] if path.is_file() else path.rglob("*"))]
    return sum(f.stat().st_size for f in files if f.is_file()) + (600 << 10)


def _mount(folder, options):
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)],
        stderr=subprocess.DEVNULL,
        check=False,
    )
    return done.returncode == 0


def two_at_once(command, rng, folder, base, expected):
    """Two of a command in one place: one or both do it, a second one says why not."""
    prepare(command, folder, base)
    first = start(command, folder)
    with contextlib.suppress(subprocess.TimeoutExpired):
        first.wait(float(rng.uniform(0, expected.seconds * 0.7)))
    kept = folder / ".err"
    mine = Path(folder / ".first")
    kept.rename(mine)
    second = start(command, folder)
    statuses = finish(first), finish(second)
    findings = []
    for status, path in zip(statuses, (mine, kept), strict=True):
        err = path.read_text(errors="replace")
        fits = status == 0 or (status == 2 and err.splitlines()[-1].startswith("stmnist: "))
        if not fits or "Traceback" in err:
            findings.append(f"two at once: statuses {statuses}: {err[-300:]!r}")
    mine.unlink()
    if 0 not in statuses:
        findings.append(f"two at once: neither came to an end: {statuses}")
    if not findings:
        findings += compared(folder, expected)
    return findings
