"""Artifacts: what they record, what makes them outdated, and that no dependency is forgotten."""

import pickle
from dataclasses import asdict, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.files import read_json, write_json
from pipeline.kinds.registry import find_kind
from pipeline.recordings.dataset import make_dataset_origin
from pipeline.settings import PATHS, Settings, UndeclaredSetting
from pipeline.storage.artifacts import Artifact, Library, Origin

SETTINGS = Settings()


def changed(name, value):
    section, _, entry = name.partition(".")
    return SETTINGS.with_values({section: {entry: value}} if entry else {section: value})


def test_an_artifact_is_missing_then_current_then_outdated(tmp_path):
    origin = Origin.from_settings(SETTINGS, ["cnn.epochs", "image"], contents={"recordings": "ab"})
    artifact = Artifact("cnn", tmp_path / "metrics.json", origin, (tmp_path / "weights.npz",))
    assert artifact.find_state().condition == "missing"
    artifact.write({"accuracy": 0.5})
    assert artifact.find_state().condition == "missing"  # without its weights
    artifact.files[0].write_bytes(b"")
    state = artifact.find_state()
    assert state.is_current
    assert state.record["accuracy"] == 0.5
    state.announce("training", pytest.fail)
    later = Origin.from_settings(
        changed("cnn.epochs", 2), ["cnn.epochs", "image"], contents=origin.contents
    )
    state = replace(artifact, origin=later).find_state()
    assert (state.condition, state.to_json()["because"]) == (
        "outdated",
        ["cnn.epochs changed from automatic (0) to 2"],
    )
    state.announce("training", (said := []).append)
    assert "cnn.epochs" in said[0]


def test_contents_settings_that_come_and_settings_that_go_are_told():
    before = Origin.from_settings(
        SETTINGS, ["cnn.epochs", "seed"], contents={"recordings": "a" * 64}
    )
    now = Origin.from_settings(
        SETTINGS, ["cnn.model_sha256", "seed"], contents={"recordings": "b" * 64}
    )
    told = [str(change) for change in now.list_changes_since(before.to_json())]
    assert told == [
        'cnn.model_sha256 changed from unused to ""',
        "cnn.epochs changed from automatic (0) to unused",
        "recordings changed from aaaaaaaaaaaa to bbbbbbbbbbbb",
    ]


def test_an_origin_is_read_back_as_it_was_written(tmp_path):
    origin = Origin.from_settings(SETTINGS, ["snn", "deployment", "data.skip_bad"])
    write_json(tmp_path / "x.json", {"made_from": origin.to_json()})
    assert origin.list_changes_since(read_json(tmp_path / "x.json", "")["made_from"]) == ()


def test_an_artifact_depends_on_all_that_it_uses():
    below = Origin.from_settings(SETTINGS, ["cnn"], contents={"recordings": "ab"})
    above = Origin.from_settings(SETTINGS, ["snn"], [below])
    assert above.settings.keys() >= below.settings.keys()
    assert above.contents["recordings"] == "ab"
    assert above.key != Origin.from_settings(SETTINGS, ["snn"]).key
    with pytest.raises(ValueError, match=r"cnn\.epochs"):
        Origin.from_settings(changed("cnn.epochs", 3), ["cnn"], [below])


def test_a_setting_that_is_not_declared_cannot_be_read():
    origin = Origin.from_settings(SETTINGS, ["cnn.epochs", "image", "seed"])
    view = SETTINGS.select(origin.settings)
    for seen in (view, pickle.loads(pickle.dumps(view))):  # as a worker gets it
        assert (seen.seed, seen.cnn.epochs, seen.image) == (0, 0, SETTINGS.image)
        for read in (
            lambda s: s.cnn.batch_size,
            lambda s: s.snn.recipe,
            lambda s: s.on_events,
            lambda s: s.steps,
            lambda s: s.stimulus,
            lambda s: s.make_presentation(),
            lambda s: asdict(s.cnn),
            lambda s: s.flatten(),
            lambda s: replace(s, cnn=replace(s.cnn, epochs=3)),
            lambda s: s == SETTINGS,
        ):
            with pytest.raises(UndeclaredSetting):
                read(seen)
    assert SETTINGS.cnn.batch_size == 8  # the settings themselves stay whole


@given(st.sets(st.sampled_from(sorted(SETTINGS.flatten()))))
def test_a_view_holds_the_declared_settings_and_paths(names):
    view = SETTINGS.select(names)
    for name, value in SETTINGS.flatten().items():
        if name in names or name in PATHS:
            assert view.get_value(name) == value
        else:
            with pytest.raises(UndeclaredSetting):
                view.get_value(name)


