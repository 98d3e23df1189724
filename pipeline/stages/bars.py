"""The progress bars of the commands on a run, in order, so that each bar can say "2 of 4"."""

from __future__ import annotations

from pipeline.roads.answers import LADDER_ONLY, REFERENCES
from pipeline.settings import SIMULATED, Settings
from pipeline.stages.training import ARTIFACTS


def bars(settings: Settings, until: str) -> list:
    """The bars of a command, if nothing is up to date.

    Parameters
    ----------
    settings : Settings
    until : str
        How far the command goes: ``"train"``, ``"bundle"``, ``"convert"`` or ``"ladder"``.

    Returns
    -------
    list of str
        The first words of each bar's label, for :func:`pipeline.progress.stages`.
    """
    kind = settings.network
    recordings = ["simulate" if settings.data.source == SIMULATED else "import"]
    checks = {
        "convert": [f"check {stage}" for stage in REFERENCES[kind] if stage not in LADDER_ONLY],
        "ladder": ["check", *([] if kind == "nir" else ["compare layers"])],
    }
    training = [
        "simulate nir" if name == "nir" else f"train {name}"
        for name in ARTIFACTS[kind]
        if name != "threshold"
    ]
    if until == "train":
        training = training[:1]
    return [*recordings, *training, *checks.get(until, ())]
