"""The gain of fitting a network to a person, over people and numbers of digits.

For each person, some recordings of each class are used for training and all others for testing; the
test recordings do not depend on the number of training recordings.  Several draws of a person are
averaged, and intervals are over people.  What is fitted is the readout on the host, as ``stmnist
adapt`` does it, or a readout on the chip that learns with PES.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from deploy.check.bundle import Bundle
from deploy.errors import UserError
from deploy.network.spec import NetworkSpec
from deploy.tables import aligned
from pipeline.data.events import Recordings
from pipeline.training.adaptation import Responder, require_fit
from pipeline.training.readout import Person, refit

SCHEMA = "stmnist-adaptation/2"


@dataclass(frozen=True)
class Plan:
    """The plan of a measurement.

    Attributes
    ----------
    each : tuple of int
        Numbers of training recordings of each class.
    draws : int
        Number of random draws of the training recordings, for each person.
    seed : int
    """

    each: tuple = (1, 2, 5)
    draws: int = 5
    seed: int = 0


@dataclass(frozen=True)
class Case:
    """A draw of a person's recordings.

    Attributes
    ----------
    spec : NetworkSpec
    scale : float
        Factor that converts scores to the logits of the training.
    training : Person
        The recordings to which the network is fitted.
    rest, others : tuple of ndarray
        Responses and labels of the person's other recordings, and of other people's.
    seed : int
    tuned : callable, optional
        ``tuned(labels, seed)`` trains all layers further on the training recordings; returns
        responses to the rest and to the others, and the new readout.
    """

    spec: NetworkSpec
    scale: float
    training: Person
    rest: tuple
    others: tuple
    seed: int
    tuned: Callable | None = None

    def accuracies(self, weights) -> tuple:
        """Accuracy of a readout on the rest and on the others."""
        bias = self.spec.layers[-1].bias
        return tuple(
            float(((x @ weights.T + bias).argmax(1) == labels).mean())
            for x, labels in (self.rest, self.others)
        )


def on_host(case: Case) -> dict:
    """Fit the readout on the host; ``exact`` is the accuracy without rounding to 8 bits."""
    readout, kept = case.spec.layers[-1], case.spec.rehearsal
    fit = refit(readout.weights, readout.bias, case.training, kept, case.seed, case.scale)
    weights, exact = (fit.weights, fit.exact) if fit.helps else [readout.weights] * 2
    after, others_after = case.accuracies(weights)
    return {
        "after": after,
        "others_after": others_after,
        "exact": case.accuracies(exact)[0],
        "used": float(fit.helps),
    }


@dataclass(frozen=True)
class Method:
    """A way to fit a network to a person.

    Attributes
    ----------
    title : str
    learn : callable
        Function from a :class:`Case` to a dict: the accuracies ``after`` and ``others_after`` on
        the rest and on others, ``exact``, the accuracy on the rest without rounding of weights, and
        ``used``, 1 (the default) if the network was changed, else 0.
    wrong : float
        Share of the training labels that are replaced by wrong ones, to measure their effect.
    every : bool
        True if the method is measured with every number of recordings, else with the largest only.
    draws : int
        Maximum number of draws for each person.
    chosen_on : int or None
        The fold of three on whose people the parameters were chosen, which is not measured.
    how : str
        Parameters of the method; results with other parameters are outdated.
    """

    title: str
    learn: Callable
    wrong: float = 0.0
    every: bool = True
    draws: int = 1_000
    chosen_on: int | None = None
    how: str = ""


METHODS = {
    "readout": Method("readout on the host", on_host),
}
"""The ways to fit a network that are compared."""


@dataclass(frozen=True)
class Subjects:
    """People's responses to a network, computed once for all methods.

    Attributes
    ----------
    spec : NetworkSpec
    scale : float
        See :class:`Case`.
    people : dict of int to Person
    others : tuple of ndarray
        Responses and labels of other people's samples.
    seed : int
    tune : callable, optional
        ``tune(who, training, test)`` gives :attr:`Case.tuned` of a draw.
    """

    spec: NetworkSpec
    scale: float
    people: dict
    others: tuple
    seed: int
    tune: Callable | None = None

    @classmethod
    def of(
        cls, spec: NetworkSpec, others, recordings: Recordings, plan: Plan, advance=None, tune=None
    ) -> Subjects:
        """Run a network on people's recordings and their altered copies.

        Parameters
        ----------
        spec : NetworkSpec
        others : tuple of ndarray
            Inputs of the network for other people's samples, and their labels.
        recordings : Recordings
            Recordings of several known writers, with every class from each writer.
        plan : Plan
        advance : callable, optional
            Called with 1 after each person.
        tune : callable, optional
            See :attr:`tune`.

        Raises
        ------
        UserError
            Fewer than two writers have enough recordings of each class.
        """
        require_fit(spec, recordings)
        known = _enough(recordings, len(recordings.sensor.classes), max(plan.each))
        if len(known) < 2:
            raise UserError(
                f"{recordings.source.name}: fewer than two known writers with "
                f"{max(plan.each) + 1} recordings of each class; give more, or learn from fewer "
                "(--each)"
            )
        responder, people = Responder(spec, plan.seed), {}
        for who in known:
            mine = recordings.part(np.flatnonzero(recordings.writers == who))
            own = responder.responses_to(mine)
            # Only recordings that a draw learns from need altered copies.
            draws = [_drawn(mine.labels, plan, who, draw)[0] for draw in range(plan.draws)]
            some = np.unique(draws)
            altered = responder.copies(mine.part(some), [plan.seed, who])
            copies = np.zeros((len(mine), *altered.shape[1:]))
            copies[some] = altered
            people[who] = Person(own, mine.labels, copies)
            if advance is not None:
                advance(1)
        inputs, labels = others
        others = responder.responses(inputs), labels
        return cls(spec, responder.scale, people, others, plan.seed, tune)

    def measured(self, plan: Plan, method: Method) -> list:
        """Fit the network to each draw of each person.

        Returns
        -------
        list of dict
            For each case ``who``, ``each``, ``draw``, ``before``, ``others_before``, the items that
            the method returns, and its ``seconds`` of processor time.
        """
        old, rows = self.spec.layers[-1].weights, []
        counts = plan.each if method.every else (max(plan.each),)
        for who, person in self.people.items():
            for draw in range(min(plan.draws, method.draws)):
                drawn, test = _drawn(person.labels, plan, who, draw)
                rng = np.random.default_rng([self.seed, who, draw, 1])
                rest = person.responses[test], person.labels[test]
                for count in counts:
                    some = drawn[:, :count].ravel()
                    labels = _mistaken(person.labels[some], method.wrong, rng)
                    training = Person(person.responses[some], labels, person.copies[some])
                    tuned = self.tune and self.tune(who, some, test)
                    case = Case(self.spec, self.scale, training, rest, self.others, draw, tuned)
                    before, others_before = case.accuracies(old)
                    row = {"who": who, "each": count, "draw": draw, "before": before}
                    row |= {"others_before": others_before, "used": 1.0}
                    begun = time.process_time()
                    row |= method.learn(case)
                    rows.append({**row, "seconds": time.process_time() - begun})
        return rows


def measure_adaptation(
    bundle: Bundle, recordings: Recordings, plan: Plan, methods=("readout",), advance=None
) -> dict:
    """Fit a bundle's readout to each person with some recordings, and test it on the others.

    Parameters
    ----------
    bundle : Bundle
    recordings, plan, advance
        As in :meth:`Subjects.of`.
    methods : sequence of str
        Keys of :data:`METHODS`.

    Returns
    -------
    dict
        ``methods``: :func:`summary_of` the cases of each method.
    """
    others = bundle.checks.inputs, bundle.checks.labels
    subjects = Subjects.of(bundle.spec, others, recordings, plan, advance)
    return {
        "schema": SCHEMA,
        "bundle": bundle.id,
        "source": recordings.source.name,
        "source_sha256": recordings.source.sha256,
        "simulated": recordings.source.simulated,
        "seed": plan.seed,
        "methods": {name: summary_of(subjects.measured(plan, METHODS[name])) for name in methods},
    }


def _enough(recordings, classes, most):
    """Writers who have enough recordings of each class for training and testing."""
    writers, labels = recordings.writers, recordings.labels
    return [
        int(who)
        for who in np.unique(writers[writers >= 0])
        if np.bincount(labels[writers == who], minlength=classes).min() > most
    ]


def _drawn(labels, plan, who, draw):
    """Indices of the training recordings, shape (classes, most), and of the test recordings."""
    rng, most = np.random.default_rng([plan.seed, who, draw]), max(plan.each)
    order = [rng.permutation(np.flatnonzero(labels == label)) for label in np.unique(labels)]
    training = np.array([mine[:most] for mine in order])
    return training, np.concatenate([mine[most:] for mine in order])


def _mistaken(labels, wrong, rng):
    """Labels with a share of them replaced by those of other classes."""
    labels, classes = labels.copy(), labels.max() + 1
    some = rng.permutation(len(labels))[: round(wrong * len(labels))]
    labels[some] = (labels[some] + rng.integers(1, classes, len(some))) % classes
    return labels


def summary_of(rows) -> dict:
    """Means over people of the rows of :meth:`Subjects.measured`.

    Returns
    -------
    dict
        ``people``, ``draws``, ``before`` and its ``lowest`` and ``highest`` person, and ``each``:
        for each number of recordings the mean accuracies ``before``, ``after`` and ``exact``,
        ``gain_points`` with its ``interval95``, the ``worst`` person's gain, the points ``lost`` on
        others, the share of cases in which the network was changed (``used``), and the mean
        ``seconds``.
    """
    tables = {}
    for count in sorted({row["each"] for row in rows}):
        people = {}
        for row in rows:
            if row["each"] == count:
                people.setdefault(row["who"], []).append(row)
        tables[count] = {
            name: np.array([np.mean([row[name] for row in mine]) for mine in people.values()])
            for name in ("before", "after", "exact", "others_before", "others_after", "used",
                         "seconds")
        }  # fmt: skip
    before = next(iter(tables.values()))["before"]
    return {
        "people": len(before),
        "draws": 1 + max(row["draw"] for row in rows),
        "before": float(before.mean()),
        "before_interval95": interval(before),
        "lowest": float(before.min()),
        "highest": float(before.max()),
        "each": {str(count): _gain(table) for count, table in tables.items()},
    }


def _gain(table):
    gain = 100 * (table["after"] - table["before"])
    means = {name: float(values.mean()) for name, values in table.items()}
    return {
        **{name: means[name] for name in ("before", "after", "exact")},
        "after_interval95": interval(table["after"]),
        "gain_points": float(gain.mean()),
        "interval95": interval(gain),
        "worst": float(gain.min()),
        "lost": float(100 * (table["others_before"] - table["others_after"]).mean()),
        "used": means["used"],
        "seconds": means["seconds"],
    }


def interval(values) -> list:
    """95 % confidence interval of a mean over people (Student's t)."""
    from scipy import stats

    middle, n = float(np.mean(values)), len(values)
    half = stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / np.sqrt(n)
    return [float(middle - half), float(middle + half)]


def adaptation_text(measured: dict) -> str:
    """The result of :func:`measure_adaptation` as tables."""
    kind = "simulated " if measured["simulated"] else ""
    return f"{methods_text(measured)}\n{kind}recordings of {measured['source']}"


def methods_text(measured: dict) -> str:
    """The summaries of several methods as tables."""
    lines = []
    for method, found in measured["methods"].items():
        low, high = found["before_interval95"]
        lines += [
            f"{METHODS[method].title}: {found['people']} people, {found['draws']} draws each; "
            f"before {found['before']:.3f} ({low:.3f} to {high:.3f}; by person "
            f"{found['lowest']:.3f} to {found['highest']:.3f})",
            *aligned(_rows(found)),
            "",
        ]
    return "\n".join([*lines, "intervals over people; gain, worst and lost in points"])


def _rows(summary):
    rows = [["each class", "before", "after", "gain", "95 %", "worst", "lost", "used"]]
    for count, row in summary["each"].items():
        low, high = row["interval95"]
        rows.append(
            [
                count, f"{row['before']:.3f}", f"{row['after']:.3f}", f"{row['gain_points']:+.1f}",
                f"{low:+.1f} to {high:+.1f}", f"{row['worst']:+.1f}", f"{row['lost']:.1f}",
                f"{row['used']:.0%}",
            ]
        )  # fmt: skip
    return rows
