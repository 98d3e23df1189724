"""Defaults that fit recordings of one's own, and everything that does not fit told at once."""

from dataclasses import replace

import numpy as np
import pytest

from deploy.errors import SeveralErrors, UserError
from models.architecture import parse_architecture
from pipeline.kinds.architectures import suggest_architecture
from pipeline.kinds.events.sizes import SIZES as NETWORK_SIZES
from pipeline.kinds.events.sizes import suggest_event_architecture
from pipeline.kinds.image import choices
from pipeline.kinds.preparation import choose_settings
from pipeline.kinds.registry import find_kind
from pipeline.recordings.files.writing import write_recordings
from pipeline.recordings.sensor import Sensor
from pipeline.settings import Settings
from pipeline.sources import load_recordings
from pipeline.storage.run_folder import RunFolder
from pipeline.training.event_updates import choose_epochs
from tests.command import missing
from tests.own_sensor import CLASSES, gestures, write_folder


def said_of(settings):
    lines = []
    choose_settings(settings, say=lines.append)
    return lines


SIZES = [
    (1, 2), (1, 12), (2, 2), (3, 64), (5, 5), (6, 6), (9, 12), (12, 9), (16, 16), (18, 18),
    (34, 34), (12, 100), (7, 250), (128, 128), (256, 256), (100, 17), (17, 18), (64, 48),
]  # fmt: skip


@pytest.mark.parametrize("on_events", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_there_is_an_architecture_for_every_sensor(size, on_events):
    for n in (2, 300):
        sensor = Sensor(*size, classes=tuple(map(str, range(n))))
        architecture = parse_architecture(suggest_architecture(sensor, on_events))
        assert architecture.input_shape == (*size, 2 if on_events else 1)
        assert architecture.outputs == n
        assert len(architecture.layers) >= 2
        assert max(np.prod(shape) for shape in architecture.shapes[1:]) <= 8192


def test_the_paper_s_layers_where_they_fit():
    assert suggest_architecture(Sensor(), False) == Settings().cnn.architecture
    assert suggest_architecture(Sensor(9, 12, classes=CLASSES), False) == "9x12-6c4-24c3-4o"


def settings_of(source, **changes):
    return Settings().with_values({"data": {"source": str(source)}, **changes})


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("own") / "own", per_class=15)


def test_images_of_a_sensor_of_one_s_own(own):
    chosen, said = choose_settings(settings_of(own)), said_of(settings_of(own))
    assert chosen.cnn.architecture == "9x12-6c4-24c3-4o"
    assert chosen.check == Settings().check  # not chosen: the recordings may grow
    assert chosen.check.count_samples(12) == 12  # a fifth of sixty
    assert choose_settings(chosen) == chosen
    assert any("9x12-6c4-24c3-4o" in line for line in said)


def test_many_real_images_have_more_epochs_unless_the_user_says(own, monkeypatch):
    assert choose_settings(settings_of(own)).snn.epochs == 0  # as many as the schedule says
    monkeypatch.setattr(choices, "MIN_RECORDINGS_FOR_EPOCHS", 60)
    assert choose_settings(settings_of(own)).snn.epochs == choices.EPOCHS_ON_REAL_IMAGES
    assert choose_settings(settings_of(own, snn={"epochs": 5})).snn.epochs == 5
    assert choose_settings(settings_of(own, input={"kind": "slices"})).snn.epochs == 0


@pytest.mark.parametrize("samples", [199, 200])
def test_a_number_of_samples_that_is_given_counts(own, samples):
    """Also if it is the default: a fifth of sixty are twelve."""
    with pytest.raises(UserError) as caught:
        choose_settings(settings_of(own, check={"samples": samples}))
    assert f"{samples} samples requested, the test set has 12" in str(caught.value)


@pytest.mark.parametrize(("kind", "section"), [("image", "cnn"), ("events", "events")])
def test_an_architecture_is_chosen_again_for_other_classes(tmp_path, kind, section):
    """Also for fewer of them; the one that the user has chosen is kept."""
    items = gestures(12)
    path = tmp_path / "own.zip"
    run, own = RunFolder(tmp_path / "run"), settings_of(path, input={"kind": kind})
    for classes in (4, 5, 3):
        some = [(e, CLASSES[label]) for e, label in items if label < classes]
        more = [(e, "more") for e, label in items if label == 0 and classes == 5]
        path.unlink(missing_ok=True)
        write_recordings(path, some + more)
        chosen = choose_settings(own)
        assert getattr(chosen, section).architecture.endswith(f"-{classes}o")
        run.path.mkdir(exist_ok=True)
        run.save_settings(chosen)
        own = run.resolve_settings(None, {})
    mine = getattr(chosen, section).architecture.replace("3o", "4o")
    with pytest.raises(SeveralErrors, match="3 classes"):
        choose_settings(own.with_values({section: {"architecture": mine}}, ""))


def test_a_budget_of_the_user_s_is_kept(tmp_path):
    items = [
        ([np.tile(part, 30) for part in (3 * x, 3 * y, t, p)], label)
        for (x, y, t, p), label in gestures(10)
    ]
    path = write_recordings(tmp_path / "large.zip", items, CLASSES)
    for given, kept in (({}, False), ({"events": {"budget": 0.5}}, True)):
        settings = settings_of(path, input={"kind": "events"}, **given)
        assert (choose_settings(settings).events.budget == settings.events.budget) is kept


