"""Fit the readout of a bundle to one person, while it stays accurate for other people.

With x the responses at the input of the readout, W its weights and p = softmax(W x), the change D
of the weights minimises

    mean over the person's samples of -log p_c + rehearsal * mean over kept samples of -log p_c
        + pull / 2 * |D|^2

with the responses in units of their usual length, so that ``pull`` has the same meaning for all
networks.  This is a multinomial logistic regression with a regularisation towards the old weights
(a Gaussian prior around them; C. Chelba and A. Acero, "Adaptation of maximum entropy capitalizer:
little data can help a lot", EMNLP 2004).  The kept training samples prevent forgetting (rehearsal;
A. Robins, Connection Science 7, 1995).  ``rehearsal`` and ``pull`` are chosen by cross-validation
on the person's own samples.
"""

import itertools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_softmax
from threadpoolctl import threadpool_limits

from deploy.check.bundle import Bundle
from deploy.check.intervals import compute_wilson_interval
from deploy.errors import UserError
from deploy.network.chip import LOIHI
from deploy.network.decision import choose_threshold
from deploy.network.ops.dense import DeployedDense
from deploy.network.provenance import TRAINING_RECORDINGS, read_classes, read_training_hashes
from deploy.network.readout import compute_running_sums, select_readout
from deploy.network.rehearsal import Rehearsal
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import EventFrames, find_last_steps
from deploy.tables import list_names
from deploy.targets.fast import Emulation
from pipeline.recordings.augmentation import AUGMENTATIONS, alter_recordings, choose_augmentation
from pipeline.recordings.dataset import make_inputs_for, require_sensor_fits
from pipeline.recordings.events import Recordings
from pipeline.settings import Image

# Strengths of regularisation and of rehearsal among which cross-validation chooses.
PULLS = (3e-4, 3e-3)
REHEARSALS = (0.3, 1.0, 3.0)

FOLDS = 5

# Directions of the responses in which the weights may change, those of the largest variance: a
# layer of many neurons would take minutes without a gain.
MAX_DIRECTIONS = 96

# Maximum loss of accuracy on the kept samples in cross-validation, similar to the loss of other
# people.
MAX_KEPT_LOSS = 0.015


@dataclass(frozen=True)
class Person:
    """Responses to a person's samples and to augmented copies of them.

    Attributes
    ----------
    responses : ndarray, shape (n, inputs)
        Responses to the original samples.
    labels : ndarray of int, shape (n,)
    copies : ndarray, shape (n, n_copies, inputs)
        Responses to augmented copies, which are used for training only.
    """

    responses: np.ndarray
    labels: np.ndarray
    copies: np.ndarray

    def __len__(self):
        return len(self.labels)

    def select_with_copies(self, indices) -> tuple:
        """Responses and labels for the fit: some samples and their copies."""
        own = self.responses[indices]
        copies = self.copies[indices]
        every = np.concatenate([own[:, None], copies], axis=1)
        return every.reshape(-1, own.shape[1]), np.repeat(self.labels[indices], every.shape[1])


@dataclass(frozen=True)
class Refit:
    """A refitted readout and how good it is in cross-validation.

    Attributes
    ----------
    weights : ndarray, shape (classes, inputs)
        Weights rounded to 255 levels.
    pull, rehearsal : float
        The chosen values; see the module's description.
    before, after : ndarray of bool, shape (n_samples,)
        For each sample of the person, whether the old readout is right, and whether a readout that
        was refitted without this sample is right.
    kept_before, kept_after : ndarray of bool
        The same for the kept training samples.
    """

    weights: np.ndarray
    pull: float
    rehearsal: float
    before: np.ndarray
    after: np.ndarray
    kept_before: np.ndarray
    kept_after: np.ndarray

    @property
    def helps(self) -> bool:
        """True if the accuracy improves for the person and is almost unchanged for other people."""
        kept_loss = self.kept_before.mean() - self.kept_after.mean()
        return bool(self.after.sum() > self.before.sum() and kept_loss <= MAX_KEPT_LOSS)


