"""Options that verbs share."""

import pytest

from deploy.errors import UserError
from pipeline.commands import options
from tests.command import call


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


def test_a_mistyped_setting_is_answered_with_the_one_that_was_meant(tmp_path, capsys):
    assert call("ladder", tmp_path / "run", "--set", "cnn.epoch=5") == 2
    assert "did you mean 'cnn.epochs'?" in capsys.readouterr().err


def test_an_option_that_is_a_setting_s_name(tmp_path, capsys):
    assert call("ladder", tmp_path / "run", "--epochs", 5) == 2
    assert "--set cnn.epochs=5" in capsys.readouterr().err
    assert call("ladder", tmp_path / "run", "--input", "events", "--epochs", 5) == 2
    assert "--set events.epochs=5" in capsys.readouterr().err
    assert call("ladder", tmp_path / "run", "--nonsense") == 2
    assert "settings are given" not in capsys.readouterr().err
