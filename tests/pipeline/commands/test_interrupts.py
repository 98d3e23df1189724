"""Ctrl-C is one line and status 130, without a traceback, and nothing is left."""

import os
import signal
import subprocess
import sys

import pytest

from deploy.terminal import INTERRUPTION
from tests.command import environment, process_of

LINE = f"stmnist: {INTERRUPTION}"


@pytest.mark.parametrize("module", ["deploy.errors", "numpy", "scipy.special", "pipeline.settings"])
def test_early_in_the_command(module, tmp_path):
    """As soon as Python tells that it has imported a module, which is before anything is done."""
    command = ("-X", "importtime", "-m", "pipeline", "data", "simulate", "--seed", "12345")
    told = {"env": environment(STMNIST_CACHE=str(tmp_path / "cache")), "text": True}
    with process_of(
        *command, "--out", tmp_path / "a.zip", stdout=subprocess.PIPE, **told
    ) as process:
        while not process.stderr.readline().rstrip().endswith(f" {module}"):
            assert process.poll() is None
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=300)
    assert (process.returncode, out, err.splitlines()[-1]) == (130, "", LINE)
    assert "Traceback" not in err
    assert not list(tmp_path.rglob(".*.tmp"))


IN_A_DESTRUCTOR = """
import os, signal
from pipeline.commands.main import main

class Late:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        sum(range(9))

def command(**options):
    Late()
    signal.pause()

main([], command)
"""


IN_NATIVE_CODE = """
import os, signal
from pipeline.commands.main import main

def command(**options):
    try:
        os.kill(os.getpid(), signal.SIGINT)
        signal.pause()
    except KeyboardInterrupt:
        raise TypeError("what native code makes of it")

main([], command)
"""


@pytest.mark.parametrize("program", [IN_A_DESTRUCTOR, IN_NATIVE_CODE])
def test_where_python_drops_it(program):
    """In a destructor, of which TensorFlow has many, or as another error of native code."""
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        timeout=60,
        env=environment(),
    )
    assert (done.returncode, done.stderr.splitlines()) == (130, [LINE])


WITH_WORKERS = """
import os, signal
from joblib import delayed
from pipeline.commands.main import main
from pipeline.jobs import call_in_processes

def command(**options):
    with call_in_processes([delayed(os.getpid)(), delayed(signal.pause)()], 2) as results:
        print(next(results), flush=True)
        list(results)

main([], command)
"""


def test_a_command_that_is_terminated_ends_its_workers():
    """They inherit its output, which has an end only when the last of them has ended."""
    with process_of("-c", WITH_WORKERS, stdout=subprocess.PIPE, env=environment()) as process:
        assert int(process.stdout.readline()) != process.pid
        process.terminate()
        _, err = process.communicate(timeout=60)
    assert (process.returncode, err.decode().splitlines()) == (130, [LINE])
