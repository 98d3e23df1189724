"""A package of another author adds a target, a format and an operation, by entry points alone."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.check.bundle import make_zipapp
from deploy.network.ops import DEPLOYED_OPERATIONS
from deploy.plugins import NOT_IN_BUNDLES
from deploy.targets.registry import TARGETS
from models.conformance import assert_operation_conforms
from models.ops import OPERATIONS
from tests.command import ROOT, environment, missing
from tests.deploy.networks import bundle_at
from tests.extensions.test_from_outside import delete_at_the_end
from tests.test_documentation import blocks, read

TARGET = """
from dataclasses import dataclass

import numpy as np
from deploy.network.output import TargetOutput
from deploy.targets.options import Options, option
from deploy.targets.registry import Target, register_target


@dataclass(frozen=True)
class ConstantOptions(Options):
    label: int = option(0, "The class that is always predicted.", 0, 9)


def run(spec, streams, seed, options):
    for samples in streams:
        readout = np.zeros((len(samples), spec.presentation.steps, spec.layers[-1].size))
        readout[:, :, options.label] = 100  # far above the bias
        yield TargetOutput(readout)


register_target(Target("constant", run, "Always one class", options=ConstantOptions))
"""
FORMAT = """
import json

from pipeline.recordings.formats import register_format
from pipeline.recordings.formats.recording import make_recording


def read(content, name):
    x, y, t, p = zip(*json.loads(content))
    return make_recording({"x": x, "y": y, "t_s": t, "p": p})


def register():
    register_format(".toy", read)
"""
ENTRIES = """
[stmnist.plugins]
constant-target = toy_target
toy-format = toy_format:register
"""
ENTRY_OF_OPERATION = """
[stmnist.plugins]
scaling = my_additions.operation
"""
ENTRIES_OF_OPERATION = f"""{ENTRY_OF_OPERATION}
scaling-in-bundles = my_additions.deployed_operation
"""
MAKE_BUNDLE = """
import sys
from pathlib import Path

from deploy.plugins import load_plugins

load_plugins()

from pipeline.kinds.architectures import make_untrained_network
from pipeline.settings import Settings
from tests.deploy.networks import bundle_at

spec = make_untrained_network("5x5-scale-10o", False, Settings().deployment)
bundle_at(Path(sys.argv[1]), spec)
"""
BROKEN = """
[stmnist.plugins]
broken = no_such_module
"""


def install(site, name, entries, **modules):
    """A distribution as pip installs it in a folder, which may be on Python's path."""
    for module, source in modules.items():
        (site / f"{module}.py").write_text(source)
    info = site / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entries)


@pytest.fixture
def site(tmp_path):
    site = tmp_path / "site"
    site.mkdir()
    install(site, "toy", ENTRIES, toy_target=TARGET, toy_format=FORMAT)
    return site


