"""A bundle whose readout is fitted to one person."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from deploy.check.bundle import Bundle
from deploy.check.intervals import wilson_interval
from deploy.errors import UserError
from deploy.network.decision import choose_threshold
from deploy.network.rehearsal import Rehearsal
from deploy.network.responses import decoded, running_sums
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import EventFrames, last_steps
from deploy.tables import listed
from deploy.targets.fast import Emulation
from pipeline.data.altering import AUGMENTATIONS, altered_recordings, augmentation_for
from pipeline.data.dataset import (
    TRAINED_ON,
    classes_of,
    inputs_for,
    require_sensor_fits,
    training_hashes,
)
from pipeline.data.events import Recordings
from pipeline.settings import Image
from pipeline.training.readout import PULLS, REHEARSALS, Person, Refit, refit

# Number of training samples whose responses are in a bundle.
KEPT = 500

# Number of augmented copies of each sample of a person.
COPIES = 10

# Number of samples that are run in parallel, which limits the memory.
AT_ONCE = 32


class Responder:
    """A bundle's network up to its readout, on the target ``fast``.

    Parameters
    ----------
    spec : NetworkSpec
    seed : int
    image : Image, optional
        Conversion of events to images, for a network on images whose bundle does not have it.

    Raises
    ------
    UserError
        The readout is on the chip, where it is not a linear function of spikes.
    """

    def __init__(self, spec: NetworkSpec, seed: int = 0, image: Image | None = None):
        readout = spec.layers[-1]
        if readout.neurons is not None or len(spec.layers) < 2:
            raise UserError(
                "the readout is a layer of neurons on the chip; only a readout on the host can be "
                "fitted (deployment.readout = 'host')"
            )
        inputs = readout.weights.shape[1]
        through = replace(
            readout, shape=(inputs,), block_shape=None, weights=np.eye(inputs),
            bias=np.zeros(inputs), starts=(0,),
        )  # fmt: skip
        self.spec = spec
        self._emulation = Emulation(
            replace(spec, layers=(*spec.layers[:-1], through), estimator=None, rehearsal=None), seed
        )
        self._image = image

    @property
    def scale(self) -> float:
        """Factor that converts scores to the logits of the training."""
        presentation = self.spec.presentation
        on_events = isinstance(self.spec.stimulus, EventFrames)
        return float(presentation.steps - presentation.readout_start) if on_events else 1.0

    def inputs(self, recordings: Recordings) -> np.ndarray:
        """The inputs of the network for recordings."""
        return inputs_for(self.spec, recordings, self._image)

    def outputs(self, samples):
        """The input of the readout at each step.

        Parameters
        ----------
        samples : ndarray, shape (n_samples, ...)
            Inputs of the network; each is presented to a fresh network.

        Yields
        ------
        ndarray, shape (some, steps, inputs)
        """
        gap = self.spec.presentation.gap
        fed = self.spec.fed(samples)
        for start in range(0, len(fed), AT_ONCE):
            part = fed[start : start + AT_ONCE, None]
            yield self._emulation.run(part).output[:, 0, gap:]

    def responses(self, samples) -> np.ndarray:
        """Mean input of the readout while it is read.

        Returns
        -------
        ndarray, shape (n_samples, parts * inputs)
            See :mod:`deploy.network.rehearsal`.
        """
        start, readout = self.spec.presentation.readout_start, self.spec.layers[-1]
        found = [np.empty((0, readout.by_class.shape[1]))]
        for output in self.outputs(samples):
            output = output[:, start:]
            part = readout.part_of(start + np.arange(output.shape[1]))
            sums = [output[:, part == k].sum(axis=1) for k in range(readout.parts)]
            found.append(np.concatenate(sums, axis=1) / output.shape[1])
        return np.concatenate(found)

    def inputs_in_parts(self, recordings: Recordings):
        """:meth:`inputs` of some recordings at a time.

        The inputs on events of 500 recordings of a large sensor need gigabytes.
        """
        for start in range(0, len(recordings), AT_ONCE):
            yield self.inputs(recordings.part(np.arange(len(recordings))[start : start + AT_ONCE]))

    def responses_to(self, recordings: Recordings) -> np.ndarray:
        """:meth:`responses` to recordings."""
        return np.concatenate([self.responses(some) for some in self.inputs_in_parts(recordings)])

    def copies(self, recordings: Recordings, seed) -> np.ndarray:
        """Responses to augmented copies of recordings, shape (n_samples, COPIES, inputs)."""
        n = len(recordings)
        step_ms = 1e3 * self.spec.stimulus.step_seconds
        often = np.repeat(np.arange(n), COPIES)
        how = AUGMENTATIONS[augmentation_for(recordings)]
        altered = altered_recordings(recordings, often, how, step_ms, seed)
        return self.responses_to(altered).reshape(n, COPIES, -1)

    def person(self, recordings: Recordings, seed) -> Person:
        """The responses to a person's recordings that a refit needs."""
        own = self.responses_to(recordings)
        return Person(own, recordings.labels, self.copies(recordings, seed))


