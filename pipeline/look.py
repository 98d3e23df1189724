"""Colours and type that the report, the live page, pictures and the animation share."""

import re
from importlib import resources

# The style sheet with the colours as custom properties, for light and dark.
STYLE = resources.files("pipeline").joinpath("look.css").read_text(encoding="utf-8")

_LIGHT = dict(re.findall(r"--([\w-]+): (#\w+);", STYLE.partition("@media")[0]))


def find_colour(name: str) -> str:
    """A colour on a light background, such as ``"on"`` or ``"s1"``, as ``#rrggbb``."""
    return _LIGHT[name]
