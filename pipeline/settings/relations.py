"""Limits of settings that depend on other settings."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from deploy import limits
from deploy.loading import WrongValue
from models.architecture import NotationError, parse_architecture
from pipeline.settings.groups import MAX_TAU_MS

if TYPE_CHECKING:
    from pipeline.settings.schema import Settings

# Files of imported networks, and the settings with their hashes.
IMPORTED = {"cnn.model": "cnn.model_sha256", "nir.file": "nir.sha256"}


def require_relations(settings: Settings):
    """Refuse settings that contradict other settings, and wrong notations.

    Raises
    ------
    WrongValue
    """
    _require_readout_window(settings)
    event_layers = _parse_architecture(settings.events.architecture, "events.architecture").layers
    _require(
        len(event_layers) > 1 and all(layer.has_neurons for layer in event_layers),
        "events.architecture",
        "a network with a hidden layer and without pooling",
    )
    n_spiking = len(_parse_architecture(settings.cnn.architecture, "cnn.architecture").spiking)
    _require(
        n_spiking >= 1, "cnn.architecture", "a network with a layer of neurons before its output"
    )
    _require_read_files(settings)
    _require_max_rates(settings, n_spiking)
    _require_time_constants(settings, len(event_layers) - 1)
    _require(
        max(settings.snn.max_rates) * settings.snn.tau_ref < 1,
        "snn.max_rates",
        f"below 1 / snn.tau_ref = {1 / settings.snn.tau_ref:g} spikes per second",
    )


def _require(condition, name, expected):
    """Raise an error that names a setting and what its value must be, unless a condition holds."""
    if not condition:
        raise WrongValue(name, f"must be {expected}")


def _require_readout_window(settings):
    """The readout window begins within the presentation; with events it always does."""
    start = settings.presentation.readout_start
    _require(
        settings.on_events or 0 <= start < settings.steps,
        "presentation.readout_start",
        f"from 0 to below presentation.steps ({settings.steps}), not {start}; "
        "with so few steps give it too, such as "
        f"--set presentation.readout_start={settings.steps // 5}",
    )


def _require_read_files(settings):
    """A file of a network has been read, so that its hash is set, and it determines the input."""
    _require(
        settings.input.kind != "slices" or not settings.nir.file,
        "input.kind",
        "'image' for a NIR graph, with image.slices and image.aggregation as it was trained",
    )
    for file, content in IMPORTED.items():
        _require(
            settings.get_value(content) or not settings.get_value(file),
            file,
            "given with 'stmnist convert RUN --model FILE', or --nir FILE for a graph",
        )


def _require_max_rates(settings, n_layers):
    """There are at most as many maximum rates as layers of neurons."""
    rates = settings.snn.max_rates
    _require(
        1 <= len(rates) <= n_layers and min(rates) >= 1e-3,
        "snn.max_rates",
        f"1 to {n_layers} rates above 0, one per layer of neurons",
    )


def _require_time_constants(settings, n_layers):
    """There are at most as many time constants as layers of neurons."""
    for name in ("events.tau_u_ms", "events.tau_v_ms"):
        taus = settings.get_value(name)
        _require(
            1 <= len(taus) <= n_layers and min(taus) > 0 and max(taus) <= MAX_TAU_MS,
            name,
            f"1 to {n_layers} times above 0 and at most {MAX_TAU_MS:g}, one per layer of neurons",
        )


def _parse_architecture(architecture, name):
    """The network of a notation, which is valid and not too large."""
    try:
        parsed = parse_architecture(architecture)
    except NotationError as error:
        raise WrongValue(name, f"is not a network: {error}") from error
    weights = sum(map(math.prod, parsed.weight_shapes.values()))
    if weights > limits.WEIGHTS or max(map(math.prod, parsed.shapes)) > limits.NEURONS:
        raise WrongValue(
            name,
            f"must be a network of at most {limits.WEIGHTS} weights, "
            f"and {limits.NEURONS} neurons in a layer",
        )
    return parsed
