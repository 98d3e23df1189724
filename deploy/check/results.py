"""The result of a check, and its file, ``checks/<target>.json``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Dict, List, Optional, Union

from ..errors import UserError
from ..files import read_json, write_json
from ..loading import (
    Limit,
    WrongValue,
    between,
    dump_dataclass,
    limited_field,
    list_names_in_file,
    load_dataclass,
    named_field,
)

SCHEMA = "stmnist-check/1"

COUNT = between(0, 2**53)
SHARE = between(0, 1)
INTERVAL = Limit(
    lambda pair: len(pair) == 2 and all(map(SHARE.holds, pair)), "two numbers from 0 to 1"
)
SHARES_OF_1 = Limit(lambda values: all(map(SHARE.holds, values)), "numbers from 0 to 1")
COUNTS = Limit(lambda counts: all(n >= 0 for n in counts.values()), "counts of at least 0")


@dataclass(frozen=True)
class SampleResult:
    """The response to a sample.

    Attributes
    ----------
    id : str
    label, prediction : int
        Classes, from 0.
    scores : list of float
        Of each class.
    stopped_at : int or None
        Steps until the decision; None without a confidence for early decisions.
    spike_hash : str or None
        Hash of all spikes; None for targets that do not record single spikes.
    """

    id: str
    label: int = limited_field(COUNT)
    prediction: int = limited_field(COUNT)
    scores: List[float]
    stopped_at: Optional[int] = limited_field(COUNT, None)
    spike_hash: Optional[str] = None

    @property
    def is_right(self) -> bool:
        """True if the prediction is the label."""
        return self.prediction == self.label


@dataclass(frozen=True)
class EarlyDecisions:
    """The network's own decisions, which it makes before a recording ends.

    Attributes
    ----------
    confidence : float
        The threshold of decisions.
    accuracy : float
    accuracy_ci95 : list of float
        Wilson's interval.
    share_of_writing_mean : float
        Mean share of the recording until the decision.
    before_the_end : float
        Share of the samples that are decided before their end.
    """

    confidence: float = limited_field(SHARE)
    accuracy: float = limited_field(SHARE)
    accuracy_ci95: List[float] = limited_field(INTERVAL)
    share_of_writing_mean: float = limited_field(SHARE)
    before_the_end: float = limited_field(SHARE)

    @property
    def are_possible(self) -> bool:
        """False if no confidence is high enough, so that each decision is made at the end."""
        return self.confidence < 1


@dataclass(frozen=True)
class WhileWritten:
    """The accuracy while the samples are being written; of networks on events only.

    Attributes
    ----------
    step_ms : float
    written_steps_mean : float
        Mean number of steps until a sample's last event.
    shares : list of float
        Shares of the writing time.
    accuracy : list of float
        The accuracy at each of the shares.
    early : EarlyDecisions or None
    """

    step_ms: float
    written_steps_mean: float
    shares: List[float] = limited_field(SHARES_OF_1)
    accuracy: List[float] = limited_field(SHARES_OF_1)
    early: Optional[EarlyDecisions] = named_field("by_itself", None)

    def __post_init__(self):
        if not len(self.shares) == len(self.accuracy) > 0:
            raise WrongValue("accuracy", "must be as long as 'shares'")


@dataclass(frozen=True)
class PresentedRecordings:
    """The recordings that were presented, if they are not those of the bundle.

    Attributes
    ----------
    source : str
    sha256 : str
    recordings : int
        Number of recordings in the source.
    trained_on : int or None
        Number of the samples that were used to make the network.
    warnings : list of str
    """

    source: str
    sha256: str
    recordings: int = limited_field(COUNT)
    trained_on: Optional[int] = limited_field(COUNT, None)
    warnings: Optional[List[str]] = None


@dataclass(frozen=True)
class SubsetAccuracy:
    """The accuracy on the samples of a class, or of a writer.

    Attributes
    ----------
    n : int
        Number of samples.
    accuracy : float
    accuracy_ci95 : list of float
        Wilson's interval.
    class_name : str or None
    writer : int or None
    """

    n: int = limited_field(COUNT)
    accuracy: float = limited_field(SHARE)
    accuracy_ci95: List[float] = limited_field(INTERVAL)
    class_name: Optional[str] = named_field("class", None)
    writer: Optional[int] = None


@dataclass(frozen=True)
class CheckResult:
    """The result of a check of a target or reference stage.

    ``result["accuracy"]`` is the entry of the file with this name.

    Attributes
    ----------
    target : str
        Name of the target or stage.
    bundle_id : str
    seed : int or None
        Seed of the simulator.
    simulated : bool or None
        True if the samples are simulated, None if that is unknown.
    steps_per_sample, n_samples : int
    classes_without_samples : list of str or None
    accuracy : float
    accuracy_ci95 : list of float
        Wilson's interval.
    anytime_accuracy : list of float
        The accuracy of the decisions at each step.
    while_written : WhileWritten or None
    samples : list of SampleResult
    spikes, synaptic_operations : dict of str to int
        Of each layer, of all samples together.
    multiply_accumulates : dict of str to int
        Of each layer of a network of this architecture without spikes, for one sample.
    wall_seconds : float
        Time spent on the samples.
    versions : dict of str to str
        Of the software.
    target_notes : dict
        Further entries of the file, which the target itself adds, such as the board.
    options : dict or None
        Options of the target that change its outputs, where they differ from the defaults.
    samples_unlike_fast : int or None
        Number of samples whose spikes differ from those of ``fast``; of boards only.
    network : str or None
        Key of a stage's own network, from which the bundle was not made.
    trained_on : int or None
        Number of the bundle's samples to which an adapted network was fitted.
    data : PresentedRecordings or None
        This and the next four are of a check on other recordings.
    classes : list of str or None
    confusion : list of list of int or None
        Number of samples by label (row) and prediction (column).
    per_class, per_writer : list of SubsetAccuracy or None
    fault : dict or None
        Numbers of faulty taxels in each sample.
    """

    target: str
    bundle_id: str = named_field("bundle")
    seed: int
    simulated: Optional[bool]
    steps_per_sample: int = limited_field(COUNT)
    n_samples: int = limited_field(COUNT)
    accuracy: float = limited_field(SHARE)
    accuracy_ci95: List[float] = limited_field(INTERVAL)
    anytime_accuracy: List[float] = limited_field(SHARES_OF_1)
    samples: List[SampleResult] = limited_field(Limit(len, "a sample or more"))
    spikes: Dict[str, int] = limited_field(COUNTS)
    synaptic_operations: Dict[str, int] = limited_field(COUNTS)
    wall_seconds: float = limited_field(COUNT)
    versions: Dict[str, str]
    classes_without_samples: Optional[List[str]] = None
    while_written: Optional[WhileWritten] = None
    multiply_accumulates: Dict[str, int] = field(default_factory=dict)
    target_notes: dict = field(default_factory=dict)
    options: Optional[dict] = None
    samples_unlike_fast: Optional[int] = limited_field(COUNT, None)
    network: Optional[str] = None
    trained_on: Optional[int] = limited_field(COUNT, None)
    data: Optional[PresentedRecordings] = None
    classes: Optional[List[str]] = None
    confusion: Optional[List[List[int]]] = None
    per_class: Optional[List[SubsetAccuracy]] = None
    per_writer: Optional[List[SubsetAccuracy]] = None
    fault: Optional[dict] = None

    def __getitem__(self, name: str):
        return self.to_dict()[name]

    @property
    def n_right(self) -> int:
        """Number of samples whose prediction is their label."""
        return sum(sample.is_right for sample in self.samples)

    @property
    def is_consistent(self) -> bool:
        """True if the samples agree with each other and with the accuracy."""
        samples = self.samples
        return (
            len(samples) == self.n_samples
            and len({sample.id for sample in samples}) == len(samples)
            and len({len(sample.scores) for sample in samples}) == 1
            and all(max(each.label, each.prediction) < len(each.scores) for each in samples)
            and abs(self.n_right / len(samples) - self.accuracy) < 1e-9
        )

    @property
    def early_decisions(self) -> Optional[EarlyDecisions]:
        """The network's decisions before the end of a recording; None if it makes none."""
        early = self.while_written and self.while_written.early
        return early if early and early.are_possible else None

    def to_dict(self) -> dict:
        """The result as plain values, as in its file."""
        values = {"schema": SCHEMA, **dump_dataclass(self)}
        notes = values.pop("target_notes")
        return {**values, **notes}

    @classmethod
    def from_dict(cls, values: dict) -> CheckResult:
        """Make a result of plain values.

        Raises
        ------
        deploy.loading.WrongValue
            A value is missing, of another type or beyond its limit.
        """
        result = load_dataclass(cls, values, ignore_extra=True)
        own_names = {"schema", *list_names_in_file(cls)}
        notes = {name: value for name, value in values.items() if name not in own_names}
        return replace(result, target_notes=notes)


