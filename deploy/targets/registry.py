"""Targets: what answers the samples of a check.

A target is a function ``run(spec, streams, seed)`` that yields, for each stream of images in
order, the :class:`~deploy.network.responses.Responses` to its samples.  Each stream starts from a
fresh network.
"""

from __future__ import annotations

from typing import Callable, Dict, Iterable, Iterator

import nengo
import numpy as np

from ..errors import UserError
from ..network.build import build
from ..network.loihi_import import nengo_loihi
from ..network.responses import Responses, join, show, streams_of
from ..network.spec import NetworkSpec
from .board import run_loihi
from .fast.emulation import run_fast


def run_nengo(spec, streams, seed=0) -> Iterator[Responses]:
    """NengoCore's reference simulator, with Loihi's neurons in floating point."""
    return _run(
        spec,
        streams,
        seed,
        lambda network: nengo.Simulator(network, progress_bar=False, optimize=False),
    )


def run_simreal(spec, streams, seed=0) -> Iterator[Responses]:
    """NengoLoihi's model of the chip before discretisation."""
    return _run(spec, streams, seed, lambda network: _loihi_simulator(network, "simreal"))


def run_emulator(spec, streams, seed=0) -> Iterator[Responses]:
    """NengoLoihi's emulator: the chip's integers."""
    return _run(spec, streams, seed, lambda network: _loihi_simulator(network, "sim"))


TARGETS: Dict[str, Callable] = {
    "nengo": run_nengo,
    "simreal": run_simreal,
    "emulator": run_emulator,
    "fast": run_fast,
    "loihi": run_loihi,
}


def target_named(name: str) -> Callable:
    """Look a target up.

    Raises
    ------
    UserError
        There is no target of that name.
    """
    try:
        return TARGETS[name]
    except KeyError:
        known = ", ".join(TARGETS)
        raise UserError(f"no target {name!r}; the targets are {known}") from None


def answer(spec: NetworkSpec, images, target: str, seed=0, advance=None) -> Responses:
    """Show images to a target in the network's own presentation.

    Parameters
    ----------
    spec : NetworkSpec
    images : ndarray, shape (n_samples, ...)
        Tactile images with values from 0 to 1.
    target : str
        ``"nengo"``, ``"simreal"``, ``"emulator"``, ...
    seed : int
    advance : callable, optional
        Called with the number of samples done since the last call.

    Returns
    -------
    Responses
    """
    images = np.asarray(images, float).reshape(len(images), -1)
    streams = [images[part] for part in streams_of(len(images), spec.presentation.stream_length)]
    parts = []
    for responses in target_named(target)(spec, streams, seed):
        parts.append(responses)
        if advance is not None:
            advance(len(responses.scores))
    return join(parts)


def _loihi_simulator(network, target):
    try:
        # The target is always passed: left out, NengoLoihi takes hardware where NxSDK is installed.
        return nengo_loihi.Simulator(network, target=target, precompute=True)
    except (nengo.exceptions.BuildError, nengo.exceptions.ValidationError) as error:
        raise UserError(f"NengoLoihi cannot build this network: {error}") from error
    except AttributeError as error:
        # NengoLoihi trips over its own message where pop_type 16 meets filters not in fours.
        raise UserError(
            f"NengoLoihi cannot build this network ({error}); what does not fit a core is said by "
            "'stmnist deploy plan'"
        ) from error


def _run(spec: NetworkSpec, streams: Iterable, seed, simulator) -> Iterator[Responses]:
    for images in streams:
        built = build(spec, seed)
        with simulator(built.network) as sim:
            yield show(spec, built, sim, images)
