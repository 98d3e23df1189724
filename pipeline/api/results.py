"""Results of a run: attributes, plain values, one line, and a table for notebooks.

Each result prints as the command of the same name does: ``print(run.ladder())``.
"""

from __future__ import annotations

import html
from numbers import Integral
from typing import Any

import numpy as np

from deploy.check import results as check_results
from deploy.check.energy import EnergyEstimate, format_estimate, format_joules
from deploy.check.text import format_result, format_result_on_others
from deploy.preflight.plan import Plan, format_plan
from deploy.tables import align_rows, format_count
from pipeline.results.compare import format_runs
from pipeline.results.ladder import format_ladder
from pipeline.results.ladder_result import LadderResult, LadderRow

# Maximum number of rows of a table in a notebook.
MAX_TABLE_ROWS = 50


class Result:
    """Base class of results.

    Attributes
    ----------
    values : dict
        Plain values, as the command's ``--json``.
    """

    def __init__(self, values: dict):
        self.values = values

    def to_dict(self) -> dict:
        """The result as plain values, for JSON."""
        return self.values

    def __repr__(self):
        return f"{type(self).__name__}({self.format_line()})"

    def format_line(self) -> str:
        """The result in a few words."""
        raise NotImplementedError

    def make_table(self) -> list:
        """Rows of values for a notebook, the heads first."""
        raise NotImplementedError

    def _repr_html_(self):
        heads, *rows = self.make_table()
        lines = [_make_row(heads, "th"), *(_make_row(row, "td") for row in rows[:MAX_TABLE_ROWS])]
        left_out = len(rows) - MAX_TABLE_ROWS
        note_on_more = f"<p>and {left_out} more rows</p>" if left_out > 0 else ""
        title = html.escape(self.format_line())
        return f"<p>{title}</p><table>{''.join(lines)}</table>{note_on_more}"


def _make_row(cells, tag):
    texts = ("" if cell is None else html.escape(str(cell)) for cell in cells)
    return "<tr>" + "".join(f"<{tag}>{text}</{tag}>" for text in texts) + "</tr>"


def _format_interval(bounds):
    low, high = bounds
    return f"{low:.3f} to {high:.3f}"


class Ladder(Result):
    """The loss ladder: ``ladder["emulator"].accuracy``.

    Attributes
    ----------
    rows : list of pipeline.results.ladder_result.LadderRow
    """

    def __init__(self, result: LadderResult):
        super().__init__(result.to_dict())
        self._result = result
        self.rows = result.rows

    def __getitem__(self, stage: str) -> LadderRow:
        for row in self.rows:
            if row.stage == stage:
                return row
        raise KeyError(f"no stage {stage!r}; the stages are {', '.join(self)}")

    def __iter__(self):
        return (row.stage for row in self.rows)

    def __len__(self):
        return len(self.rows)

    def __str__(self):
        return format_ladder(self._result)

    def format_line(self) -> str:
        """See :meth:`Result.format_line`."""
        return ", ".join(f"{row.stage} {row.accuracy:.3f}" for row in self.rows)

    def make_table(self) -> list:
        """See :meth:`Result.make_table`."""
        rows: list[list] = [
            ["stage", "accuracy", "95 % interval", "change", "disagree", "McNemar p"]
        ]
        for row in self.rows:
            change = None if row.change is None else f"{row.change:+.3f}"
            p = None if row.mcnemar_p is None else f"{row.mcnemar_p:.3f}"
            interval = _format_interval(row.accuracy_ci95)
            rows.append([row.stage, f"{row.accuracy:.3f}", interval, change, row.disagreements, p])
        return rows


