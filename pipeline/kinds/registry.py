"""The registered kinds of networks: which of them a run has, and what all of them have.

No other module asks which kind a network is.
"""

from pathlib import Path

from pipeline.kinds.events.kind import EventsKind
from pipeline.kinds.image.kind import ImageKind
from pipeline.kinds.kind import NetworkKind
from pipeline.kinds.nir.kind import NirKind
from pipeline.settings import INPUTS, Settings

# The first of them that the settings select is the kind of a run.
KINDS: list[type[NetworkKind]] = [NirKind, EventsKind, ImageKind]


def register_kind(kind: type[NetworkKind], samples: str = "images"):
    """Add a kind of network of another package.

    Parameters
    ----------
    kind : type
        ``--input`` selects it by its :attr:`NetworkKind.input_kinds`.
    samples : str
        What its network gets of each recording: ``"images"`` or ``"frames"`` of events.

    Raises
    ------
    ValueError
        There is a kind of this name, or one that ``--input`` selects by the same value.
    """
    if kind.name in {other.name for other in KINDS} or {*kind.input_kinds} & {*INPUTS}:
        raise ValueError(f"kind {kind.name!r}: there is one of this name, or for the same --input")
    KINDS.insert(0, kind)
    INPUTS.update(dict.fromkeys(kind.input_kinds, samples))


def list_references() -> dict:
    """The :class:`pipeline.kinds.reference.Reference` stages of all kinds by their names."""
    return {name: stage for kind in KINDS for name, stage in kind.references.items()}


def list_trained_stages() -> tuple:
    """The reference stages whose networks become bundles; conversion causes all later losses."""
    return tuple(kind.deployed_stage for kind in KINDS)


def list_compared_stages() -> tuple:
    """The stages that a deployed network is compared with: the first of them that there is."""
    return tuple(stage for kind in KINDS for stage in (*kind.compared_stages, kind.deployed_stage))


def find_compared_stage(stages) -> str:
    """The stage that the deployed network is compared with, and from which losses are stated.

    Parameters
    ----------
    stages : sequence of str
        Stages in the order of the ladder.
    """
    return next((stage for stage in list_compared_stages() if stage in stages), next(iter(stages)))


def find_kind(settings: Settings) -> NetworkKind:
    """The kind of a run's network; the only place that decides it."""
    return next(kind for kind in KINDS if kind.is_selected_by(settings))(settings)


def has_networks(settings: Settings, folder: Path) -> bool:
    """True if the folder of a run with these settings has a network for the bundle."""
    kind = find_kind(settings)
    steps = [step for step in kind.steps if kind.is_deployed(step.name)]
    return any((folder / step.folder / step.files[0]).exists() for step in steps)
