"""Pictures as files, drawn with Matplotlib; the charts of the report are SVG text."""

import io
import warnings
from pathlib import Path

from matplotlib import font_manager
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.text import Text

from deploy.errors import UserError
from deploy.files import replacing
from deploy.terminal import WARNING, escape_control, remark
from pipeline.look import find_colour

FORMATS = ("png", "svg", "pdf")

# From no event to the most.
SHADES = LinearSegmentedColormap.from_list("events", ["#ffffff", find_colour("on")])


def find_format(path: Path) -> str:
    """The format of a picture, from its name.

    Raises
    ------
    UserError
        The format is not supported.
    """
    ending = Path(path).suffix.lstrip(".").lower()
    if ending not in FORMATS:
        raise UserError(f"{path}: not a picture that can be drawn; use .png, .svg or .pdf")
    return ending


def escape_formula(name: str) -> str:
    """A name in which Matplotlib does not interpret dollar signs as a formula."""
    return escape_control(name).replace("$", r"\$")


def add_fonts(figure):
    """Give the texts of a figure an installed font for the characters that the usual one lacks."""
    texts = [text for text in figure.findobj(Text) if not text.get_text().isascii()]
    lacking = find_lacking(
        "".join(text.get_text() for text in texts), font_manager.findfont("sans")
    )
    families = []
    # Matplotlib's font of last resort has a box for every character.
    fonts = [e for e in font_manager.fontManager.ttflist if not e.name.startswith("Last Resort")]
    for entry in fonts if lacking else ():
        still = find_lacking(lacking, entry.fname)
        if len(still) < len(lacking):
            families.append(entry.name)
            lacking = still
        if not lacking:
            break
    for text in texts if families else ():
        text.set_fontfamily([*text.get_fontfamily(), *families])
    if lacking:
        remark(
            f"{WARNING}no installed font has {' '.join(sorted(lacking)[:8])}; they are drawn as "
            "boxes: install a font of that script, such as one of the Noto fonts"
        )


def find_lacking(characters, file) -> set:
    """The characters that a font does not have; all, if it cannot be read."""
    try:
        font = font_manager.get_font(file)
    except (OSError, RuntimeError):
        return set(characters)
    return {c for c in characters if c.isprintable() and not font.get_char_index(ord(c))}


def save_figure(figure, path: Path, dpi: int = 120):
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
    add_fonts(figure)
    with warnings.catch_warnings():
        # A class may have a name in any script; what no font has is drawn as a box.
        warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from")
        figure.savefig(buffer, format=find_format(path), dpi=dpi)
    with replacing(path) as file:
        file.write(buffer.getvalue())
