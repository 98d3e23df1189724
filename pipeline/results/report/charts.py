"""Charts as SVG text, coloured by the style sheet of the page that contains them.

Every mark has a class (``s1`` to ``s4`` for series, ``grid``, ``axis``, ``on``, ``off``, ...) and
no colour of its own, so that one chart is used for light, dark and print.  Charts scale with the
page and are as wide as the screen of a phone, so that their text is never smaller than the page's
notes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

WIDTH, HEIGHT = 360, 250
LEFT, RIGHT, TOP, BOTTOM = 48, 14, 26, 40


@dataclass(frozen=True)
class Series:
    """A line of a chart.

    Attributes
    ----------
    name : str
    x, y : sequence of float
    intervals : sequence of (low, high), optional
        Interval of each y: a band around the line, or a bar if there is only one point.
    """

    name: str
    x: tuple
    y: tuple
    intervals: tuple = ()


def line_chart(
    series, x_label: str, y_label: str, y_range=None, description="", mark=None
) -> Markup:
    """Lines over a common x axis; the names are in a separate legend, see :func:`legend`.

    Parameters
    ----------
    series : sequence of Series
    x_label, y_label : str
    y_range : tuple of float, optional
    description : str
        Text for screen readers.
    mark : float, optional
        Position of a vertical line on the x axis.
    """
    x = np.concatenate([np.asarray(s.x, float) for s in series])
    y = np.concatenate([np.ravel([*s.y, *np.ravel(s.intervals)]) for s in series])
    x_axis = _Axis(x.min(), x.max(), LEFT, WIDTH - RIGHT)
    low, high = y_range or (y.min(), y.max())
    y_axis = _Axis(low, high, HEIGHT - BOTTOM, TOP)
    marks = [_axes(x_axis, y_axis, x_label, y_label)]
    if mark is not None:
        at = x_axis(min(max(mark, x_axis.low), x_axis.high))
        marks.append(_segment("reference", at, y_axis.start, at, y_axis.end))
    for number, s in enumerate(series, 1):
        points = _points(x_axis, y_axis, s.x, s.y)
        if s.intervals and len(s.x) > 1:
            low, high = zip(*s.intervals, strict=True)
            around = _points(x_axis, y_axis, (*s.x, *s.x[::-1]), (*low, *high[::-1]))
            marks.append(f'<polygon class="band s{number}" points="{around}"/>')
        elif s.intervals:
            (low, high), at = s.intervals[0], x_axis(s.x[0])
            marks.append(_segment(f"line s{number}", at, y_axis(low), at, y_axis(high)))
        if len(s.x) == 1:
            at = points.split(",")
            marks.append(f'<circle class="dot s{number}" cx="{at[0]}" cy="{at[1]}" r="3"/>')
        marks.append(f'<polyline class="line s{number}" points="{points}"/>')
    return _svg(WIDTH, HEIGHT, marks, description)


def scatter(points, x_label: str, y_label: str, description="") -> Markup:
    """Pairs of values on two equal axes from 0, with the line on which they would be equal.

    Parameters
    ----------
    points : sequence of (x, y)
        Not negative.
    x_label, y_label : str
    description : str
    """
    points = np.asarray(points, float).reshape(-1, 2)
    high = max(points.max(initial=0), 1e-9)
    x_axis, y_axis = _Axis(0, high, LEFT, WIDTH - RIGHT), _Axis(0, high, HEIGHT - BOTTOM, TOP)
    dots = "".join(f"M{x_axis(x):.1f} {y_axis(y):.1f}h0" for x, y in points)
    marks = [
        _axes(x_axis, y_axis, x_label, y_label),
        _segment("axis", x_axis.start, y_axis.start, x_axis.end, y_axis.end),
        f'<path class="points" d="{dots}"/>',
    ]
    return _svg(WIDTH, HEIGHT, marks, description)


def _points(x_axis, y_axis, x, y):
    return " ".join(f"{x_axis(a):.1f},{y_axis(b):.1f}" for a, b in zip(x, y, strict=True))


def interval_chart(rows, x_label: str, description="") -> Markup:
    """A chart with one row per value: a dot with its interval, and an optional reference mark.

    Parameters
    ----------
    rows : sequence of (name, value, (low, high) or None, reference or None)
        Accuracies, 0 to 1.
    x_label : str
    description : str
    """
    numbers = [n for _, value, interval, reference in rows
               for n in (value, *(interval or ()), reference) if n is not None]  # fmt: skip
    low = max(0.0, np.floor(min(numbers) * 20) / 20)
    left, top, step = 22, 12, 40
    height = top + step * len(rows) + BOTTOM
    axis = _Axis(low, 1.0, left, WIDTH - left)
    marks = []
    for tick in axis.ticks():
        marks.append(_segment("grid", axis(tick), top, axis(tick), height - BOTTOM))
        marks.append(_text(axis(tick), height - BOTTOM + 18, f"{100 * tick:.0f} %", "middle"))
    marks.append(_text(WIDTH / 2, height - 4, x_label, "middle"))
    for number, (name, value, interval, reference) in enumerate(rows):
        y = top + step * (number + 0.7)
        marks.append(_text(left, y - 12, name, "start"))
        if reference is not None:
            marks.append(_segment("reference", axis(reference), y - 10, axis(reference), y + 10))
        if interval:
            marks.append(_segment("line s1", axis(interval[0]), y, axis(interval[1]), y))
        marks.append(f'<circle class="dot s1" cx="{axis(value):.1f}" cy="{y:.1f}" r="4.5"/>')
    return _svg(WIDTH, height, marks, description)


def image(values, description="") -> Markup:
    """A tactile image: one square per taxel, darker with more events; negative values in red."""
    values = np.asarray(values, float)
    scale = np.abs(values).max() or 1.0
    marks = ['<rect class="paper" width="{1}" height="{0}"/>'.format(*values.shape)]
    for (row, column), value in np.ndenumerate(values / scale):
        if abs(value) > 0.004:
            sign = "on" if value > 0 else "off"
            marks.append(
                f'<rect class="{sign}" x="{column}" y="{row}" width="1" height="1" '
                f'fill-opacity="{abs(value):.2f}"/>'
            )
    return _svg(values.shape[1], values.shape[0], marks, description, "image")


def raster(groups, extent: float, x_label: str, y_label: str, description="", rows=None) -> Markup:
    """Events or spikes over time.

    Parameters
    ----------
    groups : sequence of (class, times, units)
        Marks, each group in one colour.
    extent : float
        End of the time axis.
    x_label, y_label : str
    description : str
    rows : int, optional
        Height in units; default: the highest unit.
    """
    rows = rows or max((int(np.max(units)) + 1 for _, _, units in groups if len(units)), default=1)
    height = 200
    x_axis = _Axis(0, extent, LEFT, WIDTH - RIGHT, exact=True)
    y_axis = _Axis(0, rows, height - BOTTOM, TOP, exact=True)
    marks = [_axes(x_axis, y_axis, x_label, y_label)]
    tall = max(1.6, (height - BOTTOM - TOP) / rows)
    for name, times, units in groups:
        path = "".join(
            f"M{x_axis(t):.1f} {y_axis(u + 1):.1f}v{tall:.1f}"
            for t, u in zip(times, units, strict=True)
        )
        marks.append(f'<path class="event {name}" d="{path}"/>')
    return _svg(WIDTH, height, marks, description)


def legend(names) -> Markup:
    """The legend of a chart: names of the series with their lines."""
    items = (
        f'<li><svg class="key" viewBox="0 0 30 6" aria-hidden="true"><line class="line s{number}" '
        f'x1="0" y1="3" x2="30" y2="3"/></svg>{escape(name)}</li>'
        for number, name in enumerate(names, 1)
    )
    return Markup('<ul class="legend">' + "".join(items) + "</ul>")


class _Axis:
    """A linear scale from values to places, with ticks at round values."""

    def __init__(self, low, high, start, end, exact=False):
        if high <= low:
            high = low + (abs(low) or 1.0)
        self.step = _round_step((high - low) / 5)
        if not exact:
            low = np.floor(low / self.step + 1e-9) * self.step
            high = np.ceil(high / self.step - 1e-9) * self.step
        self.low, self.high, self.start, self.end = low, high, start, end

    def __call__(self, value):
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self):
        first = np.ceil(self.low / self.step - 1e-9) * self.step
        return np.arange(first, self.high + self.step * 1e-6, self.step)

    def label(self, value):
        value = 0.0 if abs(value) < self.step * 1e-6 else value  # no "-0"
        return f"{value:.6g}"


def _round_step(step):
    magnitude = 10.0 ** np.floor(np.log10(step))
    return next(m * magnitude for m in (1, 2, 2.5, 5, 10) if m * magnitude >= step * 0.999)


def _axes(x_axis, y_axis, x_label, y_label):
    marks = []
    for tick in y_axis.ticks():
        marks.append(_segment("grid", x_axis.start, y_axis(tick), x_axis.end, y_axis(tick)))
        marks.append(_text(x_axis.start - 7, y_axis(tick) + 4, y_axis.label(tick), "end"))
    for tick in x_axis.ticks():
        marks.append(_segment("axis", x_axis(tick), y_axis.start, x_axis(tick), y_axis.start + 4))
        marks.append(_text(x_axis(tick), y_axis.start + 18, x_axis.label(tick), "middle"))
    marks.append(_segment("axis", x_axis.start, y_axis.start, x_axis.end, y_axis.start))
    middle = (x_axis.start + x_axis.end) / 2
    marks.append(_text(middle, y_axis.start + 35, x_label, "middle"))
    marks.append(_text(0, 12, y_label, "start"))
    return "".join(marks)


def _segment(name, x1, y1, x2, y2):
    return f'<line class="{name}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _text(x, y, text, anchor):
    return (
        f'<text class="label" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'
    )


def _svg(width, height, marks, description, name="chart"):
    return Markup(
        f'<svg class="{name}" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="{escape(description)}">{"".join(marks)}</svg>'
    )
