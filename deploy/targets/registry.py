"""The list of targets: the simulators and the hardware that run the samples of a check.

To add a target:

1. Write its function ``run`` in a file of this folder; :class:`Target` says what it must do.
   :mod:`deploy.network.reference` has what a target computes, as equations, and
   :func:`~deploy.network.reference.run_reference` is a target of them.  :mod:`.simulators` has
   targets that run the network in Nengo.
2. Write its options, if it has any, in :mod:`.options`: a dataclass with a field for each.  No two
   targets have an option of the same name.
3. Enter a `Target` in `TARGETS`; its ``run`` is ``import_when_called("FILE", "FUNCTION")``.  A
   package of yours calls :func:`register_target` instead, in a plugin (:mod:`deploy.plugins`).
4. Set ``is_in_ladder`` if every ladder should have a row of it.
5. Set ``refuses_unfit_itself`` if the function raises a `UserError` for a network that the chip's
   integers cannot hold; otherwise such a network is refused before the function is called.
6. Set ``is_exact`` if every spike is that of NengoLoihi's emulator: the energy and the comparison
   of runs then take its counts.  Otherwise set ``tolerance`` if it computes in real numbers, or
   rounds more than the chip.

Ladder, report and both command lines read it from there.  The list is read without Nengo, since the
help of the commands needs it; the file of a target is imported when the target runs.
"""

from __future__ import annotations

import importlib
import inspect
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Callable, Dict, Iterator, Optional, Tuple, Type

from ..errors import UserError
from ..terminal import WARNING, remark
from .options import BoardOptions, Options, format_flag
from .overflow import OverflowWatch, describe_overflows

if TYPE_CHECKING:
    from ..network.responses import Responses
    from ..network.spec import NetworkSpec


# What a target can have for its ``tolerance``: it computes in real numbers of double precision, or
# rounds weights and states, such as to 8 bits.
REAL_NUMBERS = 1e-6
ROUNDED = 0.15

NOT_TESTED = (
    "it was not tested whether the network fits the chip's integers, since NengoLoihi cannot be "
    "imported"
)


@dataclass(frozen=True)
class Target:
    """A target with its description and options.

    Attributes
    ----------
    name : str
    run : callable
        ``run(spec, streams, seed, options)`` yields a :class:`~deploy.network.output.TargetOutput`
        for each stream, in order: the readout at each step, and the spikes if the target knows
        them.  Scores and decisions are computed from it in one place.

        - ``spec`` is the :class:`~deploy.network.spec.NetworkSpec`.
        - ``streams`` is an iterable of arrays, as returned by `Stimulus.flatten`.  The samples of a
          stream are presented one after the other, from a fresh network on.
        - ``seed``, an int, determines what is random.  It must not depend on earlier streams or on
          later samples: draw it anew for each stream, and for each sample in order.
        - ``options`` is an instance of the class in the attribute ``options``, or None if that is
          None.
    title : str
        Short description.
    note : str
        Additional information for readers of its results; empty if the title is sufficient.
    is_slow : bool
        True if the whole test set takes minutes.
    refuses_unfit_itself : bool
        True if ``run`` raises a `UserError` for a network that the chip's integers cannot hold.
        Otherwise :func:`refuse_unfit` refuses it before the target runs, with NengoLoihi.
    needs_board : bool
        True if the target is hardware.
    is_exact : bool
        True if every spike is that of NengoLoihi's emulator.
    tolerance : float
        How far its readout and its numbers of spikes may be from those of the equations, relative
        to them (:func:`deploy.conformance.targets.assert_target_conforms`): :data:`REAL_NUMBERS`,
        :data:`ROUNDED`, or more if it rounds more.  Not read if it is exact.  A target that
        computes in real numbers should state :data:`REAL_NUMBERS`: sums over many steps are
        compared, so outputs that are a few steps late pass with the default.
    is_in_ladder : bool
        True if every ladder has a row of it, that of a board if there is one; see
        :func:`list_ladder_targets`.
    options : type or None
        Subclass of :class:`~deploy.targets.options.Options`; its field names are the names of the
        command's options, and no other target has them.
    describe : callable or None
        Function from the notes of all streams, a list of dict, to additional fields of a result.  A
        field ``versions``, a dict, is added to the versions of packages in the result.
    """

    name: str
    run: Callable
    title: str
    note: str = ""
    is_slow: bool = False
    refuses_unfit_itself: bool = False
    needs_board: bool = False
    is_exact: bool = False
    tolerance: float = ROUNDED
    is_in_ladder: bool = False
    options: Optional[Type[Options]] = None
    describe: Optional[Callable] = None


