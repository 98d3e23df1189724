"""``stmnist adapt``: a new bundle for one person, or nothing at all."""

import json
from dataclasses import replace

import numpy as np
import pytest

from deploy.check.bundle import read_bundle, write_bundle
from deploy.errors import UserError
from deploy.files import read_json
from pipeline.live.network import SHIPPED
from pipeline.recordings.files.writing import write_mat_zip
from pipeline.recordings.recordings import Recordings
from pipeline.results.other_recordings import read_recordings_for
from pipeline.settings import Settings, write_settings
from pipeline.simulation import handwriting, parameters
from pipeline.simulation.handwriting import Trace
from pipeline.simulation.shape_model import fit_in_box
from pipeline.simulation.simulate import SimulationSetup, simulate_recordings
from tests.command import call

# From (down, right) to that of a digit that leans to the left.
LEANING = np.array([[1.0, 0.7], [0.0, 1.0]])


def strange_hand(each, seed=5):
    """Recordings of somebody whose digits lean far to the left."""
    p, rng = parameters.read_parameters(), np.random.default_rng(seed)
    who = handwriting.draw_writer(rng, p)
    traces = []
    for digit in np.repeat(np.arange(10), each):
        shape = handwriting.draw_shape(digit, who, rng, p.shapes)
        strokes = handwriting.write_digit(digit, shape, who, p)
        traces.append(Trace(int(digit), 7, fit_in_box(stroke @ LEANING for stroke in strokes)))
    return simulate_recordings(seed, [each] * 10, 1, setup=SimulationSetup(traces=tuple(traces)))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run on events, of which only the bundle is there: the network of the package.

    Its check has every fourth sample, since each fit computes the answers to all of them.
    """
    folder = tmp_path_factory.mktemp("adapt") / "run"
    bundle = read_bundle(SHIPPED)
    write_bundle(folder / "bundle", bundle.spec, bundle.checks[::4])
    return folder


@pytest.fixture(scope="module")
def person(tmp_path_factory):
    recordings = strange_hand(5)
    path = tmp_path_factory.mktemp("person") / "mine.zip"
    write_mat_zip(path, recordings)
    return path


def told(capsys):
    return json.loads(capsys.readouterr().out)


def contents(folder):
    return {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_person_whom_the_network_does_not_know(run, person, tmp_path, capsys):
    before = contents(run)
    assert call("adapt", run, "--data", person, "--json") == 0
    result = told(capsys)
    assert set(result) == {
        "before", "after", "others_before", "others_after", "bundle", "samples", "trained_on",
        "in_check", "kept_before", "kept_after",
    }  # fmt: skip
    assert result["samples"] == 50
    assert result["after"] > result["before"]
    folder = run / "adapted" / "7"
    assert result["bundle"] == str(folder)
    assert {p: b for p, b in contents(run).items() if "adapted" not in p.parts} == before
    old, new = read_bundle(run / "bundle"), read_bundle(folder)
    for was, now in zip(old.spec.layers[:-1], new.spec.layers[:-1], strict=True):
        np.testing.assert_array_equal(was.weights, now.weights)
    weights = new.spec.layers[-1].weights
    assert len(np.unique(weights)) <= 255
    unit = np.abs(weights).max() / 127
    np.testing.assert_allclose(weights / unit, np.rint(weights / unit), atol=1e-6)
    assert new.spec.presentation.threshold >= old.spec.presentation.threshold
    assert new.spec.provenance.entries["adapted"]["from"] == old.id
    # The new bundle is one like any other: its check says what was promised of the others.
    out = tmp_path / "fast.json"
    assert call("check", "run", folder, "--target", "fast", "--out", out) == 0
    assert read_json(out, "")["accuracy"] == pytest.approx(result["others_after"], abs=0.05)
    # Unseen digits of the same person are told better too.
    unseen = strange_hand(8, seed=6)
    from pipeline.training.adaptation.responder import Responder

    responses = (r := Responder(old.spec)).compute_responses(r.make_inputs(unseen))
    right = [
        np.mean((responses @ b.spec.layers[-1].weights_by_class.T).argmax(1) == unseen.labels)
        for b in (old, new)
    ]
    assert right[1] > right[0]
    # The same again gives the same, and from the adapted bundle one can go on.
    assert call("adapt", run, "--data", person, "--out", tmp_path / "again", "--json") == 0
    assert read_bundle(tmp_path / "again").id == new.id
    assert call("adapt", folder, "--data", person, "--json") == 0
    # Another person's recordings do not take the place of these.
    write_mat_zip(tmp_path / "7.zip", named(strange_hand(5, seed=9)))
    assert call("adapt", run, "--data", tmp_path / "7.zip") == 2
    assert read_bundle(folder).id == new.id


@pytest.mark.parametrize("of", ["run", "tiny_run"])
def test_responses_are_what_the_readout_reads(of, request):
    """Old weights on the responses give the scores of the target itself, and of other targets."""
    from deploy.targets.registry import run_target
    from pipeline.training.adaptation.responder import Responder

    bundle = read_bundle(request.getfixturevalue(of) / "bundle")
    alone = bundle.spec.with_presentation(stream_length=1)
    readout = bundle.spec.layers[-1]
    responses = Responder(bundle.spec).compute_responses(bundle.checks.inputs)
    scores = responses @ readout.weights_by_class.T
    result = run_target(alone, bundle.checks.inputs, "fast").scores
    np.testing.assert_allclose(scores + readout.bias, result, atol=1e-6)


def test_of_images(tiny_run, person, tmp_path, capsys):
    assert call("adapt", tiny_run, "--data", person, "--out", tmp_path / "new", "--json") == 0
    result = told(capsys)
    assert result["samples"] == 50
    assert result["after"] > result["before"]
    assert read_bundle(result["bundle"]).spec.stimulus.is_static


def test_labels_that_are_all_wrong_cost_others_as_little_as_is_promised(run, tmp_path, capsys):
    recordings = strange_hand(3)
    labels = np.random.default_rng(0).permutation(recordings.labels)
    write_mat_zip(tmp_path / "wrong.zip", named(replace(recordings, labels=labels)))
    before = contents(run)
    arguments = ("--data", tmp_path / "wrong.zip", "--out", tmp_path / "new", "--json")
    assert call("adapt", run, *arguments) == 0
    fit = told(capsys)
    is_kept = fit["kept_before"] - fit["kept_after"] <= 0.015
    assert (fit["bundle"] is not None) == (is_kept and fit["after"] > fit["before"])
    assert (tmp_path / "new").exists() == (fit["bundle"] is not None)
    assert contents(run) == before


def test_the_reason_for_which_nothing_changes():
    from pipeline.training.adaptation.adapt import Adaptation, format_adaptation
    from pipeline.training.adaptation.refit import Refit

    right, wrong = np.ones(10, bool), np.zeros(10, bool)
    for after, kept, reason in ((wrong, right, "no improvement"), (right, wrong, "100.0 points")):
        fit = Refit(np.zeros((2, 3)), 1.0, 1.0, wrong, after, right, kept)
        assert not fit.helps
        assert reason in format_adaptation(Adaptation(None, fit, right, right), None)


def named(recordings: Recordings) -> Recordings:
    """With ids, which become the folders of a zip, as the labels say."""
    ids = tuple(f"{label}/{index:04d}" for index, label in enumerate(recordings.labels))
    return replace(recordings, ids=ids)


def test_bad_input_is_one_line_and_nothing_is_written(run, person, tmp_path, capsys):
    whole = strange_hand(1)
    write_mat_zip(tmp_path / "nine.zip", whole.subset(range(9)))
    write_mat_zip(tmp_path / "one.zip", whole.subset([3]))
    (tmp_path / "empty").mkdir()
    small = simulate_recordings(0, [1] * 10, 1, setup=SimulationSetup(size=(8, 8)))
    write_mat_zip(tmp_path / "small.zip", small)
    bundle = read_bundle(run / "bundle")
    write_bundle(tmp_path / "forgetful", replace(bundle.spec, rehearsal=None), bundle.checks)
    before = contents(tmp_path)
    for arguments, names in (
        ((run, "--data", tmp_path / "nine.zip"), "nine.zip"),
        ((run, "--data", tmp_path / "one.zip"), "one.zip"),
        ((run, "--data", tmp_path / "empty"), "empty"),
        ((run, "--data", tmp_path / "none.zip"), "none.zip"),
        ((run, "--data", tmp_path / "small.zip"), "small.zip"),
        ((run, "--data", person, "--writer", 3), "writer 3"),
        ((run, "--data", person, "--out", run / "bundle"), "bundle"),
        ((tmp_path / "forgetful", "--data", person), "forgetful"),
        ((tmp_path / "no-run", "--data", person), "no-run"),
    ):
        assert call("adapt", *arguments) == 2, arguments
        printed = capsys.readouterr()
        assert printed.out == ""
        assert len([line for line in printed.err.splitlines() if "stmnist:" in line]) == 1
        assert names in printed.err, arguments
    assert contents(tmp_path) == before


def test_a_readout_on_the_chip_and_other_classes(tmp_path, run, person, capsys):
    from deploy.network.layer import Neurons

    bundle = read_bundle(run / "bundle")
    on_host = bundle.spec.layers[-1]
    readout = replace(
        on_host,
        weights=on_host.weights[: on_host.size],
        section_starts=(0,),
        neurons=Neurons(0.001),
        synapse=0.008,
    )
    layers = (*bundle.spec.layers[:-1], readout)
    on_chip = replace(bundle.spec, layers=layers, estimator=None, rehearsal=None)
    write_bundle(tmp_path / "chip", on_chip, bundle.checks)
    assert call("adapt", tmp_path / "chip", "--data", person) == 2
    assert "deployment.readout" in capsys.readouterr().err
    letters = bundle.spec.provenance.with_entries(classes=list("abcdefghij"))
    write_bundle(tmp_path / "letters", replace(bundle.spec, provenance=letters), bundle.checks)
    assert call("adapt", tmp_path / "letters", "--data", person) == 2
    assert "mine.zip" in capsys.readouterr().err


def test_one_of_several_writers(run, tmp_path, capsys, monkeypatch):
    recordings = strange_hand(2)
    several = replace(recordings, writers=np.arange(20) % 2 + 3)
    from pipeline.commands import adapt
    from pipeline.results import other_recordings

    monkeypatch.setattr(other_recordings, "load_recordings", lambda *a, **k: several)
    assert call("adapt", run, "--data", "any", "--out", tmp_path / "new") == 2
    assert "3, 4" in capsys.readouterr().err
    chosen, name = adapt._select_person(several, 4)
    assert (len(chosen), name, set(chosen.writers)) == (10, "4", {4})
    assert not (tmp_path / "new").exists()
    # The network was made with the recordings of writer 3, which matters for that writer only.
    bundle = read_bundle(SHIPPED)
    hashes = [several.hashes[index] for index in np.flatnonzero(several.writers == 3)]
    provenance = bundle.spec.provenance.with_entries(training_recordings=hashes)
    bundle = replace(bundle, spec=replace(bundle.spec, provenance=provenance))
    for writer, number in ((3, 10), (4, 0)):
        said = " ".join(
            other_recordings.list_warnings(bundle, adapt._select_person(several, writer)[0])
        )
        assert (f"{number} of 10 recordings were used" in said) == (number > 0)


def test_recordings_are_read_with_the_settings_of_the_run(tmp_path, capsys):
    """The recordings are of a camera with twice as many rows and columns as the network."""
    shipped = read_bundle(SHIPPED)
    read_with = {k: v for k, v in shipped.spec.provenance.entries.items() if k != "downsample"}
    unknown = replace(shipped.spec, provenance=read_with)
    write_bundle(tmp_path / "run" / "bundle", unknown, shipped.checks)
    own = Settings().with_values({"data": {"source": "own", "downsample": 2}})
    write_settings(tmp_path / "run" / "experiment.toml", own)
    small = strange_hand(4)
    for index, label in enumerate(small.labels):
        events, who = small[index], index % 2
        folder = tmp_path / "data" / str(label)
        folder.mkdir(parents=True, exist_ok=True)
        y, x = np.divmod(2 * np.array(events.taxel, int), 20)
        t, p = events.time_ns // 1000, events.polarity
        np.savez(folder / f"{who}-{index}.npz", x=x, y=2 * y, t=t, p=p)
    arguments = (tmp_path / "run", "--data", tmp_path / "data", "--json")
    assert call("adapt", *arguments) == 0
    assert told(capsys)["samples"] == 40
    copied = read_bundle(tmp_path / "run" / "bundle")
    spec = replace(copied.spec, provenance=copied.spec.provenance.with_entries(downsample=2))
    arguments = str(tmp_path / "data"), Settings()
    assert len(read_recordings_for(replace(copied, spec=spec), *arguments)) == 40
    with pytest.raises(UserError):
        read_recordings_for(copied, *arguments)
