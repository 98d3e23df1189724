"""Recorded handwriting: UNIPEN text."""

import numpy as np
import pytest

from deploy.errors import UserError
from experiments import unipen
from pipeline.simulation import handwriting, parameters

P = parameters.read_parameters()

SEVEN = """\
.INCLUDE dene.doc
.HIERARCHY DIGIT
.SEGMENT DIGIT 0-1 ? "7"
.COMMENT 7 12 224
.PEN_DOWN
 100 200
 200 200
 150 0
.PEN_UP
.DT 100
.PEN_DOWN
 120 100
 180 100
.PEN_UP
.SEGMENT DIGIT 2 ? "x"
.PEN_DOWN
 1 1
 2 2
.PEN_UP
"""


def test_strokes_box_and_writer(tmp_path):
    path = tmp_path / "seven.unipen"
    path.write_text(SEVEN)
    (trace,) = unipen.read(path)  # the x is left out
    assert (trace.digit, trace.writer) == (7, 11)
    # 200 high, 100 wide, y upwards in the file: (down, right) around the middle, over the height.
    np.testing.assert_allclose(trace.strokes[0], [[-0.5, -0.25], [-0.5, 0.25], [0.5, 0.0]])
    np.testing.assert_allclose(trace.strokes[1], [[0.0, -0.15], [0.0, 0.15]])


def test_the_order_of_a_point_s_values(tmp_path):
    """Time before x and y, and y before x."""
    path = tmp_path / "seven.unipen"
    path.write_text(SEVEN)
    (expected,) = unipen.read(path)
    for order, line in (("T X Y", "12 {} {} 5"), ("Y X", "{1} {0}")):
        lines = [line.format(*each.split()) if each[0] == " " else each
                 for each in SEVEN.splitlines()]  # fmt: skip
        path.write_text("\n".join([f".COORD {order}", *lines]))
        (trace,) = unipen.read(path)
        for stroke, wanted in zip(trace.strokes, expected.strokes, strict=True):
            np.testing.assert_array_equal(stroke, wanted)


def test_written_on_the_skin(tmp_path):
    path = tmp_path / "seven.unipen"
    path.write_text(SEVEN)
    (trace,) = unipen.read(path)
    strokes = [8 * stroke + 5 for stroke in trace.strokes]
    motion = handwriting.move_pen(strokes, 1.0, 1e-3, 0.1, P.kinematics)
    assert motion.force[0] == motion.force[-1] == 0
    lands = np.flatnonzero(np.diff((motion.force > 0.5).astype(int)) == 1)
    assert len(lands) == 2
    assert (motion.down[lands[1]], motion.right[lands[1]]) == pytest.approx((5, 3.8), abs=0.2)
    assert (motion.down[0], motion.right[0]) == pytest.approx((1, 3))
    assert motion.time_s[-1] - motion.time_s[0] == pytest.approx(
        handwriting.measure_duration_s(strokes, P.kinematics)
        + P.kinematics.landing_s
        + P.kinematics.settle_s,
        abs=2e-3,
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('.SEGMENT DIGIT 0 ? "3"\n.PEN_DOWN\n 1 2\n 1 two\n.PEN_UP\n', "line 4 "),
        ('.SEGMENT DIGIT 0 ? "3"\n.PEN_DOWN\n 1\n.PEN_UP\n', "line 3 "),
        *(
            (f'.SEGMENT DIGIT 0 ? "3"\n.PEN_DOWN\n 1 2\n {point}\n.PEN_UP\n', "line 4 ")
            for point in ("nan 1", "1 -inf", "1e400 1", "1 -1e308")
        ),
        ('.SEGMENT DIGIT 0-1 ? "3"\n.PEN_DOWN\n 1 2\n 1 3\n.PEN_UP\n', "line 1:"),
        ('.SEGMENT DIGIT 0:0-0:5 ? "3"\n.PEN_DOWN\n 1 2\n 1 3\n.PEN_UP\n', "line 1:"),
        (
            '.SEGMENT DIGIT 0 ? "3"\n.SEGMENT DIGIT 1 ? "4"\n'
            + 2 * ".PEN_DOWN\n 1 2\n 1 3\n.PEN_UP\n",
            "line 1:",
        ),
        (".COORD T X\n" + SEVEN, "line 1:"),
        (".COORD T X Y\n" + SEVEN, "line 7 "),
        ("hello\n", "segment"),
        ("", "segment"),
    ],
)
def test_bad_files(tmp_path, text, problem):
    path = tmp_path / "bad.unipen"
    path.write_text(text)
    with pytest.raises(UserError, match=problem) as raised:
        unipen.read(path)
    assert str(path) in str(raised.value)


def test_real_handwriting(shared_data):
    traces = unipen.read(shared_data / "pendigits-train.unipen")
    assert len(traces) == 7494
    assert {trace.writer for trace in traces} == set(range(30))
    assert np.bincount([trace.digit for trace in traces]).min() > 700
    for trace in traces:
        points = np.concatenate(trace.strokes)
        assert np.ptp(points[:, 0]) == pytest.approx(1)
    # Length of the path over the larger side, as measured on this file elsewhere: 3.1 for a 0.
    zeros = [trace for trace in traces if trace.digit == 0]
    ratio = [
        sum(np.hypot(*np.diff(s, axis=0).T).sum() for s in trace.strokes)
        / np.ptp(np.concatenate(trace.strokes), axis=0).max()
        for trace in zeros
    ]
    assert np.mean(ratio) == pytest.approx(3.1, abs=0.1)
    strokes = [8 * stroke + 4.5 for stroke in zeros[0].strokes]
    motion = handwriting.move_pen(strokes, 1.0, 1e-3, 0.1, P.kinematics)
    assert 0.3 < motion.time_s[-1] < 2.0
