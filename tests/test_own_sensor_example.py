"""examples/own_sensor.py runs as a user's own would."""

import pytest

from deploy.files import read_json
from tests.command import ROOT, call, printed_by, users_environment
from tests.test_example import with_fewer

SCRIPT = ROOT / "examples" / "own_sensor.py"


@pytest.mark.slow
def test_the_script_runs(tmp_path):
    """With fewer epochs and recordings than it shows; then the commands that it names."""
    code = with_fewer(
        SCRIPT.read_text(encoding="utf-8"),
        {
            "range(75)": "range(15)",
            '"input": {"kind": kind}}': '"input": {"kind": kind}, "cnn": {"epochs": 3}, '
            '"snn": {"epochs": 1}, "events": {"epochs": 2}}',
        },
    )
    out = printed_by(code, env=users_environment(), cwd=tmp_path)
    assert out.count("12 simulated samples") >= 2
    for kind, first in (("image", "cnn"), ("events", "trained")):
        ladder = read_json(tmp_path / "runs" / f"gestures-{kind}" / "ladder.json", "")
        assert [row["stage"] for row in ladder["rows"][:2]] == ["counts", first]
        assert ladder["classes"][0] == "circle"
        assert "circle" in (tmp_path / "runs" / f"gestures-{kind}" / "report.html").read_text()
    assert "input.kind" in out
    runs = [tmp_path / "runs" / f"gestures-{kind}" for kind in ("image", "events")]
    assert call("compare", *runs) == 0
    others = ("--target", "fast", "--data", tmp_path / "gestures.zip", "--samples", 5)
    assert call("check", "run", runs[1], *others) == 0
