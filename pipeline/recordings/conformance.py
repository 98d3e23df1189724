"""Checks that every format of recordings must pass; the test of a new one calls them.

A test gives one file as the sensor's software writes it, and the events that are in it::

    def test_my_format(tmp_path):
        events = {"x": [3, 0], "y": [1, 2], "t": [0.1, 0.25], "p": [1, -1]}
        assert_format_conforms(".mine", path.read_bytes(), events, tmp_path)

The reader must be in :data:`pipeline.recordings.formats.READERS`.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from pipeline.recordings.files.reading import read_source
from pipeline.recordings.formats import READERS, read_file
from pipeline.recordings.formats.recording import UNITS, BadRecording, EventRecording

# Positions at which the file is cut, as shares of its length.
CUTS = (0.01, 0.25, 0.5, 0.9, 0.999)

# Contents that are no file of any format: rubbish, and valid JSON with values of wrong types.
FOREIGN_CONTENTS = (
    *(b"\0", b"no recording", bytes(range(256)) * 40, b"\xff\xfe" * 500),
    *(b"5", b"null", b"[]", b"{}", b"[[]]", b'{"x": [1]}', b"[[0, 0, 0.1, 1], 5]"),
    b'{"x": [1], "y": 0, "t_s": 0.1, "p": 1}\n{"x": 0, "y": null, "t_s": "a", "p": {}}\n5\n',
    b'[{"x": [1], "y": 0, "t_s": 0.1, "p": 1}, {"x": 0, "y": 0, "t_s": 0.2, "p": 1}]',
)


def assert_format_conforms(
    ending: str,
    content: bytes,
    events: dict,
    folder: Path,
    others: Sequence[bytes] = (),
    size: tuple | None = None,
):
    """Find the usual mistakes of a reader of recordings; each is an error that names the mistake.

    Parameters
    ----------
    ending : str
        Ending of the files, such as ``".mine"``.
    content : bytes
        A file with some events; at least one in which x and y differ, and one of each polarity if
        the sensor has both.
    events : dict of str to sequence
        The events of the file in order of time: ``x``, the column from the left, or the number of
        the taxel if the file numbers them; ``y``, the row from the top, or 0; ``t`` in seconds;
        ``p``, 1 where pressure rises and -1 where it falls.
    folder : Path
        An empty folder.
    others : sequence of bytes
        More files of the same sensor, which must fit together with the first one.  Best are some
        in which other taxels have events: a reader that infers the size of the sensor from one
        file fails on them.
    size : (int, int), optional
        Rows and columns of the sensor if the file has them, two different numbers.

    Raises
    ------
    AssertionError
    """
    _require_entry(ending)
    result = READERS[ending](content, f"recording{ending}")
    assert isinstance(result, EventRecording), "the reader does not return an EventRecording"
    expected = {name: np.asarray(values) for name, values in events.items()}
    _require_types(result)
    _require_times(result, expected)
    _require_places(result, expected)
    _require_size(result, size)
    _require_polarities(result, expected)
    _require_same_for_every_name(ending, content, result)
    _require_refusals(ending, content)
    _require_source(ending, (content, *others), folder)


def _require_entry(ending):
    assert ending == ending.lower(), f"{ending}: READERS has endings in lower case"
    assert ending.startswith("."), f"{ending}: the ending begins with a dot"
    assert ending in READERS, f"{ending}: READERS has no reader for it"


def _require_types(found):
    for name in ("x", "y", "time", "polarity"):
        array = getattr(found, name)
        assert isinstance(array, np.ndarray), f"{name} is not an array"
        assert array.shape == (len(found),), f"{name} has the shape {array.shape}, not (events,)"
    assert len(found), "a recording has events; the reader must refuse a file without any"
    for name in ("x", "y"):
        assert getattr(found, name).dtype == np.int64, f"{name} is not of 64-bit integers"
    assert found.time.dtype in (np.int64, np.float64), "time is of a type other than int64, float64"
    assert found.polarity.dtype == np.int8, "polarity is not of 8-bit integers"


def _require_times(found, expected):
    assert (np.diff(found.time) >= 0).all(), (
        "events are not in order of time (make_recording sorts)"
    )
    n = len(expected["t"])
    assert len(found) == n, f"{len(found)} events, the file has {n}"
    if found.layout == "bins":
        return  # the width of a bin is a setting
    assert found.unit in UNITS, "no unit of time; name it, such as t_us for make_recording"
    seconds = found.time * UNITS[found.unit]
    if np.allclose(seconds, expected["t"], rtol=1e-6, atol=1e-9):
        return
    factor = seconds[-1] / expected["t"][-1]
    raise AssertionError(
        f"times are in another unit or from another start: the last one is {seconds[-1]:g} s, not "
        f"{expected['t'][-1]:g} s (factor {factor:g}), read in {found.unit}"
    )


def _require_places(found, expected):
    is_right = [np.array_equal(getattr(found, name), expected[name]) for name in ("x", "y")]
    if all(is_right):
        return
    is_exchanged = np.array_equal(found.x, expected["y"]) and np.array_equal(found.y, expected["x"])
    assert not is_exchanged, "x and y are exchanged: x is the column from the left, y the row"
    name = "y" if is_right[0] else "x"
    top = getattr(found, name)
    difference = np.unique(top - expected[name])
    assert len(difference) > 1, f"{name} is {difference[0]:+d} too large; places count from 0"
    rows_from_below = len(np.unique(top + expected[name])) == 1
    assert not rows_from_below, f"{name} counts from the other side; rows count from the top"
    raise AssertionError(f"{name} is {top.tolist()}, not {expected[name].tolist()}")


def _require_size(found, expected):
    """The size is (rows, columns), that of the file, and no event is outside of it."""
    if expected is not None:
        assert found.size is not None, (
            f"no size, the file has {expected}: pass it to make_recording"
        )
        is_right = tuple(found.size) == tuple(expected)
        is_exchanged = tuple(found.size) == tuple(reversed(expected))
        assert is_right or not is_exchanged, (
            f"rows and columns of the size are exchanged: {expected} is (rows, columns)"
        )
        assert is_right, f"the size is {found.size}, not {expected}"
    if found.size is not None:
        extent = (found.y.max() + 1, found.x.max() + 1)
        assert np.all(np.less_equal(extent, found.size)), (
            f"events are outside of the size {found.size}; it is (rows, columns)"
        )


def _require_polarities(found, expected):
    polarity = expected["p"]
    assert not np.array_equal(found.polarity, -polarity), "the polarity is reversed: ON is 1"
    assert np.array_equal(found.polarity, polarity), (
        f"p is {found.polarity.tolist()}, not {polarity.tolist()}"
    )


def _require_same_for_every_name(ending, content, found):
    """The name of a file says nothing but its format, and reading leaves nothing behind."""
    for name in (f"Über uns 7{ending.upper()}", f"a/b{ending}", f"0{ending}"):
        again = read_file(content, name)
        for field in ("x", "y", "time", "polarity"):
            same = np.array_equal(getattr(again, field), getattr(found, field))
            assert same, f"{field} is another one for the name {name!r}"


def _require_refusals(ending, content):
    """A file that is damaged or of another format is refused, or read as far as it goes."""
    cut = [content[: int(share * len(content))] for share in CUTS]
    for wrong in (b"", *cut, *FOREIGN_CONTENTS):
        shown = f"a damaged file of {len(wrong)} bytes ({wrong[:40]!r})"
        try:
            result = READERS[ending](wrong, f"damaged{ending}")
        except BadRecording:
            continue
        except Exception as error:
            raise AssertionError(
                f"{shown} raises {type(error).__name__}, not BadRecording: {error}"
            ) from error
        assert isinstance(result, EventRecording), "a damaged file gives something else"
        assert len(result), f"{shown} gives a recording without events"


def _require_source(ending, contents, folder):
    """Folders of classes with such files are a source."""
    for label in ("a", "b"):
        for number, content in enumerate(2 * contents):
            path = folder / label / f"{number}{ending}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
    try:
        recordings = read_source(folder, jobs=1)
    except UserError as error:
        raise AssertionError(f"files of one sensor do not fit together: {error}") from error
    n = 4 * len(contents)
    read = f"{len(recordings)} of {n} files were read from a folder of classes"
    assert len(recordings) == n, read
    assert recordings.sensor.classes == ("a", "b")
