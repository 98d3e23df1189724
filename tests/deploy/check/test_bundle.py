import json
import re
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from deploy.check import bundle as bundles
from deploy.check.bundle import FILES, CheckSet, read_bundle, write_bundle
from deploy.conformance.networks import draw_frames, make_event_network, make_image_network
from deploy.errors import UserError
from deploy.files import hash_file, read_arrays, read_json, write_json
from tests.deploy.networks import bundle_at, draw_checks


@pytest.fixture
def bundle(tmp_path):
    return bundle_at(tmp_path / "bundle")


def test_round_trip(bundle):
    read = read_bundle(bundle.path)
    checks = draw_checks(make_image_network(), 7)
    assert read.id == bundle.id == hash_file(bundle.path / "MANIFEST.json")
    assert read.spec == make_image_network()
    np.testing.assert_array_equal(
        read.spec.layers[0].weights, make_image_network().layers[0].weights
    )
    np.testing.assert_array_equal(read.checks.inputs, np.float32(checks.inputs))
    np.testing.assert_array_equal(read.checks.labels, checks.labels)
    assert (read.checks.ids, read.checks.seed, len(read.checks)) == (checks.ids, checks.seed, 7)


def test_the_files_of_the_contract(bundle):
    assert {path.name for path in bundle.path.iterdir()} == {
        *("network.json", "weights.npz", "checks.npz", "MANIFEST.json", "deploy.pyz")
    }
    manifest = read_json(bundle.path / "MANIFEST.json", "")
    for name in FILES:
        assert manifest["files"][name] == hash_file(bundle.path / name)


def test_the_same_inputs_make_the_same_id(bundle, tmp_path):
    assert bundle_at(tmp_path / "again").id == bundle.id
    with zipfile.ZipFile(bundle.path / "deploy.pyz") as file:
        assert {member.date_time for member in file.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_other_inputs_make_another_id(bundle, tmp_path):
    assert bundle_at(tmp_path / "other", make_image_network(seed=1)).id != bundle.id
    assert bundle_at(tmp_path / "gap", make_image_network(gap=6)).id != bundle.id
    assert bundle_at(tmp_path / "more", count=8).id != bundle.id


@pytest.mark.parametrize("name", FILES)
def test_a_changed_byte_or_a_missing_file_is_refused_by_name(bundle, name):
    path = bundle.path / name
    content = path.read_bytes()
    for where in (0, len(content) // 2, len(content) - 1):
        changed = bytearray(content)
        changed[where] ^= 1
        path.write_bytes(changed)
        with pytest.raises(UserError, match=name):
            read_bundle(bundle.path)
    path.write_bytes(content)
    read_bundle(bundle.path)
    path.unlink()
    with pytest.raises(UserError, match=name):
        read_bundle(bundle.path)


def with_its_hash(bundle, file):
    """Give a file that was changed a hash that fits, as another version might."""
    manifest = read_json(bundle.path / "MANIFEST.json", "")
    manifest["files"][file] = hash_file(bundle.path / file)
    write_json(bundle.path / "MANIFEST.json", manifest)
    return bundle.path


def rewrite(bundle, change):
    description = read_json(bundle.path / "network.json", "")
    change(description)
    (bundle.path / "network.json").write_text(json.dumps(description))
    return with_its_hash(bundle, "network.json")


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        (lambda d: d.update(schema="stmnist-bundle/9"), "'stmnist-bundle/9'"),
        (lambda d: d.pop("layers"), "'layers'"),
        (lambda d: d["layers"][0].update(block_shape=[0, 0, 0]), r"block_shape.*\(0, 0, 0\)"),
        (lambda d: d["layers"][0].update(block_shape=[1, 2]), r"block_shape \(1, 2\)"),
        (lambda d: d["layers"][0]["neurons"].update(tau_rc=float("nan")), "network.json"),
        (lambda d: d["layers"][0]["neurons"].update(tau_ref=2**70), "tau_ref"),
        (lambda d: d["layers"][0]["neurons"].update(amplitude=float("inf")), "network.json"),
        (lambda d: d["layers"][0].update(name="x" * 200), "x{100}"),
        (lambda d: d.update(note="mine"), "note"),
        (lambda d: d.update(input_shape=[10**6, 10**6, 1]), "input_shape"),
    ],
)
def test_a_description_of_another_version_or_without_a_meaning(bundle, change, fact):
    with pytest.raises(UserError, match=fact) as caught:
        read_bundle(rewrite(bundle, change))
    assert str(bundle.path) in str(caught.value)