class CheckResult(Result):
    """The predictions of a stage or target.

    Attributes
    ----------
    target : str
    accuracy : float
    accuracy_ci95 : list of float
    ids : list of str
    labels, predictions : ndarray of int, shape (n_samples,)
        Classes, from 0.
    classes : tuple of str
        Names of the classes.
    spikes, synaptic_operations : dict of str to int
        Of each layer, of all samples.
    """

    def __init__(self, result: check_results.CheckResult, classes: tuple):
        super().__init__(result.to_dict())
        self._result = result
        self.target = result.target
        self.accuracy = result.accuracy
        self.accuracy_ci95 = result.accuracy_ci95
        self.ids = [sample.id for sample in result.samples]
        self.labels = np.array([sample.label for sample in result.samples])
        self.predictions = np.array([sample.prediction for sample in result.samples])
        self.classes = classes
        self.spikes = result.spikes
        self.synaptic_operations = result.synaptic_operations

    def __len__(self):
        return len(self.ids)

    def __str__(self):
        if self._result.data is not None:
            return format_result_on_others(self._result)
        return format_result(self._result)

    @property
    def confusion(self) -> np.ndarray:
        """Number of samples by label (row) and prediction (column)."""
        counts = np.zeros((len(self.classes), len(self.classes)), int)
        np.add.at(counts, (self.labels, self.predictions), 1)
        return counts

    def format_line(self) -> str:
        """See :meth:`Result.format_line`."""
        interval = _format_interval(self.accuracy_ci95)
        return f"{self.target}: {self.accuracy:.3f} ({interval}) on {len(self)} samples"

    def make_table(self) -> list:
        """See :meth:`Result.make_table`."""
        rows: list[list] = [["class", "samples", "right", "accuracy"]]
        for label, name in enumerate(self.classes):
            of_class = self.labels == label
            if of_class.any():
                right = self.predictions[of_class] == label
                rows.append([name, int(of_class.sum()), int(right.sum()), f"{right.mean():.3f}"])
        return rows


class Predictions(Result):
    """Predictions for recordings: ``predictions["today/000"]`` is the name of a class.

    So is ``predictions[0]``, that of the first recording.

    Parameters
    ----------
    predictions : list of pipeline.results.other_recordings.Prediction
    classes : sequence of str
        Names of the network's classes, in the order of its outputs.

    Attributes
    ----------
    ids : list of str
    names : list of str
        Name of the predicted class of each recording, in the order of the recordings.
    probabilities : list of (float or None)
        Estimated probability of each that the class is right, or the softmax of the outputs if the
        network has no confidence estimator; None where no spike has reached the readout.
    classes : tuple of str
        Names of the network's classes.
    class_probabilities : ndarray of float, shape (n_recordings, n_classes)
        Probability of each of the ``classes``; a row has the sum 1, and is NaN where no spike has
        reached the readout.

    Examples
    --------
    >>> p = run.predict(recordings)
    >>> p.classes
    ('left', 'right')
    >>> p.class_probabilities.round(2)
    array([[0.97, 0.03],
           [0.08, 0.92]])
    >>> p.names
    ['left', 'right']
    """

    def __init__(self, predictions, classes):
        rows = [
            {
                "recording": each.recording,
                "class": each.label,
                "probability": each.probability,
                "class_probabilities": each.class_probabilities,
            }
            for each in predictions
        ]
        super().__init__({"predictions": rows})
        self.classes = tuple(classes)
        self.class_probabilities = np.full((len(rows), len(self.classes)), np.nan)
        for row, by_class in zip(self.class_probabilities, rows, strict=True):
            if by_class["class_probabilities"] is not None:
                row[:] = list(by_class["class_probabilities"].values())
        self.ids = [row["recording"] for row in rows]
        self.names = [row["class"] for row in rows]
        self.probabilities = [row["probability"] for row in rows]
        self._name_of = dict(zip(self.ids, self.names, strict=True))

    def __getitem__(self, recording: str | int) -> str:
        """Name of the predicted class of a recording, given by its id or its index."""
        if isinstance(recording, Integral):
            return self.names[recording]
        if recording not in self._name_of:
            raise KeyError(f"no recording {recording!r}; ids are like {self.ids[0]!r}")
        return self._name_of[recording]

    def __iter__(self):
        return iter(self.ids)

    def __len__(self):
        return len(self.ids)

    def __str__(self):
        return "\n".join(align_rows(self.make_table()))

    def format_line(self) -> str:
        """See :meth:`Result.format_line`."""
        counts = {name: self.names.count(name) for name in sorted(set(self.names))}
        return f"{len(self)}: " + ", ".join(f"{n} x {name}" for name, n in counts.items())

    def make_table(self) -> list:
        """See :meth:`Result.make_table`."""
        rows = [["recording", "class", "probability"]]
        for name, label, probability in zip(self.ids, self.names, self.probabilities, strict=True):
            rows.append([name, label, "-" if probability is None else f"{probability:.3f}"])
        return rows


