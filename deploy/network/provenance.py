"""What a deployed network knows of the recordings it was made with: entries of its provenance."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Dict, Optional

import numpy as np

if TYPE_CHECKING:
    from .spec import NetworkSpec

# Entry with the hashes of the recordings that a network was trained on or fitted to.
TRAINING_RECORDINGS = "training_recordings"


@dataclass(frozen=True)
class NetworkProvenance:
    """Records how a network was made.

    Attributes
    ----------
    entries : dict
        By their names in the bundle; those that this version does not know stay as they are.
    """

    entries: Dict[str, Any] = field(default_factory=dict)

    def with_entries(self, **changes) -> NetworkProvenance:
        """The same record with changed and further entries."""
        return NetworkProvenance({**self.entries, **changes})

    @property
    def simulated(self) -> Optional[bool]:
        """True if the recordings are simulated; None if that is unknown."""
        return self.entries.get("simulated")

    @property
    def source(self) -> Optional[str]:
        """Name of the recordings."""
        return self.entries.get("source")

    @property
    def source_sha256(self) -> Optional[str]:
        """Hash of the recordings."""
        return self.entries.get("source_sha256")

    @property
    def classes(self) -> Optional[list]:
        """Names of the classes; :func:`read_classes` also has names for a network without them."""
        return self.entries.get("classes")

    @property
    def polarities(self) -> int:
        """2 for ON and OFF events, 1 for ON events only."""
        return self.entries.get("polarities", 2)

    @property
    def time_unit(self) -> Optional[str]:
        """Unit of the times in files of the recordings."""
        return self.entries.get("time_unit")

    @property
    def image(self) -> Optional[dict]:
        """Section of the settings by which recordings become images."""
        return self.entries.get("image")

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return self.entries.get("seed", 0)

    @property
    def settings(self) -> dict:
        """Settings that the network was made with, by their dotted names."""
        return self.entries["made_from"]["settings"]

    @property
    def warnings(self) -> list:
        """Warnings about the recordings."""
        return self.entries.get("warnings", [])

    @property
    def adapted(self) -> Optional[dict]:
        """The person to whom the readout was fitted."""
        return self.entries.get("adapted")


def read_classes(spec: NetworkSpec) -> tuple:
    """Names of the classes of a network; numbers for one without names."""
    return tuple(map(str, spec.provenance.classes or range(spec.layers[-1].size)))


def read_positions(spec: NetworkSpec) -> Optional[np.ndarray]:
    """Where a network's taxels are on the sensor.

    Returns
    -------
    ndarray of float, shape (n_taxels, 2), or None
        To the right and down; the larger extent is 1, the origin is the upper left corner.  None if
        the positions are not known.
    """
    stored = spec.provenance.entries.get("positions")
    if stored is None:
        return None
    positions = np.asarray(stored, float)
    positions = positions - positions.min(axis=0)
    return positions / (positions.max() or 1.0)


def read_training_hashes(spec: NetworkSpec) -> set:
    """Hashes of the recordings that a network was trained on or fitted to, if they are known."""
    hashes = spec.provenance.entries.get(TRAINING_RECORDINGS)
    return set(map(str, hashes)) if isinstance(hashes, list) else set()
