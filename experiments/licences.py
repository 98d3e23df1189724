"""The licences of the packages that this project is installed with, from their own metadata."""

import importlib.metadata
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

# Parts of the installation that developers need, not users.
FOR_DEVELOPERS = ("dev", "docs")

# Licences by the word that their names have, with what they ask of whoever passes a package on or
# uses it; the first that fits counts.
OBLIGATIONS = {
    "non-commercial": "free for non-commercial use only; commercial use needs a paid licence",
    "LESSER GENERAL PUBLIC": "may be sold; changes of this package are passed on as source",
    "LGPL": "may be sold; changes of this package are passed on as source",
    "General Public License": "may be used and sold; programs made with it are passed on as source",
    "GPL": "may be used and sold; programs made with it are passed on as source",
    "Mozilla": "may be sold; changed files of this package are passed on as source",
    "MPL": "may be sold; changed files of this package are passed on as source",
}
PERMISSIVE = "may be used and sold; the notice is kept"


def read_licence(package: str) -> str:
    """The licence of an installed package.

    It is the licence expression of its metadata, or else its classifier, its field ``License``, or
    the first line of its licence file.
    """
    distribution = importlib.metadata.distribution(package)
    metadata = distribution.metadata
    if expression := metadata.get("License-Expression"):
        return expression
    classifiers = [
        words.rpartition("::")[2].strip()
        for words in metadata.get_all("Classifier", [])
        if words.startswith("License ::")
    ]
    if classifiers:
        return classifiers[0]
    if line := metadata.get("License", "").strip().partition("\n")[0]:
        return line
    files = [file for file in distribution.files or [] if "LICEN" in file.name.upper()]
    return files[0].read_text().strip().partition("\n")[0].strip() if files else "not stated"


def describe_obligations(licence: str) -> str:
    """What a licence asks for, in a few words."""
    return next((text for word, text in OBLIGATIONS.items() if word in licence), PERMISSIVE)


def list_users_packages() -> list:
    """Packages that ``pyproject.toml`` asks for, without those that only developers need."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        project = tomllib.load(file)["project"]
    requirements = list(project["dependencies"])
    for extra, names in project["optional-dependencies"].items():
        requirements += [] if extra in FOR_DEVELOPERS else names
    return [_find_name(requirement) for requirement in requirements]


def _read_requirements(package):
    """Names of the packages that an installed package needs, without its optional parts."""
    requirements = importlib.metadata.requires(package) or []
    return [
        _find_name(requirement) for requirement in requirements if "extra ==" not in requirement
    ]


def _find_name(requirement):
    return re.match(r"[\w.-]+", requirement)[0]


def list_restricted_packages() -> list:
    """All installed packages of users, also indirect ones, whose licence is not permissive."""
    obligations = {}
    waiting = list_users_packages()
    while waiting:
        name = _normalise(waiting.pop())
        if name in obligations:
            continue
        try:
            obligations[name] = describe_obligations(read_licence(name))
        except importlib.metadata.PackageNotFoundError:
            continue  # of another system or version of Python
        waiting += _read_requirements(name)
    return sorted(name for name, text in obligations.items() if text != PERMISSIVE)


def _normalise(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def make_cells() -> list:
    """The table of the packages that the project asks for, and of those that have conditions."""
    direct = list(map(_normalise, list_users_packages()))
    indirect = [name for name in list_restricted_packages() if name not in direct]
    rows = [(name, read_licence(name)) for name in [*direct, *indirect]]
    restricted = [row for row in rows if describe_obligations(row[1]) != PERMISSIVE]
    permissive = [row for row in rows if describe_obligations(row[1]) == PERMISSIVE]
    return [
        ("package", "licence", "in short"),
        *(
            (name, licence, describe_obligations(licence))
            for name, licence in [*restricted, *permissive]
        ),
    ]
