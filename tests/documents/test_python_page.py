"""The code in docs/python.md runs as pasted."""

import json

import pytest

from tests.documents.brief import hurry_runs
from tests.test_documentation import DOCS, blocks, read


def the_code_of_the_page():
    """Its blocks of Python, one after the other: a reader pastes them into one session."""
    (page,) = (page for page in DOCS if page.name == "python.md")
    return "\n".join(code for language, code in blocks(read(page)) if language == "python")


@pytest.mark.slow
def test_the_page_on_python(tmp_path, monkeypatch, capsys):
    pytest.importorskip("nir", reason="the page writes a NIR graph (pip install nir)")
    monkeypatch.chdir(tmp_path)
    with hurry_runs(epochs=10):
        exec(compile(the_code_of_the_page(), "python.md", "exec"), {"__name__": "__main__"})
    ladder = json.loads((tmp_path / "runs/mine/ladder.json").read_text())
    accuracies = {row["stage"]: row["accuracy"] for row in ladder["rows"]}
    assert accuracies["emulator"] > 0.8
    assert "['left', 'right', 'right']" in capsys.readouterr().out
    assert (tmp_path / "runs/mine/report.html").is_file()
    assert (tmp_path / "network.nir").is_file()
