"""The code in docs/python.md runs as pasted, in a user's environment."""

import json

import pytest

from tests.command import LEAVE_GARBAGE, printed_by, users_environment
from tests.test_documentation import DOCS, blocks, read

RUN_THE_PAGE = LEAVE_GARBAGE + "import runpy, sys\nrunpy.run_path(sys.argv[1])\n"


def the_code_of_the_page():
    """Its blocks of Python, one after the other: a reader pastes them into one session."""
    (page,) = (page for page in DOCS if page.name == "python.md")
    return "\n".join(code for language, code in blocks(read(page)) if language == "python")


@pytest.mark.slow
def test_the_page_on_python(tmp_path):
    pytest.importorskip("nir", reason="the page writes a NIR graph (pip install nir)")
    (tmp_path / "page.py").write_text(the_code_of_the_page(), encoding="utf-8")
    out = printed_by(RUN_THE_PAGE, "page.py", env=users_environment(), cwd=tmp_path)
    ladder = json.loads((tmp_path / "runs/mine/ladder.json").read_text())
    accuracies = {row["stage"]: row["accuracy"] for row in ladder["rows"]}
    assert accuracies["emulator"] > 0.8
    assert "['left', 'right', 'right']" in out
    assert (tmp_path / "runs/mine/report.html").is_file()
    assert (tmp_path / "network.nir").is_file()