# Runs a program as on a host that has only `deploy`, although the tests' Python has the rest.
RUN_IN_BUNDLE = f"""
import runpy
import sys

for name in {NOT_IN_BUNDLES}:
    sys.modules[name] = None
del sys.argv[0]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def run(site, *arguments, has_pipeline=True):
    """A Python process with the folder on its path; with the packages of this repository or not."""
    if not has_pipeline:
        arguments = ("-c", RUN_IN_BUNDLE, *arguments)
    path = [str(site), str(ROOT / "fastloihi" / "src"), *([str(ROOT)] if has_pipeline else [])]
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=site.parent, env=environment(PYTHONPATH=os.pathsep.join(path)),
        capture_output=True, text=True,
    )  # fmt: skip


def predictions_of(path):
    return {sample["prediction"] for sample in json.loads(path.read_text())["samples"]}


def test_the_command_knows_the_target_and_its_options(site, tmp_path):
    bundle_at(tmp_path / "bundle")
    out = tmp_path / "constant.json"
    check = ("-m", "pipeline", "check", "run", tmp_path / "bundle", "--target", "constant")
    done = run(site, *check, "--label", "3", "--out", out)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert predictions_of(out) == {3}
    shown = run(site, "-m", "pipeline", "check", "run", "--help").stdout
    assert missing(shown, "Target constant", "--label") == []


def test_a_copied_bundle_knows_the_target_and_leaves_out_the_format(site, tmp_path):
    """There is no ``pipeline``, for which the format is."""
    bundle_at(tmp_path / "bundle")
    program = tmp_path / "deploy.pyz"
    program.write_bytes(make_zipapp())
    check = (program, "check", tmp_path / "bundle", "--target", "constant", "--label", "2")
    done = run(site, *check, has_pipeline=False)
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr
    assert predictions_of(tmp_path / "bundle" / "checks" / "constant.json") == {2}


@pytest.fixture
def recordings(tmp_path):
    content = json.dumps([[0, 0, 0.1, 1], [2, 1, 0.2, 0]])
    for label in ("a", "b"):
        for number in range(4):
            path = tmp_path / "own" / label / f"{number}.toy"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
    return tmp_path / "own"


def test_the_command_and_its_workers_read_the_format(site, recordings):
    done = run(site, "-m", "pipeline", "data", "import", recordings, "--jobs", "2")
    assert done.returncode == 0, done.stderr
    assert "8" in done.stdout + done.stderr


def test_python_reads_the_format(site, recordings):
    code = f"from stmnist import Recordings; print(len(Recordings.read({str(recordings)!r})))"
    done = run(site, "-c", code)
    assert done.stdout.split() == ["8"], done.stderr


def test_a_plugin_that_cannot_be_imported_is_named_in_one_line(site, tmp_path):
    install(site, "other", BROKEN)
    done = run(site, "-m", "pipeline", "check", "run", "--help")
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()
    assert missing(line, "broken", "no_such_module", "ModuleNotFoundError") == []


def test_the_list_of_commands_loads_no_plugin(site):
    install(site, "other", BROKEN)
    assert run(site, "-m", "pipeline", "--help").stderr == ""


def list_page_blocks():
    """The blocks of Python of the page on plugins: the file each is in, or None, and its code."""
    for language, block in blocks(read(ROOT / "docs" / "plugins.md")):
        if language == "python":
            first = block.lstrip().splitlines()[0]
            is_file = first.startswith("# my_additions/")
            yield Path(first[2:]) if is_file else None, block


def write_page_modules(site):
    """Write the modules of the page on plugins."""
    (site / "my_additions").mkdir(parents=True)
    for path, block in list_page_blocks():
        if path is not None:
            (site / path).write_text(block)


def check_with_scaling(tmp_path, entries):
    """Check a bundle with the operation of the page where only ``deploy`` is installed."""
    site = tmp_path / "site"
    write_page_modules(site)
    install(site, "additions", entries)
    bundle = tmp_path / "bundle"
    made = run(site, "-c", MAKE_BUNDLE, bundle)
    assert made.returncode == 0, made.stderr
    check = (bundle / "deploy.pyz", "check", bundle, "--target", "fast")
    return run(site, *check, has_pipeline=False)


def test_a_copied_bundle_runs_the_operation(tmp_path):
    done = check_with_scaling(tmp_path, ENTRIES_OF_OPERATION)
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr
    result = json.loads((tmp_path / "bundle" / "checks" / "fast.json").read_text())
    assert "scaling1" in result["spikes"]


def test_a_copied_bundle_names_the_plugin_that_it_left_out(tmp_path):
    done = check_with_scaling(tmp_path, ENTRY_OF_OPERATION)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    wanted = ("'layers[0].kind'", "not 'scaling'", "plugin scaling (my_additions.operation)")
    assert missing(line, *wanted, "ModuleNotFoundError") == []


def test_the_page_on_plugins(monkeypatch, tmp_path):
    """Its blocks of Python, one after the other."""
    delete_at_the_end(monkeypatch, TARGETS, "noisy")
    for table in (OPERATIONS, DEPLOYED_OPERATIONS):
        delete_at_the_end(monkeypatch, table, "scaling")
    write_page_modules(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    page = {"__name__": "page"}
    for path, block in list_page_blocks():
        if path is None:
            exec(compile(block, "plugins.md", "exec"), page)
        else:
            importlib.import_module(".".join(path.with_suffix("").parts))
    assert_operation_conforms(OPERATIONS["scaling"](), (4, 4, 2))
    for name in [name for name in sys.modules if name.partition(".")[0] == "my_additions"]:
        del sys.modules[name]
