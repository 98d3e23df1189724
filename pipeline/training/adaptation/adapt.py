"""Fit the readout of a bundle to one person's recordings."""

from dataclasses import dataclass, replace

import numpy as np

from deploy.check.bundle import Bundle
from deploy.check.intervals import compute_wilson_interval
from deploy.errors import UserError
from deploy.network.decision import choose_threshold
from deploy.network.provenance import TRAINING_RECORDINGS, read_classes, read_training_hashes
from deploy.network.readout import compute_running_sums, select_readout
from deploy.network.rehearsal import Rehearsal
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import find_last_steps
from deploy.tables import list_names
from pipeline.recordings.dataset import require_sensor_fits
from pipeline.recordings.recordings import Recordings
from pipeline.training.adaptation.refit import PULLS, REHEARSALS, Refit, fit_readout
from pipeline.training.adaptation.responder import Responder

# Number of training samples whose responses are in a bundle.
MAX_KEPT_SAMPLES = 500


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
    order = np.random.default_rng([seed, 0xADA97]).permutation(np.asarray(train))
    kept = order[:MAX_KEPT_SAMPLES]
    responses = Responder(spec).compute_responses(inputs[kept])
    return replace(spec, rehearsal=Rehearsal(responses.astype(np.float32), labels[kept]))


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
        Recordings of the person, of every class; see :func:`require_adaptable_recordings`.
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
    fit = fit_readout(
        readout.weights_by_class, readout.bias, person, spec.rehearsal, seed, responder.scale
    )
    is_other = ~_mark_check_samples(bundle, responder, recordings)
    responses = responder.compute_responses(bundle.checks.inputs)[is_other]
    others_before, others_after = (
        (responses @ weights.T + readout.bias).argmax(axis=1) == bundle.checks.labels[is_other]
        for weights in (readout.weights_by_class, fit.weights)
    )
    n_fitted = int(np.sum(~is_other))
    adapted = None
    if fit.helps:
        entry = _make_provenance(bundle, recordings, writer, fit, n_fitted)
        adapted = _change_readout(spec, fit, recordings, entry)
        adapted = _raise_threshold(adapted, responder, recordings)
    return Adaptation(adapted, fit, others_before, others_after, n_fitted)


def _make_provenance(bundle, recordings, writer, fit, n_fitted):
    """The entry in a network's provenance about the person that it was fitted to."""
    return {
        "from": bundle.id,
        "writer": writer,
        "source": recordings.source.name,
        "source_sha256": recordings.source.sha256,
        "samples": len(recordings),
        "in_check": n_fitted,
        "pull": fit.pull,
        "rehearsal": fit.rehearsal,
    }


def _change_readout(spec, fit, recordings, entry):
    """The network with the new weights, and with its provenance."""
    hashes = sorted({*read_training_hashes(spec), *recordings.hashes})
    return replace(
        spec,
        layers=(*spec.layers[:-1], spec.layers[-1].with_weights_by_class(fit.weights)),
        provenance=spec.provenance.with_entries(adapted=entry, **{TRAINING_RECORDINGS: hashes}),
    )


def _mark_check_samples(bundle, responder, recordings):
    """Mark the samples of a bundle's check that are among recordings, by their input."""
    samples = bundle.checks.inputs
    contents = {
        np.asarray(row, samples.dtype).tobytes()
        for batch in responder.make_inputs_in_batches(recordings)
        for row in batch
    }
    return np.array([row.tobytes() in contents for row in samples], bool)


def require_adaptable_recordings(spec: NetworkSpec, recordings: Recordings):
    """Refuse recordings to which a network's readout cannot be fitted.

    Raises
    ------
    UserError
    """
    require_sensor_fits(spec, recordings)
    source = recordings.source.name
    sensor = recordings.sensor
    classes = read_classes(spec)
    if sensor.classes != classes:
        raise UserError(
            f"{source}: recordings of the classes {list_names(sensor.classes)}; the network "
            f"distinguishes {list_names(classes)}: give recordings of these classes"
        )
    counts = np.bincount(recordings.labels, minlength=len(classes))
    if not counts.all():
        missing = [classes[label] for label in np.flatnonzero(counts == 0)]
        raise UserError(f"{source}: no recording of {list_names(missing)}; give one of each class")


def _raise_threshold(spec, responder, recordings):
    """The network with a threshold that keeps the accuracy of early decisions for the person.

    The threshold is never lower than before, because it would be unreliable with few samples.
    """
    threshold = spec.presentation.threshold
    if threshold is None:
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
    return spec.with_presentation(threshold=max(threshold, chosen.value))


def format_adaptation(adapted: Adaptation, folder) -> str:
    """The result of :func:`adapt` as text.

    Parameters
    ----------
    adapted : Adaptation
    folder : path-like or None
        Folder of the new bundle.
    """
    fit = adapted.fit
    lines = []
    chosen = f" (best of {len(PULLS) * len(REHEARSALS)} settings, so optimistic)"
    compared = [(f"this person, cross-validated{chosen}", fit.before, fit.after)]
    if folder is not None and len(adapted.others_before):
        row = (
            "the bundle's check, each sample from rest",
            adapted.others_before,
            adapted.others_after,
        )
        compared.append(row)
    for who, before, after in compared:
        lines.append(f"{who}: {_format_share(before)} before, {_format_share(after)} after")
    if adapted.fitted:
        lines.append(
            f"{adapted.fitted} of the {adapted.fitted + len(adapted.others_before)} samples of the "
            "bundle's check are among these recordings and are not counted"
        )
    if folder is not None:
        lines.append(f"bundle: written to {folder}")
    elif fit.after.sum() > fit.before.sum():
        kept_loss = 100 * (fit.kept_before.mean() - fit.kept_after.mean())
        lines.append(f"{kept_loss:.1f} points lost on samples of the training: nothing was changed")
    else:
        lines.append("no improvement: nothing was changed")
    return "\n".join(lines)


def _format_share(right):
    """The share of right predictions, with its interval."""
    low, high = compute_wilson_interval(int(right.sum()), len(right))
    return f"{right.mean():.3f} ({low:.3f} to {high:.3f}, {len(right)} samples)"