# In one thread: matrix products of a few hundred rows take 12 times as long in several threads.
@threadpool_limits.wrap(limits=1, user_api="blas")
def refit(weights, bias, person: Person, kept: Rehearsal, seed: int = 0, scale: float = 1.0):
    """Refit a readout, with ``pull`` and ``rehearsal`` chosen by cross-validation.

    Parameters
    ----------
    weights : ndarray, shape (classes, inputs)
    bias : ndarray, shape (classes,)
        Bias of the readout, which is not changed.
    person : Person
    kept : Rehearsal
    seed : int
        Seed of the folds.
    scale : float
        Factor that converts scores to the logits of the training.

    Returns
    -------
    Refit
        The best fit; see :attr:`Refit.helps` for its use.
    """
    weights = np.asarray(weights, float)
    bias = np.asarray(bias, float)
    problem = _Regression(weights, bias, person, kept, scale)
    folds = _Folds.draw(person, kept, seed)
    before = problem.compute_log_probabilities(problem.weights, person.responses)
    kept_before = _find_right(
        problem.compute_log_probabilities(problem.weights, kept.responses), kept.labels
    )

    def rate(trial):
        """Keeping the accuracy for others comes first, then the likelihood for the person."""
        kept_loss = kept_before.mean() - trial.kept_after.mean()
        return kept_loss <= MAX_KEPT_LOSS, trial.likelihood

    trials = [
        _cross_validate(problem, person, kept, folds, pull, rehearsal)
        for pull, rehearsal in itertools.product(PULLS, REHEARSALS)
    ]
    best = max(trials, key=rate)
    everything = np.ones(len(kept), bool)
    samples, labels = person.select_with_copies(np.arange(len(person)))
    refitted = problem.solve(samples, labels, everything, best.pull, best.rehearsal)
    return Refit(
        weights=round_to_8_bits(refitted),
        pull=best.pull,
        rehearsal=best.rehearsal,
        before=_find_right(before, person.labels),
        after=best.after,
        kept_before=kept_before,
        kept_after=best.kept_after,
    )


class _Folds(NamedTuple):
    """The fold of each sample of the person, and of each kept sample."""

    own: np.ndarray
    kept: np.ndarray

    @classmethod
    def draw(cls, person, kept, seed):
        """Draw the folds; the samples of a class are in as many folds as possible."""
        own = _draw_folds(person.labels, seed)
        order = np.random.default_rng([seed, 1]).permutation(len(kept))
        return cls(own, order % (own.max() + 1))


class _Trial(NamedTuple):
    """The result of cross-validating a pair of ``pull`` and ``rehearsal``; see `Refit`.

    ``likelihood`` is the mean logarithm of the probability of the right class.
    """

    pull: float
    rehearsal: float
    after: np.ndarray
    kept_after: np.ndarray
    likelihood: float


def _cross_validate(problem, person, kept, folds, pull, rehearsal) -> _Trial:
    """Predict each sample with a readout that was refitted to the other folds."""
    log_p = np.empty((len(person), len(problem.weights)))
    kept_after = np.empty(len(kept), bool)
    for fold in range(folds.own.max() + 1):
        is_out = folds.own == fold
        is_kept_out = folds.kept == fold
        samples, labels = person.select_with_copies(~is_out)
        solution = problem.solve(samples, labels, ~is_kept_out, pull, rehearsal)
        refitted = round_to_8_bits(solution)
        log_p[is_out] = problem.compute_log_probabilities(refitted, person.responses[is_out])
        log_kept = problem.compute_log_probabilities(refitted, kept.responses[is_kept_out])
        kept_after[is_kept_out] = _find_right(log_kept, kept.labels[is_kept_out])
    likelihood = log_p[np.arange(len(person)), person.labels].mean()
    return _Trial(pull, rehearsal, _find_right(log_p, person.labels), kept_after, likelihood)


