"""Charts as SVG text, coloured by the style sheet of the page that contains them.

Every mark has a class (``s1`` to ``s4`` for series, ``grid``, ``axis``, ``on``, ``off``, ...) and
no colour of its own, so that one chart is used for light, dark and print.  Values are shown by the
browser's own tooltips (``<title>``).
"""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape
from PIL import Image

from pipeline.look import find_colour

WIDTH = 360
CHART = 440
HEIGHT = 250
LEFT = 48
RIGHT = 14
TOP = 26
BOTTOM = 40
# Width of a timeline, the top of its first panel, and height and distance of its panels.
TIMELINE = 2 * WIDTH
FIRST_PANEL = 22
PANEL = 90
PANEL_GAP = 26
# Points of a line that have a tooltip of their own.
MAX_TOOLTIPS = 60


@dataclass(frozen=True)
class Series:
    """A line of a chart.

    Attributes
    ----------
    name : str
    x, y : sequence of float
    intervals : sequence of (low, high), optional
        Interval of each y: a band around the line.
    """

    name: str
    x: tuple
    y: tuple
    intervals: tuple = ()


@dataclass(frozen=True)
class Raster:
    """Events or spikes over time, a panel of :func:`draw_timeline`.

    Attributes
    ----------
    title : str
    groups : sequence of (class, times, units)
        Marks, each group in one colour.
    rows : int
        Number of units.
    """

    title: str
    groups: tuple
    rows: int


@dataclass(frozen=True)
class Lines:
    """Curves from 0 to 1 over time, a panel of :func:`draw_timeline`.

    Attributes
    ----------
    title : str
    series : tuple of Series
    levels : tuple of float
        Heights of dashed lines.
    points : tuple of (float, float)
        Time and height of single values.
    """

    title: str
    series: tuple
    levels: tuple = ()
    points: tuple = ()


def format_percent(share: float) -> str:
    """A share in percent, rounded as the same share in a terminal is (to three decimals)."""
    return f"{100 * round(share, 3):.1f}\u00a0%"


@dataclass(frozen=True)
class LineChart:
    """Lines over a common x axis; the names are in a separate legend, see :func:`draw_legend`.

    Attributes
    ----------
    series : sequence of Series
    x_label, y_label : str
    description : str
        Text for screen readers.
    least : float or None
        Lower end of the y axis; None for that of the lines.
    points : sequence of (x, y, name)
        Single values.
    levels : sequence of (y, name)
        Dashed lines.
    """

    series: Sequence[Series]
    x_label: str
    y_label: str
    description: str = ""
    least: float | None = None
    points: Sequence[tuple] = ()
    levels: Sequence[tuple] = ()


def draw_line_chart(chart: LineChart) -> Markup:
    """Draw lines over a common x axis."""
    every_x = np.concatenate([np.asarray(one.x, float) for one in chart.series])
    every_y = np.concatenate([np.ravel([*one.y, *np.ravel(one.intervals)]) for one in chart.series])
    every_y = np.append(every_y, [*(y for _, y, _ in chart.points), *(y for y, _ in chart.levels)])
    lowest = every_y.min() if chart.least is None else chart.least
    x_axis = _Axis(every_x.min(), every_x.max(), LEFT, CHART - RIGHT)
    y_axis = _Axis(lowest, every_y.max(), HEIGHT - BOTTOM, TOP)
    marks = [_draw_axes(x_axis, y_axis, chart.x_label, chart.y_label)]
    for number, one in enumerate(chart.series, 1):
        if one.intervals:
            low, high = zip(*one.intervals, strict=True)
            around = _format_points(x_axis, y_axis, (*one.x, *one.x[::-1]), (*low, *high[::-1]))
            marks.append(f'<polygon class="band s{number}" points="{around}"/>')
        marks.append(_draw_line(x_axis, y_axis, one, number))
    for level, name in chart.levels:
        height = y_axis(level)
        marks.append(_draw_segment("reference", LEFT, height, CHART - RIGHT, height))
        # On the side of the line where no curve ends.
        aside = 16 if any(one.y[-1] > level for one in chart.series) else -6
        marks.append(_draw_text(CHART - RIGHT, height + aside, f"{name} {level:.1f}", "end"))
    for x, y, name in chart.points:
        marks.append(_draw_dot(x_axis(x), y_axis(y), f"{name}: {y:.1f} %"))
        aside = 18 if any(0 <= level - y < 9 for level, _ in chart.levels) else -9
        marks.append(_draw_text(x_axis(x), y_axis(y) + aside, f"{name} {y:.1f}", "end"))
    return _make_svg(CHART, HEIGHT, marks, chart.description)


