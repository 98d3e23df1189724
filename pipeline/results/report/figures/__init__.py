"""Pictures as files, drawn with Matplotlib; the charts of the report are SVG text."""

import io
import warnings
from pathlib import Path

from matplotlib.colors import LinearSegmentedColormap

from deploy.errors import UserError
from deploy.files import replacing
from deploy.terminal import printable
from pipeline.look import colour

FORMATS = ("png", "svg", "pdf")

# From no event to the most.
SHADES = LinearSegmentedColormap.from_list("events", ["#ffffff", colour("on")])


def format_of(path: Path) -> str:
    """The format of a picture, from its name.

    Raises
    ------
    UserError
        The format is not supported.
    """
    kind = Path(path).suffix.lstrip(".").lower()
    if kind not in FORMATS:
        raise UserError(f"{path}: not a picture that can be drawn; use .png, .svg or .pdf")
    return kind


def plain(name: str) -> str:
    """A name in which Matplotlib does not interpret dollar signs as a formula."""
    return printable(name).replace("$", r"\$")


def save(figure, path: Path, dpi: int = 120):
    """Write a figure in the format of its file's name.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    path : Path
    dpi : int
        Resolution of a .png in dots per inch.

    Raises
    ------
    UserError
        The format is not supported, or the file cannot be written.
    """
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # A class may have a name in any script; what the font lacks is drawn as a box.
        warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from")
        figure.savefig(buffer, format=format_of(path), dpi=dpi)
    with replacing(path) as file:
        file.write(buffer.getvalue())
