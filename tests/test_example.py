"""The code in docs/python.md runs in a user's environment and prints what the page says."""

import numpy as np
import pytest

from tests.command import printed_by, users_environment
from tests.test_documentation import DOCS, blocks, read

SHOWN = """
import atexit, gc, runpy, sys
atexit.register(gc.freeze)  # Python would look through TensorFlow for garbage, a second long
runpy.run_path(sys.argv[1])
"""


def with_fewer(code, instead):
    """Code with values of its own in the place of those that it shows."""
    for shown, fewer in instead.items():
        assert shown in code
        code = code.replace(shown, fewer)
    return code


@pytest.mark.slow
@pytest.mark.skip(reason="the page reads a file of the user's that this test does not make yet")
def test_the_page_on_python(tmp_path):
    """With fewer samples, epochs and steps than it shows: the simulators take their time."""
    (tmp_path / "models.py").write_text("raise RuntimeError('beside the notebook')\n")
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
    (tmp_path / "new" / "today").mkdir(parents=True)  # a recording without a label
    np.savez(tmp_path / "new/today/000.npz", x=[3, 9], y=[0, 9], t=[0, 900_000], p=[1, 0])
    out = printed_by(SHOWN, "page.py", env=users_environment(), cwd=tmp_path)
    for said in (
        "'today/000': ",
        "rate-lif: ",
        "nengo: ",
        "fast: ",
        "ESTIMATE",
        "cores: 2, chips: 1",
    ):
        assert said in out
    assert (tmp_path / "mine" / "network.nir").is_file()