class Training(Result):
    """Trained networks: ``training["cnn"]["accuracy"]["test"]``.

    Attributes
    ----------
    networks : dict of str to dict
        Record of each network: ``accuracy`` on each set of the split, ``epochs``, ``seconds``.
    """

    def __init__(self, values: dict):
        super().__init__(values)
        self.networks = values

    def __getitem__(self, name: str) -> dict:
        return self.networks[name]

    def format_line(self) -> str:
        """See :meth:`Result.format_line`."""
        return ", ".join(
            f"{name} {_list_accuracies(record)}" for name, record in self.networks.items()
        )

    def make_table(self) -> list:
        """See :meth:`Result.make_table`."""
        rows: list[list] = [["network", "accuracy", "epochs", "seconds"]]
        for name, record in self.networks.items():
            seconds = record.get("seconds")
            seconds = None if seconds is None else f"{seconds:.0f}"
            rows.append([name, _list_accuracies(record), record.get("epochs"), seconds])
        return rows


def _list_accuracies(record):
    accuracies = record.get("accuracy")
    if not isinstance(accuracies, dict):
        return "trained"
    measured = {name: value for name, value in accuracies.items() if value is not None}
    return ", ".join(f"{value:.3f} ({name})" for name, value in measured.items())


class ChipPlan(Result):
    """The resources of the chip that a network needs.

    Attributes
    ----------
    fits : bool
    chips : int
    cores : int
    problems, warnings : list of str
    """

    def __init__(self, plan: Plan):
        super().__init__(plan.to_json())
        self._plan = plan
        self.fits = not plan.problems
        self.chips = plan.chips
        self.cores = len(plan.cores)
        self.problems = plan.problems
        self.warnings = plan.warnings

    def __str__(self):
        return format_plan(self._plan)

    def format_line(self) -> str:
        """See :meth:`Result.format_line`."""
        size = f"{format_count(self.cores, 'core')} of {format_count(self.chips, 'chip')}"
        return f"{size}, fits" if self.fits else f"{size}, does not fit: {self.problems[0]}"

    def make_table(self) -> list:
        """See :meth:`Result.make_table`."""
        limits = self._plan.chip.limits
        rows: list[list] = [["layer", "chip", "core", *limits]]
        for core in self._plan.cores:
            used = [f"{core.used[name]} of {limit}" for name, limit in limits.items()]
            rows.append([core.layer, core.chip, core.core, *used])
        return rows


class Energy(Result):
    """An estimate of the energy of an inference, from published constants."""

    def __init__(self, estimate: EnergyEstimate):
        super().__init__(estimate.to_json())
        self.estimate = estimate

    def __str__(self):
        return format_estimate(self.estimate)

    def format_line(self) -> str:
        """See :meth:`Result.format_line`."""
        return f"{format_joules(self.estimate.chip_joules)} on Loihi, an estimate"

    def make_table(self) -> list:
        """See :meth:`Result.make_table`."""
        return [["estimate"], *([line] for line in str(self).splitlines())]


class RunsComparison(Result):
    """Runs side by side; see :func:`pipeline.api.run.compare_runs`."""

    def __init__(self, values: dict[str, Any]):
        super().__init__(values)

    def __str__(self):
        return format_runs(self.values)

    def format_line(self) -> str:
        """See :meth:`Result.format_line`."""
        return ", ".join(run["name"] for run in self.values["runs"])

    def make_table(self) -> list:
        """See :meth:`Result.make_table`."""
        return [[""], *([line] for line in str(self).splitlines())]
