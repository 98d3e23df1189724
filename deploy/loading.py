"""Dataclasses from plain values, such as those of JSON or TOML, with types and limits checked.

The type hints of a dataclass say what a value may be: ``bool``, ``int``, ``float`` (a whole number
will do), ``str``, ``Optional``, ``Tuple[X, ...]``, ``List[X]``, ``Dict[str, X]`` or another
dataclass; any other hint, such as ``dict`` or ``np.ndarray``, is not checked.  A :class:`Limit` is
the metadata of a field (:func:`limited_field`) or, from Python 3.9 on, part of its hint
(``Annotated[int, limit]``).  An error has the field's name with those around it, such as
``layers[0].neurons.tau_rc``.
"""

from __future__ import annotations

import functools
import numbers
import os
from dataclasses import MISSING, field, fields, is_dataclass
from typing import Callable, NamedTuple, Union, get_type_hints

# Largest magnitude of a number; NaN and infinite values are refused.
MAX_NUMBER = 1e300


class Limit(NamedTuple):
    """A condition on a value.

    Attributes
    ----------
    holds : callable
        From a value to whether it is allowed.
    expected : str
        Wording of the condition in an error, after "must be".
    """

    holds: Callable
    expected: str


# The limit of a number of things, of which there is at least one.
AT_LEAST_1 = Limit(lambda value: value >= 1, "at least 1")


def between(low, high, unit="") -> Limit:
    """The limit of a number from ``low`` to ``high``, both included."""
    return Limit(lambda value: low <= value <= high, f"from {low:.10g} to {high:.10g}{unit}")


def one_of(*values) -> Limit:
    """The limit of a value that has only these values; an empty text leaves the choice open."""
    text = "one of " + ", ".join(str(value) for value in values if value != "")
    if "" in values:
        text += ", or '' to leave it open"
    return Limit(lambda value: value in values, text)


class KeyOf:
    """The :class:`Limit` of a value that is a key of a table, to which keys can be added.

    Parameters
    ----------
    table : dict
    """

    def __init__(self, table: dict):
        self._table = table

    def holds(self, value) -> bool:
        """True if the table has the key now."""
        return value in self._table

    @property
    def expected(self) -> str:
        """The keys that the table has now."""
        return f"one of {', '.join(self._table)}"


def limited_field(limit: Union[Limit, KeyOf], default=MISSING, name_in_file: str = ""):
    """A field of a dataclass with a limit; its value may be None if the hint allows it.

    Parameters
    ----------
    limit : Limit or KeyOf
    default : optional
    name_in_file : str
        Name by which :func:`load_dataclass` finds the value; default: that of the field.
    """
    return field(default=default, metadata={"limit": limit, "name_in_file": name_in_file})


def named_field(name_in_file: str, default=MISSING):
    """A field of a dataclass whose value has another name in files."""
    return field(default=default, metadata={"name_in_file": name_in_file})


class WrongValue(ValueError):
    """A value does not fit its field.

    Parameters
    ----------
    name : str
        Dotted name of the field; empty for the whole.
    problem : str
        Such as "must be from 0 to 1".
    """

    def __init__(self, name: str, problem: str):
        self.name = name
        self.problem = problem
        super().__init__(f"'{name}' {problem}" if name else problem)


def load_dataclass(kind, values, name: str = "", ignore_extra: bool = False):
    """Make a dataclass of plain values.

    Parameters
    ----------
    kind : type
        The dataclass.
    values : dict
        By the names of its fields, or their names in files.
    name : str
        Dotted name of the whole in error messages.
    ignore_extra : bool
        Ignore entries that are not fields, here and below.

    Returns
    -------
    instance of ``kind``

    Raises
    ------
    WrongValue
        An entry is missing, unknown, of another type or beyond its limit.
    """
    if not isinstance(values, dict):
        raise WrongValue(name, f"must be a table of values, not {_shorten(values)}")
    entries = _list_entries(kind)
    built = {}
    unknown = sorted(str(key)[:40] for key in set(values) - set(entries))
    if unknown and not ignore_extra:
        raise WrongValue(_join_names(name, unknown[0]), "is unknown")
    for entry_name, entry in entries.items():
        full_name = _join_names(name, entry_name)
        if entry_name in values:
            hint = _read_hints(kind)[entry.name]
            value = _build_value(hint, values[entry_name], full_name, ignore_extra)
            _require_limit(entry.metadata.get("limit"), value, full_name)
            built[entry.name] = value
        elif entry.default is MISSING and entry.default_factory is MISSING:
            raise WrongValue(full_name, "is missing")
    try:
        return kind(**built)
    except WrongValue as error:
        raise WrongValue(_join_names(name, error.name), error.problem) from error


