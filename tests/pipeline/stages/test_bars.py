"""The bars of a command, numbered."""

import pytest

from pipeline.progress import stage_of
from pipeline.progress import stages as numbered
from pipeline.settings import Settings
from pipeline.stages import bars


@pytest.mark.parametrize(
    ("kind", "until", "label", "said"),
    [
        ("image", "train", "train cnn", "2 of 2 "),
        ("image", "convert", "train rate-lif", "3 of 6 "),
        ("image", "convert", "check spiking-lif", "6 of 6 "),
        ("image", "ladder", "check", "4 of 5 "),
        ("events", "train", "simulate", "1 of 2 "),
        ("events", "bundle", "train events", "2 of 2 "),
        ("events", "convert", "check trained", "3 of 3 "),
        ("events", "ladder", "compare layers", "4 of 4 "),
    ],
)
def test_each_bar_says_which_of_a_commands_it_is(kind, until, label, said):
    settings = Settings().with_values({"input": {"kind": kind}}, "a test")
    with numbered(bars(settings, until)):
        assert stage_of(label) == said


def test_recordings_of_ones_own_are_imported():
    settings = Settings().with_values({"data": {"source": "own"}}, "a test")
    assert bars(settings, "train") == ["import", "train cnn"]
