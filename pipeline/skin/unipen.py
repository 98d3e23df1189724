"""Recorded handwriting: pen trajectories in UNIPEN text.

Only the parts for isolated, labelled symbols are read: ``.SEGMENT`` (its components and its
label), ``.PEN_DOWN``, ``.PEN_UP`` and the points under them (I. Guyon et al., "UNIPEN
project of on-line data exchange and recognizer benchmarks", ICPR 1994).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import open_regular
from pipeline.settings import LARGEST
from pipeline.skin.handwriting import Trace
from pipeline.skin.shape_model import boxed

MOST_TEXT = 1 << 26
"""Characters that are read of a file; a thousand writers take a tenth of it."""

_SEGMENT = re.compile(r'\.SEGMENT\s+\S+\s+(\S+)\s+\S+\s+"(.*)"')


def read(path) -> tuple:
    """Read the digits of a UNIPEN file.

    Segments whose label is not a digit are left out.

    Returns
    -------
    tuple of Trace
        In the order of the file.

    Raises
    ------
    UserError
        The file cannot be read, a line is not a point, or there is no digit.
    """
    path = Path(path)
    try:
        with open_regular(path, "r", encoding="utf-8", errors="replace") as file:
            lines = file.read(MOST_TEXT).splitlines()
    except OSError as error:
        raise UserError(
            f"{path}: cannot read ({error.strerror or error}); give a UNIPEN file"
        ) from error
    traces, segment, strokes, pen_down = [], None, [], False

    def finish():
        if segment is not None and (trace := _trace(*segment, strokes)) is not None:
            traces.append(trace)

    for number, line in enumerate(lines, 1):
        if line.startswith("."):
            keyword = line.split()[0]
            if keyword == ".SEGMENT":
                finish()
                match = _SEGMENT.match(line)
                segment, strokes = ((match[2], -1) if match else None), []
            elif keyword == ".COMMENT" and segment is not None and not strokes:
                segment = segment[0], _writer(line, segment[0])
            elif keyword == ".PEN_DOWN":
                strokes.append([])
            pen_down = keyword == ".PEN_DOWN"
        elif pen_down and line.strip():
            try:
                right, up = (float(value) for value in line.split()[:2])
                if not (abs(right) <= LARGEST and abs(up) <= LARGEST):  # NaN is not
                    raise ValueError
            except ValueError:
                raise UserError(
                    f"{path}: line {number} is not a point (x y): {line.strip()[:40]!r}; "
                    "give a UNIPEN file with points in plain numbers"
                ) from None
            strokes[-1].append((-up, right))
    finish()
    if not traces:
        raise UserError(f"{path}: no segment labelled with a digit; give a UNIPEN file of digits")
    return tuple(traces)


def _writer(comment, label):
    """Pen-Based Recognition of Handwritten Digits notes digit, writer and number."""
    match = re.fullmatch(r"\.COMMENT\s+(\d)\s+(\d+)\s+\d+\s*", comment)
    return int(match[2]) - 1 if match and match[1] == label else -1


def _trace(label, writer, strokes):
    strokes = [np.array(stroke) for stroke in strokes if len(stroke) > 1]
    if not re.fullmatch("[0-9]", label) or not strokes:
        return None
    return Trace(int(label), writer, boxed(strokes))
