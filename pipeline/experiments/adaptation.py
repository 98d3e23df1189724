"""The gain of fitting the readout to a person, over people and numbers of digits.

For each person, some recordings of each class are used for training and all others for testing; the
test recordings do not depend on the number of training recordings.  Several draws of a person are
averaged, and intervals are over people.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from deploy.check.bundle import Bundle
from deploy.errors import UserError
from deploy.tables import aligned
from pipeline.recordings.events import Recordings
from pipeline.run.adaptation import Responder, fits
from pipeline.training.readout import refit

SCHEMA = "stmnist-adaptation/1"


def measure_adaptation(
    bundle: Bundle, recordings: Recordings, each=(1, 2, 5), draws=5, wrong=0.0, seed=0, advance=None
) -> dict:
    """Fit a bundle's readout to each person with some recordings, and test it on the others.

    Parameters
    ----------
    bundle : Bundle
    recordings : Recordings
        Recordings of several known writers, with every class from each writer.
    each : sequence of int
        Numbers of training recordings of each class.
    draws : int
        Number of random draws of the training recordings, for each person.
    wrong : float
        Share of the training labels that are replaced by wrong ones, to measure their effect.
    seed : int
    advance : callable, optional
        Called with 1 after each person.

    Returns
    -------
    dict
        ``people``, ``each``: for each number of recordings the mean accuracies ``before`` and
        ``after``, ``gain_points`` with its ``interval95``, the ``worst`` person's gain, the points
        ``lost`` on the bundle's own check, and the share of fits that were ``used``.

    Raises
    ------
    UserError
        Fewer than two writers have enough recordings of each class.
    """
    people = _enough(recordings, len(bundle.spec.provenance.get("classes", range(10))), max(each))
    if len(people) < 2:
        raise UserError(
            f"{recordings.source.name}: fewer than two known writers with {max(each) + 1} "
            "recordings of each class; give more, or learn from fewer (--each)"
        )
    fits(bundle, recordings.part(np.flatnonzero(recordings.writers == people[0])))
    responder = Responder(bundle.spec, seed)
    others = responder.responses(bundle.checks.inputs), bundle.checks.labels
    rows = {count: [] for count in each}
    for who in people:
        mine = recordings.part(np.flatnonzero(recordings.writers == who))
        person = responder.person(mine, [seed, who])
        for draw in range(draws):
            rng = np.random.default_rng([seed, who, draw])
            learned, judged = _drawn(person.labels, max(each), rng)
            for count in each:
                some = learned[:, :count].ravel()
                labels = _mistaken(person.labels[some], wrong, rng)
                told = replace(
                    person, responses=person.responses[some], labels=labels,
                    copies=person.copies[some],
                )  # fmt: skip
                rest = person.responses[judged], person.labels[judged]
                rows[count].append((who, *_judge(bundle, responder, told, rest, others, draw)))
        if advance is not None:
            advance(1)
    return {
        "schema": SCHEMA,
        "bundle": bundle.id,
        "source": recordings.source.name,
        "source_sha256": recordings.source.sha256,
        "simulated": recordings.source.simulated,
        "seed": seed,
        "draws": draws,
        "wrong_labels": wrong,
        "people": len(people),
        "each": {str(count): _summary(np.array(found)) for count, found in rows.items()},
    }


def _enough(recordings, classes, most):
    """Writers who have enough recordings of each class for training and testing."""
    known = [int(who) for who in np.unique(recordings.writers) if who >= 0]
    counts = {
        who: np.bincount(recordings.labels[recordings.writers == who], minlength=classes)
        for who in known
    }
    return [who for who in known if counts[who].min() > most]


def _drawn(labels, most, rng):
    """Indices of the training recordings, shape (classes, most), and of the test recordings."""
    order = [rng.permutation(np.flatnonzero(labels == label)) for label in np.unique(labels)]
    learned = np.array([mine[:most] for mine in order])
    return learned, np.concatenate([mine[most:] for mine in order])


def _mistaken(labels, wrong, rng):
    """Labels, a share of which is replaced by those of other classes."""
    labels, classes = labels.copy(), labels.max() + 1
    some = rng.permutation(len(labels))[: round(wrong * len(labels))]
    labels[some] = (labels[some] + rng.integers(1, classes, len(some))) % classes
    return labels


def _judge(bundle, responder, person, rest, others, seed):
    """Accuracy on the rest before and after, on others before and after, whether it was used."""
    readout, kept = bundle.spec.layers[-1], bundle.spec.rehearsal
    fit = refit(readout.weights, readout.bias, person, kept, seed, responder.scale)
    new = fit.weights if fit.helps else readout.weights
    return (
        *(
            float(((x @ weights.T + readout.bias).argmax(1) == labels).mean())
            for x, labels in (rest, others)
            for weights in (readout.weights, new)
        ),
        float(fit.helps),
    )


def _summary(found):
    """Of rows (who, before, after, others before, others after, used)."""
    from scipy import stats

    people = [found[found[:, 0] == who].mean(axis=0) for who in np.unique(found[:, 0])]
    _, before, after, others_before, others_after, used = np.array(people).T
    gain = 100 * (after - before)
    half = stats.t.ppf(0.975, len(gain) - 1) * gain.std(ddof=1) / np.sqrt(len(gain))
    return {
        "before": float(before.mean()),
        "after": float(after.mean()),
        "gain_points": float(gain.mean()),
        "interval95": [float(gain.mean() - half), float(gain.mean() + half)],
        "worst": float(gain.min()),
        "lost": float(100 * (others_before - others_after).mean()),
        "used": float(used.mean()),
    }


def adaptation_text(measured: dict) -> str:
    """The result of :func:`measure_adaptation` as a table."""
    rows = [["each class", "before", "after", "gain", "95 %", "worst", "lost", "used"]]
    for count, row in measured["each"].items():
        low, high = row["interval95"]
        rows.append(
            [
                count, f"{row['before']:.3f}", f"{row['after']:.3f}", f"{row['gain_points']:+.1f}",
                f"{low:+.1f} to {high:+.1f}", f"{row['worst']:+.1f}", f"{row['lost']:.1f}",
                f"{row['used']:.0%}",
            ]
        )  # fmt: skip
    kind = "simulated " if measured["simulated"] else ""
    note = (
        f"{measured['people']} people, {measured['draws']} draws each, {kind}recordings of "
        f"{measured['source']}; gain, worst and lost in points"
    )
    return "\n".join([*aligned(rows), note])
