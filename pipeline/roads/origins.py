"""Origins of all artifacts of a run: the one list of their dependencies.

Each function returns the :class:`pipeline.artifacts.Origin` of an artifact, made from the settings
and the origin of the data set.  The code that makes the artifact can read no other settings.
"""

from __future__ import annotations

import hashlib
import json

from pipeline.artifacts import Origin
from pipeline.settings import Settings


def cnn_origin(settings: Settings, dataset: Origin) -> Origin:
    """Origin of the CNN: trained, or read from the user's Keras model."""
    reads = ["input.kind", "image", "cnn.architecture"]
    if settings.cnn.model:
        reads.append("cnn.model_sha256")
    else:
        reads += ["cnn.epochs", "cnn.batch_size", "cnn.learning_rate"]
    return Origin.of(settings, reads, [dataset])


def counts_origin(settings: Settings, dataset: Origin) -> Origin:
    """Origin of the classifier of event counts, which has no settings of its own."""
    return Origin.of(settings, uses=[dataset])


def rates_origin(settings: Settings, dataset: Origin) -> Origin:
    """Origin of the network with rate-based LIF neurons, which starts from the CNN."""
    return Origin.of(settings, ["snn"], [cnn_origin(settings, dataset)])


def events_origin(settings: Settings, dataset: Origin) -> Origin:
    """Origin of the network trained on events.

    It does not depend on the presentation.
    """
    return Origin.of(settings, ["input", "events"], [dataset])


def threshold_origin(settings: Settings, dataset: Origin) -> Origin:
    """Origin of the confidence for early decisions of a network on events, and of its accuracy.

    Both depend on the training and on the length of the presentation.
    """
    return Origin.of(settings, ["presentation.steps"], [events_origin(settings, dataset)])


def nir_origin(settings: Settings, dataset: Origin) -> Origin:
    """Origin of an imported NIR graph, with its accuracy and threshold."""
    presented = ["presentation.steps"] if settings.on_events else ["presentation", "image"]
    graph = ["nir.sha256", "nir.step", "nir.method"]
    return Origin.of(settings, ["input", *graph, *presented], [dataset])


def network_origin(settings: Settings, dataset: Origin) -> Origin:
    """Origin of the network that is deployed: a NIR graph, or trained on events or images."""
    if settings.network == "nir":
        return nir_origin(settings, dataset)
    return (events_origin if settings.on_events else rates_origin)(settings, dataset)


def trained_origin(settings: Settings, dataset: Origin) -> Origin:
    """Origin of all that a bundle is made from: the network, and on events its threshold."""
    if settings.on_events and settings.network != "nir":
        return threshold_origin(settings, dataset)
    return network_origin(settings, dataset)


def bundle_origin(settings: Settings, dataset: Origin) -> Origin:
    """Origin of the bundle."""
    trained = trained_origin(settings, dataset)
    placement = [] if settings.on_events else ["deployment"]
    # The image settings matter for events too: the live page displays the image.
    return Origin.of(settings, [*placement, "presentation", "check", "image"], [trained])


def check_origin(settings: Settings, bundle_id: str) -> Origin:
    """Origin of the check result of a network or target.

    It only depends on the bundle, which may have been copied to another machine.
    """
    return Origin({"seed": settings.seed}, {"bundle": bundle_id})


def recorded_in_check(result: dict) -> dict:
    """The origin that is recorded in a check's result."""
    return Origin({"seed": result.get("seed")}, {"bundle": result.get("bundle")}).to_json()


def ladder_origin(results) -> Origin:
    """Origin of the loss ladder, from the check results that it compares."""
    return Origin(
        contents={
            f"checks/{result['target']}": _hash_of([result["bundle"], result["samples"]])
            for result in results
        }
    )


def _hash_of(value):
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
