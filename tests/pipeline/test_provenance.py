"""Where the value of a setting comes from: the user, a rule, or the default."""

import pytest

from deploy.errors import UserError
from pipeline.settings import (
    Choice,
    Provenance,
    Settings,
    apply_choices,
    list_reasons,
    read_own_settings,
    read_settings,
    write_settings,
)

CHOICES = [
    Choice("input.step", 20.0, "steps of 20 ms"),
    Choice("input.refractory", 20.0),
    Choice("events.tau_u_ms", (9.0, 12.0), "short time constants"),
]


def test_a_value_of_the_user_is_never_replaced_also_if_it_is_the_default():
    own = Settings().with_values({"input": {"step": Settings().input.step}})
    chosen = apply_choices(own, CHOICES)
    assert chosen.input.step == Settings().input.step
    assert chosen.find_provenance("input.step") is Provenance.USER
    assert chosen.find_provenance("input.refractory") is Provenance.CHOSEN
    assert chosen.find_provenance("input.kind") is Provenance.DEFAULT
    assert list_reasons(own, CHOICES) == ["short time constants"]


def test_the_later_of_two_choices_of_a_setting_is_applied():
    chosen = apply_choices(Settings(), [*CHOICES, Choice("input.step", 5.0)])
    assert (chosen.input.step, chosen.input.refractory) == (5.0, 20.0)


def test_a_default_that_asks_for_a_choice_is_no_value_of_the_user():
    own = Settings().with_values({"presentation": {"steps": 0}, "events": {"augment": "auto"}})
    chosen = apply_choices(
        own, [Choice("presentation.steps", 90), Choice("events.augment", "time")]
    )
    assert (chosen.presentation.steps, chosen.events.augment) == (90, "time")


def test_a_choice_that_does_not_fit_is_refused():
    with pytest.raises(UserError, match=r"own\.zip.*input\.step"):
        apply_choices(Settings(), [Choice("input.step", 0.0)], "own.zip")


def test_what_is_chosen_stays_chosen_in_a_file(tmp_path):
    own = Settings().with_values({"seed": 3})
    chosen = apply_choices(own, CHOICES)
    write_settings(tmp_path / "a.toml", chosen)
    read = read_settings(tmp_path / "a.toml")
    assert read == chosen
    assert read.list_names(Provenance.USER) == ("seed",)
    assert set(read.list_names(Provenance.CHOSEN)) == {choice.setting for choice in CHOICES}
    assert read_own_settings(tmp_path / "a.toml") == own == read.without_choices()


EARLIER = """
chosen = {"input.step" = 20.0, "events.tau_u_ms" = [9.0, 12.0]}
GIVENseed = 3
[input]
kind = "events"
step = 20.0
refractory = 10.0
[events]
tau_u_ms = [9.0, 12.0]
"""


@pytest.mark.parametrize("given", ["", 'given = ["seed", "input.kind", "input.refractory"]\n'])
def test_files_of_earlier_runs(tmp_path, given):
    path = tmp_path / "experiment.toml"
    path.write_text(EARLIER.replace("GIVEN", given))
    own = read_own_settings(path)
    assert (own.seed, own.input.kind, own.input.step) == (3, "events", Settings().input.step)
    assert own.events == Settings().events
    assert own.is_set_by_user("input.refractory") == bool(given)
    assert not own.is_set_by_user("input.step")


def test_all_values_in_a_file_that_the_user_wrote_are_the_user_s(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text("[events]\ndropout = 0.1\nepochs = 4\n")
    assert read_own_settings(path).list_names(Provenance.USER) == (
        "events.epochs",
        "events.dropout",
    )


def test_a_value_that_the_user_edits_is_the_user_s(tmp_path):
    path = tmp_path / "experiment.toml"
    write_settings(path, apply_choices(Settings(), CHOICES))
    path.write_text(path.read_text().replace("\nstep = 20.0", "\nstep = 10.0"))
    own = read_own_settings(path)
    assert own.list_names(Provenance.USER) == ("input.step",)
    assert own.input.step == 10


@pytest.mark.parametrize("name", ["snn.epochs", "events.parts", "events.augment", "skin.rows"])
def test_an_automatic_value_that_the_user_states_is_open(name):
    stated = Settings().with_named_values({name: Settings().get_value(name)})
    assert stated.is_open(name)
    assert not stated.with_named_values({name: "time" if "augment" in name else 3}).is_open(name)
