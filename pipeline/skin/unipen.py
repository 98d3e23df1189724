"""Recorded handwriting: pen trajectories in UNIPEN text.

Only what a file of isolated, labelled symbols needs is read: ``.SEGMENT`` (the components it spans
and its label), ``.PEN_DOWN``, ``.PEN_UP`` and the points under them (I. Guyon et al., "UNIPEN
project of on-line data exchange and recognizer benchmarks", ICPR 1994).
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from deploy.errors import UserError
from deploy.files import open_regular
from pipeline.settings import LARGEST
from pipeline.skin.handwriting import Motion, on_skin

MOST_TEXT = 1 << 26
"""Characters that are read of a file; a thousand writers take a tenth of it."""

_SEGMENT = re.compile(r'\.SEGMENT\s+\S+\s+(\S+)\s+\S+\s+"(.*)"')


@dataclass(frozen=True)
class Trace:
    """One digit as a tablet recorded it.

    Attributes
    ----------
    digit : int
    writer : int
        -1 where the file does not tell.
    strokes : tuple of ndarray, shape (n, 2)
        (down, right) along each contact of the pen, in a box of unit size around the whole digit,
        centred on 0; evenly spaced in time.
    """

    digit: int
    writer: int
    strokes: tuple


def read(path) -> tuple:
    """Read the digits of a UNIPEN file.

    Segments with another label than a digit are left out.

    Returns
    -------
    tuple of Trace
        In the order of the file.

    Raises
    ------
    UserError
        The file can't be read, a line is no point, or there is no digit in it.
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
    points = np.concatenate(strokes)
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(high[0] - low[0], 1e-9)
    middle = (low + high) / 2
    return Trace(int(label), writer, tuple((stroke - middle) / size for stroke in strokes))


def length_s(trace: Trace, place, p) -> float:
    """Seconds that :func:`move` takes at tempo 1."""
    clock = _timing([place(stroke) for stroke in trace.strokes], 1.0, p)
    return float(clock[-1][-1])


def move(trace: Trace, place, tempo: float, step_s: float, start_s: float, p) -> Motion:
    """Write a trace on the skin.

    Along each stroke the tablet's points stand at even times, so the writer's own changes of speed
    are kept; how long the whole takes follows from its length, since files such as this seldom give
    a sampling rate to rely on.

    Parameters
    ----------
    trace : Trace
    place : callable
        From points of the trace's box to points on the skin, in taxels.
    tempo, step_s, start_s, p
        As in :func:`pipeline.skin.handwriting.move`.
    """
    strokes = [place(stroke) for stroke in trace.strokes]
    clock = _timing(strokes, tempo, p)
    end = clock[-1][-1]
    time = np.arange(-p.landing_s, end + p.settle_s, step_s)
    path = scipy.interpolate.PchipInterpolator(np.concatenate(clock), np.concatenate(strokes))
    down, right = path(np.clip(time, 0, end)).T
    lands, lifts = np.array([(stroke[0], stroke[-1]) for stroke in clock]).T
    return Motion(start_s + time, down, right, on_skin(time, lands, lifts, p))


def _timing(strokes, tempo, p):
    """Time of each point of each stroke, from the first point on."""
    path = sum(np.hypot(*np.diff(stroke, axis=0).T).sum() for stroke in strokes)
    writing_s = p.stroke_s * (1 - p.overlap) * max(path, 1.0) / p.stroke_taxels / tempo
    interval = writing_s / sum(len(stroke) - 1 for stroke in strokes)
    clock = [interval * np.arange(len(strokes[0]))]
    for before, stroke in itertools.pairwise(strokes):
        leap = max(np.hypot(*(stroke[0] - before[-1])), 0.3)
        lands = clock[-1][-1] + p.stroke_s * (leap / p.stroke_taxels) ** p.isochrony / tempo
        clock.append(lands + interval * np.arange(len(stroke)))
    return clock
