import re
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.results.report import charts
from pipeline.results.report.page import confusion_cells


def texts(svg):
    return [t.text for t in ElementTree.fromstring(svg).iter() if t.tag.endswith("text")]


def test_a_line_goes_through_its_points():
    svg = charts.line_chart([charts.Series("a", (0, 10), (0.0, 1.0))], "x", "y")
    points = ElementTree.fromstring(svg).find(".//*[@class='line s1']").get("points")
    assert points == "48.0,210.0 346.0,26.0"  # the corners of the plot
    assert {"0", "2", "10", "0.2", "1", "x", "y"} <= set(texts(svg))


@given(
    st.lists(
        st.floats(-1e6, 1e6, allow_nan=False).map(lambda v: round(v, 3)), min_size=1, max_size=20
    )
)
def test_any_values_make_a_chart(values):
    svg = charts.line_chart([charts.Series("a", tuple(range(len(values))), tuple(values))], "", "")
    places = [float(v) for v in re.findall(r"[\d.]+", svg.split('points="')[1].split('"')[0])]
    assert all(25.9 <= y <= 210.1 for y in places[1::2])
    assert "-0<" not in svg
    assert "nan" not in svg


def test_names_are_escaped():
    rows = [("a < b & c", 0.5, (0.4, 0.6), None)]
    assert "a < b & c" in texts(charts.interval_chart(rows, "accuracy"))
    assert "<b>" not in charts.legend(["<b>"])


def test_an_interval_by_hand():
    svg = charts.interval_chart([("one", 0.75, (0.5, 1.0), 0.5)], "accuracy")
    root = ElementTree.fromstring(svg)
    line, dot, mark = (
        root.find(f".//*[@class='{name}']") for name in ("line s1", "dot s1", "reference")
    )
    assert (line.get("x1"), line.get("x2")) == ("22.0", "338.0")  # 50 % and 100 %, the axis' ends
    assert float(dot.get("cx")) == 180.0
    assert mark.get("x1") == "22.0"


def test_an_image_has_a_square_for_each_taxel_that_was_touched():
    values = np.zeros((10, 10))
    values[2, 7], values[3, 1] = 4, -2
    root = ElementTree.fromstring(charts.image(values))
    marks = [r for r in root.iter() if r.get("class") in ("on", "off")]
    assert [(m.get("class"), m.get("x"), m.get("y"), m.get("fill-opacity")) for m in marks] == [
        ("on", "7", "2", "1.00"),
        ("off", "1", "3", "0.50"),
    ]


def test_a_raster_has_a_stroke_for_each_spike():
    svg = charts.raster([("s1", [0, 50], [0, 9])], 100, "steps", "neuron", rows=10)
    path = ElementTree.fromstring(svg).find(".//*[@class='event s1']").get("d")
    assert re.findall(r"M([\d.]+) ([\d.]+)", path) == [("48.0", "146.6"), ("197.0", "26.0")]


def test_a_mark_stands_where_it_belongs():
    svg = charts.line_chart([charts.Series("a", (0, 10), (0.0, 1.0))], "x", "y", mark=5)
    line = ElementTree.fromstring(svg).find(".//*[@class='reference']")
    assert line.get("x1") == line.get("x2") == "197.0"


def test_a_confusion_matrix_has_its_counts_and_the_whole_names():
    matrix = np.diag(np.arange(1, 11))
    matrix[3, 5] = 77
    names = [f"a gesture whose name has forty characters {n}" for n in range(10)]
    drawn = confusion_cells(matrix, names)
    assert [name for name, _ in drawn["rows"]] == names
    cell = drawn["rows"][3][1][5]
    assert (cell["count"], cell["kind"]) == (77, "off")
    assert drawn["common"] == [(77, names[3], names[5])]


def test_hundreds_of_classes_are_not_drawn_as_a_matrix():
    matrix = np.eye(300, dtype=int)
    matrix[7, 9] = 2
    drawn = confusion_cells(matrix, [str(n) for n in range(300)])
    assert drawn["rows"] is None
    assert drawn["common"] == [(2, "7", "9")]


@pytest.mark.parametrize("matrix", [np.zeros((10, 10), int), np.ones((10, 10), int)])
def test_confusions_of_nothing_and_of_everything(matrix):
    drawn = confusion_cells(matrix, list("0123456789"))
    shades = [cell["shade"] for _, cells in drawn["rows"] for cell in cells]
    assert 0 <= min(shades) <= max(shades) <= 75


def test_equal_rates_are_dots_on_the_line():
    svg = charts.scatter([(0, 0), (50, 50), (100, 100), (0, 100)], "trained", "chip")
    tree = ElementTree.fromstring(svg)
    line = tree.findall(".//*[@class='axis']")[-1]
    ends = [float(line.get(name)) for name in ("x1", "y1", "x2", "y2")]
    dots = re.findall(r"M([\d.]+) ([\d.]+)h0", tree.find(".//*[@class='points']").get("d"))
    assert [tuple(map(float, dot)) for dot in dots] == [
        tuple(ends[:2]),
        ((ends[0] + ends[2]) / 2, (ends[1] + ends[3]) / 2),
        tuple(ends[2:]),
        (ends[0], ends[3]),
    ]
