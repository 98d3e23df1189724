"""The kind of spiking networks that are trained on the sensor's events."""

import numpy as np

from deploy.arithmetic import divide_up, select_evenly
from deploy.files import reporting_damage
from deploy.network.decision import Estimator, Threshold
from deploy.network.presentation import Presentation
from deploy.network.responses import compute_responses
from deploy.network.spec import NetworkSpec
from deploy.tables import format_count
from models import chain
from models.architecture import parse_architecture
from models.integers import from_integers
from pipeline.kinds import counts
from pipeline.kinds.events.choices import EventChoices
from pipeline.kinds.kind import NetworkKind
from pipeline.kinds.presentation import fit_gap
from pipeline.kinds.records import (
    describe_accuracy,
    list_training_versions,
    make_training_record,
    time_training,
    write_network,
)
from pipeline.kinds.reference import Reference
from pipeline.kinds.steps import Step
from pipeline.recordings.dataset import Dataset, list_event_warnings
from pipeline.settings import Settings
from pipeline.storage.artifacts import DELETE_IT
from pipeline.storage.run_folder import DELETE_ITS_FOLDER
from pipeline.training.event_samples import EventSamples

# Minimum number of samples for choosing a threshold; with fewer, the allowed loss, half a
# percentage point, is less than half a sample.
MIN_HELD_OUT = 100

# Settings that the threshold of early decisions depends on.
DECISION_SETTINGS = ("presentation.steps", "presentation.early_loss")

# Maximum number of samples that are held out to choose a threshold: the others are for training.
MAX_HELD_OUT = 300

# State of a training that is not complete.
CHECKPOINT = "checkpoint.npz"

# Maximum number of held-out samples for the learning curve.
MAX_CURVE_SAMPLES = 200


def _compute_logits(stage, inputs, samples, advance):
    """Logits at the end of each sample, which begins at rest."""
    from pipeline.training.events import TrainedOnEvents

    network = TrainedOnEvents.from_weights(inputs.settings, inputs.read_weights("events"))
    return network.compute_logits(samples.inputs.astype(np.uint8))[:, None]


def _respond(inputs, bundle, advance):
    """Respond to each sample from rest, delayed as on the chip."""
    from pipeline.training.events import TrainedOnEvents, delay_as_on_chip

    network = TrainedOnEvents.from_weights(inputs.settings, inputs.read_weights("events"))
    frames = bundle.checks.inputs.astype(np.uint8)
    outcome = network.run_on_frames(frames, advance)
    arrived = frames.reshape(*frames.shape[:2], -1).sum(1, dtype=np.int64)
    delayed = delay_as_on_chip(outcome.outputs, network.design).astype(float)
    output = np.diff(delayed, axis=1, prepend=0)
    return compute_responses(bundle.spec, output, {"input": arrived, **outcome.spikes})


class EventsKind(NetworkKind):
    """A spiking network trained on events in the chip's integers."""

    name = "events"
    input_kinds = ("events",)
    references = {  # noqa: RUF012 - declared as a class variable in the base
        "counts": counts.REFERENCE,
        "trained": Reference(
            "Trained network",
            "the spiking network as trained, with each sample from rest",
            "events",
            _compute_logits,
            list_training_versions,
            _respond,
        ),
    }
    deployed_step = "threshold"
    deployed_stage = "trained"
    settings_group = "events"
    channels = 2
    grid = ("events.budget=0.6,0.9", "events.early=0.3,1")

    @property
    def steps(self):
        training = ("training.json", "weights.npz")
        reads = ("input", "events")
        return (
            counts.STEP,
            Step("events", "snn", training, reads, self._train, temporary=(CHECKPOINT,)),
            # The threshold depends on the length of the presentation, unlike the training.
            Step("threshold", "snn", ("metrics.json",), DECISION_SETTINGS, self._choose_threshold,
                 uses=("events",), action="choosing", measures="events"),
        )  # fmt: skip

    @property
    def trained_steps(self):
        return ("events", "threshold")

    def list_shapes(self, name):
        settings = self.settings
        parsed = parse_architecture(settings.events.architecture)
        sections = len(settings.events.find_section_starts(settings.input.step_ms))
        return parsed.list_event_weight_shapes(sections) | Estimator.list_shapes(parsed.outputs)

    @staticmethod
    def _train(inputs, artifact):
        """Train the network; an interrupted training continues after its last epoch."""
        from pipeline.training import events  # TensorFlow takes seconds to import

        settings = inputs.settings
        samples = hold_out_event_samples(inputs.dataset, settings.seed)
        n_train = len(samples.train)
        design = events.EventDesign.from_settings(settings).with_epochs_for(n_train)
        updates = design.epochs * divide_up(n_train, design.batch_size)
        epochs = format_count(design.epochs, "epoch")
        inputs.say(f"events: {epochs}, {format_count(updates, 'update')}, on {n_train:,} samples")
        checkpoint = events.Checkpoint(artifact.folder / CHECKPOINT, artifact.origin.key)
        of_curve = samples._replace(held_out=select_evenly(samples.held_out, MAX_CURVE_SAMPLES))

        def train(advance):
            return events.train_events(design, of_curve, settings.seed, checkpoint, advance)

        trained, seconds = time_training("events", design.epochs, train)
        write_network(artifact.folder, trained, on_test=False)
        epochs = len(trained.history)
        return {"epochs": epochs, "seconds": seconds, "versions": list_training_versions()}

    @staticmethod
    def _choose_threshold(inputs, artifact):
        """Choose the threshold for early decisions of the network; measure its accuracy."""
        from pipeline.training.events import TrainedOnEvents

        settings = inputs.settings
        dataset = inputs.dataset
        trained = TrainedOnEvents.from_weights(settings, inputs.read_weights("events"))
        samples = hold_out_event_samples(dataset, settings.seed)
        held_out = samples.held_out
        chosen = choose_early_threshold(settings, samples, trained, settings.seed)
        training = inputs.find_artifact("events")
        with reporting_damage(training.record, DELETE_ITS_FOLDER):
            record = training.find_state().record
            seconds = float(record["seconds"])
            epochs = int(record["epochs"])
        metrics = make_training_record(trained, dataset, seconds, list_training_versions())
        metrics["epochs"] = epochs
        metrics["decides_by_itself"] = {**chosen.to_json(), "samples": len(held_out)}
        inputs.say(describe_accuracy("events", metrics))
        inputs.say(f"threshold: {_describe_decision(chosen, len(held_out))}")
        return metrics

    def make_spec(self, inputs, provenance):
        from pipeline.training.events import EventDesign

        presentation = inputs.settings.make_presentation(
            read_threshold(inputs.find_artifact("threshold"))
        )
        design = EventDesign.from_settings(inputs.settings)
        weights = inputs.read_weights("events")
        taus = {name: float(tau) for name, tau in weights.items() if name.endswith(".tau_u")}
        presentation, line = fit_gap(
            presentation, taus, inputs.settings.is_set_by_user("presentation.gap")
        )
        if line:
            inputs.say(line)
        return make_event_spec(design, weights, presentation, provenance)

    def make_choices(self, recordings, train):
        return EventChoices(self.settings, recordings, train).choices

    def list_notes(self, recordings):
        return list_event_warnings(self.settings, recordings)


