"""A user's Keras model in the place of the CNN: taken over, scaled, converted, or refused."""

import re
import shutil

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.check.results import read_result
from deploy.files import read_json
from models.architecture import parse_architecture
from pipeline import workflow
from pipeline.api.run import Run
from pipeline.kinds.image.keras_model import make_model_settings
from pipeline.kinds.records import read_weights
from pipeline.settings import Settings, read_settings
from pipeline.sources import load_dataset
from pipeline.storage.run_folder import RunFolder
from tests.command import call, hurry_emulator, missing

DATA = ("--set", "data.samples_per_digit=60")
SMALL = (*DATA, "--samples", "20", "--steps", "40", "--set", "image.normalisation=sqrt-clip")
ARCHITECTURE = "10x10-6c4-24c3-10o"


@pytest.fixture(scope="module")
def dataset(tiny_run):
    """The recordings of the small run, which are in the cache with it."""
    changes = {"data": {"samples_per_digit": 60}, "image": {"normalisation": "sqrt-clip"}}
    return load_dataset(Settings().with_values(changes, "test"))


@pytest.fixture(scope="module")
def files(tmp_path_factory, dataset):
    """A trained model with a normalisation, and the same with the classes in another order."""
    from models.keras.keras2 import tf

    folder = tmp_path_factory.mktemp("models")
    images, labels = dataset.subset("train")
    layers = tf.keras.layers

    def network():
        return tf.keras.Sequential([
            tf.keras.Input((10, 10, 1)),
            layers.Conv2D(6, 4, use_bias=False),
            layers.BatchNormalization(),
            layers.ReLU(),
            layers.Conv2D(24, 3, activation="relu"),
            layers.Flatten(),
            layers.Dropout(0.1),
            layers.Dense(10, activation="softmax"),
        ])  # fmt: skip

    tf.keras.utils.set_random_seed(0)
    model = network()
    model.compile(tf.keras.optimizers.Adam(0.01), "sparse_categorical_crossentropy")
    model.fit(images, labels, epochs=30, batch_size=32, verbose=0)
    model.save(folder / "good.keras")
    np.save(folder / "probabilities.npy", model(dataset.inputs))
    output = model.layers[-1]
    output.set_weights([np.roll(array, 1, axis=-1) for array in output.get_weights()])
    model.save(folder / "other.keras")
    model = tf.keras.Sequential([
        tf.keras.Input((100,)),
        layers.Reshape((10, 10, 1)),
        layers.Conv2D(6, 3, activation="relu"),
        layers.MaxPooling2D(2, name="pool"),
        layers.Flatten(),
        layers.Dense(10, activation="softmax"),
    ])  # fmt: skip
    model.compile(tf.keras.optimizers.Adam(0.01), "sparse_categorical_crossentropy")
    model.fit(images.reshape(-1, 100), labels, epochs=12, batch_size=32, verbose=0)
    model.save(folder / "maximum.keras")
    large = tf.keras.Sequential([
        tf.keras.Input((12, 11, 1)),
        layers.Flatten(),
        layers.Dense(9, activation="relu"),
        layers.Dense(10),
    ])  # fmt: skip
    large.save(folder / "large.keras")
    small = tf.keras.Sequential([
        tf.keras.Input((8, 8, 1)),
        layers.Flatten(),
        layers.Dense(9, activation="relu", bias_initializer="ones"),
        layers.Dense(4),
    ])  # fmt: skip
    small.save(folder / "small.keras")
    network().save(folder / "new.keras")
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory, files):
    folder = tmp_path_factory.mktemp("runs") / "own"
    assert call("convert", folder, "--model", files / "good.keras", *SMALL) == 0
    return folder


def weights_in(run, folder, settings):
    return read_weights(run / folder, parse_architecture(settings.cnn.architecture).weight_shapes)


