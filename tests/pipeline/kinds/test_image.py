"""What the kind of images chooses, and which stages its ladder has."""

import re
from dataclasses import asdict, replace

import numpy as np
import pytest

from deploy.errors import UserError
from models.architecture import parse_architecture
from pipeline.kinds.image.choices import choose_image_augmentation
from pipeline.kinds.image.kind import make_kept_image_settings
from pipeline.kinds.imported import ImportedNetwork
from pipeline.kinds.registry import find_compared_stage, find_kind
from pipeline.recordings.events import Events
from pipeline.recordings.recordings import Source, join_recordings
from pipeline.recordings.sensor import Sensor, TaxelMap
from pipeline.settings import Image, Settings, apply_choices, list_reasons, set_nested
from pipeline.storage.artifacts import CURRENT, MISSING, State
from pipeline.storage.run_folder import RunFolder
from pipeline.training.images.schedules import SCHEDULES


def settings(**sections):
    return Settings().with_values(sections)


def choose(own, made):
    """The values that are chosen, as ``with_values`` takes them, and the reasons."""
    choices = find_kind(own).make_choices(made, np.arange(len(made)))
    changes = {}
    for choice in choices:
        set_nested(changes, choice.setting, choice.value, "test")
    return changes, list_reasons(own, choices)


def recordings(rows, columns, duration_ms=400):
    """Ten recordings of two classes, with an event at the start and one at the end."""
    n = 10
    times = np.array([0, duration_ms]) * 10**6
    events = Events(times, np.zeros(2, int), np.array([1, -1]), np.ones(2, int))
    source = Source("made", "0" * 64, False)
    taxels = TaxelMap.grid(rows, columns)
    sensor = Sensor(rows, columns, classes=("a", "b", "c"))
    ids = [str(i) for i in range(n)]
    labels = [i % 3 for i in range(n)]
    return join_recordings([events] * n, labels, ids, [-1] * n, source, taxels, sensor)


def test_a_strip_gets_channels_of_polarities_in_slices_of_time():
    changes, lines = choose(settings(), recordings(1, 30))
    assert changes["cnn"] == {"architecture": "1x30x16-256-3o"}
    image = {"aggregation": "polarities", "slices": 8, "duration": 400.0}
    assert changes["image"] == {**image, "normalisation": "sqrt-clip"}
    assert changes["snn"] == {"dropout": 0.5}
    assert changes["deployment"] == {"input_rate": 60.0}
    assert len(lines) == 5
    chosen = find_kind(settings(**changes))
    assert chosen.channels == 16


def test_neurons_with_many_inputs_are_trained_further_at_a_lower_rate():
    own = {"model": "net.keras", "model_sha256": "0" * 64}
    own["architecture"] = "28x28-32c3-64c3-2a-128-3o"
    narrow = {**own, "architecture": "28x28-6c5p-2a-16c5-2a-120-3o"}
    changes, lines = choose(settings(cnn=own), recordings(28, 28))
    assert changes["snn"] == {"learning_rate": 0.0002}  # 9,216 inputs
    assert any("9216 inputs" in line for line in lines)
    others = [
        {"cnn": narrow},
        {"cnn": own, "snn": {"recipe": "as-is"}},
        {"cnn": own, "snn": {"learning_rate": 0.01}},
        {},
    ]
    for sections in others:
        assert "learning_rate" not in choose(settings(**sections), recordings(28, 28))[0].get(
            "snn", {}
        )


def test_the_rate_from_which_lower_ones_are_chosen():
    assert SCHEDULES["loihi"].learning_rate == 0.004


SLICES = {"input": {"kind": "slices"}}


def test_slices_of_time_on_a_grid_have_a_convolution_with_a_stride():
    changes, lines = choose(settings(**SLICES), recordings(10, 10))
    assert changes["cnn"] == {"architecture": "10x10x16-32c4s2-128-3o"}
    image = {"aggregation": "polarities", "slices": 8, "duration": 400.0}
    assert changes["image"] == {**image, "normalisation": "sqrt-clip"}
    assert (changes["snn"], changes["deployment"]) == ({"dropout": 0.1}, {"input_rate": 60.0})
    assert len(lines) == 5
    chosen = settings(**SLICES).with_values(changes)
    assert find_kind(chosen).channels == 16


def test_what_the_user_sets_of_slices_is_kept():
    grid = recordings(10, 10)
    own = settings(**SLICES, image={"slices": 3, "aggregation": "on"}, snn={"dropout": 0.3})
    changes, _ = choose(own, grid)
    assert changes["image"] == {"duration": 400.0, "normalisation": "sqrt-clip"}
    assert changes["cnn"] == {"architecture": "10x10x3-32c4s2-128-3o"}
    assert "snn" not in changes
    mine = settings(**SLICES, cnn={"architecture": "10x10x8-16c4-3o"})
    changes, _ = choose(mine, grid)
    assert changes["image"]["slices"] == 4
    assert "cnn" not in changes


def test_a_larger_grid_has_a_larger_stride():
    changes, _ = choose(settings(**SLICES), recordings(40, 30))
    assert changes["cnn"]["architecture"] == "40x30x16-32c8s6-128-3o"
    changes, _ = choose(settings(**SLICES), recordings(2, 30))
    assert changes["cnn"]["architecture"] == "2x30x16-256-3o"


def test_a_graph_has_no_slices():
    graph = {"file": "net.nir", "sha256": "a"}
    with pytest.raises(UserError, match=r"input\.kind.*image\.slices"):
        settings(**SLICES, nir=graph)


