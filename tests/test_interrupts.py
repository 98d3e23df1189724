"""Ctrl-C, however early and wherever it falls."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import pytest

from pipeline.__main__ import QUIET

from .command import ROOT, environment

LINE = "stmnist: interrupted; the same command goes on where it stopped"


def started(code):
    """A process of its own that runs some code and has said that it is ready."""
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)],
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout.readline() == "ready\n"
    return process


def interrupted(process, seconds=20):
    process.send_signal(signal.SIGINT)
    try:
        out, err = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise
    return process.returncode, out, err


def test_in_the_imports_it_is_one_line():
    process = started(
        """
        from deploy import interrupts
        interrupts.end_at_once("stmnist")
        print("ready", flush=True)
        while True:
            try:
                import nowhere
            except BaseException:
                pass
        """
    )
    assert interrupted(process) == (130, "", LINE + "\n")


DROPPED = """
    import gc, sys
    from deploy import interrupts

    waiting = True
    def callback(phase, info):
        global waiting
        if waiting:
            waiting = False
            print("ready", flush=True)
            while True:
                pass

    with interrupts.raised("stmnist"):
        try:
            gc.callbacks.append(callback)
            gc.collect()
            while True:
                pass
        except KeyboardInterrupt:
            print("came through", flush=True)
            sys.exit(130)
"""


def test_a_callback_of_the_garbage_collector_does_not_lose_it():
    status, out, err = interrupted(started(DROPPED))
    assert (status, out) == (130, "came through\n")
    assert err == ""


def test_without_the_guard_it_would_be_lost():
    """What the test before is about: Python itself prints and drops it."""
    code = DROPPED.replace('interrupts.raised("stmnist")', "open('/dev/null')")
    with pytest.raises(subprocess.TimeoutExpired):
        interrupted(started(code), seconds=1)


def test_a_weak_reference_does_not_lose_it():
    process = started(
        """
        import sys, weakref
        from deploy import interrupts

        class Thing:
            pass

        def gone(reference):
            print("ready", flush=True)
            while True:
                pass

        thing = Thing()
        with interrupts.raised("stmnist"):
            try:
                reference = weakref.ref(thing, gone)
                del thing
                while True:
                    pass
            except KeyboardInterrupt:
                sys.exit(130)
        """
    )
    assert interrupted(process)[0] == 130


def test_a_second_one_ends_at_once():
    process = started(
        """
        from deploy import interrupts

        with interrupts.raised("stmnist"):
            while True:
                try:
                    print("ready", flush=True)
                    while True:
                        pass
                except KeyboardInterrupt:
                    pass
        """
    )
    process.send_signal(signal.SIGINT)
    assert process.stdout.readline() == "ready\n"
    assert interrupted(process) == (130, "", LINE + "\n")


def test_in_the_background_it_stays_ignored():
    code = """
        from deploy import interrupts
        import os, signal
        interrupts.end_at_once("stmnist")
        with interrupts.raised("stmnist"):
            os.kill(os.getpid(), signal.SIGINT)
        print("went on")
        """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env=environment(), capture_output=True, text=True, check=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )  # fmt: skip
    assert done.stdout == "went on\n"


@pytest.mark.parametrize("moment", [0.2, 0.5, 0.9])
def test_early_in_the_command(moment, tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "pipeline", "data", "simulate", "--out", tmp_path / "a.zip",
         "--seed", "12345"],
        env=environment(STMNIST_CACHE=str(tmp_path / "cache")),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    time.sleep(moment)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    if process.returncode == -signal.SIGINT:  # before Python itself had started
        return
    assert (process.returncode, out) == (130, "")
    assert err.splitlines()[-1] == LINE
    assert len(err.splitlines()) <= 2  # progress may be there, a traceback may not


def test_what_an_interruption_leaves_to_joblibs_process_is_not_told():
    """It came after the command's last line: a warning of semaphores that are cleaned up."""
    warn = "import warnings; warnings.warn('resource_tracker: There appear to be 6 leaked')"
    for quiet, heard in ((QUIET, False), ("default", True)):
        done = subprocess.run(
            [sys.executable, "-c", warn], env=environment(PYTHONWARNINGS=quiet),
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert ("leaked" in done.stderr) == heard


def test_the_script_begins_where_the_guard_is():
    assert 'stmnist = "pipeline.__main__:main"' in (ROOT / "pyproject.toml").read_text()