def test_the_cnn_of_the_run_answers_as_the_model_does(run, files, dataset):
    from pipeline.training.images.networks import TrainedCNN

    settings = read_settings(run / "experiment.toml")
    assert settings.cnn.architecture == ARCHITECTURE
    assert settings.snn.recipe == "as-is"
    weights = weights_in(run, "cnn", settings)
    logits = TrainedCNN(settings, weights).compute_logits(dataset.inputs)
    expected = np.load(files / "probabilities.npy")
    scores = np.exp(logits - logits.max(1, keepdims=True))
    np.testing.assert_allclose(scores / scores.sum(1, keepdims=True), expected, atol=1e-5)
    right = (expected.argmax(1) == dataset.labels)[dataset.split.test].mean()
    assert read_json(run / "cnn" / "metrics.json", "")["accuracy"]["test"] == pytest.approx(right)


def test_without_retraining_the_weights_are_only_fitted(run, dataset):
    """The same network but for a factor and a shift a layer, which bring the curves together."""
    from pipeline.training.images.networks import TrainedCNN, TrainedRates
    from pipeline.training.images.rescaling import scale_to_unit

    settings = read_settings(run / "experiment.toml")
    cnn, snn = (weights_in(run, name, settings) for name in ("cnn", "snn"))
    for name, array in cnn.items():
        factor = np.sum(array * snn[name]) / np.sum(array * array)
        if name.endswith("kernel"):
            np.testing.assert_allclose(snn[name], factor * array, rtol=1e-4, atol=1e-6)
    images = dataset.subset("train")[0]
    wanted = TrainedCNN(settings, cnn).compute_logits(images)

    def error(weights):
        return np.std(TrainedRates(settings, weights).compute_logits(images) - wanted) / np.std(
            wanted
        )

    assert error(snn) < 0.25
    assert error(snn) < 0.5 * error(scale_to_unit(settings, cnn, images))
    assert read_json(run / "snn" / "metrics.json", "")["epochs"] == 0


def test_it_goes_into_the_bundle_and_through_the_ladder(run):
    assert read_bundle(run / "bundle").spec.architecture == ARCHITECTURE
    for stage in ("cnn", "rate-lif", "spiking-lif"):
        assert len(read_result(run / "checks" / f"{stage}.json", "")["samples"]) == 20
    with hurry_emulator():
        assert call("ladder", run) == 0
    table = read_json(run / "ladder.json", "")
    rows = {row["stage"]: row["accuracy"] for row in table["rows"]}
    assert min(rows["cnn"], rows["emulator"]) > 0.3  # of 20 samples; chance is 0.1


def test_a_setting_of_the_training_changes_nothing_of_a_network_that_is_not_trained(run, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    before = read_bundle(copy / "bundle").id
    assert call("convert", copy, "--set", "snn.epochs=9", "--set", "snn.noise=0.3") == 0
    assert read_bundle(copy / "bundle").id == before


def test_a_later_version_and_another_split_are_reported(run, files, tmp_path, capsys):
    copy, path = tmp_path / "run", files / "good.keras"
    shutil.copytree(run, copy)
    content = path.read_bytes()
    path.write_bytes((files / "other.keras").read_bytes())
    try:
        assert call("status", copy) == 0
        assert missing(capsys.readouterr().err, str(path), "--model FILE") == []
    finally:
        path.write_bytes(content)
    assert call("status", copy) == 0
    assert str(path) not in capsys.readouterr().err
    assert call("train", copy, "--seed", 1) == 0
    assert "this split" in capsys.readouterr().err
    assert call("convert", copy, "--set", "snn.max_rates=[150]") == 0
    assert "this split" not in capsys.readouterr().err
    path.rename(tmp_path / "away")  # as on another machine
    try:
        assert call("train", copy, "--seed", 2) == 0
    finally:
        (tmp_path / "away").rename(path)


def test_retraining_starts_from_the_model(files, tmp_path):
    folder = tmp_path / "run"
    options = ("--set", "snn.epochs=1", "--retrain")
    assert call("convert", folder, "--model", files / "good.keras", *SMALL, *options) == 0
    assert read_settings(folder / "experiment.toml").snn.recipe == "loihi"
    metrics = read_json(folder / "snn" / "metrics.json", "")
    assert metrics["epochs"] == 1
    assert metrics["accuracy"]["test"] > 0.5  # from new weights one epoch gives a tenth


def test_a_maximum_becomes_an_average_and_is_trained_further(files, tmp_path, capsys):
    folder, path = tmp_path / "run", files / "maximum.keras"
    assert call("convert", folder, "--model", path, *SMALL) == 2
    assert missing(capsys.readouterr().err, f"{path}: layer 'pool'", "--retrain") == []
    assert not folder.exists()
    options = ("--set", "snn.epochs=1", "--set", "cnn.epochs=12", "--retrain")
    assert call("convert", folder, "--model", path, *SMALL, *options) == 0
    said = capsys.readouterr()
    assert re.search(r"needs \d+ cores? on \d+ chip", said.err)
    said = said.err + said.out
    line = next(line for line in said.splitlines() if "as in the file" in line)
    before, replaced, after = (float(number) for number in re.findall(r"[01]\.\d{3}", line))
    assert min(before, after) > replaced
    assert after > before - 0.15
    assert "AveragePooling2D" in said
    metrics = read_json(folder / "cnn" / "metrics.json", "")
    assert metrics["accuracy"]["test"] == pytest.approx(after, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "facts"),
    [
        ("large", ["12x11x1", "10x10x1", "skin.rows=12", "skin.columns=11"]),
        ("small", ["8x8x1", "4 classes", "10x10x1", "10 classes"]),
        ("new", ["chance", "accuracy 0."]),
        ("other", ["accuracy 0."]),
    ],
)
def test_what_cannot_stand_in_is_one_line(files, tmp_path, capsys, name, facts):
    folder = tmp_path / "run"
    assert call("convert", folder, "--model", files / f"{name}.keras", *SMALL) == 2
    *_, said = capsys.readouterr().err.splitlines()
    assert missing(said, files / f"{name}.keras", *facts) == []
    assert not folder.exists()