@pytest.mark.parametrize(
    "manifest",
    ["", "[]", "{}", '{"schema": "stmnist-manifest/1"}', '{"schema": "stmnist-manifest/9"}']
    + [json.dumps({"schema": "stmnist-manifest/1", "files": {"network.json": "0"}})],
)
def test_a_broken_manifest(bundle, manifest):
    (bundle.path / "MANIFEST.json").write_text(manifest)
    with pytest.raises(UserError, match=r"MANIFEST\.json"):
        read_bundle(bundle.path)


def test_a_log_in_the_folder_is_not_in_the_way_and_not_lost(bundle):
    (bundle.path / "nohup.out").write_text("half a day's work")
    assert read_bundle(bundle.path).id == bundle.id
    with pytest.raises(UserError, match=r"nohup\.out"):
        write_bundle(bundle.path, bundle.spec, bundle.checks)
    assert (bundle.path / "nohup.out").read_text() == "half a day's work"


def test_what_is_no_bundle(tmp_path):
    missing = tmp_path / "nowhere"
    for path, fact in ((missing, "does not exist"), (tmp_path, "not a bundle")):
        with pytest.raises(UserError, match=f"{re.escape(str(path))}: {fact}"):
            read_bundle(path)


def test_a_run_without_a_bundle_is_told_how_to_make_it(tmp_path):
    (tmp_path / "experiment.toml").write_text("")
    with pytest.raises(UserError, match=f"{re.escape(str(tmp_path))}: .*convert"):
        read_bundle(tmp_path / "bundle")


def test_a_folder_with_other_files_is_not_replaced(bundle):
    file = bundle.path / "thesis.txt"
    file.write_text("years of work")
    with pytest.raises(UserError, match=r"thesis\.txt"):
        bundle_at(bundle.path, make_image_network(seed=1))
    assert file.read_text() == "years of work"


def test_an_interruption_leaves_the_earlier_bundle(bundle, tmp_path, monkeypatch):
    def interrupt():
        raise KeyboardInterrupt

    monkeypatch.setattr(bundles, "make_zipapp", interrupt)
    with pytest.raises(KeyboardInterrupt):
        bundle_at(bundle.path, make_image_network(seed=1))
    assert read_bundle(bundle.path).id == bundle.id
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]


def test_an_interruption_of_the_exchange_leaves_the_earlier_bundle(bundle, tmp_path, monkeypatch):
    replace = bundles.os.replace

    def interrupt(source, target):
        if str(target) == str(bundle.path) and "earlier" not in monkeypatched:
            monkeypatched.append("earlier")
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatched = []
    new = make_image_network(seed=1), draw_checks(make_image_network(), 7)
    monkeypatch.setattr(bundles.os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_bundle(bundle.path, *new)
    monkeypatch.undo()
    assert read_bundle(bundle.path).id == bundle.id
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]
    assert write_bundle(bundle.path, *new).id != bundle.id
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]


def test_the_zipapp_holds_the_package(bundle):
    with zipfile.ZipFile(bundle.path / "deploy.pyz") as archive:
        names = archive.namelist()
    assert {
        "__main__.py",
        "deploy/__init__.py",
        "deploy/cli.py",
        "deploy/targets/registry.py",
    } <= set(names)
    assert not [name for name in names if name.startswith(("pipeline", "models", "tests"))]


