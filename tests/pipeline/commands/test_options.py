"""Options that verbs share."""

import pytest

from deploy.errors import UserError
from pipeline.commands import options


def test_options_go_before_what_is_set(tmp_path):
    given = {"seed": 3, "samples": 50, "assignments": ["check.samples=100", "cnn.epochs=7"]}
    with options.opened(tmp_path / "run", **given) as (folder, resolved):
        assert folder.path == tmp_path / "run"
        assert (resolved.seed, resolved.check.samples, resolved.cnn.epochs) == (3, 50, 7)


@pytest.mark.parametrize(
    ("option", "given", "section"),
    [
        ("--samples", {"samples": 50}, "check"),
        ("--steps", {"steps": 50}, "presentation"),
        ("--data", {"data": "simulated"}, "data"),
        ("--input", {"kind": "events"}, "input"),
    ],
)
def test_a_section_given_a_value_beside_an_option_is_refused(tmp_path, option, given, section):
    opened = options.opened(tmp_path / "run", assignments=[f"{section}=100"], **given)
    with pytest.raises(UserError, match=f"^{option}: '{section}' has a value of its own"), opened:
        pass
