"""Signatures of the commands, as Typer reads them: groups of options, and short placeholders.

Commands share groups of options, such as those that choose the settings of a run.  A command
receives a group as one value::

    def train(run: options.Run, given: options.RunGiven, jobs: options.Jobs = 2): ...

where the annotation contains a :class:`Group`.  Typer needs one parameter for each option, so
:func:`for_typer` replaces the group by its options.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, get_args, get_origin, get_type_hints

from typer.models import OptionInfo

METAVARS = {bool: "", int: "N", float: "X", Path: "PATH", str: "TEXT"}
"""The placeholders of option values in ``--help``; a choice lists its values instead.  Typer's own
placeholders, such as ``<int range>``, would take a third of a help text 60 columns wide."""


@dataclass(frozen=True)
class Group:
    """Options that a command receives as one value.

    Attributes
    ----------
    make : callable
        Function that makes the value from the options; its parameters have the options' defaults.
    options : dict
        Annotation of each option, by the parameter of ``make``, in the order of the help.
    """

    make: Callable
    options: dict


def group(make: Callable, **options):
    """Annotation of a parameter that receives a :class:`Group` of options as one value."""
    return Annotated[object, Group(make, options)]


def for_typer(verb: Callable) -> Callable:
    """A verb whose signature has one parameter with a short placeholder for each option.

    Parameters
    ----------
    verb : callable
        Function of a command; parameters may be annotated with a :func:`group`.

    Returns
    -------
    callable
        Takes every option as a keyword argument.
    """
    hints = get_type_hints(verb, include_extras=True)
    parameters, groups = [], {}
    for name, parameter in signature(verb).parameters.items():
        metadata = getattr(hints[name], "__metadata__", ())
        if metadata and isinstance(metadata[0], Group):
            groups[name] = metadata[0]
            defaults = signature(metadata[0].make).parameters
            parameters += [
                _parameter(option, hint, defaults[option].default)
                for option, hint in metadata[0].options.items()
            ]
        else:
            parameters.append(_parameter(name, hints[name], parameter.default))

    @wraps(verb)
    def with_groups(**values):
        for name, each in groups.items():
            values[name] = each.make(**{option: values.pop(option) for option in each.options})
        return verb(**values)

    with_groups.__signature__ = Signature(parameters)
    with_groups.__annotations__ = {each.name: each.annotation for each in parameters}
    return with_groups


def _parameter(name, hint, default):
    """A parameter for Typer; an option without a placeholder gets that of its type."""
    kinds = {hint.__origin__, *get_args(hint.__origin__)} if get_origin(hint) is Annotated else ()
    inner = {kind for outer in kinds for kind in (outer, *get_args(outer))}
    word = next((METAVARS[kind] for kind in METAVARS if kind in inner), None)
    for info in getattr(hint, "__metadata__", ()):
        if isinstance(info, OptionInfo) and info.metavar is None:
            info.metavar = word
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=hint)
