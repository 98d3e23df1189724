"""The road of networks on tactile images: the paper's CNN, or a user's Keras model in its place."""

from __future__ import annotations

import importlib.metadata

from deploy.check.rates import firing_rates
from deploy.errors import UserError
from deploy.files import copy_file
from models.architecture import parse
from pipeline.data.dataset import require_images_fit
from pipeline.roads import counts
from pipeline.roads.architectures import architecture_for, chosen_text, is_for
from pipeline.roads.conversion import deployed
from pipeline.roads.diagnosis import (
    activity,
    fastest_rate,
    layers_json,
    rate_points,
    training_lines,
)
from pipeline.roads.imported import Imported
from pipeline.roads.own_model import GIVE_MODEL_AGAIN, copy_of_model, take_over
from pipeline.roads.road import (
    Part,
    Reference,
    Road,
    accuracy_text,
    metrics_of,
    responses_of,
    timed,
    watched,
    write_network,
)
from pipeline.settings import Settings
from pipeline.training.threads import one_thread_each


def training_versions() -> dict:
    """Versions of the packages that trained networks need."""
    names = ("tensorflow", "nengo-dl")
    return {name.replace("-", "_"): importlib.metadata.version(name) for name in names}


def _respond(stage, opened, bundle, advance):
    settings, images = opened.settings, bundle.checks.inputs
    weights = opened.weights(ImageRoad.references[stage].part)
    # Both import TensorFlow, which takes ten seconds and is not needed for a finished stage.
    if stage == "spiking-lif":
        from pipeline.training import nengodl

        logits = nengodl.run(settings, weights, images, settings.steps, advance=advance)
        return responses_of(logits, settings.presentation)
    from pipeline.training.networks import TrainedCNN, TrainedRates

    network = TrainedCNN if stage == "cnn" else TrainedRates
    logits = network(settings, weights).logits(images)[:, None]
    advance(len(images))
    return responses_of(logits, settings.presentation)


