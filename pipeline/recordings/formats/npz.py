"""NumPy's files: ``.npz`` with arrays x, y, t, p or one array, ``.npy`` with one array.

A ``.npz`` may also have ``rows`` and ``columns`` of the sensor, the number of a ``writer``, and
``simulated``.

Nothing in a file is executed: only plain arrays of numbers are read, and no more than a recording
can have.
"""

import io
import zipfile
from dataclasses import replace

import numpy as np

from pipeline.recordings.formats.bins import make_binned_recording
from pipeline.recordings.formats.column_order import make_array_recording
from pipeline.recordings.formats.recording import (
    MAX_EVENTS,
    MAX_PLACE,
    BadRecording,
    EventRecording,
    find_columns,
    make_recording,
    parse_writer,
)

# Bytes of an event in an array: eight fields of eight bytes.
MAX_EVENT_BYTES = 64

# Names of arrays that are not events.
ABOUT = ("simulated", "writer", "rows", "columns")


def read_npz(content: bytes, name: str = "") -> EventRecording:
    """Read four arrays by name, or a single array; and further entries of the file.

    Raises
    ------
    BadRecording
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            sizes = {
                info.filename.removesuffix(".npy"): info.file_size
                for info in archive.infolist()
                if info.filename.endswith(".npy")
            }
            fact_names = [name for name in ABOUT if name in sizes]
            events = [name for name in sizes if name not in fact_names]
            event_names = events if len(events) == 1 else list(find_columns(events).values())
            if (
                sum(sizes[name] for name in event_names + fact_names)
                > MAX_EVENT_BYTES * MAX_EVENTS + 4096
            ):
                raise BadRecording(f"has arrays of more than {MAX_EVENTS} events")
            arrays = {
                name: read_array(archive.read(f"{name}.npy"), name)
                for name in event_names + fact_names
            }
    except BadRecording:
        raise
    except MemoryError:
        raise
    except Exception as error:  # damaged lists and unsupported compressions fail in many ways
        raise BadRecording("is not a .npz file, or damaged") from error
    facts = {name: arrays.pop(name) for name in fact_names}
    size = [_find_side(facts.get(name)) for name in ("rows", "columns")]
    # Events outside of the size are reported with the source.
    return replace(
        make_recording(arrays) if len(arrays) > 1 else make_array_recording(*arrays.values()),
        simulated=bool(np.any(facts.get("simulated", False))),
        writer=parse_writer(_read_single_number(facts.get("writer"))),
        size=None if None in size else tuple(size),
    )


def _read_single_number(array):
    """The number in an array with one value; None for other arrays, and for None."""
    return array.item() if array is not None and array.size == 1 else None


def _find_side(array):
    """Rows or columns in an array with one value; None if it is not a size."""
    number = _read_single_number(array)
    is_size = number is not None and 0 < number <= MAX_PLACE + 1 and number == int(number)
    return int(number) if is_size else None


def read_npy(content: bytes, name: str = "") -> EventRecording:
    """Read one array: events, structured or in rows of four numbers, or counts in bins.

    An array of more than two dimensions has counts, see
    :func:`pipeline.recordings.formats.bins.make_binned_recording`.

    Raises
    ------
    BadRecording
    """
    array = read_array(content, "the array", max_dimensions=np.inf)
    has_counts = array.ndim > 2 and array.dtype.names is None
    return make_binned_recording(array) if has_counts else make_array_recording(array)


def read_array(content: bytes, name: str, max_dimensions: float = 2) -> np.ndarray:
    """An array of numbers, after comparing its declared size with the number of bytes."""
    data = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(data)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, columns_first, dtype = read_header(data)
        type_codes = {dtype[field].kind for field in dtype.names} if dtype.names else {dtype.kind}
        is_too_large = dtype.itemsize > MAX_EVENT_BYTES or len(shape) > max_dimensions
        if "O" in type_codes:
            raise BadRecording(
                f"{name!r} has Python objects, which are not read; write arrays of numbers"
            )
        if not type_codes <= set("fiub") or is_too_large:
            raise BadRecording(f"{name!r} is not a row of numbers")
        return np.frombuffer(data.read(), dtype).reshape(shape, order="F" if columns_first else "C")
    except BadRecording:
        raise
    except Exception as error:  # damaged headers fail in many ways
        raise BadRecording(f"{name!r} is damaged") from error
