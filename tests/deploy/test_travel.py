"""A copied bundle runs by itself: on this Python, on a real Python 3.8, with a board, at INRC."""

import json
import os
import platform
import re
import shutil
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deploy import requirements as host
from deploy.check.bundle import CheckSet, write_bundle
from deploy.check.run import run_check
from deploy.conformance.networks import draw_frames, make_event_network, make_image_network
from deploy.network.decision import Estimator
from deploy.network.stimulus import EventFrames, apply_refractory_period
from tests.command import missing
from tests.deploy.networks import draw_checks
from tests.deploy.standin import STANDIN

ROOT = Path(__file__).parent.parent.parent
INRC = ROOT / "deploy" / "inrc"
OLD_PYTHON = ROOT / ".venv-inrc" / "bin" / "python"


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A bundle and the emulator's result at home: ``(bundle, result)``."""
    spec = make_image_network(steps=10, gap=3, readout_start=4)
    bundle, result = at_home(tmp_path_factory.mktemp("home"), spec)
    assert all(result["spikes"].values())
    assert len({sample["spike_hash"] for sample in result["samples"]}) == 7
    return bundle, result


def at_home(folder, spec, checks=None):
    bundle = write_bundle(folder / "bundle", spec, checks or draw_checks(spec, 7))
    result = run_check(bundle, "emulator", folder / "checks" / "emulator.json")
    return bundle, result.to_dict()


@pytest.fixture
def copied(home, tmp_path):
    """The bundle as it arrives on another machine."""
    return Path(shutil.copytree(home[0].path, tmp_path / "copied"))


def pyz(bundle, *arguments, python=sys.executable, standin=True, faults=None, **options):
    """Run ``deploy.pyz`` inside the bundle with nothing of this repository on its path."""
    environment = {"PATH": os.environ["PATH"], "HOME": os.environ.get("HOME", "/")}
    if standin:
        environment["PYTHONPATH"] = str(STANDIN)
    if faults:
        environment["NXSDK_STANDIN"] = json.dumps(faults)
    return subprocess.run(
        [str(python), "deploy.pyz", *arguments],
        cwd=bundle, env=environment, capture_output=True, text=True, timeout=300, **options,
    )  # fmt: skip


def same_answers(a, b):
    """Every spike and prediction the same; scores may differ in the last digit, as BLAS's kernels
    for different processors do."""
    scores = [np.array([sample["scores"] for sample in result["samples"]]) for result in (a, b)]
    rest = [[{**sample, "scores": None} for sample in r["samples"]] for r in (a, b)]
    same = rest[0] == rest[1] and a["spikes"] == b["spikes"]
    return same and np.allclose(*scores, rtol=0, atol=1e-9)


def result_in(bundle, target):
    return json.loads((bundle / "checks" / f"{target}.json").read_text())


@pytest.mark.parametrize(
    ("package", "version", "fact"),
    [
        ("numpy", "3.0.0", "'numpy>=1.17,<3'"),
        ("numpy", "1.16.6", "'numpy>=1.17,<3'"),
        ("nengo", "2.8.0", "'nengo>=3.1,<5'"),
        ("nengo", "5.0.0", "'nengo>=3.1,<5'"),
        ("nengo", "3.2.0", "'numpy<2'"),
        ("nengo-loihi", "0.10.0", "nengo-loihi 0.10.0"),
    ],
)
def test_host_with_other_versions(monkeypatch, package, version, fact):
    real = host.version
    monkeypatch.setattr(host, "version", lambda name: version if name == package else real(name))
    assert missing(host.describe_missing(), fact, *([version] if version != "3.2.0" else [])) == []


def test_host_without_a_package(monkeypatch):
    monkeypatch.setattr(host, "PACKAGES", {"no-such-package": ((1,), (2,), "")})
    assert "'no-such-package>=1,<2'" in host.describe_missing()


def test_all_packages_that_a_host_lacks_are_said_at_once(monkeypatch):
    packages = {"no-such-package": ((1,), (2,), ""), "nor-this": ((0, 3), (4,), "")}
    monkeypatch.setattr(host, "PACKAGES", packages)
    command = "pip install 'no-such-package>=1,<2' 'nor-this>=0.3,<4'"
    assert command in host.describe_missing()


def test_host_with_an_old_python(monkeypatch):
    monkeypatch.setattr(host, "OLDEST_PYTHON", (3, 99))
    assert f"Python {platform.python_version()} " in host.describe_missing()


old_python = pytest.mark.skipif(
    not OLD_PYTHON.exists(), reason="no Python 3.8 environment; 'make setup-inrc' makes one"
)


@old_python
def test_python_38_gives_the_same_result(home, copied):
    """Only numpy, scipy, nengo and nengo-loihi are there, in the versions of INRC hosts."""
    run = pyz(copied, "check", ".", "--target", "emulator", python=OLD_PYTHON, standin=False)
    assert run.returncode == 0, run.stderr
    result = result_in(copied, "emulator")
    assert result["versions"]["python"].startswith("3.8")
    assert same_answers(result, home[1])
    assert set(result) == set(home[1])


