"""Figures of recordings: what is drawn, and where."""

import io

import numpy as np
import pytest
from matplotlib import font_manager
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text

from pipeline.look import find_colour
from pipeline.recordings.events import Events
from pipeline.recordings.recordings import Source, join_recordings
from pipeline.recordings.sensor import Sensor, TaxelMap
from pipeline.results.report import figures
from pipeline.results.report.figures import recordings as data_figures


@pytest.fixture
def recordings():
    # Taxel 3 is in row 3 of the first column, taxel 70 in the first row of column 7 (zero-based).
    events = Events([100e6, 200e6, 1500e6], [3, 70, 70], [1, -1, 1], [4, 2, 5])
    other = Events([300e6], [99], [1], [4])
    return join_recordings(
        [events, other], [4, 8], ["4/0000", "8/0000"], [0, 1], Source("simulated, seed 0", "", True)
    )


def drawn(figure):
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=40)
    return file.getvalue()


def test_recording(recordings):
    figure = data_figures.draw_recording(recordings, 0)
    *frames, raster, _ = figure.get_axes()  # the last is the scale
    first, last = (np.asarray(axes.images[0].get_array()) for axes in (frames[1], frames[-1]))
    assert len(frames) == 8
    assert first[3, 0] > 0
    assert first[0, 7] == first[3, 0]  # one event each within a quarter of the 1.4 s
    assert last[0, 7] == 1.0  # two events at the end, the most of all
    assert last[3, 0] == 0.5
    assert (raster.get_xlim(), raster.get_ylim()) == (
        (0, pytest.approx(1.4)),
        (99.5, -0.5),
    )  # from above
    on, off = raster.collections
    # ON in the upper half of a taxel's row, OFF in the lower half.
    np.testing.assert_allclose(on.get_segments(), [[[0, 30], [0, 29.55]], [[1.4, 7], [1.4, 6.55]]])
    np.testing.assert_allclose(off.get_segments(), [[[0.1, 7], [0.1, 7.45]]])
    for marks, name in ((on, "on"), (off, "off")):
        assert to_hex(marks.get_color()[0]) == find_colour(name)
    assert "simulated" in figure.get_suptitle()
    assert drawn(figure).startswith(b"\x89PNG")


def test_sheet_has_a_row_for_each_digit(recordings):
    figure = data_figures.draw_sheet(recordings)
    *shown, _ = [axes for axes in figure.get_axes() if axes.get_visible()]  # the last is the scale
    assert [axes.get_ylabel() for axes in shown] == ["4 (1)", "8 (1)"]
    image = np.asarray(shown[1].images[0].get_array())
    assert image[9, 9] == 1
    assert image.sum() == 1
    assert "simulated" in figure.get_suptitle()


@pytest.mark.parametrize("rows", [1, 3])
def test_all_text_of_a_sheet_is_inside_it(rows):
    taxels = TaxelMap(np.repeat(np.arange(rows), 3), np.tile(np.arange(3), rows))
    classes = ("tap", "slide")
    samples = [Events([0, 9e8], [0, 2], [1, -1], [1, 1]), Events([5e8], [1], [1], [1])]
    sensor = Sensor(rows, 3, duration_s=1.0, classes=classes)
    ids, of = ["a/0", "b/0"], Source("strip", "", False)
    source = join_recordings(samples, [0, 1], ids, [-1, -1], of, taxels, sensor)
    figure = data_figures.draw_sheet(source)
    figure.draw_without_rendering()
    texts = [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
    extents = [text.get_window_extent() for text in texts]
    width, height = figure.bbox.size
    outside = [
        text.get_text()
        for text, box in zip(texts, extents, strict=True)
        if box.x0 < 0 or box.y0 < 0 or box.x1 > width or box.y1 > height
    ]
    assert outside == []


@pytest.mark.parametrize("positions", [None, [[0.0, 0.0], [1.0, 2.0], [5.0, -1.0]]])
def test_taxels_in_one_row_are_drawn_where_they_are_or_over_time(positions):
    taxels = TaxelMap(np.zeros(3, int), np.arange(3), positions and np.array(positions))
    samples = [Events([0, 9e8], [0, 2], [1, -1], [1, 1]), Events([5e8], [1], [1], [1])]
    sensor = Sensor(1, 3, duration_s=1.0, classes=("a", "b"))
    ids, of = ["a/0", "b/0"], Source("strip", "", False)
    strip = join_recordings(samples, [0, 1], ids, [-1, -1], of, taxels, sensor)
    shown = [axes for axes in data_figures.draw_sheet(strip).get_axes() if axes.get_visible()]
    first, second, _ = shown
    panels = data_figures.draw_recording(strip, 0).get_axes()
    raster = panels[-2] if positions else panels[0]  # the scale is the last
    np.testing.assert_allclose(raster.collections[0].get_segments(), [[[0, 0], [0, -0.45]]])
    if positions:
        last = panels[-3]
        for axes, expected in ((first, [1, 0, 1]), (second, [0, 1, 0]), (last, [1, 0, 1])):
            (points,) = axes.collections
            np.testing.assert_array_equal(points.get_offsets(), positions)
            np.testing.assert_array_equal(points.get_array(), expected)
            assert axes.yaxis_inverted()
    else:
        assert [tick for tick in raster.get_yticks() if -0.5 <= tick <= 2.5] == [0, 1, 2]
        image = np.asarray(first.images[0].get_array())
        assert [list(place) for place in np.argwhere(image)] == [[0, 0], [2, 36]]
        assert len(panels) == 1


def test_characters_that_no_font_has_are_said_and_others_get_a_font(monkeypatch, capsys):
    usual = font_manager.findfont("sans")
    assert figures.find_lacking("círcle 3", usual) == set()
    assert figures.find_lacking("a\U0001f9ea", usual) == {"\U0001f9ea"}
    monkeypatch.setattr(font_manager.fontManager, "ttflist", [])
    figure = Figure()
    figure.text(0, 0, "class \U0001f9ea")
    figures.add_fonts(figure)
    assert "no installed font" in capsys.readouterr().err


def test_events_at_the_borders_are_whole(recordings):
    *_, raster, _ = data_figures.draw_recording(recordings, 0).get_axes()
    lines = raster.collections
    assert lines
    assert not any(each.get_clip_on() for each in lines)
