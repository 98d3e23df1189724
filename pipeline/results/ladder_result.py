"""The values of the loss ladder, as they are stored in ``ladder.json``."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from deploy.check.results import WhileWritten
from deploy.loading import dump_dataclass, load_dataclass

SCHEMA = "stmnist-ladder/1"


@dataclass(frozen=True)
class LadderRow:
    """A stage of the ladder.

    Attributes
    ----------
    stage : str
    accuracy : float
    accuracy_ci95 : tuple of float
        Wilson's interval.
    change : float or None
        Change of the accuracy from the row above.  This and the next two are None in the first row
        and in the row below ``counts``.
    disagreements : int or None
        Number of samples with another prediction than in the row above.
    mcnemar_p : float or None
        McNemar's exact test of the change.
    """

    stage: str
    accuracy: float
    accuracy_ci95: tuple[float, float]
    change: float | None = None
    disagreements: int | None = None
    mcnemar_p: float | None = None

    def to_dict(self) -> dict:
        """The row as plain values."""
        return {**asdict(self), "accuracy_ci95": list(self.accuracy_ci95)}


@dataclass(frozen=True)
class AccuracyChange:
    """The change of the accuracy from a reference to the deployed network.

    Attributes
    ----------
    difference : float
        Negative for a loss.
    mcnemar_p : float
    """

    difference: float
    mcnemar_p: float


@dataclass(frozen=True, kw_only=True)
class LadderResult:
    """The loss ladder of a bundle; values with a default are missing from older files.

    Attributes
    ----------
    bundle : str
        Id of the bundle.
    simulated : bool or None
        True if the samples are simulated.
    n_samples : int
    classes : list of str
        Class names in the order of the scores.
    classes_without_samples : list of str or None
    rows : list of LadderRow
    last_against_trained_p : float or None
        McNemar's test of the deployed network against the trained one; None without a trained one.
    against_reference, against_counts : AccuracyChange or None
        The deployed network against the reference stage and against ``counts``; None if there is no
        such stage, or if it is the deployed network itself.
    while_written : WhileWritten or None
        Accuracy during the recordings.
    remedy : str
        What to try if the network is less accurate than ``counts``.
    layers : list of dict or None
        From :func:`pipeline.kinds.diagnosis.compare_rates`.
    least_faithful_layer : str or None
    made_from : dict or None
        What a stored ladder was made from.
    """

    bundle: str
    simulated: bool | None
    n_samples: int
    classes: list[str]
    classes_without_samples: list[str] | None = None
    rows: list[LadderRow]
    last_against_trained_p: float | None = 0.0
    against_reference: AccuracyChange | None
    against_counts: AccuracyChange | None
    while_written: WhileWritten | None = None
    remedy: str = ""
    layers: list[dict] | None
    least_faithful_layer: str | None
    made_from: dict | None = None

    def to_dict(self) -> dict:
        """The ladder as plain values, for JSON."""
        values = {"schema": SCHEMA, **asdict(self), "rows": [row.to_dict() for row in self.rows]}
        if self.while_written is not None:
            values["while_written"] = dump_dataclass(self.while_written)
        made_from = values.pop("made_from")
        return values if made_from is None else {"made_from": made_from, **values}

    @classmethod
    def from_dict(cls, values: dict) -> LadderResult:
        """Make a ladder of plain values; others than those of the ladder are ignored.

        Raises
        ------
        deploy.loading.WrongValue
            A value is missing or of another type.
        """
        return load_dataclass(cls, values, ignore_extra=True)