def make_event_spec(
    design, weights: dict, presentation: Presentation, provenance: dict
) -> NetworkSpec:
    """Describe the spiking network trained on events.

    The confidence estimator is trained on training samples.  It is left out if no threshold for
    early decisions could be chosen on held-out samples: an estimator that is trained on few samples
    is confident of every prediction.

    NengoLoihi discretises it to the integers used in training; a step of the chip is a step of the
    design, independently of the recording time that it represents.

    Parameters
    ----------
    design : pipeline.training.events.design.EventDesign
    weights : dict
        Weights of a :class:`pipeline.training.events.network.TrainedOnEvents`.
    presentation : Presentation
    provenance : dict
        Stored in the bundle.
    """
    from pipeline.training.events import build_network  # imports TensorFlow

    architecture = parse_architecture(design.architecture)
    integers = build_network(design, weights).compute_integers()
    links = from_integers(architecture, weights, integers, design.section_starts)
    is_early = presentation.threshold_or_1 < 1
    estimator = Estimator.from_arrays(weights, architecture.outputs) if is_early else None
    stimulus = design.stimulus
    return chain.build_network_spec(links, stimulus, presentation, provenance, estimator)


def hold_out_event_samples(dataset: Dataset, seed: int) -> EventSamples:
    """Hold out the validation samples or, if there are none, some of the training samples.

    Without validation samples, no training samples are held out if these would be too few to choose
    a threshold on: the network learns from all of them and decides at the end.

    Parameters
    ----------
    dataset : Dataset
    seed : int
        Seed of :meth:`pipeline.recordings.splits.Split.hold_out`.
    """
    train, held_out = dataset.split.hold_out(seed)
    if not len(dataset.split.validation) and len(held_out) < MIN_HELD_OUT:
        train = dataset.split.train
        held_out = held_out[:0]
    elif not len(dataset.split.validation) and len(held_out) > MAX_HELD_OUT:
        order = np.random.default_rng([seed, 0x3E1D]).permutation(held_out)
        train = np.sort(np.concatenate([train, order[MAX_HELD_OUT:]]))
        held_out = np.sort(order[:MAX_HELD_OUT])
    return EventSamples(dataset.recordings.table, dataset.labels, train, held_out)


def choose_early_threshold(
    settings: Settings, samples: EventSamples, trained, seed: int
) -> Threshold:
    """Choose the threshold for early decisions on the held-out samples.

    See :func:`drop_unreliable_threshold`.
    """
    table, labels, _, held_out = samples
    if not len(held_out):
        return Threshold(1.0, 0.0, 1.0)
    loss = settings.presentation.early_loss
    chosen = trained.choose_threshold(table, labels, held_out, settings.steps, seed, loss)
    return drop_unreliable_threshold(chosen, len(held_out))


def drop_unreliable_threshold(chosen: Threshold, n_samples: int) -> Threshold:
    """The threshold, or 1 if it was chosen on fewer samples than `MIN_HELD_OUT`.

    With a threshold of 1 the network decides at the end of each recording.
    """
    return chosen if n_samples >= MIN_HELD_OUT else chosen._replace(value=1.0, share=1.0)


def read_threshold(artifact) -> float | None:
    """The threshold for early decisions in a network's record, or None."""
    with reporting_damage(artifact.record, DELETE_IT):
        chosen = artifact.find_state().record["decides_by_itself"]
        if chosen is None:
            return None
        if not 0 <= chosen["confidence"] <= 1:
            raise ValueError("a confidence that is not from 0 to 1")
        return float(chosen["confidence"])


def _describe_decision(chosen, samples):
    if chosen.value < 1:
        return (
            f"early decision at a confidence of {chosen.value:.4f}, after "
            f"{chosen.share:.0%} of a recording on {samples} held-out samples"
        )
    reason = ""
    if samples < MIN_HELD_OUT:
        reason = (
            f", since fewer than {MIN_HELD_OUT} samples could be held out to choose a confidence "
            "on (more: split.validation_fraction)"
        )
    return f"no early decisions, the network decides at the end of each recording{reason}"