def with_rehearsal(spec: NetworkSpec, inputs, labels, train, seed: int) -> NetworkSpec:
    """A network with responses to some of its training samples, as :func:`adapt` needs them.

    Parameters
    ----------
    spec : NetworkSpec
    inputs : ndarray
        Input of the network for all samples.
    labels : ndarray of int
    train : ndarray of int
        Indices of the training samples.
    seed : int
        Seed of the draw of samples.
    """
    if spec.layers[-1].neurons is not None or len(spec.layers) < 2:
        return spec
    rng = np.random.default_rng([seed, 0xADA97])
    some = rng.permutation(np.asarray(train))[:KEPT]
    responses = Responder(spec).responses(inputs[some])
    return replace(spec, rehearsal=Rehearsal(responses.astype(np.float32), labels[some]))


@dataclass(frozen=True)
class Adapted:
    """The result of fitting a bundle's readout to a person.

    Attributes
    ----------
    spec : NetworkSpec or None
        The network with the new readout; None if the accuracy does not improve.
    fit : Refit
    others_before, others_after : ndarray of bool
        True if the old and the new readout are right, for each sample of the bundle's check that
        is not among the person's recordings.
    fitted : int
        Number of the samples of the bundle's check that are among the person's recordings.
    """

    spec: NetworkSpec | None
    fit: Refit
    others_before: np.ndarray
    others_after: np.ndarray
    fitted: int = 0


def adapt(bundle: Bundle, recordings: Recordings, writer: str, seed: int = 0) -> Adapted:
    """Fit a bundle's readout to one person's recordings.

    Parameters
    ----------
    bundle : Bundle
    recordings : Recordings
        Recordings of the person, of every class.
    writer : str
        Name of the person, for the new network's provenance.
    seed : int
        Seed of the augmented copies and of the folds of the cross-validation.

    Raises
    ------
    UserError
        The recordings are from another sensor or of other classes, a class is missing, or the
        bundle cannot be fitted.
    """
    spec = bundle.spec
    require_fit(spec, recordings)
    try:
        responder = Responder(spec, seed)
    except UserError as error:
        raise UserError(f"{bundle.path}: {error}") from error
    if spec.rehearsal is None:
        raise UserError(
            f"{bundle.path}: has no responses to training samples (made by an earlier version); "
            "delete it and make it again with 'stmnist convert'"
        )
    person = responder.person(recordings, [seed, 0xADA])
    readout = spec.layers[-1]
    fit = refit(readout.by_class, readout.bias, person, spec.rehearsal, seed, responder.scale)
    new = ~_in_check(bundle, responder, recordings)
    others = responder.responses(bundle.checks.inputs)[new]
    others_before, others_after = (
        (others @ weights.T + readout.bias).argmax(axis=1) == bundle.checks.labels[new]
        for weights in (readout.by_class, fit.weights)
    )
    fitted = int(np.sum(~new))
    if not fit.helps:
        return Adapted(None, fit, others_before, others_before, fitted)
    about = {
        "from": bundle.id,
        "writer": writer,
        "source": recordings.source.name,
        "source_sha256": recordings.source.sha256,
        "samples": len(recordings),
        "in_check": fitted,
        "pull": fit.pull,
        "rehearsal": fit.rehearsal,
    }
    adapted = replace(
        spec,
        layers=(*spec.layers[:-1], readout.with_by_class(fit.weights)),
        provenance={
            **spec.provenance,
            "adapted": about,
            TRAINED_ON: sorted({*training_hashes(spec), *recordings.hashes()}),
        },
    )
    adapted = _with_threshold(adapted, responder, recordings)
    return Adapted(adapted, fit, others_before, others_after, fitted)