def with_arrays(bundle, file, **changes):
    """The bundle with other arrays in a file, and right hashes."""
    path = bundle.path / file
    arrays = {**read_arrays(path, ""), **changes}
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            with archive.open(name + ".npy", "w") as stream:
                np.lib.format.write_array(stream, np.asarray(array), allow_pickle=True)
    return with_its_hash(bundle, file)


NAN = np.full((7, 6, 6, 1), np.nan, np.float32)


@pytest.mark.parametrize(
    ("changes", "fact"),
    [
        ({"labels": [0, 1, 2, 3, 4, 5, 99]}, "labels.* 0 to 9"),
        ({"labels": [0, 1, 2, 3, 4, 5, -1]}, "labels.* 0 to 9"),
        ({"labels": [0, 1, 2, 3, 4, 5, 6.5]}, "labels"),
        ({"labels": np.full(7, np.nan)}, "labels"),
        ({"labels": ["1"] * 7}, "labels"),
        ({"labels": np.zeros((7, 1), int)}, "labels"),
        ({"labels": np.zeros(6, int)}, "labels"),
        ({"ids": ["a"] * 7}, r"\bid\b"),
        ({"ids": [*"abcdef", "\ud800"]}, r"\bid\b.*UTF-8"),
        ({"ids": np.arange(7)}, r"\bids\b"),
        ({"ids": np.array([["a"]] * 7)}, r"\bids\b"),
        ({"inputs": NAN}, "NaN"),
        ({"inputs": np.full((7, 6, 6, 1), 1e30, np.float32)}, "large"),
        ({"inputs": np.zeros((7, 6, 6, 1), complex)}, "real"),
        ({"inputs": np.zeros((7, 6, 6, 2))}, r"\(6, 6, 2\)"),
        ({"seed": [0, 1]}, "seed"),
        ({"more": [0]}, "more"),
    ],
)
def test_checks_that_are_none(bundle, changes, fact):
    with pytest.raises(UserError, match=rf"checks\.npz.*{fact}"):
        read_bundle(with_arrays(bundle, "checks.npz", **changes))


@pytest.mark.parametrize(
    ("changes", "fact"),
    [
        ({"conv1.weights": np.zeros((3, 3, 1, 4), complex)}, "'conv1'.*weights"),
        ({"conv1.weights": np.full((3, 3, 1, 4), "x")}, "'conv1'.*weights"),
        ({"conv1.weights": np.full((3, 3, 1, 4), 1e300)}, r"'conv1'.*weights.* 1e\+"),
        ({"conv9.weights": np.zeros(3)}, r"conv9\.weights"),
    ],
)
def test_weights_that_are_none(bundle, changes, fact):
    with pytest.raises(UserError, match=fact):
        read_bundle(with_arrays(bundle, "weights.npz", **changes))


@pytest.mark.parametrize(("change", "fact"), [
    (lambda c: replace(c, inputs=0.7 * c.inputs), "whole number"),
    (lambda c: replace(c, inputs=c.inputs.astype(int) + 256), "whole number"),
    (lambda c: replace(c, labels=c.labels + 0.7), "whole number"),
    (lambda c: replace(c, labels=c.labels.astype(str)), "whole number"),
    (lambda c: replace(c, labels=c.labels[:3]), "^the samples of the check .*length"),
    (lambda c: replace(c, ids=tuple("abca")), "^the samples of the check .*same id"),
])  # fmt: skip
def test_samples_that_would_be_stored_as_others(tmp_path, change, fact):
    spec = make_event_network()
    checks = CheckSet(draw_frames(spec, 4), np.arange(4) % 3, tuple("abcd"), 0)
    with pytest.raises(ValueError, match=fact):
        write_bundle(tmp_path / "b", spec, change(checks))
    assert not (tmp_path / "b").exists()
