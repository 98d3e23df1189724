"""Imports go one way, and what travels to an INRC host needs nothing that is not there."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.files import read_json
from tests.command import ROOT, environment, printed_by

HIDDEN = (
    "tensorflow",
    "nengo_dl",
    "keras",
    "pipeline",
    "models",
    "h5py",
    "typer",
    "rich",
    "numba",
    "nir",
)
BARRED = f"""
import sys, runpy
class Barred:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {HIDDEN!r}:
            raise ImportError("not on this host: " + name)
sys.meta_path.insert(0, Barred())
sys.modules.pop("numba", None)
"""
OPTIONAL = {"numba", "nir", "nxsdk"}  # imported where they are used, and said if they are missing
OF_DEPLOY = {"numpy", "scipy", "nengo", "nengo_loihi", "fastloihi", "deploy", *OPTIONAL}
ALLOWED = {
    "models": {"models", "deploy"},
    "deploy": {"deploy"},
    "pipeline": {"pipeline", "models", "deploy"},
    "experiments": {"stmnist", "experiments", "pipeline", "models", "deploy"},
    "stmnist": {"stmnist"},  # and loads all others by their names, when it is asked for them
}


def sources(package):
    return sorted((ROOT / package).rglob("*.py"))


@functools.cache
def imported(path):
    """Top-level names that a source file imports, wherever in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module.split(".")[0])
    return names


# The modules and folders of each package in layers.  A module imports only modules of its own layer
# or of an earlier one.
LAYERS = {
    "pipeline": [
        {"interrupts", "jobs", "look", "paper", "progress"},
        {"settings"},
        {"storage"},
        {"recordings"},
        {"simulation"},
        {"sources"},
        {"training"},
        {"kinds"},
        {"workflow"},
        {"results"},
        {"api"},
        {"live"},
        {"commands"},
        {"__main__"},
    ],
    "deploy": [
        {"terminal"},
        {"arithmetic", "errors", "limits", "loading", "progress", "tables", "requirements"},
        {"plugins"},
        {"files"},
        {"network"},
        {"preflight"},
        {"targets"},
        {"check"},
        {"conformance", "stream"},
        {"cli"},
        {"__main__"},
    ],
}


def list_imported_modules(path):
    """Yield ``(package, module or folder)`` of all that a source file imports from our packages."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = path.relative_to(ROOT).parts[: -node.level] if node.level else ()
            base = ".".join((*above, *([node.module] if node.module else [])))
            names = [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            package, _, rest = name.partition(".")
            module = rest.split(".")[0]
            if package in LAYERS and (ROOT / package / module).with_suffix("").name:
                there = (ROOT / package / module).is_dir() or (
                    ROOT / package / f"{module}.py"
                ).exists()
                if module and there:
                    yield package, module


@pytest.mark.parametrize("package", sorted(LAYERS))
def test_a_module_imports_no_later_layer(package):
    layer_of = {module: n for n, modules in enumerate(LAYERS[package]) for module in modules}
    for path in sources(package):
        module = path.relative_to(ROOT / package).parts[0].removesuffix(".py")
        if module == "__init__":
            continue
        for other, below in list_imported_modules(path):
            if other == package and below != module:
                assert layer_of[below] <= layer_of[module], f"{path} imports {package}.{below}"


def test_only_deploy_imports_its_command_line():
    for package in ("pipeline", "models"):
        for path in sources(package):
            assert ("deploy", "cli") not in list_imported_modules(path), path


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_packages_import_one_way(package):
    ours = {"stmnist", "pipeline", "models", "deploy", "experiments", "tests"}
    for path in sources(package):
        assert imported(path) & ours <= ALLOWED[package], path


def test_deploy_imports_what_an_inrc_host_has():
    for path in sources("deploy"):
        assert imported(path) <= OF_DEPLOY | set(sys.stdlib_module_names), path


def test_each_large_library_is_imported_in_one_file():
    def users(name):
        return {
            path.relative_to(ROOT).as_posix()
            for package in ALLOWED
            for path in sources(package)
            if name in imported(path)
        }

    assert users("nengo_dl") == {"pipeline/training/nengodl.py"}
    assert users("nengo_loihi") == {"deploy/network/loihi_import.py"}
    assert users("tensorflow") == {"models/keras/keras2.py"}
    assert users("fcntl") == {"deploy/files.py"}


def test_deploy_is_written_for_python_38():
    for path in sources("deploy"):
        ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 8))


def run(code, *arguments, cwd=None, path=None):
    return subprocess.run(
        [sys.executable, "-c", BARRED + code, *map(str, arguments)],
        cwd=cwd,
        env=environment(PYTHONPATH=str(path or "")),
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_every_module_of_deploy_is_imported_without_tensorflow(tmp_path):
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in sources("deploy")
        if path.stem != "__main__"
    ]
    code = f"""
import importlib
for name in {modules!r}:
    importlib.import_module(name)
"""
    done = run(code, cwd=tmp_path, path=ROOT)
    assert done.returncode == 0, done.stderr


def test_a_copied_bundle_checks_itself_without_tensorflow(tiny_run, tmp_path):
    import shutil

    bundle = tmp_path / "bundle"
    shutil.copytree(tiny_run / "bundle", bundle)
    code = """
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    done = run(code, "deploy.pyz", "check", ".", "--target", "nengo", cwd=bundle)
    assert done.returncode == 0, done.stderr
    assert "nengo: accuracy" in done.stdout
    result = read_json(tiny_run / "checks" / "nengo.json", "")
    expected = read_json(bundle / "checks" / "nengo.json", "")
    assert expected["samples"] == result["samples"]
    assert expected["bundle"] == result["bundle"]
    assert Path(tiny_run / "bundle" / "checks").exists() is False


def test_the_command_starts_without_tensorflow():
    """Each verb imports it when it trains; a check or a --help does not wait for it."""
    code = """
import sys
from pipeline.commands.main import with_every_verb
with_every_verb()
sys.exit("tensorflow" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_the_list_of_commands_imports_none_of_their_modules():
    """They take most of a second, and ``--help`` and a TAB are to be quick."""
    code = """
import sys
from pipeline.commands.main import main
try:
    main(["--help"])
finally:
    heavy = {"nengo", "scipy", "h5py", "joblib", "pipeline.commands.workflow"} & set(sys.modules)
    assert not heavy, heavy
"""
    assert "settings" in printed_by(code)


@pytest.mark.parametrize("package", [*ALLOWED, "fastloihi/src"])
def test_no_constant_is_assigned_twice(package):
    for path in sources(package):
        body = ast.parse(path.read_text(encoding="utf-8")).body
        targets = [
            target for node in body if isinstance(node, ast.Assign) for target in node.targets
        ]
        names = [target.id for target in targets if isinstance(target, ast.Name)]
        constants = [name for name in names if name.isupper()]
        assert len(constants) == len(set(constants)), path
