"""Ctrl-C, however early and wherever it falls."""

import contextlib
import os
import signal
import subprocess
import sys
import textwrap
import threading

import pytest

from deploy import interrupts
from pipeline.__main__ import QUIET, report_thread_errors

from .command import ROOT, environment, process_of

LINE = f"stmnist: {interrupts.LINE}"


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


GARBAGE = """
    def callback(phase, info):
        wait()
    gc.callbacks.append(callback)
    gc.collect()
"""
WEAK_REFERENCE = """
    class Thing:
        pass
    thing = Thing()
    reference = weakref.ref(thing, lambda _: wait())
    del thing
"""
EXECUTED = """
    exec("wait()")
"""
CAUGHT = """
    while True:
        try:
            wait()
        except BaseException:
            pass
"""
SILENCED = """
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    wait()
"""
BUSY = """
    import gc, os, weakref
    from deploy import interrupts

    def wait():
        print("ready", flush=True)
        while True:
            pass

    interrupts.end_at_once("stmnist")
"""


@pytest.mark.parametrize("where", [GARBAGE, WEAK_REFERENCE, EXECUTED, CAUGHT, SILENCED])
def test_it_is_one_line_wherever_it_falls(where):
    """Python drops a KeyboardInterrupt in the first two; a library may catch it."""
    with started(textwrap.dedent(BUSY) + textwrap.dedent(where)) as process:
        assert interrupted(process) == (130, "", LINE + "\n")


def test_it_leaves_no_temporary_file_and_no_child(tmp_path):
    code = f"""
        import multiprocessing, os, signal, sys, tempfile
        from deploy import interrupts
        from deploy.files import locked_folder, replacing
        from pipeline.temporary import own_folder

        interrupts.end_at_once("stmnist")
        multiprocessing.set_start_method("fork")
        folder = {str(tmp_path)!r}
        with own_folder(), locked_folder(folder + "/new/run", ""), replacing(folder + "/a") as file:
            file.write(b"half")
            handle, _ = tempfile.mkstemp()
            child = multiprocessing.Process(target=signal.pause)
            child.start()
            print(child.pid, flush=True)
            signal.pause()
        """
    own = told(TMPDIR=str(tmp_path))
    with process_of("-c", textwrap.dedent(code), **own) as process:
        child = int(process.stdout.readline())
        assert len(list(tmp_path.iterdir())) == 3
        assert interrupted(process) == (130, "", LINE + "\n")
    assert not list(tmp_path.iterdir())
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_a_new_bundle_is_removed_and_the_earlier_one_restored(tmp_path):
    """Interrupted between the two renames that exchange them."""
    code = f"""
        import os, signal
        from pathlib import Path
        from deploy import interrupts
        from deploy.check.bundle import _exchange

        interrupts.end_at_once("stmnist")
        replace = os.replace
        def replace_and_wait(*names):
            replace(*names)
            print("ready", flush=True)
            while True:
                pass
        os.replace = replace_and_wait
        os.chdir({str(tmp_path)!r})
        Path("old").mkdir()
        Path("new").mkdir()
        Path("old/kept").touch()
        def unwind():
            os.replace = replace
        with interrupts.at_the_end(unwind):
            _exchange(Path("new"), Path("old"))
        """
    with started(code) as process:
        assert interrupted(process)[0] == 130
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "old"]
    assert (tmp_path / "old" / "kept").exists()


ORDERLY = """
    from deploy import interrupts
    interrupts.end_at_once("stmnist")
    try:
        with interrupts.orderly():
            print("ready", flush=True)
            while True:
                pass
    except KeyboardInterrupt:
        print("closed", flush=True)
        {rest}
"""


@pytest.mark.parametrize(
    ("rest", "again", "outcome"),
    [
        ("exit(130)", False, (130, "closed\n", "")),
        ("while True: pass", True, (130, "", LINE + "\n")),
    ],
)
def test_an_orderly_end_is_interrupted_once(rest, again, outcome):
    """A second Ctrl-C ends the process."""
    with started(ORDERLY.format(rest=rest)) as process:
        if again:
            process.send_signal(signal.SIGINT)
            assert process.stdout.readline() == "closed\n"
        assert interrupted(process) == outcome


@pytest.mark.parametrize(("guard", "status"), [("end_at_once('stmnist')", 0), ("LINE", -2)])
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
        with interrupts.orderly():
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
    # The first line can be the rest of one that was read above.
    assert (process.returncode, out, err.splitlines()[-1]) == (130, "", LINE)
    assert "Traceback" not in err


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
    report_thread_errors()

    def trip():
        raise error(2)

    thread = threading.Thread(target=trip, name=name)
    thread.start()
    thread.join()
    assert said == [error] * heard
