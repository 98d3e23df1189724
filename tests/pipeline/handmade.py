"""Recordings and archives made by hand."""

import io
import zipfile

import numpy as np
import scipy.io

from pipeline.recordings.events import Events
from pipeline.recordings.recordings import Source, join_recordings
from pipeline.recordings.sensor import TaxelMap
from pipeline.recordings.spike_frames import EventTable

SOURCE = Source("made by hand", "0" * 64, simulated=True)

# Time in ns, taxel, polarity, columns.
GOOD = [(0, 5, 1, 4), (100_000, 17, -1, 2), (2_000_000, 5, -1, 1), (3_000_000, 99, 1, 5)]


def events(rows=GOOD):
    return Events(*np.array(rows, np.int64).reshape(-1, 4).T)


def recordings(*samples, labels=None, taxels=None, parts=()):
    each, n = [events(rows) for rows in samples], len(samples)
    ids, labels = [f"0/{i}" for i in range(n)], labels or [0] * n
    return join_recordings(each, labels, ids, [-1] * n, SOURCE, taxels, parts=parts)


def event_table(columns, offsets, size=(10, 10)):
    """A table of events: times in ms, rows, columns, and 0 for ON or 1 for OFF."""
    time_ms, row, column, polarity = columns
    rows, side = size
    taxels = TaxelMap(np.arange(rows * side) // side, np.arange(rows * side) % side)
    time_ns = np.rint(1e6 * np.asarray(time_ms, float))
    taxel = np.asarray(row, int) * side + column
    signs = 1 - 2 * np.asarray(polarity, int)
    return EventTable(Events(time_ns, taxel, signs, np.ones(len(taxel))), offsets, taxels, size)


def spiketrain(n=6):
    """Events on taxels 0, 1, ..., one each 1 ms, ON (-1) and OFF (1) in turn."""
    array = np.zeros((101, n))
    array[np.arange(n), np.arange(n)] = np.where(np.arange(n) % 2, 1, -1)
    array[100] = 0.1 + 0.001 * np.arange(n)
    return array


def mat5(**variables) -> bytes:
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, variables)
    return buffer.getvalue()


def npz(*arrays, **named) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, *arrays, **named)
    return buffer.getvalue()


def archive(path, members) -> None:
    with zipfile.ZipFile(path, "w") as file:
        for name, content in members.items():
            file.writestr(name, content)


def good_members(per_digit=1, root="data_submission/"):
    """Members of an archive in the published layout, no two recordings the same."""
    return {
        f"{root}{digit}/{index:03d}.mat": mat5(spiketrain=spiketrain(1 + digit + index))
        for digit in range(10)
        for index in range(per_digit)
    }


def encrypt(path, name):
    """Set the bit that says that a member is encrypted, in both places where a zip has it."""
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as file:
        local = file.getinfo(name).header_offset
    content[local + 6] |= 1
    central = content.find(b"PK\x01\x02")
    while central >= 0:
        length = int.from_bytes(content[central + 28 : central + 30], "little")
        if content[central + 46 : central + 46 + length].decode() == name:
            content[central + 8] |= 1
        central = content.find(b"PK\x01\x02", central + 1)
    path.write_bytes(content)


def assert_same(a, b, source=True):
    """Two sets of recordings are the same in all they hold."""
    for name in ("time_ns", "taxel", "polarity", "columns"):
        np.testing.assert_array_equal(getattr(a.events, name), getattr(b.events, name))
    for name in ("offsets", "labels", "writers"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_array_equal(a.taxels.row, b.taxels.row)
    np.testing.assert_array_equal(a.taxels.column, b.taxels.column)
    np.testing.assert_array_equal(a.taxels.positions, b.taxels.positions)
    assert (a.ids, a.parts) == (b.ids, b.parts)
    if source:
        assert a.source == b.source
