"""Plugins: other packages that add targets, formats, operations and kinds of network.

A package names each of its additions in the group of entry points :data:`GROUP`::

    [project.entry-points."stmnist.plugins"]
    my-target = "my_package.target"
    my-format = "my_package.formats:register"

An entry is a module, which registers its addition when it is imported, or a function without
parameters, which is called.  The command ``stmnist``, the public names of ``stmnist`` and a
bundle's ``deploy.pyz`` load all entries once in each process.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import sys
from typing import Dict

from .terminal import WARNING, remark

# The group of entry points.
GROUP = "stmnist.plugins"

# Packages that ``deploy.pyz`` lacks on another host, where additions that need them have no use.
NOT_IN_BUNDLES = ("models", "pipeline", "stmnist")

_is_loaded = False

# The reason why an entry was left out in this process, by the entry's text for messages.
_LEFT_OUT: Dict[str, str] = {}


def load_plugins(is_worker: bool = False):
    """Load the entries of all installed plugins; later calls in the same process do nothing.

    An entry that raises an error is left out, and one line on standard error says why.  There is no
    such line if it needs a package of `NOT_IN_BUNDLES` on a host without it; see
    :func:`describe_left_out`.

    Parameters
    ----------
    is_worker : bool
        True in a process of which the user knows nothing: it prints no lines.
    """
    global _is_loaded
    if _is_loaded:
        return
    _is_loaded = True  # an entry may use the public names, which load plugins
    for entry in _list_entries():
        try:
            loaded = entry.load()
            if callable(loaded):
                loaded()
        except Exception as error:
            plugin = f"plugin {entry.name} ({entry.value})"
            problem = f"{type(error).__name__}: {error}"
            _LEFT_OUT[plugin] = problem
            if not is_worker and not _needs_more_than_bundles(error):
                remark(f"{WARNING}{plugin} is left out: {problem}")


def describe_left_out() -> str:
    """The entries that were left out and why, for a message on something unknown.

    Empty if there is none.
    """
    if not _LEFT_OUT:
        return ""
    entries = (f"{plugin}: {problem}" for plugin, problem in _LEFT_OUT.items())
    return f"left out on this host: {', '.join(entries)}"


def _list_entries() -> list:
    """The entries of all plugins, by their names."""
    if sys.version_info >= (3, 10):
        entries = importlib.metadata.entry_points(group=GROUP)
    else:
        entries = importlib.metadata.entry_points().get(GROUP, ())
    # Before Python 3.10 a distribution that is found twice on the path lists its entries twice.
    by_name = {(entry.name, entry.value): entry for entry in entries}
    return [by_name[key] for key in sorted(by_name)]


def _needs_more_than_bundles(error) -> bool:
    """True if a package of `NOT_IN_BUNDLES` is missing on this host."""
    if not isinstance(error, ModuleNotFoundError) or error.name is None:
        return False
    package = error.name.partition(".")[0]
    return package in NOT_IN_BUNDLES and importlib.util.find_spec(package) is None
