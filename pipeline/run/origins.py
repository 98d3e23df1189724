"""What each artifact of a run is made from: the one list of dependencies.

Each function gives the :class:`pipeline.artifacts.Origin` of one artifact from the settings and the
origins of the artifacts it uses.  The code that makes the artifact can read no other settings.
"""

from __future__ import annotations

import hashlib
import json

from pipeline.artifacts import Origin
from pipeline.settings import Settings


def cnn_origin(settings: Settings, dataset: Origin) -> Origin:
    """Of the CNN: trained, or read from the user's Keras model."""
    reads = ["input.kind", "image", "cnn.architecture"]
    if settings.cnn.model:
        reads.append("cnn.model_sha256")
    else:
        reads += ["cnn.epochs", "cnn.batch_size", "cnn.learning_rate"]
    return Origin.of(settings, reads, [dataset])


def rates_origin(settings: Settings, cnn: Origin) -> Origin:
    """Of the network with rate-based LIF neurons, which starts from the CNN."""
    return Origin.of(settings, ["snn"], [cnn])


def events_origin(settings: Settings, dataset: Origin) -> Origin:
    """Of the network trained on events, whatever the presentation is."""
    return Origin.of(settings, ["input", "events"], [dataset])


def threshold_origin(settings: Settings, events: Origin) -> Origin:
    """Of the confidence at which a network on events decides, and of its accuracy.

    Both depend on the training and on for how long samples are presented.
    """
    return Origin.of(settings, ["presentation.steps"], [events])


def nir_origin(settings: Settings, dataset: Origin) -> Origin:
    """Of a NIR graph that was taken over, with its accuracy and threshold."""
    shown = ["presentation.steps"] if settings.on_events else ["presentation", "image"]
    return Origin.of(settings, ["input", "nir.sha256", "nir.step", "nir.method", *shown], [dataset])


def trained_origin(settings: Settings, dataset: Origin) -> Origin:
    """Of what the bundle is made from: rate-based network, threshold on events, or NIR graph."""
    if settings.nir.file:
        return nir_origin(settings, dataset)
    if settings.on_events:
        return threshold_origin(settings, events_origin(settings, dataset))
    return rates_origin(settings, cnn_origin(settings, dataset))


def bundle_origin(settings: Settings, dataset: Origin) -> Origin:
    """Of the bundle."""
    trained = trained_origin(settings, dataset)
    placement = ["deployment.pop_type"] if settings.on_events else ["deployment"]
    # How events become an image counts on events too: the live page shows it.
    return Origin.of(settings, [*placement, "presentation", "check", "image"], [trained])


def check_origin(settings: Settings, bundle_id: str) -> Origin:
    """Of what a network or target answers to the bundle's samples.

    It needs nothing but the bundle, which may have been copied to another machine.
    """
    return Origin({"seed": settings.seed}, {"bundle": bundle_id})


def recorded_in_check(result: dict) -> dict:
    """What a check's result says of its origin."""
    return Origin({"seed": result.get("seed")}, {"bundle": result.get("bundle")}).to_json()


def ladder_origin(results) -> Origin:
    """Of the loss ladder, from the check results that it compares."""
    return Origin(
        contents={
            f"checks/{result['target']}": _hash_of([result["bundle"], result["samples"]])
            for result in results
        }
    )


def _hash_of(value):
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
