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
MAX_CHARACTERS = 1 << 26

# Largest coordinate; all integers up to it are exact.
MAX_COORDINATE = 2**53

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
        lines = file.read(MAX_CHARACTERS).splitlines()
    reader = _Reader(path)
    for number, line in enumerate(lines, 1):
        reader.read_line(number, line)
    reader.finish_segment()
    if not reader.traces:
        raise UserError(f"{path}: no segment labelled with a digit; give a UNIPEN file of digits")
    return tuple(reader.traces)


class _Reader:
    """The strokes found in a file so far, and the segment that is being read."""

    def __init__(self, path):
        self.path = path
        self.traces = []
        self._segment = None  # label, writer and number of strokes
        self._begin = 1  # line of the segment
        self._strokes = []
        self._pen_is_down = False
        self._coordinate_columns = (0, 1)  # of x and y in a line

    def read_line(self, number, line):
        if line.startswith("."):
            self._read_keyword(number, line)
        elif self._pen_is_down and line.strip():
            self._strokes[-1].append(self._read_point(number, line))

    def finish_segment(self):
        """Add the digit of the segment, if it is one."""
        if self._segment is None:
            return
        label, writer, n_strokes = self._segment
        if re.fullmatch("[0-9]", label) and n_strokes != len(self._strokes):
            raise UserError(
                f"{self.path}: line {self._begin}: the strokes below it are not those that the "
                "segment names; give a UNIPEN file in which each digit's strokes follow its "
                ".SEGMENT"
            )
        trace = _make_trace(label, writer, self._strokes)
        if trace is not None:
            self.traces.append(trace)

    def _read_keyword(self, number, line):
        keyword = line.split()[0]
        if keyword == ".SEGMENT":
            self._begin_segment(number, line)
        elif keyword == ".COMMENT" and self._segment is not None and not self._strokes:
            label, _, n_strokes = self._segment
            self._segment = label, _find_writer(line, label), n_strokes
        elif keyword == ".COORD":
            self._coordinate_columns = self._find_coordinate_columns(number, line)
        elif keyword == ".PEN_DOWN":
            self._strokes.append([])
        self._pen_is_down = keyword == ".PEN_DOWN"

    def _begin_segment(self, number, line):
        self.finish_segment()
        match = _SEGMENT.match(line)
        self._segment = (match[2], -1, _count_strokes(match[1])) if match else None
        self._begin = number
        self._strokes = []

    def _find_coordinate_columns(self, number, line):
        names = line.split()[1:]
        if not {"X", "Y"} <= set(names):
            raise UserError(
                f"{self.path}: line {number}: no X and Y in {line.strip()[:40]!r}; give a "
                "UNIPEN file whose points have both"
            )
        return names.index("X"), names.index("Y")

    def _read_point(self, number, line):
        """The point (down, right) of a line."""
        try:
            values = line.split(maxsplit=max(self._coordinate_columns) + 1)
            right, up = (float(values[column]) for column in self._coordinate_columns)
            if not (abs(right) <= MAX_COORDINATE and abs(up) <= MAX_COORDINATE):  # NaN is not
                raise ValueError
        except (ValueError, IndexError):
            raise UserError(
                f"{self.path}: line {number} is not a point (x y): {line.strip()[:40]!r}; "
                "give a UNIPEN file with points in plain numbers"
            ) from None
        return -up, right


def _count_strokes(components):
    """Number of the components in ``3`` or ``3-5``; None for another form."""
    match = _COMPONENTS.fullmatch(components)
    return int(match[2] or match[1]) - int(match[1]) + 1 if match else None


def _find_writer(comment, label):
    """Pen-Based Recognition of Handwritten Digits notes digit, writer and number."""
    match = re.fullmatch(r"\.COMMENT\s+(\d)\s+(\d+)\s+\d+\s*", comment)
    return int(match[2]) - 1 if match and match[1] == label else -1


def _make_trace(label, writer, strokes):
    strokes = [np.array(stroke) for stroke in strokes if len(stroke) > 1]
    if not re.fullmatch("[0-9]", label) or not strokes:
        return None
    return Trace(int(label), writer, fit_in_box(strokes))
