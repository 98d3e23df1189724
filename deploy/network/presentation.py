"""The presentation of samples to a network, and its readout."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Optional

from .. import limits
from ..loading import Limit, WrongValue, between, limited_field, require_valid


@dataclass(frozen=True)
class Presentation:
    """The presentation and the readout of samples; every target follows it step by step.

    Samples are presented in streams.  A stream starts from a fresh network; each sample follows
    ``gap`` silent steps and is presented for ``steps`` steps.  The network is not reset between
    samples, because a board cannot be.  The gap comes first, so that the first sample of a stream,
    too, starts with a network at rest under its bias currents.

    Attributes
    ----------
    steps : int
        Steps for which a sample is presented.
    gap : int
        Silent steps before each sample.
    readout_start : int
        Steps at the start of each sample that the readout ignores.
    stream_length : int
        Samples per stream; 1 means that every sample starts from a fresh network.
    threshold : float or None
        Confidence at which the network decides early, see :mod:`deploy.network.decision`; None for
        a decision at the end.  In files its name is ``confidence``.

    Raises
    ------
    ValueError
        A number is out of range; the message names the setting.
    """

    steps: int = limited_field(between(1, limits.STEPS), 100)
    gap: int = limited_field(between(0, limits.STEPS), 20)
    readout_start: int = limited_field(between(0, limits.STEPS), 20)
    stream_length: int = limited_field(between(1, limits.SAMPLES), 10)
    threshold: Optional[float] = limited_field(
        Limit(lambda value: 0 < value <= 1, "above 0, at most 1"), None, name_in_file="confidence"
    )

    @property
    def threshold_or_1(self) -> float:
        """The threshold; without one 1, which no confidence reaches."""
        return 1.0 if self.threshold is None else self.threshold

    @property
    def period(self) -> int:
        """Steps from one sample to the next, including the gap."""
        return self.gap + self.steps

    def to_json(self) -> dict:
        """The values by their names in files."""
        values = asdict(self)
        values["confidence"] = values.pop("threshold")
        return values

    def list_streams(self, n_samples: int) -> list:
        """Cut samples 0 to n_samples - 1 into streams, as slices in order."""
        return [
            slice(start, min(start + self.stream_length, n_samples))
            for start in range(0, n_samples, self.stream_length)
        ]

    def __post_init__(self):
        require_valid(self)
        if self.readout_start >= self.steps:
            raise WrongValue(
                "readout_start", f"must be from 0 to below presentation.steps ({self.steps})"
            )
