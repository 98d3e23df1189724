"""The kind of networks on tactile images: the paper's CNN, or a user's Keras model in its place."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from deploy.arithmetic import thin
from deploy.check.intervals import compute_wilson_interval
from deploy.errors import UserError
from deploy.files import copy_file, hash_file
from deploy.network.spec import NetworkSpec
from deploy.tables import format_count
from deploy.targets.fast import measure_firing_rates
from models import chain
from models.architecture import parse
from models.keras.reader import make_original_network, read_keras
from pipeline.kinds import counts
from pipeline.kinds.architectures import plan_untrained
from pipeline.kinds.diagnosis import (
    compare_rates,
    compute_fastest_rate,
    describe_neurons,
    measure_activity,
)
from pipeline.kinds.image.choices import choose_image_augmentation, choose_image_settings
from pipeline.kinds.imported import Imported, find_imported_file
from pipeline.kinds.kind import NetworkKind
from pipeline.kinds.normalisation import require_images_of_network
from pipeline.kinds.records import (
    describe_accuracy,
    list_training_versions,
    make_training_record,
    measure_accuracies,
    select_curve_samples,
    time_training,
    write_network,
)
from pipeline.kinds.reference import Reference
from pipeline.kinds.steps import Step
from pipeline.recordings.dataset import Dataset, require_images_fit
from pipeline.settings import Settings, read_settings
from pipeline.storage.run_folder import RunFolder
from pipeline.training.schedules import make_cnn_schedule, make_snn_schedule


def _compute_logits(stage, inputs, samples, advance):
    """Logits of a stage on images; with spikes those of each step."""
    settings = inputs.settings
    weights = inputs.read_weights(ImageKind.references[stage].step)
    # Both import TensorFlow, which takes ten seconds and is not needed for a finished stage.
    if stage == "spiking-lif":
        from pipeline.training import nengodl

        return nengodl.run(settings, weights, samples.inputs, settings.steps, advance=advance)
    from pipeline.training.networks import TrainedCNN, TrainedRates

    network = TrainedCNN if stage.startswith("cnn") else TrainedRates
    logits = network(settings, weights).compute_logits(samples.inputs)[:, None]
    if advance is not None:
        advance(len(logits))
    return logits


# Maximum number of firing rates, of a neuron in a sample, that are compared with activations: they
# are thinned for large networks, whose emulation takes long.  Networks such as the paper's, of some
# thousand neurons, have fewer on all samples of a check.
MAX_COMPARED_RATES = 1_000_000

# Settings of the neurons, and those that have an effect in each recipe of the spiking network.
NEURON_SETTINGS = ("snn.recipe", "snn.max_rates", "snn.tau_rc", "snn.tau_ref")
SNN_SETTINGS = {
    "loihi": ("snn", "cnn.augment"),
    "paper": (*NEURON_SETTINGS, "snn.epochs", "snn.batch_size", "snn.learning_rate"),
    "as-is": NEURON_SETTINGS,
}


class ImageKind(NetworkKind):
    """CNN, rate-LIF network, spiking network: the paper's way."""

    name = "image"
    input_kinds = ("image", "slices")
    references = {  # noqa: RUF012 - declared as a class variable in the base
        "counts": counts.REFERENCE,
        "cnn": Reference(
            "CNN of the paper",
            "the network without spikes, in the paper's training",
            "cnn",
            _compute_logits,
            list_training_versions,
        ),
        "cnn-matched": Reference(
            "CNN, longer training",
            "the same CNN, trained further as the spiking network is, but with ReLU neurons",
            "cnn-matched",
            _compute_logits,
            list_training_versions,
        ),
        "rate-lif": Reference(
            "Rate-LIF",
            "LIF neurons with firing rates instead of spikes",
            "rate-lif",
            _compute_logits,
            list_training_versions,
        ),
        "spiking-lif": Reference(
            "Spiking LIF, NengoDL",
            "the same weights with spiking neurons",
            "rate-lif",
            _compute_logits,
            list_training_versions,
        ),
    }
    deployed_step = "rate-lif"
    deployed_stage = "rate-lif"
    compared_stages = ("cnn-matched", "cnn")
    bundle_settings = ("deployment",)
    settings_group = "cnn"
    grid = (
        "presentation.steps=50,100",
        "deployment.synapse=0.005,0.01",
        "snn.max_rates=100,150",
        "snn.spike_penalty=0,0.05",
    )

    @property
    def remedy(self):
        """Time and polarity, which one image lacks, are what most recordings need."""
        if self.settings.image.channels == 1:
            return "--input slices, or --input events"
        return "--input events, a wider architecture or more epochs"

    @property
    def reference_stages(self):
        settings = self.settings
        if settings.snn.recipe == "loihi" and not settings.cnn.model:
            return tuple(self.references)
        # No CNN can be trained as a network that is not trained further than the CNN itself.
        return tuple(stage for stage in self.references if stage != "cnn-matched")

    @property
    def channels(self):
        return self.settings.image.channels

    @property
    def steps(self):
        cnn = ["cnn.epochs", "cnn.batch_size", "cnn.learning_rate", "cnn.augment"]
        if self.settings.cnn.model:
            is_trained = self.settings.snn.recipe == "loihi"
            cnn = ["cnn.model_sha256", "snn.recipe", *(cnn if is_trained else [])]
        files = ("metrics.json", "weights.npz")
        further = SNN_SETTINGS[self.settings.snn.recipe]
        reads = ("input.kind", "image", "cnn.architecture", *cnn)
        return (
            counts.STEP,
            Step("cnn", "cnn", files, reads, self._train_cnn),
            Step("cnn-matched", "cnn-matched", files, further, self._train_matched, uses=("cnn",)),
            Step("rate-lif", "snn", files, further, self._train_rates, uses=("cnn",)),
        )

    @property
    def trained_steps(self):
        return ("cnn",)

    @property
    def recipe(self):
        return self.settings.snn.recipe

    @property
    def is_trained_in_integers(self):
        return self.settings.snn.recipe == "loihi"

    @property
    def imported(self):
        cnn = self.settings.cnn
        if not cnn.model:
            return None
        return Imported(cnn.model, cnn.model_sha256, "cnn", GIVE_MODEL_AGAIN)

    def list_shapes(self, name):
        return parse(self.settings.cnn.architecture).weight_shapes

    @staticmethod
    def _train_cnn(inputs, artifact):
        """Train the CNN, or read the user's own."""
        settings = inputs.settings
        dataset = inputs.dataset
        if settings.cnn.model:
            path, model = read_usable_model(artifact.folder, settings, dataset)
            trained, seconds = _adopt(model, settings, dataset, inputs.say)
            copy = name_copied_model(artifact.folder, settings)
            if path != copy:
                copy_file(path, copy)
        else:
            trained, seconds = _train_cnn(settings, dataset)
        write_network(artifact.folder, trained, not len(dataset.split.validation))
        metrics = make_training_record(trained, dataset, seconds, list_training_versions())
        inputs.say(describe_accuracy("cnn", metrics))
        return metrics

    @staticmethod
    def _train_matched(inputs, artifact):
        """Train the CNN further, as the rate-based network is trained."""
        from pipeline.training.networks import train_matched

        _, metrics = _train_further("cnn-matched", train_matched, inputs, artifact)
        inputs.say(describe_accuracy("cnn-matched", metrics))
        return metrics

    @staticmethod
    def _train_rates(inputs, artifact):
        """Train the rate-LIF network, starting from the CNN."""
        from pipeline.training.networks import select_measured, train_rate_network

        trained, metrics = _train_further("rate-lif", train_rate_network, inputs, artifact)
        images, _ = inputs.dataset.subset("train")
        measured = select_measured(images, parse(inputs.settings.cnn.architecture))
        metrics["neurons"] = _measure_activity(inputs.settings, trained, measured)
        inputs.say(describe_accuracy("rate-lif", metrics))
        if len(measured) < len(images):
            inputs.say(
                f"rate-lif: its neurons are measured on {len(measured)} of {len(images)} training "
                "samples, because they are many"
            )
        for line in describe_neurons(metrics["neurons"]):
            inputs.say(f"rate-lif: {line}")
        return metrics

    def make_spec(self, inputs, provenance):
        # A damaged CNN is found now, not when its predictions are compared.
        inputs.read_weights("cnn")
        weights = inputs.read_weights("rate-lif")
        return make_network_spec(
            inputs.settings, weights, provenance, inputs.dataset.subset("train")
        )

    def compare_layers(self, inputs, bundle, advance=None):
        from pipeline.training.networks import TrainedRates

        settings = inputs.settings
        spec = bundle.spec
        neurons = sum(layer.size for layer in spec.layers if layer.neurons is not None)
        images = thin(bundle.checks.inputs, max(MAX_COMPARED_RATES // max(neurons, 1), 1))
        start = spec.presentation.readout_start
        rates = measure_firing_rates(spec, images, settings.seed, start, advance)
        if advance is not None:
            advance(len(bundle.checks) - len(images))
        network = TrainedRates(settings, inputs.read_weights("rate-lif"))
        activations = network.compute_activations(images)
        return compare_rates(spec, rates, activations)

    def make_choices(self, recordings, train):
        return choose_image_settings(self.settings, recordings)

    def require_presentable(self, dataset):
        require_images_fit(dataset.inputs, self.settings)

    def require_usable(self, inputs):
        artifact = inputs.find_artifact("cnn")
        if self.settings.cnn.model and not artifact.find_state().is_current:
            if self.settings.is_open("image.normalisation"):
                _require_images_of_model(artifact.folder, self.settings, inputs.dataset)
            read_usable_model(artifact.folder, self.settings, inputs.dataset)
            inputs.say(f"cnn: its spiking network needs {_describe_need(self.settings)}")


def make_network_spec(settings: Settings, weights: dict, provenance: dict, data) -> NetworkSpec:
    """Describe the spiking network on images with the given weights.

    Parameters
    ----------
    settings : Settings
    weights : dict
        Weights of the rate-based network.
    provenance : dict
        Stored in the bundle; :attr:`Dataset.provenance` has what other recordings are read with.
    data : (images, labels)
        Training samples, which determine the range of a readout on the chip.

    Raises
    ------
    UserError
        The images cannot be presented to this network.
    """
    images, labels = data
    require_images_fit(images, settings)
    range_of = None
    if settings.deployment.readout == "chip":
        from pipeline.training.networks import TrainedRates

        range_of = TrainedRates(settings, weights).compute_logits(images), labels
    return make_image_spec(settings, weights, provenance, range_of)


def make_image_spec(
    settings: Settings, weights: dict, provenance: dict, range_of=None
) -> NetworkSpec:
    """As :func:`make_network_spec`; ``range_of`` is that of :func:`models.chain.from_rates`."""
    architecture = parse(settings.cnn.architecture)
    synapse = settings.deployment.synapse
    links = chain.from_rates(architecture, weights, settings.snn, synapse, range_of)
    provenance = {"image": asdict(settings.image), **provenance}  # for other recordings
    return chain.build_network_spec(
        links, settings.stimulus, settings.make_presentation(), provenance
    )


def _describe_need(settings):
    """The cores and chips that the spiking network will need."""
    plan = plan_untrained(settings.cnn.architecture, False, settings.deployment)
    cores = format_count(len(plan.cores), "core")
    return (
        f"{cores} on {format_count(plan.chips, 'chip')}, see 'stmnist deploy plan' for each layer"
    )


def _train_cnn(settings, dataset, weights=None):
    """Train the CNN from given weights or from new ones; return it and the seconds."""
    from pipeline.training.networks import train_cnn  # imports TensorFlow

    augmentation = settings.cnn.augment
    samples = _collect_samples(dataset, "none" if augmentation == "auto" else augmentation)
    epochs = make_cnn_schedule(settings.cnn, len(samples)).epochs
    seed = settings.seed
    return time_training("cnn", epochs, train_cnn, settings, samples, seed, weights=weights)


def _collect_samples(dataset, how):
    """The training samples, how they are altered, and those of the learning curve."""
    from pipeline.training.networks import TrainingSamples

    images, labels = dataset.subset("train")
    altered = dataset.make_altered_images(how)
    return TrainingSamples(images, labels, altered, select_curve_samples(dataset))


def _adopt(model, settings, dataset, say):
    """The user's model as the CNN; it is trained further if something in it was replaced."""
    from models.cnn import predict
    from pipeline.training.networks import TrainedCNN

    for note in (*model.notes, *model.replaced):
        say(f"cnn: {note}")
    taken = TrainedCNN(settings, model.weights)
    if not model.replaced:
        return taken, 0.0
    logits = [
        predict(make_original_network(model), dataset.inputs),
        taken.compute_logits(dataset.inputs),
    ]
    trained, seconds = _train_cnn(settings, dataset, model.weights)
    logits.append(trained.compute_logits(dataset.inputs))
    rows = [
        measure_accuracies(one.argmax(1) == dataset.labels, dataset)["accuracy"] for one in logits
    ]
    part = list(rows[0])[-1]
    before, replaced, after = (f"{row[part]:.3f}" for row in rows)
    say(
        f"cnn: {part} accuracy {before} as in the file, {replaced} with what was replaced, "
        f"{after} after further training"
    )
    return trained, seconds


def _train_further(name, function, inputs, artifact):
    """Train a network that starts from the CNN; write it, and return it and its metrics."""
    settings = inputs.settings
    dataset = inputs.dataset
    augmentation = "none"
    if settings.snn.recipe == "loihi":
        augmentation = settings.cnn.augment
        if augmentation == "auto":
            augmentation = choose_image_augmentation(dataset.recordings)
    samples = _collect_samples(dataset, augmentation)
    epochs = make_snn_schedule(settings.snn, len(samples)).epochs
    trained, seconds = time_training(
        name, epochs, function, settings, samples, settings.seed, inputs.read_weights("cnn")
    )
    write_network(artifact.folder, trained, not len(dataset.split.validation))
    metrics = make_training_record(trained, dataset, seconds, list_training_versions())
    return trained, {**metrics, "augment": augmentation}


def _measure_activity(settings, trained, images):
    """Shares of silent and saturated neurons of each layer on some images."""
    fastest = compute_fastest_rate(settings.snn.tau_ref)
    outputs = trained.compute_activations(images)
    return {
        name: measure_activity(output * settings.snn.get_max_rate(index), fastest)
        for index, (name, output) in enumerate(outputs.items())
    }


# Minimum accuracy of a user's model, as a share of the range from chance to 1. The best of 30
# networks of three layers with Keras's initial weights had 0.06 by chance, on ten classes.
MIN_KNOWN_SHARE = 0.15


# Maximum number of training samples on which normalisations of images are compared.
MAX_COMPARED_SAMPLES = 500

# The remedy for a model that has changed since it was imported.
GIVE_MODEL_AGAIN = "give it again with 'stmnist convert RUN --model FILE' (and --retrain if used)"


def make_model_settings(path: Path, retrain: bool = False, before: Settings | None = None) -> dict:
    """Changes of the settings with which a user's Keras model replaces the CNN.

    Parameters
    ----------
    path : path-like
    retrain : bool
        Train the model further with rate-LIF neurons.
    before : Settings, optional
        Settings before these changes, whose rows, columns and channels are those of a model whose
        input is a vector.

    Raises
    ------
    UserError
        The file cannot be read, is not a Keras model, or does not fit any chip.
    """
    path = Path(path)
    before = before or Settings()
    skin = before.skin
    grid = (skin.rows, skin.columns, before.image.channels) if skin.rows and skin.columns else None
    model = read_keras(path, retrain, grid)
    sha256 = hash_file(path)
    rates = Settings().snn.max_rates[: max(len(model.architecture.spiking), 1)]
    return {
        "input": {"kind": "image"},
        "nir": {"file": "", "sha256": ""},
        "cnn": {
            "model": str(path.absolute()),
            "model_sha256": sha256,
            "architecture": str(model.architecture),
        },
        "snn": {"recipe": "loihi" if retrain else "as-is", "max_rates": rates},
    }


def keep_images(run: RunFolder) -> dict:
    """Changes of the settings that keep a run's images: a user's model was trained on them.

    Empty for a new run and for one of another kind.
    """
    if not run.experiment.exists():
        return {}
    settings = read_settings(run.experiment)
    if settings.nir.file or not ImageKind.describes(settings):
        return {}
    return {"image": asdict(settings.image)}


def name_copied_model(folder: Path, settings: Settings) -> Path:
    """The run's copy of the user's model, in the folder of the CNN."""
    return folder / f"model{Path(settings.cnn.model).suffix.lower()}"


def read_usable_model(folder: Path, settings: Settings, dataset: Dataset) -> tuple:
    """Use the user's model instead of the CNN; it must be better than chance.

    The run's copy is used if the user's file has changed or cannot be read, for example on another
    machine.

    Parameters
    ----------
    folder : Path
        Folder of the CNN.
    settings : Settings
        Settings from :func:`make_model_settings`.
    dataset : Dataset

    Returns
    -------
    Path, models.keras.model.KerasModel
        The file that was read, and the model.

    Raises
    ------
    UserError
        The model cannot be read or has changed, and the run has no copy; or it is not better than
        chance.
    """
    path, model = _read_model(folder, settings, dataset)
    from models.cnn import predict

    images, labels = dataset.subset("train")
    logits = predict(make_original_network(model), images)
    right = int((logits.argmax(1) == labels).sum())
    likeliest = np.bincount(labels).max() / len(labels)
    least_accuracy = compute_wilson_interval(right, len(labels))[0]
    if least_accuracy <= likeliest + MIN_KNOWN_SHARE * (1 - likeliest):
        raise UserError(
            f"{path}: hardly better than chance on this run's training samples (accuracy "
            f"{right / len(labels):.3f}, {likeliest:.3f} by always predicting the same class); "
            "train it on images as [image] in the settings makes them, with classes in this order"
        )
    return path, model


def _read_model(folder, settings, dataset):
    """The file of the user's model, or its copy, and the model."""
    copy = name_copied_model(folder, settings)
    path = find_imported_file(settings.cnn.model, settings.cnn.model_sha256, copy)
    retrain = settings.snn.recipe == "loihi"
    shape = parse(settings.cnn.architecture).input_shape
    model = read_keras(path, retrain, shape)
    if model.input_scale != 1:
        without = read_keras(path, retrain, shape, pixels=False)
        model = _choose_scale(model, without, dataset)
    imported = settings.cnn.model_sha256, settings.cnn.architecture
    if (hash_file(path), str(model.architecture)) != imported:
        raise UserError(f"{path}: has changed; {GIVE_MODEL_AGAIN}")
    return path, model


def _choose_scale(of_pixels, without, dataset):
    """A model that begins with the scaling of pixels, for the images that it was trained on.

    Nothing in a file tells if these ended at 255, or at 1 as the images of this project do, so that
    the training samples decide.

    Parameters
    ----------
    of_pixels, without : KerasModel
        The model that multiplies images, and the one that takes them as they are.
    dataset : Dataset
    """
    from models.cnn import predict

    images, labels = dataset.subset("train")
    images = thin(images, MAX_COMPARED_SAMPLES)
    labels = thin(labels, MAX_COMPARED_SAMPLES)
    accuracies = [
        float((predict(make_original_network(model), images).argmax(1) == labels).mean())
        for model in (of_pixels, without)
    ]
    if accuracies[1] <= accuracies[0]:
        return of_pixels
    note = (
        f"its first layer scales pixels, but it was trained on images that end at 1: accuracy "
        f"{accuracies[1]:.3f} on {len(labels)} training samples, and {accuracies[0]:.3f} if they "
        "are multiplied by 255"
    )
    return replace(without, notes=(*without.notes, note))


def _require_images_of_model(folder, settings, dataset):
    """Refuse images that are normalised in another way than those that the model was trained on."""
    path, model = _read_model(folder, settings, dataset)
    from models.cnn import predict

    network = make_original_network(model)

    def classify(images):
        return predict(network, images).argmax(1)

    require_images_of_network(path, settings, dataset, classify, MAX_COMPARED_SAMPLES)