def import_when_called(module: str, function: str) -> Callable:
    """A function of a module of this folder, which is imported when the function is called."""

    def call(*arguments, **options):
        imported = importlib.import_module("." + module, __package__)
        return getattr(imported, function)(*arguments, **options)

    return call


# The targets by name, in the order of tables.
TARGETS: Dict[str, Target] = {
    target.name: target
    for target in (
        Target(
            name="nengo",
            run=import_when_called("simulators", "run_nengo"),
            title="Nengo's reference simulator",
            is_slow=True,
            is_in_ladder=True,
        ),
        Target(
            name="simreal",
            run=import_when_called("simulators", "run_simreal"),
            title="Loihi's network before rounding",
            tolerance=REAL_NUMBERS,
            is_slow=True,
            is_in_ladder=True,
        ),
        Target(
            name="emulator",
            run=import_when_called("simulators", "run_emulator"),
            title="Emulated Loihi",
            is_slow=True,
            refuses_unfit_itself=True,
            is_exact=True,
            is_in_ladder=True,
        ),
        Target(
            name="fast",
            run=import_when_called("fast", "run_fast"),
            title="Emulated Loihi (fast)",
            note="bit-identical to NengoLoihi's emulator",
            refuses_unfit_itself=True,
            is_exact=True,
        ),
        Target(
            name="loihi",
            run=import_when_called("board", "run_loihi"),
            title="Loihi 1 through NxSDK",
            refuses_unfit_itself=True,
            needs_board=True,
            is_in_ladder=True,
            options=BoardOptions,
            describe=import_when_called("board", "summarise_notes"),
        ),
    )
}


def find_target(name: str) -> Target:
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


def list_ladder_targets() -> Tuple[str, ...]:
    """Names of the targets of which every ladder has a row, the nearest to the chip last.

    Simulators come first, then exact targets, then boards.  The last one with a result is the
    deployed network of the ladder and the report.
    """
    targets = [target for target in TARGETS.values() if target.is_in_ladder]
    targets.sort(key=lambda target: (target.needs_board, target.is_exact))  # a stable sort
    return tuple(target.name for target in targets)


def list_exact_targets() -> Tuple[str, ...]:
    """Names of the targets whose spikes are those of NengoLoihi's emulator, slow ones first."""
    targets = [target for target in TARGETS.values() if target.is_exact]
    targets.sort(key=lambda target: not target.is_slow)  # a stable sort
    return tuple(target.name for target in targets)


def rank_targets_by_spikes() -> Tuple[str, ...]:
    """Names of the targets; the first with a result gives the numbers of spikes.

    Exact targets come first.  The others follow from the last one of the ladder, which is the
    nearest to the chip.  Boards come last, since they do not report the spikes of all layers.
    """
    exact = list_exact_targets()
    others = [target for target in reversed(list(TARGETS.values())) if target.name not in exact]
    others.sort(key=lambda target: target.needs_board)  # a stable sort
    return (*exact, *(target.name for target in others))


def register_target(target: Target):
    """Add a target of another package, with its options on both command lines.

    Raises
    ------
    ValueError
        There is a target of this name, another one has an option of the same name, or ``run`` does
        not take the four values that it is called with.
    """
    if target.name in TARGETS:
        raise ValueError(f"target {target.name!r}: there is one already")
    try:
        inspect.signature(target.run).bind("spec", "streams", "seed", "options")
    except TypeError as error:
        problem = "run must take (spec, streams, seed, options)"
        raise ValueError(f"target {target.name!r}: {problem}: {error}") from None
    TARGETS[target.name] = target
    try:
        list_options()
    except ValueError:
        del TARGETS[target.name]
        raise