class ImageRoad(Road):
    """CNN, rate-based LIF network, spiking network: the paper's way."""

    kind = "image"
    references = {  # noqa: RUF012 - declared as a class variable in the base
        "counts": counts.REFERENCE,
        "cnn": Reference(
            "CNN", "the convolutional network, no spikes", "cnn", _respond, training_versions
        ),
        "rate-lif": Reference(
            "Rate LIF",
            "LIF neurons with firing rates instead of spikes",
            "rate-lif",
            _respond,
            training_versions,
        ),
        "spiking-lif": Reference(
            "Spiking LIF, NengoDL",
            "the same weights with spiking neurons",
            "rate-lif",
            _respond,
            training_versions,
        ),
    }
    deployed = "rate-lif"
    placement = ("deployment",)
    section = "cnn"
    channels = 1
    grid = (
        "presentation.steps=50,100",
        "deployment.synapse=0.005,0.01",
        "snn.max_rates=100,150",
        "snn.spike_penalty=0,0.05",
    )

    @property
    def parts(self):
        cnn = ["cnn.model_sha256"]
        if not self.settings.cnn.model:
            cnn = ["cnn.epochs", "cnn.batch_size", "cnn.learning_rate"]
        files = ("metrics.json", "weights.npz")
        reads = ("input.kind", "image", "cnn.architecture", *cnn)
        return (
            counts.PART,
            Part("cnn", "cnn", files, reads, self._cnn),
            Part("rate-lif", "snn", files, ("snn",), self._rates, uses=("cnn",)),
        )

    @property
    def trained(self):
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

    def shapes(self, name):
        return parse(self.settings.cnn.architecture).weight_shapes

    @staticmethod
    def _cnn(opened, artifact):
        """Train the CNN, or read the user's own."""
        one_thread_each()
        settings, dataset = opened.settings, opened.dataset
        if settings.cnn.model:
            path, trained, notes = take_over(artifact.folder, settings, dataset)
            for note in notes:
                opened.say(f"cnn: {note}")
            copy = copy_of_model(artifact.folder, settings)
            if path != copy:
                copy_file(path, copy)
            seconds = 0.0
        else:
            from pipeline.training.networks import train_cnn  # TensorFlow takes seconds to import

            arguments = settings, dataset.part("train"), settings.seed, watched(dataset)
            trained, seconds = timed("cnn", settings.cnn.epochs, train_cnn, *arguments)
        write_network(artifact.folder, trained, dataset)
        metrics = metrics_of(trained, dataset, seconds, training_versions())
        opened.say(accuracy_text("cnn", metrics))
        return metrics

    @staticmethod
    def _rates(opened, artifact):
        """Train the rate-based LIF network, starting from the CNN."""
        one_thread_each()
        from pipeline.training.networks import snn_recipe, train_rate_network

        settings, dataset = opened.settings, opened.dataset
        start = opened.weights("cnn")
        data, epochs = dataset.part("train"), snn_recipe(settings.snn).epochs
        arguments = settings, data, settings.seed, start, watched(dataset)
        trained, seconds = timed("rate-lif", epochs, train_rate_network, *arguments)
        write_network(artifact.folder, trained, dataset)
        metrics = metrics_of(trained, dataset, seconds, training_versions())
        metrics["neurons"] = _neurons(settings, trained, data[0])
        opened.say(accuracy_text("rate-lif", metrics))
        for line in training_lines(metrics["neurons"]):
            opened.say(f"rate-lif: {line}")
        return metrics

    def spec(self, opened, provenance):
        opened.weights("cnn")  # a damaged CNN is found now, not when its answers are compared
        weights = opened.weights("rate-lif")
        return deployed(self.settings, weights, provenance, opened.dataset.part("train"))

    def rates(self, opened, bundle, advance=None):
        from pipeline.training.networks import TrainedRates

        spec, inputs = bundle.spec, bundle.checks.inputs
        start = spec.presentation.readout_start
        rates = firing_rates(spec, inputs, self.settings.seed, start, advance)
        activations = TrainedRates(self.settings, opened.weights("rate-lif")).activations(inputs)
        fastest = {
            layer.name: 1 / layer.neurons.amplitude for layer in spec.layers if layer.neurons
        }
        trained = {name: values * fastest[name] for name, values in activations.items()}
        return layers_json(spec, rates, activations), rate_points(trained, rates)

    def choices(self, recordings):
        settings, default = self.settings, Settings()
        sensor, cnn = recordings.sensor, settings.cnn
        if cnn.model or cnn.architecture != default.cnn.architecture:
            return {}, []
        if is_for(cnn.architecture, sensor, 1):
            return {}, []
        chosen = architecture_for(sensor, on_events=False)
        rates, layers = settings.snn.max_rates, len(parse(chosen).spiking)
        if len(rates) > layers:  # the user's, since the default is one rate
            raise UserError(
                f"'snn.max_rates' has {len(rates)} rates, and {chosen}, chosen for the recordings, "
                f"has {layers} layer{'' if layers == 1 else 's'} of neurons; give as many rates or "
                "one, or choose cnn.architecture"
            )
        return {"cnn": {"architecture": chosen}}, [chosen_text("cnn", chosen, sensor)]

    def require_presentable(self, dataset):
        require_images_fit(dataset.inputs, self.settings)

    def require_usable(self, opened):
        if self.settings.cnn.model and not opened.artifact("cnn").state().is_current:
            take_over(opened.artifact("cnn").folder, self.settings, opened.dataset)


def _neurons(settings, trained, inputs):
    """Shares of silent and saturated neurons of each layer on the training samples."""
    fastest = fastest_rate(settings.snn.tau_ref)
    outputs = trained.activations(inputs)
    return {
        name: activity(output * settings.snn.max_rate(index), fastest)
        for index, (name, output) in enumerate(outputs.items())
    }
