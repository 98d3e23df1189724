"""Charts: every mark is where its value belongs."""

import base64
import io
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from pipeline.look import find_colour
from pipeline.results.report import charts


def test_marks_of_a_timeline_share_their_time_axis():
    """A spike at half of the time, the curve's middle point and the mark are below each other."""
    svg = charts.draw_timeline(
        [
            charts.Raster("layer", (("s1", [0, 50], [0, 9]),), 10),
            charts.Lines("p", (charts.Series("a", (0, 50, 100), (0.0, 0.5, 1.0)),)),
        ],
        100,
        "ms",
        mark=50,
    )
    root = ElementTree.fromstring(svg)
    path = root.find(".//*[@class='event s1']").get("d")
    (_, first), (_, second) = re.findall(r"M([\d.]+) ([\d.]+)", path)
    x = [float(at) for at, _ in re.findall(r"M([\d.]+) ([\d.]+)", path)]
    middle = root.find(".//*[@class='line s1']").get("points").split()[1].split(",")[0]
    assert float(first) < float(second)  # unit 0 is above unit 9
    assert x[1] == float(middle) == float(root.find(".//*[@class='reference']").get("x1"))


@pytest.mark.parametrize(("value", "is_below"), [(88, True), (95, False), (60, False)])
def test_a_point_s_name_does_not_cross_the_dashed_line(value, is_below):
    series = charts.Series("a", (0, 1), (0.0, value))
    points, levels = [(1, value, "end")], [(92, "regression")]
    chart = charts.draw_line_chart(
        charts.LineChart([series], "x", "y", least=0, points=points, levels=levels)
    )
    root = ElementTree.fromstring(chart)
    at = {text.text.split()[0]: float(text.get("y")) for text in root.iter("text")}
    dot = float(root.find(".//*[@class='dot']").get("cy"))
    assert (at["end"] > dot) is is_below
    line = float(root.find(".//*[@class='reference']").get("y1"))
    assert (at["regression"] < line) is (value < 92)  # on the side where the curve does not end


def test_an_interval_is_drawn_from_its_lower_to_its_upper_end():
    root = ElementTree.fromstring(charts.draw_interval(0.75, 0.6, 0.9, 0.5))
    (line,), (dot,) = (root.findall(f".//*[@class='{name}']") for name in ("line s1", "dot"))
    left, middle, right = (float(edge.get("x1")) for edge in root.findall(".//*[@class='grid']"))
    assert float(dot.get("cx")) == middle == (left + right) / 2  # from 0.5 to 1
    assert float(line.get("x1")) - left == pytest.approx(right - float(line.get("x2")), abs=0.2)
    assert root.find("title").text == "75.0\u00a0%, 60.0\u00a0% to 90.0\u00a0%"


def test_a_thumbnail_is_strongest_where_the_most_events_are():
    values = np.zeros((3, 2))
    values[0, 1], values[2, 0] = 4, -2
    content = re.search(r"base64,([^\"]+)", charts.draw_thumbnail(values))[1]
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(content))).convert("RGBA"))
    assert pixels[..., 3].tolist() == [[0, 255], [0, 0], [128, 0]]
    on, off = (bytes(pixels[place][:3]).hex() for place in ((0, 1), (2, 0)))
    assert (f"#{on}", f"#{off}") == (find_colour("on"), find_colour("off"))