def test_digits_on_a_grid_are_altered_in_space():
    digits = replace(recordings(10, 10), sensor=Sensor(10, 10, classes=tuple("0123456789")))
    assert choose_image_augmentation(digits) == "slight"
    assert choose_image_augmentation(recordings(10, 10)) == "time"
    strip = replace(recordings(1, 30), sensor=Sensor(1, 30, classes=tuple("0123456789")))
    assert choose_image_augmentation(strip) == "time"


def test_what_the_user_sets_is_kept():
    strip = recordings(1, 30)
    changes, _ = choose(settings(image={"normalisation": "sum"}), strip)
    assert changes == {"cnn": {"architecture": "1x30-256-3o"}}
    own = {"snn": {"dropout": 0.1}, "deployment": {"input_rate": 90.0}}
    changes, _ = choose(settings(**own), strip)
    assert not {"snn", "deployment"} & changes.keys()
    changes, _ = choose(settings(cnn={"architecture": "1x30-9-3o"}), strip)
    assert changes == {"image": {"normalisation": "sqrt-clip"}}


def test_a_model_for_a_run_gets_the_images_of_the_run(tmp_path):
    run = RunFolder(tmp_path)
    assert make_kept_image_settings(run) == {}
    image = Image("polarities", 4, 400.0, "sqrt-clip")
    run.save_settings(settings(image=asdict(image)))
    assert make_kept_image_settings(run) == {"image": asdict(image)}
    run.save_settings(settings(input={"kind": "events"}))
    assert make_kept_image_settings(run) == {}


def test_a_model_of_one_s_own_keeps_the_images_that_it_is_for():
    cnn = {"model": "m.keras", "model_sha256": "a", "architecture": "10x10-6c4-3o"}
    assert choose(settings(cnn=cnn), recordings(10, 10)) == ({}, [])


@pytest.mark.parametrize(
    "cnn",
    [
        {"architecture": "1x30x16-9-3o"},
        {"model": "m.keras", "model_sha256": "a", "architecture": "1x30x16-9-3o"},
    ],
)
def test_a_network_of_one_s_own_gets_these_channels_if_it_has_as_many(cnn):
    changes, _ = choose(settings(cnn=cnn), recordings(1, 30))
    assert "cnn" not in changes
    assert find_kind(settings(cnn=cnn, image=changes["image"])).channels == 16
    assert ("snn" in changes) == ("model" not in cnn)


def test_a_default_that_the_user_gives_is_kept(tmp_path):
    default = Settings()
    given = settings(
        snn={"dropout": default.snn.dropout},
        deployment={"input_rate": default.deployment.input_rate},
    )
    changes, _ = choose(given, recordings(1, 30))
    assert not {"snn", "deployment"} & changes.keys()
    assert "image" in changes
    image = {"slices": default.image.slices}
    changed, _ = choose(settings(image=image), recordings(1, 30))
    assert changed["image"] == {"normalisation": "sqrt-clip"}
    own = given.with_values({"seed": 3})
    run = RunFolder(tmp_path)
    choices = find_kind(own).make_choices(recordings(1, 30), np.arange(10))
    run.save_settings(apply_choices(own, choices))
    again = run.resolve_settings(None, {})  # by a later command
    assert again == own
    assert choose(again, recordings(1, 30))[0] == changes
    run.save_settings(settings(snn={"dropout": 0.3}))
    run.experiment.write_text(
        run.experiment.read_text().replace("\ndropout = 0.3", f"\ndropout = {default.snn.dropout}")
    )
    assert not run.resolve_settings(None, {}).is_open("snn.dropout")


def test_a_grid_gets_the_paper_s_image_and_layers():
    changes, _ = choose(settings(), recordings(8, 9))
    architecture = {"architecture": "8x9-6c4-24c3-3o"}
    assert changes == {"cnn": architecture, "image": {"normalisation": "sqrt-clip"}}


@pytest.mark.parametrize(
    ("sections", "against"),
    [
        ({}, "cnn-matched"),
        ({"snn": {"recipe": "paper"}}, "cnn"),
        ({"cnn": {"model": "m.keras", "model_sha256": "a"}, "snn": {"recipe": "as-is"}}, "cnn"),
    ],
)
def test_losses_are_stated_against_the_cnn_with_the_same_training(sections, against):
    stages = find_kind(settings(**sections)).reference_stages
    assert find_compared_stage(stages) == against
    assert ("cnn-matched" in stages) == (against == "cnn-matched")


@pytest.mark.parametrize("sections", [{}, {"input": {"kind": "events"}}], ids=["image", "events"])
@pytest.mark.parametrize("size", [(1, 19), (2, 3), (9, 12)])
def test_the_architecture_that_a_refusal_suggests_fits(sections, size):
    kind = find_kind(settings(cnn={"architecture": "5x5-6c4-3o"}, **sections))
    with pytest.raises(UserError) as caught:
        kind.require_recordings_fit(recordings(*size))
    suggested = parse_architecture(re.search(r"such as (\S+), not", str(caught.value))[1])
    assert (*suggested.input_shape, suggested.outputs) == (*size, kind.channels, 3)


def test_the_split_of_an_imported_network_is_said_when_it_is_new():
    imported = ImportedNetwork("graph.nir", "a", "nir", "")
    assert "seed 7" in "".join(imported.list_split_notes(State("nir", MISSING), 7))
    assert not list(imported.list_split_notes(State("nir", CURRENT), 7))