def round_to_8_bits(weights) -> np.ndarray:
    """Weights rounded to 255 levels; the largest magnitude has the last level."""
    unit = np.abs(weights).max() / LOIHI.weight_levels
    return np.rint(weights / unit) * unit if unit > 0 else np.array(weights)


class _Regression:
    """The regression's constants: old weights, kept samples, units."""

    def __init__(self, weights, bias, person, kept, scale):
        self.weights = weights
        self.bias = bias
        self._scale = scale
        self._kept = kept.responses.astype(float)
        self._classes = np.eye(len(weights))
        self._kept_labels = self._classes[kept.labels]
        self._kept_logits = self._compute_logits(weights, self._kept)
        self._unit = max(np.sqrt((self._kept**2).sum(axis=1).mean()), 1e-12)
        every = np.concatenate([self._kept, person.select_with_copies(np.arange(len(person)))[0]])
        self._directions = np.linalg.eigh(every.T @ every)[1][:, -MAX_DIRECTIONS:]

    def _compute_logits(self, weights, responses):
        return self._scale * (responses @ weights.T + self.bias)

    def compute_log_probabilities(self, weights, responses):
        """Logarithm of the softmax, shape (n_samples, classes)."""
        return log_softmax(self._compute_logits(weights, responses), axis=1)

    def solve(self, responses, labels, kept, pull, rehearsal):
        """The refitted weights."""
        units = self._directions / self._unit
        own = responses @ units
        others = self._kept[kept] @ units
        logits = self._compute_logits(self.weights, responses), self._kept_logits[kept]
        targets = self._classes[labels], self._kept_labels[kept]

        def loss(flat):
            change = flat.reshape(len(self.weights), -1)
            value = pull / 2 * (flat**2).sum()
            slope = pull * change
            for share, rows, offset, target in zip(
                (1.0, rehearsal), (own, others), logits, targets, strict=True
            ):
                log_p = log_softmax(offset + rows @ change.T, axis=1)
                value = value - share * (log_p * target).sum() / len(rows)
                slope = slope + share * (np.exp(log_p) - target).T @ rows / len(rows)
            return value, slope.ravel()

        minimum = minimize(
            loss, np.zeros(len(self.weights) * units.shape[1]), jac=True, method="L-BFGS-B",
            options={"maxiter": 100, "ftol": 1e-7},
        )  # fmt: skip
        change = minimum.x.reshape(len(self.weights), -1) @ units.T / self._scale
        return self.weights + change


def _draw_folds(labels, seed):
    """The fold of each sample; the samples of a class are in as many folds as possible."""
    order = np.random.default_rng([seed, 0]).permutation(len(labels))
    order = order[np.argsort(np.asarray(labels)[order], kind="stable")]
    folds = np.empty(len(labels), int)
    folds[order] = np.arange(len(labels)) % min(FOLDS, len(labels))
    return folds


def _find_right(log_p, labels):
    return log_p.argmax(axis=1) == labels


# Number of training samples whose responses are in a bundle.
MAX_KEPT_SAMPLES = 500

# Number of augmented copies of each sample of a person.
COPIES = 10

