"""Check that the bundle can run on this host, before anything else is imported.

Only the standard library is imported here, because with unsuitable versions the import of
NengoLoihi fails with a traceback.
"""

from __future__ import annotations

import re
import sys

try:
    from importlib.metadata import PackageNotFoundError, version
except ImportError:  # Python 3.7 and earlier, refused below
    version = None  # type: ignore[assignment]

OLDEST_PYTHON = (3, 8)
# For each package: oldest supported version, first unsupported version, and the reason.
PACKAGES = {
    "numpy": ((1, 17), (3,), ""),
    "scipy": ((1, 7), (2,), ""),
    "nengo": ((3, 1), (5,), "NengoLoihi 1.1 works with Nengo 3.1 to 4.1"),
    "nengo-loihi": ((1, 1), (1, 2), "the bundle was made with NengoLoihi 1.1"),
}


def describe_missing():
    """The problem of this host in one line.

    Returns
    -------
    str or None
        None if the bundle can run.
    """
    if sys.version_info < OLDEST_PYTHON or version is None:
        installed = ".".join(str(n) for n in sys.version_info[:3])
        return f"Python {installed} is too old; use Python 3.8 or later"
    installed_numbers = {}
    missing = []
    for package, (oldest, first_not, reason) in PACKAGES.items():
        requirement = f"'{package}>={_format_version(oldest)},<{_format_version(first_not)}'"
        remedy = f"pip install {requirement}" + (f" ({reason})" if reason else "")
        try:
            installed = version(package)
        except PackageNotFoundError:
            missing.append((package, requirement))
            continue
        number = tuple(int(n) for n in re.findall(r"\d+", installed)[:3])
        installed_numbers[package] = number
        if number < oldest:
            return f"{package} {installed} is too old; {remedy}"
        if number >= first_not:
            return f"{package} {installed} is too new; {remedy}"
    if missing:
        names = " and ".join(package for package, _ in missing)
        verb = "is" if len(missing) == 1 else "are"
        needed = " ".join(requirement for _, requirement in missing)
        return f"{names} {verb} not installed; pip install {needed}"
    if installed_numbers["nengo"] < (4,) and installed_numbers["numpy"] >= (2,):
        return "Nengo 3 fails with NumPy 2; pip install 'numpy<2' or 'nengo>=4,<5'"
    return None


def _format_version(number):
    return ".".join(str(n) for n in number)