def draw_interval(value: float, low: float, high: float, least: float) -> Markup:
    """A value with its interval, for a cell of a table.

    Parameters
    ----------
    value, low, high : float
        Shares, 0 to 1.
    least : float
        Value at the left edge; the right one is 1.
    """
    axis = _Axis(least, 1, 8, WIDTH / 2, exact=True)
    y = 10
    description = f"{format_percent(value)}, {format_percent(low)} to {format_percent(high)}"
    dot = _draw_dot(axis(value), y, description)
    line = _draw_segment("line s1", axis(low), y, axis(high), y)
    edges = (_draw_segment("grid", axis(x), 0, axis(x), 2 * y) for x in (least, (1 + least) / 2, 1))
    return _make_svg(
        WIDTH / 2 + 8, 2 * y, [*edges, _make_title(description), line, dot], description, "interval"
    )


def draw_timeline(panels, extent: float, x_label: str, description: str = "", mark=None) -> Markup:
    """Panels below each other over one time axis.

    Parameters
    ----------
    panels : sequence of Raster or Lines
    extent : float
        End of the time axis.
    x_label, description : str
    mark : float, optional
        Time of a vertical line through all panels.
    """
    x_axis = _Axis(0, extent, LEFT, TIMELINE - RIGHT, exact=True)
    marks = []
    top = FIRST_PANEL
    for panel in panels:
        bottom = top + PANEL
        marks.append(_draw_text(LEFT, top - 6, panel.title, "start"))
        marks.append(_draw_segment("axis", LEFT, bottom, TIMELINE - RIGHT, bottom))
        draw = _draw_raster if isinstance(panel, Raster) else _draw_curves
        marks += draw(panel, x_axis, top)
        top = bottom + PANEL_GAP
    end = top - PANEL_GAP
    if mark is not None:
        marks.append(_draw_segment("reference", x_axis(mark), FIRST_PANEL, x_axis(mark), end))
    for tick in x_axis.list_ticks():
        marks.append(_draw_segment("axis", x_axis(tick), end, x_axis(tick), end + 4))
        anchor = "end" if x_axis(tick) > TIMELINE - 2 * RIGHT else "middle"
        marks.append(_draw_text(x_axis(tick), end + 20, x_axis.format_label(tick), anchor))
    marks.append(_draw_text((LEFT + TIMELINE) / 2, end + 41, x_label, "middle"))
    return _make_svg(TIMELINE, end + 48, marks, description, "timeline")


def _draw_raster(panel: Raster, x_axis, top) -> list:
    """The marks of a panel of events or spikes."""
    bottom = top + PANEL
    y_axis = _Axis(0, panel.rows, top, bottom, exact=True)
    marks = [
        _draw_text(LEFT - 7, top + 10, "0", "end"),
        _draw_text(LEFT - 7, bottom, str(panel.rows - 1), "end"),
    ]
    height = max(2.0, PANEL / panel.rows)
    for name, times, units in panel.groups:
        path = "".join(
            f"M{x_axis(time):.1f} {y_axis(unit):.1f}v{height:.1f}"
            for time, unit in zip(times, units, strict=True)
        )
        marks.append(f'<path class="event {name}" d="{path}"/>')
    return marks


def _draw_curves(panel: Lines, x_axis, top) -> list:
    """The marks of a panel of curves between 0 and 1."""
    y_axis = _Axis(0, 1.06, top + PANEL, top, exact=True)  # shows what is near 1
    right = TIMELINE - RIGHT
    marks = []
    for tick in (0, 0.5, 1):
        marks.append(_draw_segment("grid", LEFT, y_axis(tick), right, y_axis(tick)))
        marks.append(_draw_text(LEFT - 7, y_axis(tick) + 4, f"{100 * tick:.0f}", "end"))
    for level in panel.levels:
        marks.append(_draw_segment("axis level", LEFT, y_axis(level), right, y_axis(level)))
    for number, series in enumerate(panel.series, 1):
        marks.append(_draw_line(x_axis, y_axis, series, number, 100))
    for x, y in panel.points:
        marks.append(_draw_dot(x_axis(x), y_axis(y), f"{100 * y:.1f} %", "end"))
    return marks


def draw_thumbnail(values, description: str = "", positions=None) -> Markup:
    """A tactile image as a small picture, one pixel or dot for each taxel.

    Parameters
    ----------
    values : ndarray, shape (rows, columns)
        A negative value has the colour of OFF events.
    description : str
    positions : ndarray, shape (columns, 2), optional
        Where the taxels of one row are, from :func:`deploy.network.provenance.read_positions`.
    """
    values = np.asarray(values, float)
    if positions is not None:
        return _draw_dots(values[0] / (np.abs(values).max(initial=0) or 1), positions, description)
    pixels = np.zeros((*values.shape, 4), np.uint8)
    for sign, name in ((1, "on"), (-1, "off")):
        pixels[np.sign(values) == sign, :3] = [
            int(find_colour(name)[i : i + 2], 16) for i in (1, 3, 5)
        ]
    pixels[..., 3] = np.rint(255 * np.abs(values) / (np.abs(values).max(initial=0) or 1))
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
    content = base64.b64encode(buffer.getvalue()).decode()
    return Markup(
        f'<span class="thumb"><img alt="{escape(description)}" '
        f'src="data:image/png;base64,{content}"></span>'
    )