def test_no_path_is_part_of_an_origin():
    here = changed("data.source", "/here/x.zip").with_values(
        {"cnn": {"model": "/here/m.keras", "model_sha256": "a"}}
    )
    there = changed("data.source", "/there/x.zip").with_values(
        {"cnn": {"model": "/there/m.keras", "model_sha256": "a"}}
    )
    one, two = (
        find_kind(s).make_bundle_origin(make_dataset_origin(s, "ab")) for s in (here, there)
    )
    assert one == two


def test_a_published_split_does_not_depend_on_a_share():
    one, two = SETTINGS, changed("split.test_fraction", 0.4)
    assert make_dataset_origin(one, "ab", "published") == make_dataset_origin(
        two, "ab", "published"
    )
    assert make_dataset_origin(one, "ab") != make_dataset_origin(two, "ab")


def test_variants_lie_side_by_side(tmp_path):
    library = Library(tmp_path)
    one, two = (Origin.from_settings(changed("cnn.epochs", n), ["cnn"]) for n in (1, 2))
    assert library.find_folder("cnn", one) != library.find_folder("cnn", two)
    assert library.find_folder("cnn", one) == library.find_folder("cnn", one)


IMAGE_DATA, EVENT_DATA = (
    "dataset cnn cnn-matched rate-lif bundle",
    "dataset events threshold bundle",
)

DEPENDS = {
    # setting: what is made again, of a run on images and of one on events
    ("cnn.epochs", 3): ("cnn cnn-matched rate-lif bundle", ""),
    ("snn.noise", 0.2): ("cnn-matched rate-lif bundle", ""),
    ("cnn.augment", "none"): ("cnn cnn-matched rate-lif bundle", ""),
    ("deployment.synapse", 0.01): ("bundle", ""),
    ("presentation.steps", 60): ("bundle", "threshold bundle"),
    ("presentation.gap", 3): ("bundle", "bundle"),
    ("check.samples", 50): ("bundle", "bundle"),
    ("input.refractory", 20.0): ("", "events threshold bundle"),
    ("events.epochs", 3): ("", "events threshold bundle"),
    ("image.aggregation", "signed"): ("cnn cnn-matched rate-lif bundle", ""),
    ("split.test_fraction", 0.3): (
        "dataset cnn cnn-matched rate-lif bundle",
        "dataset events threshold bundle",
    ),
    ("data.writers", 99): (
        "dataset cnn cnn-matched rate-lif bundle",
        "dataset events threshold bundle",
    ),
    ("data.chunked", 0.5): (
        "dataset cnn cnn-matched rate-lif bundle",
        "dataset events threshold bundle",
    ),
    ("data.reversed", 0.5): (
        "dataset cnn cnn-matched rate-lif bundle",
        "dataset events threshold bundle",
    ),
    ("data.mixed_forms", 0.5): (
        "dataset cnn cnn-matched rate-lif bundle",
        "dataset events threshold bundle",
    ),
    ("data.tablet", 0.5): (
        "dataset cnn cnn-matched rate-lif bundle",
        "dataset events threshold bundle",
    ),
    ("data.samples_per_digit", 9): (
        "dataset cnn cnn-matched rate-lif bundle",
        "dataset events threshold bundle",
    ),
    ("seed", 1): (IMAGE_DATA, EVENT_DATA),
}


@pytest.mark.parametrize(("setting", "remade"), DEPENDS.items())
def test_a_setting_remakes_what_depends_on_it_and_nothing_else(setting, remade):
    name, value = setting
    for kind, expected in zip(("image", "events"), remade, strict=True):
        found = []
        for settings in (SETTINGS, changed(name, value)):
            settings = replace(settings, input=replace(settings.input, kind=kind))
            dataset = make_dataset_origin(settings, "ab")
            network = find_kind(settings)
            made = {"dataset": dataset, "bundle": network.make_bundle_origin(dataset)}
            made |= {step.name: network.make_origin(step.name, dataset) for step in network.steps}
            del made["counts"]  # which depends on the dataset alone
            found.append(made)
        one, two = found
        assert {name for name in one if one[name] != two[name]} == set(expected.split())


def test_the_gap_that_the_user_sets_is_another_origin_than_the_same_default():
    default = Settings()
    users = default.with_named_values({"presentation.gap": default.presentation.gap})
    of_default = Origin.from_settings(default, ["presentation"])
    of_users = Origin.from_settings(users, ["presentation"])
    assert of_default.key != of_users.key
    assert not default.select(of_default.settings).is_set_by_user("presentation.gap")
    assert users.select(of_users.settings).is_set_by_user("presentation.gap")
    with pytest.raises(UndeclaredSetting):
        users.select(of_users.settings).is_set_by_user("presentation.early_loss")
