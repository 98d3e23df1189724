"""Recorded handwriting: pen trajectories in UNIPEN text.

Only the parts for isolated, labelled symbols are read: ``.COORD`` (the order of a point's values),
``.SEGMENT`` (its components and its label), ``.PEN_DOWN``, ``.PEN_UP`` and the points under them
(I. Guyon et al., "UNIPEN project of on-line data exchange and recognizer benchmarks", ICPR 1994).
Each digit's strokes must follow its ``.SEGMENT``, as many as it names: in a part of a file their
numbers need not start at 0.
"""

import re
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import open_regular, reporting_os_errors
from pipeline.simulation.handwriting import Trace
from pipeline.simulation.shape_model import fit_in_box

# Characters that are read of a file; a thousand writers take a tenth of it.
MOST_TEXT = 1 << 26

# Largest coordinate; all integers up to it are exact.
LARGEST = 2**53

_COMPONENTS = re.compile(r"(\d+)(?:-(\d+))?")
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
        The file cannot be read, a line is not a point, a digit's strokes are not those that
        follow its ``.SEGMENT``, or there is no digit.
    """
    path = Path(path)
    reporting = reporting_os_errors(path, "cannot read", "give a UNIPEN file")
    with reporting, open_regular(path, "r", encoding="utf-8", errors="replace") as file:
        lines = file.read(MOST_TEXT).splitlines()
    traces = []
    segment = None
    strokes = []
    pen_down = False
    begin, x_y = 1, (0, 1)  # line of the segment, places of x and y

    def finish():
        if segment is None:
            return
        label, writer, n_strokes = segment
        if re.fullmatch("[0-9]", label) and n_strokes != len(strokes):
            raise UserError(
                f"{path}: line {begin}: the strokes below it are not those that the segment names; "
                "give a UNIPEN file in which each digit's strokes follow its .SEGMENT"
            )
        if (trace := _trace(label, writer, strokes)) is not None:
            traces.append(trace)

    for number, line in enumerate(lines, 1):
        if line.startswith("."):
            keyword = line.split()[0]
            if keyword == ".SEGMENT":
                finish()
                match = _SEGMENT.match(line)
                segment = (match[2], -1, _strokes_of(match[1])) if match else None
                begin = number
                strokes = []
            elif keyword == ".COMMENT" and segment is not None and not strokes:
                segment = segment[0], _writer(line, segment[0]), segment[2]
            elif keyword == ".COORD":
                names = line.split()[1:]
                if not {"X", "Y"} <= set(names):
                    raise UserError(
                        f"{path}: line {number}: no X and Y in {line.strip()[:40]!r}; give a "
                        "UNIPEN file whose points have both"
                    )
                x_y = names.index("X"), names.index("Y")
            elif keyword == ".PEN_DOWN":
                strokes.append([])
            pen_down = keyword == ".PEN_DOWN"
        elif pen_down and line.strip():
            try:
                values = line.split(maxsplit=max(x_y) + 1)
                right, up = (float(values[place]) for place in x_y)
                if not (abs(right) <= LARGEST and abs(up) <= LARGEST):  # NaN is not
                    raise ValueError
            except (ValueError, IndexError):
                raise UserError(
                    f"{path}: line {number} is not a point (x y): {line.strip()[:40]!r}; "
                    "give a UNIPEN file with points in plain numbers"
                ) from None
            strokes[-1].append((-up, right))
    finish()
    if not traces:
        raise UserError(f"{path}: no segment labelled with a digit; give a UNIPEN file of digits")
    return tuple(traces)


def _strokes_of(components):
    """Number of the components in ``3`` or ``3-5``; None for another form."""
    match = _COMPONENTS.fullmatch(components)
    return int(match[2] or match[1]) - int(match[1]) + 1 if match else None


def _writer(comment, label):
    """Pen-Based Recognition of Handwritten Digits notes digit, writer and number."""
    match = re.fullmatch(r"\.COMMENT\s+(\d)\s+(\d+)\s+\d+\s*", comment)
    return int(match[2]) - 1 if match and match[1] == label else -1


def _trace(label, writer, strokes):
    strokes = [np.array(stroke) for stroke in strokes if len(stroke) > 1]
    if not re.fullmatch("[0-9]", label) or not strokes:
        return None
    return Trace(int(label), writer, fit_in_box(strokes))