# Number of samples that are run in parallel, which limits the memory.
SAMPLES_AT_ONCE = 32


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
            readout,
            operation=DeployedDense(inputs),
            block_shape=None,
            weights=np.eye(inputs),
            bias=np.zeros(inputs),
            starts=(0,),
        )
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

    def make_inputs(self, recordings: Recordings) -> np.ndarray:
        """The inputs of the network for recordings."""
        return make_inputs_for(self.spec, recordings, self._image)

    def run_to_readout(self, samples):
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
        fed = self.spec.flatten_samples(samples)
        for start in range(0, len(fed), SAMPLES_AT_ONCE):
            yield self._emulation.run(fed[start : start + SAMPLES_AT_ONCE, None]).output[:, 0, gap:]

    def compute_responses(self, samples) -> np.ndarray:
        """Mean input of the readout while it is read.

        Returns
        -------
        ndarray, shape (n_samples, sections * inputs)
            See :class:`deploy.network.rehearsal.Rehearsal`.
        """
        start = self.spec.presentation.readout_start
        readout = self.spec.layers[-1]
        batches = [np.empty((0, readout.weights_by_class.shape[1]))]
        for output in self.run_to_readout(samples):
            output = output[:, start:]
            section = readout.find_section(start + np.arange(output.shape[1]))
            sums = [output[:, section == k].sum(axis=1) for k in range(readout.sections)]
            batches.append(np.concatenate(sums, axis=1) / output.shape[1])
        return np.concatenate(batches)

    def make_inputs_in_batches(self, recordings: Recordings):
        """:meth:`make_inputs` of some recordings at a time.

        The inputs on events of 500 recordings of a large sensor need gigabytes.
        """
        for start in range(0, len(recordings), SAMPLES_AT_ONCE):
            yield self.make_inputs(
                recordings.subset(np.arange(len(recordings))[start : start + SAMPLES_AT_ONCE])
            )

    def respond_to(self, recordings: Recordings) -> np.ndarray:
        """:meth:`compute_responses` to recordings."""
        batches = self.make_inputs_in_batches(recordings)
        return np.concatenate([self.compute_responses(some) for some in batches])

    def respond_to_copies(self, recordings: Recordings, seed) -> np.ndarray:
        """Responses to augmented copies of recordings, shape (n_samples, COPIES, inputs)."""
        n = len(recordings)
        step_ms = 1e3 * self.spec.stimulus.step_seconds
        often = np.repeat(np.arange(n), COPIES)
        augmentation = AUGMENTATIONS[choose_augmentation(recordings)]
        altered = alter_recordings(recordings, often, augmentation, step_ms, seed)
        return self.respond_to(altered).reshape(n, COPIES, -1)

    def make_person(self, recordings: Recordings, seed) -> Person:
        """The responses to a person's recordings that a refit needs."""
        responses = self.respond_to(recordings)
        return Person(responses, recordings.labels, self.respond_to_copies(recordings, seed))


def add_rehearsal(spec: NetworkSpec, inputs, labels, train, seed: int) -> NetworkSpec:
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
    chosen = np.random.default_rng([seed, 0xADA97]).permutation(np.asarray(train))[
        :MAX_KEPT_SAMPLES
    ]
    responses = Responder(spec).compute_responses(inputs[chosen])
    return replace(spec, rehearsal=Rehearsal(responses.astype(np.float32), labels[chosen]))


@dataclass(frozen=True)
class Adaptation:
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


def adapt(bundle: Bundle, recordings: Recordings, writer: str, seed: int = 0) -> Adaptation:
    """Fit a bundle's readout to one person's recordings.

    Parameters
    ----------
    bundle : Bundle
    recordings : Recordings
        Recordings of the person, of every class; see :func:`require_fit`.
    writer : str
        Name of the person, for the new network's provenance.
    seed : int
        Seed of the augmented copies and of the folds of the cross-validation.

    Raises
    ------
    UserError
        The bundle cannot be fitted.
    """
    spec = bundle.spec
    try:
        responder = Responder(spec, seed)
    except UserError as error:
        raise UserError(f"{bundle.path}: {error}") from error
    if spec.rehearsal is None:
        raise UserError(
            f"{bundle.path}: has no responses to training samples; only 'stmnist convert' adds them"
        )
    person = responder.make_person(recordings, [seed, 0xADA])
    readout = spec.layers[-1]
    fit = refit(
        readout.weights_by_class, readout.bias, person, spec.rehearsal, seed, responder.scale
    )
    new = ~_mark_check_samples(bundle, responder, recordings)
    others = responder.compute_responses(bundle.checks.inputs)[new]
    others_before, others_after = (
        (others @ weights.T + readout.bias).argmax(axis=1) == bundle.checks.labels[new]
        for weights in (readout.weights_by_class, fit.weights)
    )
    fitted = int(np.sum(~new))
    if not fit.helps:
        return Adaptation(None, fit, others_before, others_after, fitted)
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
        layers=(*spec.layers[:-1], readout.with_weights_by_class(fit.weights)),
        provenance={
            **spec.provenance,
            "adapted": about,
            TRAINING_RECORDINGS: sorted({*read_training_hashes(spec), *recordings.hashes}),
        },
    )
    adapted = _with_threshold(adapted, responder, recordings)
    return Adaptation(adapted, fit, others_before, others_after, fitted)