def _draw_dots(shades, positions, description):
    """Taxels where they are, a dot for each, with shades from -1 to 1."""
    radius = 0.45 / len(positions) ** 0.5
    marks = [
        f'<circle class="{"on" if shade >= 0 else "off"}" cx="{x:.2f}" cy="{y:.2f}" '
        f'r="{radius:.2f}" fill-opacity="{max(abs(shade), 0.08):.2f}"/>'
        for (x, y), shade in zip(positions, shades, strict=True)
    ]
    width, height = positions.max(axis=0) + 2 * radius
    return Markup(
        f'<svg class="thumb" viewBox="{-radius:.3f} {-radius:.3f} {width:.3f} {height:.3f}" '
        f'role="img" aria-label="{escape(description)}">{"".join(marks)}</svg>'
    )


def draw_legend(names) -> Markup:
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
        magnitude = 10.0 ** np.floor(np.log10((high - low) / 5))
        steps = (m * magnitude for m in (1, 2, 2.5, 5, 10))
        self.step = next(step for step in steps if step >= (high - low) / 5 * 0.999)
        if not exact:
            low = np.floor(low / self.step + 1e-9) * self.step
            high = np.ceil(high / self.step - 1e-9) * self.step
        self.low = low
        self.high = high
        self.start = start
        self.end = end

    def __call__(self, value):
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)

    def list_ticks(self):
        first = np.ceil(self.low / self.step - 1e-9) * self.step + 0.0  # no "-0"
        return np.arange(first, self.high + self.step * 1e-6, self.step)

    def format_label(self, value):
        value = 0.0 if abs(value) < self.step * 1e-6 else value  # no "-0"
        return f"{value:.6g}"


def _draw_axes(x_axis, y_axis, x_label, y_label):
    marks = []
    for tick in y_axis.list_ticks():
        marks.append(_draw_segment("grid", x_axis.start, y_axis(tick), x_axis.end, y_axis(tick)))
        marks.append(
            _draw_text(x_axis.start - 7, y_axis(tick) + 4, y_axis.format_label(tick), "end")
        )
    for tick in x_axis.list_ticks():
        marks.append(
            _draw_segment("axis", x_axis(tick), y_axis.start, x_axis(tick), y_axis.start + 4)
        )
        marks.append(
            _draw_text(x_axis(tick), y_axis.start + 18, x_axis.format_label(tick), "middle")
        )
    marks.append(_draw_segment("axis", x_axis.start, y_axis.start, x_axis.end, y_axis.start))
    middle = (x_axis.start + x_axis.end) / 2
    marks.append(_draw_text(middle, y_axis.start + 35, x_label, "middle"))
    marks.append(_draw_text(0, 12, y_label, "start"))
    return "".join(marks)


def _draw_line(x_axis, y_axis, series, number, scale=1):
    """A line of percentages, or of shares, which a scale of 100 makes percentages."""
    points = _format_points(x_axis, y_axis, series.x, series.y)
    dots = ""
    if len(series.x) <= MAX_TOOLTIPS:
        dots = "".join(
            f'<circle class="hit" cx="{x_axis(x):.1f}" cy="{y_axis(y):.1f}" r="6">'
            f"{_make_title(f'{series.name}: {scale * y:.1f} % at {x:.4g}')}</circle>"
            for x, y in zip(series.x, series.y, strict=True)
        )
    title = _make_title(f"{series.name}: {scale * series.y[-1]:.1f} % at the end")
    return f'<g>{title}<polyline class="line s{number}" points="{points}"/>{dots}</g>'


def _format_points(x_axis, y_axis, x, y):
    return " ".join(f"{x_axis(a):.1f},{y_axis(b):.1f}" for a, b in zip(x, y, strict=True))


def _make_title(text):
    return f"<title>{escape(text)}</title>"


def _draw_segment(name, x1, y1, x2, y2):
    return f'<line class="{name}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _draw_dot(x, y, title, name="dot"):
    return f'<circle class="{name}" cx="{x:.1f}" cy="{y:.1f}" r="4.5">{_make_title(title)}</circle>'


def _draw_text(x, y, text, anchor):
    return (
        f'<text class="label" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'
    )


def _make_svg(width, height, marks, description, name="chart"):
    return Markup(
        f'<svg class="{name}" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="{escape(description)}">{"".join(marks)}</svg>'
    )
