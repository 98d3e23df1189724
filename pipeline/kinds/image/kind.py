"""The kind of networks on tactile images: the paper's CNN, or a user's Keras model in its place."""

from dataclasses import asdict

from deploy.arithmetic import select_evenly
from deploy.tables import format_count
from deploy.targets.fast import measure_firing_rates
from models.architecture import parse_architecture
from pipeline.kinds import counts
from pipeline.kinds.architectures import plan_untrained
from pipeline.kinds.diagnosis import compare_rates
from pipeline.kinds.image.choices import choose_image_settings
from pipeline.kinds.image.keras_model import (
    GIVE_MODEL_AGAIN,
    read_model,
    require_better_than_chance,
    require_images_of_model,
)
from pipeline.kinds.image.spec import make_network_spec
from pipeline.kinds.image.training import make_cnn, make_matched_cnn, make_rate_network
from pipeline.kinds.imported import ImportedNetwork
from pipeline.kinds.kind import NetworkKind
from pipeline.kinds.records import list_training_versions
from pipeline.kinds.reference import Reference
from pipeline.kinds.steps import Step
from pipeline.recordings.dataset import require_images_fit
from pipeline.settings import read_settings
from pipeline.storage.run_folder import RunFolder


def _compute_logits(stage, inputs, samples, advance):
    """Logits of a stage on images; with spikes those of each step."""
    settings = inputs.settings
    weights = inputs.read_weights(ImageKind.references[stage].step)
    # Both import TensorFlow, which takes ten seconds and is not needed for a finished stage.
    if stage == "spiking-lif":
        from pipeline.training import nengodl

        return nengodl.run_network(
            settings, weights, samples.inputs, settings.steps, advance=advance
        )
    from pipeline.training.images.networks import TrainedCNN, TrainedRates

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
    """The paper's way: a CNN, a rate-LIF network, a spiking network."""

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
            Step("cnn", "cnn", files, reads, make_cnn),
            Step("cnn-matched", "cnn-matched", files, further, make_matched_cnn, uses=("cnn",)),
            Step("rate-lif", "snn", files, further, make_rate_network, uses=("cnn",)),
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
        return ImportedNetwork(cnn.model, cnn.model_sha256, "cnn", GIVE_MODEL_AGAIN)

    def list_shapes(self, name):
        return parse_architecture(self.settings.cnn.architecture).weight_shapes

    def make_spec(self, inputs, provenance):
        # A damaged CNN is found now, not when its predictions are compared.
        inputs.read_weights("cnn")
        weights = inputs.read_weights("rate-lif")
        return make_network_spec(
            inputs.settings, weights, provenance, inputs.dataset.subset("train")
        )

    def compare_layers(self, inputs, bundle, advance=None):
        from pipeline.training.images.networks import TrainedRates

        settings = inputs.settings
        spec = bundle.spec
        neurons = sum(layer.size for layer in spec.layers if layer.neurons is not None)
        images = select_evenly(bundle.checks.inputs, max(MAX_COMPARED_RATES // max(neurons, 1), 1))
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
            path, model = read_model(artifact.folder, self.settings, inputs.dataset)
            if self.settings.is_open("image.normalisation"):
                require_images_of_model(path, model, self.settings, inputs.dataset)
            require_better_than_chance(path, model, inputs.dataset)
            inputs.say(f"cnn: its spiking network needs {_describe_need(self.settings)}")


def _describe_need(settings):
    """The cores and chips that the spiking network will need."""
    plan = plan_untrained(settings.cnn.architecture, False, settings.deployment)
    cores = format_count(len(plan.cores), "core")
    return (
        f"{cores} on {format_count(plan.chips, 'chip')}, see 'stmnist deploy plan' for each layer"
    )


def make_kept_image_settings(run: RunFolder) -> dict:
    """Changes of the settings that keep a run's images: a user's model was trained on them.

    Empty for a new run and for one of another kind.
    """
    if not run.experiment.exists():
        return {}
    settings = read_settings(run.experiment)
    if settings.nir.file or not ImageKind.is_selected_by(settings):
        return {}
    return {"image": asdict(settings.image)}