def _mark_check_samples(bundle, responder, recordings):
    """Mark the samples of a bundle's check that are among some recordings, by their input."""
    samples = bundle.checks.inputs
    known = {
        np.asarray(row, samples.dtype).tobytes()
        for some in responder.make_inputs_in_batches(recordings)
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
    source = recordings.source.name
    sensor = recordings.sensor
    known = read_classes(spec)
    if sensor.classes != known:
        raise UserError(
            f"{source}: recordings of the classes {list_names(sensor.classes)}; the network "
            f"distinguishes {list_names(known)}: give recordings of these classes"
        )
    counts = np.bincount(recordings.labels, minlength=len(known))
    if not counts.all():
        missing = [known[label] for label in np.flatnonzero(counts == 0)]
        raise UserError(f"{source}: no recording of {list_names(missing)}; give one of each class")


def _with_threshold(spec, responder, recordings):
    """The network with a threshold that keeps the accuracy of early decisions for the person.

    The threshold is never lower than before, because it would be unreliable with few samples.
    """
    limit = spec.presentation.confidence
    if limit is None:
        return spec
    weights = spec.layers[-1].weights
    outputs = []
    last = []
    for samples in responder.make_inputs_in_batches(recordings):
        outputs += [
            select_readout(spec, output @ weights.T) for output in responder.run_to_readout(samples)
        ]
        last.append(find_last_steps(samples))
    chosen = choose_threshold(
        compute_running_sums(spec, np.concatenate(outputs)),
        recordings.labels,
        np.concatenate(last),
        estimator=spec.estimator,
    )
    return spec.with_presentation(confidence=max(limit, chosen.confidence))


def format_adaptation(adapted: Adaptation, place) -> str:
    """The result of :func:`adapt` as text.

    Parameters
    ----------
    adapted : Adaptation
    place : path-like or None
        Folder of the new bundle.
    """
    fit = adapted.fit
    lines = []
    chosen = f" (best of {len(PULLS) * len(REHEARSALS)} settings, so optimistic)"
    compared = [(f"this person, cross-validated{chosen}", fit.before, fit.after)]
    if place is not None and len(others := adapted.others_before):
        compared.append(("the bundle's check, each sample from rest", others, adapted.others_after))
    for who, before, after in compared:
        lines.append(f"{who}: {_format_share(before)} before, {_format_share(after)} after")
    if adapted.fitted:
        lines.append(
            f"{adapted.fitted} of the {adapted.fitted + len(adapted.others_before)} samples of the "
            "bundle's check are among these recordings and are not counted"
        )
    if place is not None:
        lines.append(f"bundle: written to {place}")
    elif fit.after.sum() > fit.before.sum():
        kept_loss = 100 * (fit.kept_before.mean() - fit.kept_after.mean())
        lines.append(f"{kept_loss:.1f} points lost on samples of the training: nothing was changed")
    else:
        lines.append("no improvement: nothing was changed")
    return "\n".join(lines)


def _format_share(right):
    low, high = compute_wilson_interval(int(right.sum()), len(right))
    return f"{right.mean():.3f} ({low:.3f} to {high:.3f}, {len(right)} samples)"
