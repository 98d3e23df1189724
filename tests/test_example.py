"""What examples/ and the page on Python show runs as a user's own would, and does what it says."""

import pytest

from deploy.files import read_json
from tests.command import ROOT, missing, printed_by, users_environment
from tests.test_documentation import DOCS, blocks, read

SHOWN = """
import atexit, gc, runpy, sys
atexit.register(gc.freeze)  # Python would look through TensorFlow for garbage, a second long
runpy.run_path(sys.argv[1])
print("--- the page ---")
runpy.run_path(sys.argv[2])
"""


def with_fewer(code, instead):
    """Code with values of its own in the place of those that it shows."""
    for shown, fewer in instead.items():
        assert shown in code
        code = code.replace(shown, fewer)
    return code


@pytest.mark.slow
def test_a_network_of_ones_own_and_the_page_on_python(tmp_path):
    """With fewer samples, epochs and steps than they show: the simulators take their time.

    The example first, which imports Keras 3 before anything of ours, then the blocks of the page,
    one after the other: both in one process, as in one notebook, since half of what either takes
    is TensorFlow's start.
    """
    (tmp_path / "models.py").write_text("raise RuntimeError('beside the notebook')\n")
    source, little = '{"data": {"source": "made-up gestures"}', '"snn": {"epochs": 4}'
    example = with_fewer(
        (ROOT / "examples" / "own_network.py").read_text(encoding="utf-8"),
        {source: f'{source}, {little}, "check": {{"samples": 40}}'},
    )
    (tmp_path / "own_network.py").write_text(example, encoding="utf-8")
    small = '"cnn": {"epochs": 1}, "snn": {"epochs": 1}, "presentation": {"steps": 30}'
    (page,) = (page for page in DOCS if page.name == "python.md")
    code = with_fewer(
        "\n".join(block for _, block in blocks(read(page))),
        {
            '"samples_per_digit": 100}': f'"samples_per_digit": 20}}, {small}',
            '"samples": 100': '"samples": 8',
            "split.test, 200": "split.test, 8",
        },
    )
    (tmp_path / "page.py").write_text(code, encoding="utf-8")
    out = printed_by(SHOWN, "own_network.py", "page.py", env=users_environment(), cwd=tmp_path)
    of_the_example, of_the_page = out.split("--- the page ---\n")

    assert missing(of_the_example, "40 simulated samples") == []
    ladder = read_json(tmp_path / "runs" / "gestures" / "ladder.json", "")
    accuracy = {row["stage"]: row["accuracy"] for row in ladder["rows"]}
    assert list(accuracy) == ["cnn", "rate-lif", "nengo", "fast"]
    assert accuracy["cnn"] > 0.8  # chance is 0.2
    assert accuracy["fast"] >= accuracy["cnn"] - 0.05
    assert ladder["classes"] == ["across", "along", "diagonal", "ring", "press"]
    assert (tmp_path / "runs" / "gestures" / "bundle" / "MANIFEST.json").is_file()

    for said in ("rate-lif: ", "nengo: ", "fast: ", "ESTIMATE", "2 cores on 1 chip"):
        assert said in of_the_page
    assert (tmp_path / "mine" / "network.nir").is_file()
