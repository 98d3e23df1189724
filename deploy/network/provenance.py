"""What a deployed network knows of the recordings it was made with: entries of its provenance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Optional

import numpy as np

if TYPE_CHECKING:
    from .spec import NetworkSpec

# Entry with the hashes of the recordings that a network was trained on or fitted to.
TRAINING_RECORDINGS = "training_recordings"


class NetworkProvenance(dict):
    """Records how a network was made: entries by their names in the bundle.

    Entries that this version does not know stay as they are.

    Attributes
    ----------
    simulated : bool or None
        True if the recordings are simulated.
    source, source_sha256 : str or None
        Name and hash of the recordings.
    polarities : int
        2 for ON and OFF events, 1 for ON events only.
    time_unit : str or None
        Unit of the times in files of the recordings.
    image : dict or None
        Section of the settings by which recordings become images.
    seed : int
        Seed of the run.
    settings : dict
        Settings that the network was made with, by their dotted names.
    warnings : list of str
        What is wrong with the recordings.
    adapted : dict or None
        The person to whom the readout was fitted.
    """

    @property
    def simulated(self):
        return self.get("simulated")

    @property
    def source(self):
        return self.get("source")

    @property
    def source_sha256(self):
        return self.get("source_sha256")

    @property
    def polarities(self):
        return self.get("polarities", 2)

    @property
    def time_unit(self):
        return self.get("time_unit")

    @property
    def image(self):
        return self.get("image")

    @property
    def seed(self):
        return self.get("seed", 0)

    @property
    def settings(self):
        return self["made_from"]["settings"]

    @property
    def warnings(self):
        return self.get("warnings", [])

    @property
    def adapted(self):
        return self.get("adapted")


def read_classes(spec: NetworkSpec) -> tuple:
    """Names of the classes of a network; numbers for one without names."""
    return tuple(map(str, spec.provenance.get("classes") or range(spec.layers[-1].size)))


def read_positions(spec: NetworkSpec) -> Optional[np.ndarray]:
    """Where a network's taxels are on the sensor.

    Returns
    -------
    ndarray of float, shape (n_taxels, 2), or None
        To the right and down; the larger extent is 1, the origin is the upper left corner.  None if
        the positions are not known.
    """
    stored = spec.provenance.get("positions")
    if stored is None:
        return None
    positions = np.asarray(stored, float)
    positions = positions - positions.min(axis=0)
    return positions / (positions.max() or 1.0)


def read_training_hashes(spec: NetworkSpec) -> set:
    """Hashes of the recordings that a network was trained on or fitted to, if they are known."""
    hashes = spec.provenance.get(TRAINING_RECORDINGS)
    return set(map(str, hashes)) if isinstance(hashes, list) else set()
