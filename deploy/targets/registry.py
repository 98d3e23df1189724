"""Targets: what answers the samples of a check.

To add one, put a `Target` into `TARGETS`; ladder, report and command line read it from there.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Callable, Dict, Iterable, Iterator, Optional

import nengo

from ..errors import UserError
from ..network.build import build
from ..network.discretisation import BUILD_ERRORS, cannot_build
from ..network.loihi_import import nengo_loihi
from ..network.responses import Responses, join, respond
from ..network.spec import NetworkSpec
from ..network.stream import streams_of
from .board import BoardOptions, describe, run_loihi
from .fast.emulation import run_fast


@dataclass(frozen=True)
class Target:
    """Something that answers.

    Attributes
    ----------
    name : str
    run : callable
        ``run(spec, streams, seed)`` yields, for each stream of samples in order, the
        :class:`~deploy.network.responses.Responses` to them; each stream starts from a fresh
        network.  Where there are ``options`` it takes a keyword of that name.
    title : str
        What it is, in a few words.
    note : str
        What a reader of its figures must know; empty if the title says it.
    slow : bool
        Whether the whole test split takes this machine minutes.
    hardware : bool
        Whether it is hardware, which few have; everything else runs anywhere.
    options : type or None
        Dataclass of what can be chosen; its fields are the names of the command's options.
    describe : callable or None
        From the notes of all streams, a list of dict, to what a result says besides its samples.
    """

    name: str
    run: Callable
    title: str
    note: str = ""
    slow: bool = False
    hardware: bool = False
    options: Optional[type] = None
    describe: Optional[Callable] = None


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


TARGETS: Dict[str, Target] = {
    target.name: target
    for target in (
        Target("nengo", run_nengo, "Nengo's reference simulator, in floating point", slow=True),
        Target("simreal", run_simreal, "NengoLoihi before discretisation", slow=True),
        Target("emulator", run_emulator, "NengoLoihi's emulator, the chip's integers", slow=True),
        Target(
            "fast",
            run_fast,
            "NengoLoihi's emulator, many streams at once",
            note="NengoLoihi's emulator, bit for bit",
        ),
        Target(
            "loihi",
            run_loihi,
            "Loihi 1 through NxSDK",
            hardware=True,
            options=BoardOptions,
            describe=describe,
        ),
    )
}
"""By name, in the order of a ladder."""


def target_named(name: str) -> Target:
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


def options_for(name: str, **given):
    """A target's options from a command's.

    Parameters
    ----------
    name : str
        Of the target.
    **given
        The value of every option that any target has.

    Returns
    -------
    object or None
        Of the target's own class of options; None if it has none.

    Raises
    ------
    UserError
        There is no target of that name, or an option of another target was given.
    """
    own = target_named(name).options
    for target in TARGETS.values():
        if target.options is None or target.options is own:
            continue
        for option in fields(target.options):
            if given[option.name] != option.default:
                raise UserError(f"--{option.name} is for --target {target.name}, not for {name}")
    if own is None:
        return None
    return own(**{option.name: given[option.name] for option in fields(own)})


def answer(spec: NetworkSpec, samples, target: str, seed=0, advance=None, **options) -> Responses:
    """Show samples to a target in the network's own presentation.

    Parameters
    ----------
    spec : NetworkSpec
    samples : ndarray, shape (n_samples, ...)
        Images, mostly with values from 0 to 1, or frames, as the network's stimulus takes them.
    target : str
        ``"nengo"``, ``"simreal"``, ``"emulator"``, ...
    seed : int
    advance : callable, optional
        Called with the number of samples done since the last call.
    **options
        Of the target's own ``run``, such as the kernel of ``fast``.

    Returns
    -------
    Responses

    Raises
    ------
    UserError
        There is no target of that name, or the network's stimulus cannot show the samples.
    """
    flat = spec.fed(samples)
    streams = [flat[part] for part in streams_of(len(flat), spec.presentation.stream_length)]
    parts = []
    for responses in target_named(target).run(spec, streams, seed, **options):
        parts.append(responses)
        if advance is not None:
            advance(len(responses.scores))
    return join(parts)


def _loihi_simulator(network, target):
    try:
        # The target is always passed: left out, NengoLoihi takes hardware where NxSDK is installed.
        return nengo_loihi.Simulator(network, target=target, precompute=True)
    except BUILD_ERRORS as error:
        raise cannot_build(network, error) from error


def _run(spec: NetworkSpec, streams: Iterable, seed, simulator) -> Iterator[Responses]:
    built = build(spec, seed)
    for samples in streams:
        with simulator(built.network) as sim:
            yield respond(spec, built, sim, samples)