def list_options() -> Dict[str, tuple]:
    """The options of all targets: ``(name of the target, dataclass field)`` by their names.

    Raises
    ------
    ValueError
        Two targets have an option of the same name.
    """
    options: Dict[str, tuple] = {}
    for target in TARGETS.values():
        for option in () if target.options is None else fields(target.options):
            if option.name in options:
                owner = options[option.name][0]
                flag = format_flag(option.name)
                raise ValueError(f"targets {owner} and {target.name}: both have {flag}")
            options[option.name] = (target.name, option)
    return options


def select_options(target_name: str, **values) -> Optional[Options]:
    """Select a target's options from those of a command.

    Parameters
    ----------
    target_name : str
    **values
        The value of every option of any target.

    Returns
    -------
    Options or None
        An instance of the target's class of options; None if it has none.

    Raises
    ------
    UserError
        There is no target of that name, or an option belongs to another target.
    """
    target = find_target(target_name)
    values_of_target = {}
    for name, (owner, option) in list_options().items():
        value = values.get(name, option.default)
        if owner == target.name:
            values_of_target[name] = value
        elif value != option.default:
            raise UserError(f"{format_flag(name)} is for --target {owner}, not for {target.name}")
    return None if target.options is None else target.options(**values_of_target)


def refuse_unfit(spec: NetworkSpec, target_name: str, seed=0):
    """Refuse a network whose values do not fit the chip's integers, unless the target does so.

    This builds NengoLoihi's model once more, so it is called once for all samples and not for each
    stream.  On a host without NengoLoihi, a warning says that it was not tested.

    Raises
    ------
    UserError
        There is no target of that name, or NengoLoihi cannot build the network.
    """
    if find_target(target_name).refuses_unfit_itself:
        return
    try:
        from ..network.build import build_nengo_network
        from ..network.loihi_import import require_integers
    except ImportError as error:  # a target need not have Nengo
        remark(f"{WARNING}{NOT_TESTED}: {error}")
        return
    require_integers(build_nengo_network(spec, seed).network)


def respond_to_streams(
    spec: NetworkSpec, streams: list, target_name: str, seed=0, options: Optional[Options] = None
) -> Iterator[Responses]:
    """Run a target on streams of samples, and read the responses from its output.

    Parameters
    ----------
    spec : NetworkSpec
    streams : list of ndarray
        Each as returned by `Stimulus.flatten`.
    target_name : str
    seed : int
    options : Options, optional
        Options of the target's own class; its defaults if it is None.

    Yields
    ------
    Responses
        To each stream, in order.

    Raises
    ------
    ValueError
        The target yields anything other than the output of each stream.
    """
    from ..network.responses import make_responses

    target = find_target(target_name)
    if options is None and target.options is not None:
        options = target.options()
    outputs = iter(target.run(spec, streams, seed, options))
    for number, samples in enumerate(streams):
        output = next(outputs, None)
        if output is None:
            raise ValueError(f"target {target_name!r}: yields {number} outputs, not {len(streams)}")
        yield make_responses(spec, output, len(samples), target_name)
    if next(outputs, None) is not None:
        raise ValueError(f"target {target_name!r}: yields more outputs than {len(streams)}")


def run_target(
    spec: NetworkSpec, samples, target: str, seed=0, advance=None, options: Optional[Options] = None
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
    options : Options, optional
        As in :func:`respond_to_streams`.

    Returns
    -------
    Responses

    Raises
    ------
    UserError
        There is no target of that name, the network's stimulus cannot present the samples, or
        NengoLoihi cannot build the network.
    """
    from ..network.responses import join_responses

    flat = spec.flatten_samples(samples)
    refuse_unfit(spec, target, seed)
    streams = [flat[stream] for stream in spec.presentation.list_streams(len(flat))]
    watch = OverflowWatch()
    by_stream = []
    for responses in watch.during(respond_to_streams(spec, streams, target, seed, options)):
        by_stream.append(responses)
        if advance is not None:
            advance(len(responses.scores))
    if watch.names:
        remark(WARNING + describe_overflows(spec, target, watch.names))
    return join_responses(by_stream)