@old_python
def test_python_38_answers_a_bundle_of_events(tmp_path):
    """With taxels that rest and an estimator: each sample is decided in a step of its own."""
    rng = np.random.default_rng(0)
    estimator = {
        name: 0.3 * rng.normal(size=shape) for name, shape in Estimator.list_shapes(3).items()
    }
    spec = replace(
        make_event_network(threshold=0.7),
        stimulus=EventFrames(0.01, refractory=1),
        estimator=Estimator.from_arrays(estimator, 3),
    )
    frames = apply_refractory_period(np.moveaxis(draw_frames(spec, 7, share=0.2), 1, 0), 1)
    names = tuple(f"random/{i:03d}" for i in range(7))
    checks = CheckSet(np.moveaxis(frames, 0, 1), rng.integers(0, 3, 7), names, 0)
    bundle, expected = at_home(tmp_path / "home", spec, checks)
    copied = shutil.copytree(bundle.path, tmp_path / "copied")
    run = pyz(copied, "check", ".", "--target", "emulator", python=OLD_PYTHON, standin=False)
    assert run.returncode == 0, run.stderr
    result = result_in(copied, "emulator")
    assert same_answers(result, expected)
    decided = [sample["stopped_at"] for sample in result["samples"]]
    assert decided == [sample["stopped_at"] for sample in expected["samples"]]
    assert len(set(decided)) > 2


@old_python
def test_python_38_drives_a_board(home, copied):
    run = pyz(copied, "check", ".", "--target", "loihi", python=OLD_PYTHON)
    assert run.returncode == 0, run.stderr
    assert same_answers(result_in(copied, "loihi"), home[1])


def guide_blocks():
    return re.findall(r"```sh\n(.*?)```", (INRC / "README.md").read_text(), re.DOTALL)


def command(folder, name, text):
    path = folder / name
    path.write_text(text)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


@pytest.fixture
def far_away(tmp_path):
    """Stand-ins for what only INRC has; returns the environment to run the guide in."""
    commands, remote, jobs = tmp_path / "bin", tmp_path / "inrc", tmp_path / "jobs"
    for folder in (commands, remote, jobs):
        folder.mkdir()
    slurm = ROOT / "tests" / "slurm_standin" / "slurm.py"
    for name in ("sbatch", "squeue", "sinfo"):
        command(commands, name, f'#!/bin/bash\nexec "{sys.executable}" "{slurm}" {name} "$@"\n')
    # "ssh inrc" alone changes into the remote home, as one's terminal does
    functions = tmp_path / "functions.sh"
    functions.write_text(
        f"""
ssh() {{ shift; if [ $# = 0 ]; then cd "{remote}"; else (cd "{remote}" && "$@"); fi; }}
scp() {{ local a; a=("${{@/#inrc:/{remote}/}}"); command cp -r "${{a[@]/#-r/--}}"; }}
conda() {{ case $1 in create|activate) ;; *) return 2;; esac; }}
pip() {{ [ "$1" = install ] && if [ "$2" = -r ]; then [ -f "$3" ]; fi; }}
"""
    )
    command(commands, "python", f'#!/bin/bash\nexec "{sys.executable}" "$@"\n')
    command(
        commands, "stmnist", f'#!/bin/bash\nPYTHONPATH="{ROOT}" exec "{sys.executable}" '
        '-c "from pipeline.commands.main import main; main()" "$@"\n',
    )  # fmt: skip
    return {
        "PATH": f"{commands}:{os.environ['PATH']}",
        "HOME": str(tmp_path),
        "PYTHONPATH": str(STANDIN),
        "SLURM_STANDIN": str(jobs),
        "PARTITION": "nahuku32",
        # A few steps in plain Python take less time than to compile them in each process.
        "NUMBA_DISABLE_JIT": "1",
        "NXSDK": "nxsdk.tar.gz",
        "BASH_ENV": str(functions),
    }


def test_guide_from_end_to_end(home, far_away, tmp_path):
    """Every command of the guide, in its order, with stand-ins for what INRC has."""
    work = tmp_path / "work"
    shutil.copytree(home[0].path, work / "runs" / "default" / "bundle")
    (work / "runs" / "default" / "checks").mkdir()
    (work / "runs" / "default" / "experiment.toml").touch()
    shutil.copytree(INRC, work / "deploy" / "inrc")
    steps = guide_blocks()
    assert len(steps) == 5
    steps[4] = f'cd "{work}"\n' + steps[4]  # back home
    script = "set -euo pipefail\n" + "\n".join(steps)
    run = subprocess.run(
        ["bash", "-c", script], cwd=work, env=far_away, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert "1 COMPLETED" in run.stdout
    assert "0 of 7" in run.stdout
    fetched = json.loads((work / "runs" / "default" / "checks" / "loihi.json").read_text())
    assert same_answers(fetched, home[1])
    assert fetched["hardware"]["partition"] == "nahuku32"


def test_job_submitted_again_goes_on(home, far_away, tmp_path):
    checks = shutil.copytree(home[0].path, tmp_path / "bundle") / "checks"
    partial = checks / ".loihi.json.partial"
    shutil.copy(INRC / "check.sbatch", tmp_path)
    for faults, state in (({"kill_at_step": 60}, "FAILED 137"), ({}, "COMPLETED")):
        if not faults:
            assert len(partial.read_text().splitlines()) == 2  # a header and the first stream
            assert not (checks / "loihi.json").exists()
        far_away["NXSDK_STANDIN"] = json.dumps(faults)
        subprocess.run(
            ["sbatch", "check.sbatch", "bundle", "nahuku32"],
            cwd=tmp_path, env=far_away, check=True, capture_output=True,
        )  # fmt: skip
        states = sorted((tmp_path / "jobs").iterdir())
        assert states[-1].read_text() == state
    result = result_in(tmp_path / "bundle", "loihi")
    assert same_answers(result, home[1])
    assert result["hardware"]["connections"] == 3
    assert not partial.exists()
