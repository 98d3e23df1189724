"""What examples/ shows runs as a script of a user's would, and does what it says."""

import subprocess
import sys

import pytest

from deploy.files import read_json
from tests.command import ROOT, environment

SHOWN = """
import runpy, sys
from matplotlib.figure import Figure
shown = runpy.run_path(sys.argv[1])
assert isinstance(shown["figure"], Figure)
import matplotlib.pyplot  # which Keras brings in, where it finds it
assert not matplotlib.pyplot.get_fignums()  # none is left for pyplot to show
shown["figure"].savefig("figure.png")
"""


@pytest.mark.slow
def test_a_network_of_ones_own(tmp_path):
    """With fewer samples in its check: Nengo's reference simulator takes its time."""
    (tmp_path / "models.py").write_text("raise RuntimeError('beside the notebook')\n")
    example = (ROOT / "examples" / "own_network.py").read_text(encoding="utf-8")
    source = '{"data": {"source": "made-up gestures"}'
    assert source in example
    example = example.replace(source, f'{source}, "check": {{"samples": 40}}')
    (tmp_path / "own_network.py").write_text(example, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", SHOWN, "own_network.py"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "Loss ladder, 40 simulated samples" in done.stdout
    ladder = read_json(tmp_path / "runs" / "gestures" / "ladder.json", "")
    accuracy = {row["stage"]: row["accuracy"] for row in ladder["rows"]}
    assert list(accuracy) == ["cnn", "rate-lif", "nengo", "fast"]
    assert accuracy["cnn"] > 0.8  # chance is 0.2
    assert accuracy["fast"] >= accuracy["cnn"] - 0.05
    assert ladder["classes"] == ["across", "along", "diagonal", "ring", "press"]
    assert (tmp_path / "figure.png").stat().st_size > 1000
    assert (tmp_path / "runs" / "gestures" / "bundle" / "MANIFEST.json").is_file()