def dump_dataclass(instance) -> dict:
    """Plain values of a dataclass, of which :func:`load_dataclass` makes it again.

    A value that is None is left out if this is the default of its field.
    """
    values = {}
    for name, entry in _list_entries(type(instance)).items():
        value = getattr(instance, entry.name)
        if value is not None or entry.default is not None:
            values[name] = _make_plain(value)
    return values


def _make_plain(value):
    if is_dataclass(value):
        return dump_dataclass(value)
    if isinstance(value, dict):
        return {key: _make_plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_make_plain(entry) for entry in value]
    return value


def list_names_in_file(kind) -> list:
    """Names that the fields of a dataclass have in files."""
    return list(_list_entries(kind))


def _list_entries(kind) -> dict:
    """The fields of a dataclass by their names in files."""
    return {
        entry.metadata.get("name_in_file") or entry.name: entry
        for entry in fields(kind)
        if entry.init
    }


def require_valid(instance):
    """Refuse a dataclass with a value of a wrong type or beyond its limit, in ``__post_init__``.

    Raises
    ------
    WrongValue
    """
    for entry in fields(instance):
        value = getattr(instance, entry.name)
        _build_value(_read_hints(type(instance))[entry.name], value, entry.name, False)
        _require_limit(entry.metadata.get("limit"), value, entry.name)


@functools.lru_cache(maxsize=None)
def _read_hints(kind):
    try:
        return get_type_hints(kind, include_extras=True)
    except TypeError:  # Python 3.8
        return get_type_hints(kind)


def _build_value(hint, value, name, ignore_extra):
    """The value of a field; raises an error if it is of another type."""
    limits = getattr(hint, "__metadata__", ())
    if limits:
        value = _build_value(hint.__origin__, value, name, ignore_extra)
        for limit in limits:
            _require_limit(limit, value, name)
        return value
    origin = getattr(hint, "__origin__", hint)
    inner = getattr(hint, "__args__", ())
    if origin is Union or type(hint).__name__ == "UnionType":  # Optional[X], or X | None
        return None if value is None else _build_value(inner[0], value, name, ignore_extra)
    if is_dataclass(hint):
        return value if isinstance(value, hint) else load_dataclass(hint, value, name, ignore_extra)
    if origin in (tuple, list):
        _require(isinstance(value, (list, tuple)), name, f"a list, such as [{value!r}]", value)
        if origin is tuple and inner[-1] is not Ellipsis:
            _require(len(value) == len(inner), name, f"a list of {len(inner)}", value)
        hints = inner if origin is tuple and inner[-1] is not Ellipsis else inner[:1] * len(value)
        pairs = zip(hints, value)
        return origin(
            _build_value(h, v, f"{name}[{i}]", ignore_extra) for i, (h, v) in enumerate(pairs)
        )
    if origin is dict:
        _require(isinstance(value, dict), name, "a table of values", value)
        of_values = inner[1] if inner else None  # None lets a value of any kind pass
        return {
            key: _build_value(of_values, v, _join_names(name, key), ignore_extra)
            for key, v in value.items()
        }
    if origin is bool:
        _require(type(value) is bool, name, "true or false", value)
    elif origin is int:
        whole = isinstance(value, numbers.Integral) and type(value) is not bool  # NumPy's too
        _require(whole, name, "a whole number", value)
        return int(value)
    elif origin is float:
        number = isinstance(value, numbers.Real) and type(value) is not bool
        _require(
            number and -MAX_NUMBER <= float(value) <= MAX_NUMBER, name, "a finite number", value
        )
        return float(value)
    elif origin is str:
        value = os.fspath(value) if isinstance(value, os.PathLike) else value
        _require(_is_text(value), name, "text", value)
    return value


def _is_text(value):
    try:
        return isinstance(value, str) and len(value.encode("utf-8")) <= 10_000
    except UnicodeEncodeError:
        return False


def _require_limit(limit, value, name):
    if limit is not None and value is not None and not limit.holds(value):
        raise WrongValue(name, f"must be {limit.expected}, not {_shorten(value)}")


def _require(condition, name, expected, value):
    if not condition:
        raise WrongValue(name, f"must be {expected}, not {_shorten(value)}")


def _shorten(value):
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _join_names(name, entry):
    return f"{name}.{entry}" if name and entry else name or entry