def to_result(value: Union[CheckResult, dict]) -> CheckResult:
    """A result as it is, or made of its plain values.

    Raises
    ------
    UserError
        The values are not those of a result.
    """
    if isinstance(value, CheckResult):
        return value
    try:
        return CheckResult.from_dict(value)
    except WrongValue as error:
        raise UserError(f"not a complete check result ({error}); run the check again") from error


def read_result(path, remedy: str = "run the check again") -> CheckResult:
    """Read a result.

    Parameters
    ----------
    path : path-like
    remedy : str
        The user's remedy for a missing or damaged file, at the end of the error message.

    Raises
    ------
    UserError
        The file is missing, damaged, of another schema, or inconsistent.
    """
    values = read_json(path, remedy)
    if values.get("schema") != SCHEMA:
        raise UserError(
            f"{path}: schema {values.get('schema')!r}, but this version reads {SCHEMA!r}; {remedy}"
        )
    try:
        result = CheckResult.from_dict(values)
    except WrongValue as error:
        raise UserError(f"{path}: not a complete check result ({error}); {remedy}") from error
    if not result.is_consistent:
        raise UserError(f"{path}: its samples contradict each other or its accuracy; {remedy}")
    return result


def write_result(path, result: CheckResult):
    """Write a result, completely or not at all."""
    write_json(path, result.to_dict())
