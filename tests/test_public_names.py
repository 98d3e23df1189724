"""``from stmnist import ...``: every name, and a user's own files of the names of our packages."""

import importlib
import subprocess
import sys

import pytest

import stmnist
from tests.command import ROOT, environment, missing

RAISES = "raise RuntimeError('the file of the user was imported')\n"


def python(code, cwd):
    """Run a script of a user's in a folder, as ``python script.py`` does."""
    (cwd / "script.py").write_text(code)
    return subprocess.run(
        [sys.executable, "script.py"], cwd=cwd, env=environment(), capture_output=True, text=True
    )


MAX_NAMES = 20


@pytest.mark.parametrize("name", stmnist.__all__)
def test_a_public_name_is_there_and_documented(name):
    assert getattr(stmnist, name).__doc__
    assert name in dir(stmnist)


def test_there_are_at_most_twenty_public_names_in_three_groups():
    assert len(stmnist.GROUPS) == 3
    assert len(stmnist.__all__) == sum(map(len, stmnist.GROUPS.values())) <= MAX_NAMES


def test_no_other_name_is_there():
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = stmnist.nothing
    assert stmnist.__version__ == importlib.import_module("deploy").__version__


def test_the_import_alone_loads_next_to_nothing(tmp_path):
    code = "import stmnist, sys; sys.exit(bool({'numpy', 'tensorflow', 'nengo'} & {*sys.modules}))"
    assert python(code, tmp_path).returncode == 0


def test_files_called_as_our_packages_break_nothing(tmp_path):
    for name in ("deploy.py", "models.py", "pipeline.py"):
        (tmp_path / name).write_text(RAISES)
    done = python(
        "from stmnist import Settings, Recordings, make_plan\n"
        "from models.architecture import parse_architecture\n"
        "import models\n"
        "outputs = parse_architecture('6x6-4c3-5o').outputs\n"
        "print(Settings().cnn.architecture, outputs, models.__file__)\n",
        tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["10x10-6c4-24c3-10o", "5", str(ROOT / "models" / "__init__.py")]


@pytest.mark.parametrize("package", [False, True])
def test_a_file_that_was_imported_before_is_named_in_one_line(tmp_path, package):
    own = tmp_path / "models" / "__init__.py" if package else tmp_path / "models.py"
    own.parent.mkdir(exist_ok=True)
    own.write_text("mine = 1\n")
    done = python(
        "import models\n"
        "try:\n"
        "    import stmnist\n"
        "except ImportError as error:\n"
        "    print(error)\n"
        "import sys\n"
        "print('deploy' in sys.modules, models.mine)\n",
        tmp_path,
    )
    assert done.returncode == 0, done.stderr
    line, rest = done.stdout.splitlines()
    assert missing(line, own, "'models'", "stmnist") == []
    assert rest == "False 1"


def test_a_script_called_as_a_package_of_ours_can_import_stmnist(tmp_path):
    (tmp_path / "deploy.py").write_text("from stmnist import UserError; print(UserError.__name__)")
    done = subprocess.run(
        [sys.executable, "deploy.py"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert done.stdout.strip() == "UserError", done.stderr
