"""Roads: all that depends on the kind of network, each in one module; see :mod:`.road`."""

from __future__ import annotations

from pipeline.roads.events import EventRoad
from pipeline.roads.image import ImageRoad
from pipeline.roads.nir import NirRoad
from pipeline.roads.road import Road
from pipeline.settings import Settings

ROADS = (ImageRoad, EventRoad, NirRoad)

# Title and note of the reference stages of all roads.
REFERENCES = {stage: texts for road in ROADS for stage, texts in road.references.items()}


# The stages that a deployed network is compared with: the first of them that there is.
COMPARED_WITH = ("cnn-matched", "trained", "nir", "cnn", "rate-lif")


def compared_with(stages) -> str:
    """The stage that the deployed network is compared with, and from which losses are stated.

    Parameters
    ----------
    stages : sequence of str
        Stages in the order of the ladder.
    """
    return next((stage for stage in COMPARED_WITH if stage in stages), next(iter(stages)))


def road_of(settings: Settings) -> Road:
    """The road of a run's network; the only place that decides it."""
    if settings.nir.file:
        return NirRoad(settings)
    return EventRoad(settings) if settings.on_events else ImageRoad(settings)