def test_a_model_for_images_of_another_normalisation_names_it(files, tmp_path, capsys):
    folder, path = tmp_path / "run", files / "good.keras"
    assert call("convert", folder, "--model", path, *DATA, "--samples", "20") == 2
    assert missing(capsys.readouterr().err, path, "--set image.normalisation=sqrt-clip") == []
    assert not folder.exists()


def test_a_file_that_is_no_model(tmp_path, capsys):
    folder, path = tmp_path / "run", tmp_path / "model.keras"
    path.write_bytes(b"no model")
    for arguments, fact in (
        (("--model", path, *SMALL), f"{path}: "),
        (("--model", tmp_path / "none.keras", *SMALL), "none.keras: "),
        (("--retrain",), "--model"),
    ):
        assert call("convert", folder, *arguments) == 2
        assert fact in capsys.readouterr().err
    assert not folder.exists()


def test_a_file_that_has_changed_since(files, tmp_path, capsys):
    path, folder = tmp_path / "model.keras", tmp_path / "run"
    path.write_bytes((files / "good.keras").read_bytes())
    changes = make_model_settings(path, retrain=False)
    settings = Settings().with_values({**changes, "data": {"samples_per_digit": 60}}, "test")
    path.write_bytes((files / "other.keras").read_bytes())
    from deploy.errors import UserError

    with pytest.raises(UserError, match=r"model\.keras: .*--model"):
        workflow.open_experiment(RunFolder(folder), settings, load_dataset(settings)).make("cnn")


@pytest.mark.parametrize("stated", [{}, {"image.normalisation": "max"}])
def test_in_python_a_model_gets_the_images_of_the_run_unless_others_are_stated(
    files, run, monkeypatch, stated
):
    """As by the command: a test of the settings with which the run is opened."""

    class Opened(Exception):
        pass

    def open_run(folder, settings, *more, **options):
        raise Opened(settings)

    monkeypatch.setattr(workflow, "open_run", open_run)
    images = read_settings(run / "experiment.toml").image
    assert images.normalisation == "sqrt-clip"
    with pytest.raises(Opened) as raised:
        Run(run, **stated).convert(model=files / "good.keras", retrain=True)
    (settings,) = raised.value.args
    assert settings.image.aggregation == images.aggregation
    assert settings.image.normalisation == stated.get("image.normalisation", "sqrt-clip")
    assert settings.snn.recipe == "loihi"
