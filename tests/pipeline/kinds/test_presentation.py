"""The step, the time constants and the gap follow the recordings."""

import numpy as np
import pytest

from deploy.network.presentation import Presentation
from pipeline.kinds.preparation import choose_settings
from pipeline.kinds.presentation import (
    MAX_SHARE_LEFT,
    MAX_STEPS,
    MIN_STEPS,
    choose_image_gap,
    choose_step_ms,
    count_silent_steps,
    fit_gap,
)
from pipeline.recordings.files.writing import write_recordings
from pipeline.settings import Settings
from tests.own_sensor import CLASSES, gestures


@pytest.mark.parametrize("tau", [0.1, 1, 3, 30, 300])
def test_after_the_gap_a_current_adds_little_to_a_voltage(tau):
    steps = count_silent_steps(tau)
    current = np.exp(-np.arange(steps, steps + 60 * max(tau, 1)) / tau)
    assert current.sum() <= MAX_SHARE_LEFT
    assert steps == 0 or current.sum() * np.exp(1 / tau) > MAX_SHARE_LEFT


@pytest.mark.parametrize("longest_ms", [0.07, 0.8, 6, 49.9, 100, 480, 800, 3999, 4000, 70_000])
def test_a_recording_has_a_sensible_number_of_steps(longest_ms):
    step = choose_step_ms(longest_ms, 10.0)
    assert MIN_STEPS <= longest_ms / step <= MAX_STEPS
    assert (step == 10.0) == (500 <= longest_ms < 4000)


def test_recordings_at_one_moment_keep_the_default_step():
    assert choose_step_ms(0.0, 10.0) == 10.0


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Recordings of some ten milliseconds."""
    items = [((x, y, t / 100, p), label) for (x, y, t, p), label in gestures(5)]
    path = tmp_path_factory.mktemp("short") / "short.zip"
    return str(write_recordings(path, items, CLASSES))


def choose_for(source, **changes):
    values = {"data": {"source": source, "time_unit": "s"}, "input": {"kind": "events"}}
    for section, section_values in changes.items():
        values[section] = values.get(section, {}) | section_values
    return choose_settings(Settings().with_values(values))


@pytest.mark.parametrize("step", [None, 0.1])
def test_short_recordings_get_short_steps_and_time_constants(short, step):
    given = {} if step is None else {"input": {"step": step}}
    chosen = choose_for(short, **given)
    assert MIN_STEPS <= chosen.steps <= MAX_STEPS
    presented_ms = chosen.steps * chosen.input.step
    assert chosen.events.tau_u_ms[0] < presented_ms / 10
    assert chosen.events.tau_v_ms[0] < presented_ms / 5
    assert chosen.presentation.gap < 3 * chosen.steps


def test_long_time_constants_get_a_long_gap_unless_it_is_given(short):
    taus = {"tau_u_ms": [30.0]}
    assert choose_for(short, events=taus, input={"step": 0.1}).presentation.gap > 1000
    given = choose_for(short, events=taus, input={"step": 0.1}, presentation={"gap": 20})
    assert given.presentation.gap == 20


def test_the_defaults_stay():
    for kind in ("events", "image"):
        settings = Settings().with_values({"input": {"kind": kind}})
        chosen = choose_settings(settings.with_values({"data": {"samples_per_digit": 25}}))
        assert chosen.presentation == settings.presentation
        assert chosen.events.tau_u_ms == settings.events.tau_u_ms


@pytest.mark.parametrize(
    ("gap", "stream_length", "is_short"), [(20, 10, True), (20, 1, False), (3000, 10, False)]
)
def test_a_gap_that_the_trained_network_outlasts_is_longer(gap, stream_length, is_short):
    given = Presentation(steps=60, gap=gap, stream_length=stream_length)
    taus = {"conv1.tau_u": 3.0, "dense1.tau_u": 300.0}
    longer, line = fit_gap(given, taus, is_users=False)
    assert longer.gap == (count_silent_steps(300.0) if is_short else gap)
    assert ("presentation.gap=" in line and "dense1" in line) is is_short
    kept, warning = fit_gap(given, taus, is_users=True)
    assert kept == given
    assert warning.startswith("warning") is is_short


@pytest.mark.parametrize(
    ("presentation", "synapse", "expected"),
    [
        ({}, 0.008, None),  # the defaults
        ({}, 0.004, None),
        ({}, 0.02, 68),
        ({"gap": 10}, 0.02, None),  # the user's
        ({"stream_length": 1}, 0.02, None),
    ],
)
def test_the_gap_between_images_follows_their_currents(presentation, synapse, expected):
    values = {"presentation": presentation, "deployment": {"synapse": synapse}}
    gap, reason = choose_image_gap(Settings().with_values(values))
    assert gap == expected
    assert (str(expected) in reason) == (expected is not None)


def test_a_network_without_filtered_currents_needs_no_gap():
    given = Presentation(100, gap=0, stream_length=20)
    assert fit_gap(given, {}, is_users=False) == (given, "")