def test_events_of_a_sensor_of_one_s_own(own):
    chosen = choose_settings(settings_of(own, input={"kind": "events"}))
    assert chosen.events.architecture.startswith("9x12x2-")
    assert chosen.input.step == 10
    longest = load_recordings(str(own), jobs=1).sensor.duration_s
    assert 0.1 * 1000 < chosen.steps * 10 <= 1000 * longest + 10


def test_a_number_of_parts_changes_no_other_choice(own):
    """Each part is its share of the presentation, and the refractory period is chosen as before."""
    chosen = choose_settings(settings_of(own, input={"kind": "events"}))
    parts = choose_settings(settings_of(own, input={"kind": "events"}, events={"parts": 4}))
    assert parts.input == chosen.input
    starts = parts.events.find_section_starts(parts.input.step)
    assert starts == tuple(round(k * chosen.steps / 4) for k in range(4))
    assert replace(parts.events, parts=0, part=0) == replace(chosen.events, parts=0, part=0)


def test_long_recordings_get_long_steps(tmp_path):
    slow = [((x, y, 20 * t, p), label) for (x, y, t, p), label in gestures(4)]
    source = write_recordings(tmp_path / "slow.zip", slow, CLASSES)
    chosen = choose_settings(settings_of(source, input={"kind": "events"}))
    assert chosen.steps <= 400
    assert chosen.steps * chosen.input.step >= 1000 * 20
    given = settings_of(source, input={"kind": "events"}, presentation={"steps": 30})
    assert choose_settings(given).steps == 30


def test_what_was_chosen_stays_and_is_held_against_the_recordings(own):
    wrong = settings_of(own, cnn={"architecture": "10x10-8c3-4o"}, check={"samples": 50})
    with pytest.raises(SeveralErrors) as caught:
        choose_settings(wrong)
    lines = caught.value.lines
    assert len(lines) == 2
    assert any(not missing(line, 50, 12) for line in lines)
    assert any("9x12-6c4-24c3-4o" in line for line in lines)
    right = settings_of(own, cnn={"architecture": "9x12-8c3-4o"}, check={"samples": 5})
    assert changed_names(right) == {"image.normalisation"}


def changed_names(settings):
    """Names of the settings that are chosen."""
    chosen = choose_settings(settings).flatten()
    return {name for name, value in settings.flatten().items() if chosen[name] != value}


def test_simulated_recordings_need_only_another_image():
    settings = Settings().with_values({"data": {"samples_per_digit": 5}, "check": {"samples": 10}})
    assert changed_names(settings) == {"image.normalisation"}


@pytest.mark.parametrize(
    ("kind", "architecture", "resource"),
    [("image", "100x100-40-4o", "input axons"), ("events", "70x70x2-40-4o", "input axons")],
)
def test_what_no_core_can_hold_is_told_before_training(kind, architecture, resource):
    section = "cnn" if kind == "image" else "events"
    changes = {"input": {"kind": kind}, section: {"architecture": architecture}}
    problems = find_kind(settings_of("own", **changes)).list_chip_problems()
    assert all(line.startswith(f"{architecture}: ") for line in problems)
    assert all("layer dense1" in line for line in problems)
    assert any(not missing(line, resource, 4096) for line in problems)
    # The remedies are possible: a dense layer has no kernel, and no averaging may pass events.
    assert not any("kernel" in line for line in problems)
    assert not any("averaging" in line for line in problems)


@pytest.mark.parametrize("kind", ["image", "events"])
@pytest.mark.parametrize("size", [(1, 8), (9, 12), (34, 34), (1, 200)])
def test_the_chosen_architectures_fit_the_chip(size, kind):
    for n in (2, 300):
        sensor = Sensor(*size, classes=tuple(map(str, range(n))))
        section = "cnn" if kind == "image" else "events"
        architecture = suggest_architecture(sensor, kind == "events")
        changes = {"input": {"kind": kind}, section: {"architecture": architecture}}
        assert find_kind(settings_of("own", **changes)).list_chip_problems() == ()


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ("small", "10x10x2-24c4s3-64-10o"),
        ("standard", "10x10x2-32c4s2-128-10o"),
        ("large", "10x10x2-48c4s2-192-10o"),
    ],
)
def test_an_architecture_for_every_size(size, expected):
    assert suggest_event_architecture(Sensor(), NETWORK_SIZES[size], 5000) == expected
    strip = Sensor(1, 39, classes=CLASSES)
    few = (
        parse_architecture(suggest_event_architecture(strip, NETWORK_SIZES[size], 500))
        .layers[0]
        .units
    )
    assert few == {"small": 128, "standard": 256, "large": 384}[size]


def test_a_size_of_the_user_s_for_simulated_handwriting():
    settings = Settings().with_values(
        {
            "data": {"samples_per_digit": 20},
            "check": {"samples": 10},
            "input": {"kind": "events"},
            "events": {"size": "standard"},
        }
    )
    chosen = choose_settings(settings)
    assert chosen.events.architecture == "10x10x2-24c4s3-256-10o"  # few recordings
    assert choose_settings(chosen) == chosen


def test_the_large_size_is_trained_longer():
    settings = Settings().with_values(
        {
            "data": {"samples_per_digit": 20},
            "check": {"samples": 10},
            "input": {"kind": "events"},
            "events": {"size": "large"},
        }
    )
    chosen = choose_settings(settings)
    usual = choose_epochs(160, chosen.events.batch_size)
    assert chosen.events.epochs == NETWORK_SIZES["large"].passes * usual > usual
    of_user = settings.with_values({"events": {"epochs": 7}})
    assert choose_settings(of_user).events.epochs == 7