def _in_check(bundle, responder, recordings):
    """Mark the samples of a bundle's check that are among some recordings, by their input."""
    samples = bundle.checks.inputs
    known = {
        np.asarray(row, samples.dtype).tobytes()
        for some in responder.inputs_in_parts(recordings)
        for row in some
    }
    return np.array([row.tobytes() in known for row in samples], bool)


def require_fit(spec: NetworkSpec, recordings: Recordings):
    """Refuse recordings to which a network's readout cannot be fitted.

    Raises
    ------
    UserError
    """
    require_sensor_fits(spec, recordings)
    source, sensor, known = recordings.source.name, recordings.sensor, classes_of(spec)
    if sensor.classes != known:
        raise UserError(
            f"{source}: recordings of the classes {listed(sensor.classes)}; the network "
            f"distinguishes {listed(known)}: give recordings of these classes"
        )
    counts = np.bincount(recordings.labels, minlength=len(known))
    if not counts.all():
        missing = [known[label] for label in np.flatnonzero(counts == 0)]
        raise UserError(
            f"{source}: no recording of {listed(missing)}; give at least one of each class"
        )


def _with_threshold(spec, responder, recordings):
    """The network with a threshold that keeps the accuracy of early decisions for the person.

    The threshold is never lower than before, because it would be unreliable with few samples.
    """
    limit = spec.presentation.confidence
    if limit is None:
        return spec
    weights, outputs, last = spec.layers[-1].weights, [], []
    for samples in responder.inputs_in_parts(recordings):
        outputs += [decoded(spec, output @ weights.T) for output in responder.outputs(samples)]
        last.append(last_steps(samples))
    chosen = choose_threshold(
        running_sums(spec, np.concatenate(outputs)),
        recordings.labels,
        np.concatenate(last),
        estimator=spec.estimator,
    )
    return spec.with_presentation(confidence=max(limit, chosen.confidence))


def text_of(adapted: Adapted, place) -> str:
    """The result of :func:`adapt` as text.

    Parameters
    ----------
    adapted : Adapted
    place : path-like or None
        Folder of the new bundle.
    """
    fit, lines = adapted.fit, []
    chosen = f" (best of {len(PULLS) * len(REHEARSALS)} settings, so optimistic)"
    for who, before, after in (
        (f"this person, cross-validated{chosen}", fit.before, fit.after),
        ("the bundle's own check", adapted.others_before, adapted.others_after),
    ):
        if len(before):
            lines.append(f"{who}: {_share(before)} before, {_share(after)} after")
    if adapted.fitted:
        lines.append(
            f"{adapted.fitted} of the {adapted.fitted + len(adapted.others_before)} samples of the "
            "bundle's check are among these recordings and are not counted"
        )
    if place is None:
        lines.append("no improvement: nothing was changed")
    else:
        lines.append(f"bundle: written to {place}")
    return "\n".join(lines)


def _share(right):
    low, high = wilson_interval(int(right.sum()), len(right))
    return f"{right.mean():.3f} ({low:.3f} to {high:.3f}, {len(right)} samples)"
