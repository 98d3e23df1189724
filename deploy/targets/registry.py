"""Targets: the simulators and the hardware that run the samples of a check.

To add one, add a `Target` to `TARGETS` and its name to ``NAMES`` in :mod:`deploy.targets`, which is
read without Nengo; ladder, report and command line use them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Callable, Dict, Iterable, Iterator, Optional

import nengo

from ..errors import UserError
from ..network.build import build
from ..network.loihi_import import BUILD_ERRORS, cannot_build, nengo_loihi, require_integers
from ..network.responses import Responses, join, respond
from ..network.spec import NetworkSpec
from ..terminal import WARNING, remark
from . import BoardOptions
from .board import describe, run_loihi
from .fast import run_fast
from .overflow import OverflowWatch, overflow_text


@dataclass(frozen=True)
class Target:
    """A target with its description and options.

    Attributes
    ----------
    name : str
    run : callable
        ``run(spec, streams, seed)`` yields the :class:`~deploy.network.responses.Responses` to each
        stream of samples, in order; each stream starts from a fresh network.  Targets with options
        also have a keyword argument ``options``.
    title : str
        Short description.
    note : str
        Additional information for readers of its results; empty if the title is sufficient.
    slow : bool
        True if the whole test set takes minutes.
    floating : bool
        True if the target computes in floating point, so that it would also run a network that the
        chip's integers cannot hold: see :func:`refuse_unfit`.
    hardware : bool
        True if the target needs a board.
    in_ladder : bool
        True if every ladder has a row of it, unless it needs a board.
    options : type or None
        Dataclass of the options; its field names are the names of the command's options.
    describe : callable or None
        Function from the notes of all streams, a list of dict, to additional fields of a result.
    """

    name: str
    run: Callable
    title: str
    note: str = ""
    slow: bool = False
    floating: bool = False
    hardware: bool = False
    in_ladder: bool = True
    options: Optional[type] = None
    describe: Optional[Callable] = None


def run_nengo(spec, streams, seed=0) -> Iterator[Responses]:
    """Run NengoCore's reference simulator, with Loihi's neurons in floating point."""
    options = {"progress_bar": False, "optimize": False}
    return _run(spec, streams, seed, lambda network: nengo.Simulator(network, **options))


def run_simreal(spec, streams, seed=0) -> Iterator[Responses]:
    """Run NengoLoihi's model of the chip before discretisation."""
    return _run(spec, streams, seed, lambda network: _loihi_simulator(network, "simreal"))


def run_emulator(spec, streams, seed=0) -> Iterator[Responses]:
    """Run NengoLoihi's emulator, with the chip's integers."""
    return _run(spec, streams, seed, lambda network: _loihi_simulator(network, "sim"))


# The targets by name, in the order of a ladder.
TARGETS: Dict[str, Target] = {
    target.name: target
    for target in (
        Target("nengo", run_nengo, "Nengo's reference simulator", slow=True, floating=True),
        Target("simreal", run_simreal, "Loihi's network before rounding", slow=True, floating=True),
        Target("emulator", run_emulator, "Emulated Loihi", slow=True),
        Target(
            "fast",
            run_fast,
            "Emulated Loihi (fast)",
            note="bit-identical to NengoLoihi's emulator",
            in_ladder=False,
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


def target_named(name: str) -> Target:
    """Find a target by its name.

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


def options_for(name: str, **values):
    """Select a target's options from those of a command.

    Parameters
    ----------
    name : str
        Name of the target.
    **values
        The value of every option of any target.

    Returns
    -------
    object or None
        An instance of the target's class of options; None if it has none.

    Raises
    ------
    UserError
        There is no target of that name, or an option belongs to another target.
    """
    own = target_named(name).options
    for target in TARGETS.values():
        if target.options is None or target.options is own:
            continue
        for option in fields(target.options):
            if values.get(option.name, option.default) != option.default:
                raise UserError(f"--{option.name} is for --target {target.name}, not for {name}")
    if own is None:
        return None
    return own(**{option.name: values[option.name] for option in fields(own)})


def refuse_unfit(spec: NetworkSpec, target: str, seed=0):
    """Refuse a network whose values do not fit the chip's integers, for targets in floating point.

    All other targets refuse it when they build it.  This builds NengoLoihi's model once more, so it
    is called once for all samples and not for each stream.

    Raises
    ------
    UserError
        There is no target of that name, or NengoLoihi cannot build the network.
    """
    if target_named(target).floating:
        require_integers(build(spec, seed).network)


def run_target(
    spec: NetworkSpec, samples, target: str, seed=0, advance=None, **options
) -> Responses:
    """Run a target on samples, presented as the network defines it.

    Parameters
    ----------
    spec : NetworkSpec
    samples : ndarray, shape (n_samples, ...)
        Images, usually with values from 0 to 1, or frames, in the format of the stimulus.
    target : str
        ``"nengo"``, ``"simreal"``, ``"emulator"``, ...
    seed : int
    advance : callable, optional
        Called with the number of samples done since the last call.
    **options
        Keyword arguments of the target's ``run``, such as the kernel of ``fast``.

    Returns
    -------
    Responses

    Raises
    ------
    UserError
        There is no target of that name, the network's stimulus cannot present the samples, or
        NengoLoihi cannot build the network.
    """
    flat = spec.flatten_samples(samples)
    refuse_unfit(spec, target, seed)
    streams = [flat[part] for part in spec.presentation.streams(len(flat))]
    parts, watch = [], OverflowWatch()
    for responses in watch.during(target_named(target).run(spec, streams, seed, **options)):
        parts.append(responses)
        if advance is not None:
            advance(len(responses.scores))
    if watch.numbers:
        remark(WARNING + overflow_text(spec, target, watch.numbers))
    return join(parts)


def _loihi_simulator(network, target):
    try:
        # Without an explicit target NengoLoihi uses hardware wherever NxSDK is installed.
        return nengo_loihi.Simulator(network, target=target, precompute=True)
    except BUILD_ERRORS as error:
        raise cannot_build(network, error) from error


def _run(spec: NetworkSpec, streams: Iterable, seed, simulator) -> Iterator[Responses]:
    built = build(spec, seed)
    for samples in streams:
        with simulator(built.network) as sim:
            yield respond(spec, built, sim, samples)
