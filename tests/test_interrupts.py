"""Ctrl-C, however early and wherever it falls."""

import contextlib
import os
import signal
import subprocess
import sys
import textwrap
import threading

import pytest

from pipeline.__main__ import QUIET, hear_threads

from .command import ROOT, environment, process_of

LINE = "stmnist: interrupted; the same command goes on where it stopped"


def told(**more):
    """Options of a process whose words are read as text; ``more`` of its environment."""
    return {"env": environment(**more), "stdout": subprocess.PIPE, "text": True}


@contextlib.contextmanager
def started(code):
    """A process of its own that runs some code and has said that it is ready."""
    with process_of("-c", textwrap.dedent(code), **told()) as process:
        assert process.stdout.readline() == "ready\n"
        yield process


def interrupted(process, seconds=300):
    """Its status and what it said after Ctrl-C."""
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=seconds)
    return process.returncode, out, err


def test_in_the_imports_it_is_one_line():
    code = """
        from deploy import interrupts
        interrupts.end_at_once("stmnist")
        print("ready", flush=True)
        while True:
            try:
                import nowhere
            except BaseException:
                pass
        """
    with started(code) as process:
        assert interrupted(process) == (130, "", LINE + "\n")


def test_in_the_imports_of_a_verb_it_is_one_line():
    """They come after the command's own, since they are not needed to list the verbs."""
    code = """
        import sys

        class Long:
            def find_spec(self, name, path, target=None):
                if name == "pipeline.commands.settings":
                    print("ready", flush=True)
                    try:
                        while True:
                            pass
                    except KeyboardInterrupt:
                        raise ImportError(name)

        sys.argv = ["stmnist", "settings"]
        sys.meta_path.insert(0, Long())
        from pipeline.__main__ import main
        main()
        """
    with started(code) as process:
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
    with started(DROPPED) as process:
        status, out, err = interrupted(process)
    assert (status, out) == (130, "came through\n")
    assert err == ""


def test_without_the_guard_it_would_be_lost():
    """What the test before is about: Python itself prints and drops it, and goes on."""
    code = DROPPED.replace('interrupts.raised("stmnist")', "open('/dev/null')")
    with started(code) as process:
        process.send_signal(signal.SIGINT)
        assert process.stderr.readline().startswith("Exception ignored in")
        while process.stderr.readline() != "KeyboardInterrupt: \n":
            assert process.poll() is None
        with pytest.raises(subprocess.TimeoutExpired):
            process.communicate(timeout=0.2)


def test_in_a_text_that_is_executed_it_ends_by_its_status(tmp_path):
    """CPython takes it for one that nobody caught, and ends "python -m" by a signal."""
    code = """
        import sys, threading
        from deploy import interrupts

        interrupts.end_at_once("stmnist")
        threading.Thread(target=threading.Event().wait, daemon=True).start()
        with interrupts.raised("stmnist"):
            try:
                exec("print('ready', flush=True)\\nwhile True: pass")
            except KeyboardInterrupt:
                print("came through", flush=True)
                sys.exit(130)
        """
    (tmp_path / "executes.py").write_text(textwrap.dedent(code))
    with process_of("-m", "executes", cwd=tmp_path, **told()) as process:
        assert process.stdout.readline() == "ready\n"
        assert interrupted(process) == (130, "came through\n", "")


def test_a_weak_reference_does_not_lose_it():
    code = """
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
    with started(code) as process:
        assert interrupted(process)[0] == 130


def test_a_second_one_ends_at_once():
    code = """
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
    with started(code) as process:
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "ready\n"
        assert interrupted(process) == (130, "", LINE + "\n")


@pytest.mark.parametrize(("guard", "status"), [("end_at_once('stmnist')", 0), ("is_ours()", -2)])
def test_when_python_has_taken_its_handlers_away_all_is_done(guard, status):
    """Whichever thread hears it: those of TensorFlow and Numba outlive Python's own."""
    code = f"""
    import os, signal, sys, threading
    from deploy import interrupts
    threading.Thread(target=threading.Event().wait, daemon=True).start()
    interrupts.{guard}
    class Last:
        kill, arguments = os.kill, (os.getpid(), signal.SIGINT)
        def __del__(self):
            self.kill(*self.arguments)
    sys.kept = Last()  # until Python takes its modules apart
    with interrupts.raised("stmnist"):
        print("ready", flush=True)
    """
    with started(code) as process:
        out, err = process.communicate(timeout=300)
        assert (process.returncode, out, err) == (status, "", "")


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


@pytest.mark.parametrize("module", ["deploy.errors", "numpy", "scipy.special", "pipeline.settings"])
def test_early_in_the_command(module, tmp_path):
    """As soon as Python tells that it has imported a module, which is before anything is done."""
    command = ("-X", "importtime", "-m", "pipeline", "data", "simulate", "--seed", "12345")
    cache = {"STMNIST_CACHE": str(tmp_path / "cache")}
    with process_of(*command, "--out", tmp_path / "a.zip", **told(**cache)) as process:
        while not process.stderr.readline().rstrip().endswith(f" {module}"):
            assert process.poll() is None
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=300)
    said = [line for line in err.splitlines() if not line.startswith("import time:")]
    assert (process.returncode, out, said) == (130, "", [LINE])


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


@pytest.mark.parametrize(
    ("name", "error", "heard"),
    [
        ("ExecutorManagerThread", KeyError, False),
        ("ExecutorManagerThread", ValueError, True),
        ("another", KeyError, True),
    ],
)
def test_joblib_may_trip_over_jobs_that_are_given_up(monkeypatch, name, error, heard):
    said = []
    monkeypatch.setattr(threading, "excepthook", lambda told: said.append(told.exc_type))
    hear_threads()

    def trip():
        raise error(2)

    thread = threading.Thread(target=trip, name=name)
    thread.start()
    thread.join()
    assert said == [error] * heard
