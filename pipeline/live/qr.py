"""QR codes of the page's address, for the camera of another device."""

import io
from dataclasses import dataclass

import segno


@dataclass(frozen=True)
class QRCode:
    """A QR code.

    Attributes
    ----------
    svg : bytes
        Black on white, independently of the background.
    text : str
        Text for a terminal, two modules per character.
    """

    svg: bytes
    text: str


def qr_code(url: str) -> QRCode:
    """The QR code of an address."""
    code, svg, text = segno.make_qr(url, error="m"), io.BytesIO(), io.StringIO()
    code.save(svg, kind="svg", light="white", scale=8, svgclass=None, lineclass=None)
    code.terminal(text, compact=True)
    return QRCode(svg.getvalue(), text.getvalue())
