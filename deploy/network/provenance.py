"""What a deployed network knows of the recordings it was made with: entries of its provenance."""

from typing import Optional

import numpy as np

from deploy.network.spec import NetworkSpec

# Entry with the hashes of the recordings that a network was trained on or fitted to.
TRAINING_RECORDINGS = "training_recordings"


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
