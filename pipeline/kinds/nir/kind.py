"""The kind of networks that were trained elsewhere and come as a NIR graph.

The run has a copy of the graph, ``snn/network.nir``, from which everything else is made.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from deploy.errors import UserError
from models.nir.graph import read_nir
from pipeline.kinds import counts
from pipeline.kinds.events.kind import DECISION_SETTINGS, read_threshold
from pipeline.kinds.imported import ImportedNetwork, is_file
from pipeline.kinds.kind import NetworkKind
from pipeline.kinds.nir.conversion import list_synapse_notes, make_nir_spec, record_convention
from pipeline.kinds.nir.importing import (
    GIVE_AGAIN,
    GRAPH,
    Stepping,
    find_graph,
    read_copy_of_graph,
    require_graph_fits,
)
from pipeline.kinds.nir.measures import import_graph
from pipeline.kinds.nir.simulation import (
    NUMPY,
    compute_graph_responses,
    compute_predictions,
    simulate_samples,
)
from pipeline.kinds.normalisation import require_images_of_network
from pipeline.kinds.presentation import choose_presentation, fit_gap, list_current_taus
from pipeline.kinds.reference import Reference
from pipeline.kinds.steps import Step
from pipeline.recordings.dataset import list_event_warnings, require_images_fit
from pipeline.settings import Choice, apply_choices

# Maximum number of training samples on which the scales of a graph's weights are chosen.  More do
# not help, not even published recurrent graphs.
CALIBRATION_SAMPLES = 48

# Maximum number of training samples on which normalisations of images are compared.
MAX_COMPARED_SAMPLES = 100

# Default presentation of samples to an imported network: each from rest. Trainings in PyTorch start
# every sample with the neurons' state at rest (``reset_hidden`` of snnTorch, a state of None in
# Norse), so that this is what the network was trained for. A board loads the network at the start
# of each stream, so that it is then loaded for each sample.
REST_SETTINGS = {"input.refractory": 0.0, "presentation.gap": 0, "presentation.stream_length": 1}

# Settings that the simulation of a graph on images reads: the image, and its spikes.
IMAGE_READS = ("presentation", "image", "deployment.input_rate", "deployment.input_phase")


def _compute_logits(stage, inputs, samples, advance):
    """Outputs of the graph at each step."""
    settings = inputs.settings
    network = read_copy_of_graph(inputs.find_artifact("nir").folder, settings)
    stepping = Stepping.from_settings(settings, network)
    return simulate_samples(network, stepping, samples.inputs, settings, advance)[0]


def _respond(inputs, bundle, advance):
    folder = inputs.find_artifact("nir").folder
    return compute_graph_responses(folder, inputs.settings, bundle, advance)


def _require_images_of_graph(source, network, settings, dataset):
    """Refuse images that are normalised in another way than those that the graph was trained on."""
    stepping = Stepping.from_settings(settings, network)

    def classify(images):
        outputs, _ = simulate_samples(network, stepping, images, settings)
        return compute_predictions(outputs, settings)

    require_images_of_network(source, settings, dataset, classify, MAX_COMPARED_SAMPLES)


class NirKind(NetworkKind):
    """A NIR graph, on images or on events."""

    name = "nir"
    remedy = "a longer training of the graph; check the order of classes, step and reset"
    references = {  # noqa: RUF012 - declared as a class variable in the base
        "counts": counts.REFERENCE,
        "nir": Reference(
            "NIR",
            "the graph as written, in floating point, each sample from rest",
            "nir",
            _compute_logits,
            lambda: NUMPY,
            _respond,
        ),
    }
    deployed_step = "nir"
    deployed_stage = "nir"

    @classmethod
    def is_selected_by(cls, settings):
        return bool(settings.nir.file)

    @property
    def channels(self):
        return 2 if self.settings.on_events else self.settings.image.channels

    @property
    def bundle_settings(self):
        own = "nir.synapses_per_weight"
        return (own,) if self.settings.on_events else (own, "deployment")

    @property
    def steps(self):
        presentation_settings = DECISION_SETTINGS if self.settings.on_events else IMAGE_READS
        reads = (
            "input",
            "nir.sha256",
            "nir.step",
            "nir.method",
            "nir.reset",
            *presentation_settings,
        )
        files = ("metrics.json", GRAPH)
        return counts.STEP, Step("nir", "snn", files, reads, self._read_graph, action="reading")

    @property
    def trained_steps(self):
        raise UserError(
            f"the network is the NIR graph {self.settings.nir.file}, which is already trained; use "
            "'stmnist convert', or train a network in a new folder"
        )

    @property
    def imported(self):
        nir = self.settings.nir
        return ImportedNetwork(nir.file, nir.sha256, "nir", GIVE_AGAIN)

    @staticmethod
    def _read_graph(inputs, artifact):
        """Make the user's graph the run's network."""
        return import_graph(artifact.folder, inputs.settings, inputs.dataset, inputs.say)

    def make_spec(self, inputs, provenance):
        settings = inputs.settings
        dataset = inputs.dataset
        graph = inputs.find_artifact("nir")
        network = read_copy_of_graph(graph.folder, settings)
        presentation = settings.make_presentation(read_threshold(graph))
        rng = np.random.default_rng([settings.seed, 0x41B])
        chosen = np.sort(rng.permutation(dataset.split.train)[:CALIBRATION_SAMPLES])
        samples = dataset.inputs[chosen]
        stepping = Stepping.from_settings(settings, network)
        spec = make_nir_spec(
            network,
            stepping,
            settings.stimulus,
            presentation,
            samples,
            settings.nir.synapses_per_weight,
        )
        for line in list_synapse_notes(spec):
            inputs.say(f"nir: {line}")
        is_users = settings.is_set_by_user("presentation.gap")
        presentation, line = fit_gap(presentation, list_current_taus(spec), is_users)
        if line:
            inputs.say(line)
        provenance = {**provenance, "nir": record_convention(network, stepping)}
        return replace(spec, presentation=presentation, provenance=provenance)

    def make_choices(self, recordings, train):
        settings = self.settings
        from_rest = [Choice(name, value) for name, value in REST_SETTINGS.items()]
        if not settings.on_events:
            return from_rest
        settings = apply_choices(settings, from_rest, settings.nir.file)
        return from_rest + choose_presentation(settings, recordings)

    def require_recordings_fit(self, recordings):
        nir = self.settings.nir
        sensor = recordings.sensor
        # A file that has changed is not the run's network; the run's copy is compared when it is
        # read.
        if is_file(nir.file, nir.sha256):
            shape = sensor.rows, sensor.columns, self.channels
            require_graph_fits(
                read_nir(nir.file), shape, len(sensor.classes), nir.file, self.settings.on_events
            )

    def require_presentable(self, dataset):
        if not self.settings.on_events:
            require_images_fit(dataset.inputs, self.settings)

    def require_usable(self, inputs):
        artifact = inputs.find_artifact("nir")
        if artifact.find_state().is_current:
            return
        source, network = find_graph(artifact.folder, self.settings, inputs.dataset)
        if not self.settings.on_events and self.settings.is_open("image.normalisation"):
            _require_images_of_graph(source, network, self.settings, inputs.dataset)

    def list_notes(self, recordings):
        return list_event_warnings(self.settings, recordings) if self.settings.on_events else []
