"""A MATLAB file with one recording: ``spiketrain``, 101 x n (paper, Section 2.3).

Rows 0 to 99 have 1, -1 or 0 for the taxels, row 100 the time of each column in seconds.
For other arrays there are as many rows as taxels, and the time is in the next row.

**-1 is the rise of pressure (ON), 1 the fall (OFF)**, in every file of this layout.  The paper says
the opposite; but in its recordings -1 comes first on every taxel, in 99.96 % of 5,571 of them,
and a taxel that is not touched can only rise.  A rise is a burst of 2 or 3 columns, a fall one of 4
or 5.
Files are read with SciPy; nothing in them is executed, and nothing that declares to be larger than
a recording can be is read.
"""

import io
import math
from dataclasses import dataclass, replace

import numpy as np
import scipy

from pipeline.paper import DURATION_S
from pipeline.recordings.events import Events, expand_bursts, merge_bursts
from pipeline.recordings.formats.recording import (
    MAX_DURATION_S,
    MAX_FILE_BYTES,
    MAX_SIDE,
    MAX_TAXELS,
    BadRecording,
    EventRecording,
    make_numbered_recording,
    parse_writer,
)
from pipeline.recordings.sensor import N_TAXELS, TaxelMap

VARIABLE = "spiketrain"

# Value of a column in which the pressure rises.
RISE = -1
HEADER = b"MATLAB 5.0 MAT-file"

# Bytes of an element of each MATLAB class that a recording may have.
ITEM_SIZES = {
    **{f"{sign}int{bits}": bits // 8 for sign in ("", "u") for bits in (8, 16, 32, 64)},
    **{"double": 8, "single": 4, "logical": 1},
}


@dataclass(frozen=True)
class MatRecording:
    """The contents of one file.

    Attributes
    ----------
    events : Events
    simulated : bool
        True if the file states that it is simulated (in a variable that this project adds).
    writer : int
        Number of the writer (in such a variable), or -1.
    written : bool
        True if the file states that a person wrote it on the simulated skin (in such a variable).
    n_taxels : int
        Number of taxels, from the rows of the file.
    """

    events: Events
    simulated: bool = False
    writer: int = -1
    written: bool = False
    n_taxels: int = N_TAXELS

    def __len__(self):
        return len(self.events)


def read_recording(content: bytes, n_taxels: int | None = N_TAXELS) -> MatRecording:
    """Read a recording.

    Parameters
    ----------
    content : bytes
        Content of a MATLAB 5 file.
    n_taxels : int or None
        Number of taxels of the array; None for any.

    Returns
    -------
    MatRecording

    Raises
    ------
    BadRecording
        Not a MAT file, or not a recording; see :func:`read_spiketrain`.
    """
    names = (VARIABLE, "simulated", "written", "writer")
    variables = read_variables(content, lambda name, shape: name in names)
    if VARIABLE not in variables:
        raise BadRecording(
            f"has no variable {VARIABLE!r}, as ST-MNIST's files have; write other recordings "
            "as .npz with arrays x, y, t and p"
        )
    simulated, written, writer = (_read_number(variables.get(name)) for name in names[1:])
    spiketrain = np.asarray(variables[VARIABLE])
    events = read_spiketrain(spiketrain, n_taxels)
    return MatRecording(
        events=events,
        simulated=bool(simulated),
        writer=parse_writer(writer),
        written=bool(written),
        n_taxels=len(spiketrain) - 1,
    )


def read_mat(content: bytes, name: str = "") -> EventRecording:
    """:func:`read_recording` for any number of taxels, as an :class:`EventRecording`."""
    recording = read_recording(content, n_taxels=None)
    events = recording.events
    numbered = make_numbered_recording(
        events.taxel, events.time_ns, events.polarity, recording.n_taxels, events.columns
    )
    return replace(
        numbered,
        simulated=recording.simulated,
        writer=recording.writer,
        written=recording.written,
    )


def _read_number(variable):
    """A variable's value if it is one finite number, else None: the name may have another use."""
    values = np.ravel([] if variable is None else variable)
    is_number = values.size == 1 and values.dtype.kind in "fiub" and np.isfinite(values[0])
    return values[0] if is_number else None


def read_spiketrain(spiketrain, n_taxels: int | None = N_TAXELS) -> Events:
    """Check a ``spiketrain`` and turn it into physical events.

    Parameters
    ----------
    spiketrain : array_like, shape (n_taxels + 1, n)
    n_taxels : int or None
        Number of taxels of the array; None for any.

    Raises
    ------
    BadRecording
        Wrong number of rows; no columns; a value other than -1, 0 and 1; a column with several
        events or none; times that are NaN, negative, not increasing or in milliseconds.
    """
    spiketrain = np.asarray(spiketrain)
    if spiketrain.dtype.kind not in "fiub" or spiketrain.ndim != 2:
        raise BadRecording(f"{VARIABLE!r} is not a matrix of numbers")
    rows = spiketrain.shape[0]
    if n_taxels is not None and rows != n_taxels + 1:
        raise BadRecording(f"{VARIABLE!r} has {rows} rows, not {n_taxels + 1}")
    if not 2 <= rows <= MAX_TAXELS + 1:
        raise BadRecording(f"{VARIABLE!r} has {rows} rows, not 2 to {MAX_TAXELS + 1}")
    if spiketrain.shape[1] == 0:
        raise BadRecording("is empty: no events")
    values = spiketrain[:-1]
    times = spiketrain[-1].astype(float)
    if not np.isin(values, (-1, 0, 1)).all():
        raise BadRecording("has a value other than -1, 0 and 1")
    per_column = np.count_nonzero(values, axis=0)
    if (per_column != 1).any():
        column = int(np.argmax(per_column != 1))
        raise BadRecording(f"column {column + 1} has {per_column[column]} events, not one")
    if not np.isfinite(times).all():
        raise BadRecording("has a time that is NaN or infinite")
    if times.min() < 0:
        raise BadRecording("has a negative time")
    if times.max() > MAX_DURATION_S:
        raise BadRecording(f"has times up to {times.max():g}, not seconds (milliseconds?)")
    time_ns = np.rint(times * 1e9).astype(np.int64)
    if (np.diff(time_ns) <= 0).any():
        column = int(np.argmax(np.diff(time_ns) <= 0)) + 1
        raise BadRecording(f"times do not increase at column {column + 1}")
    taxel = np.argmax(values != 0, axis=0)
    polarity = RISE * values[taxel, np.arange(values.shape[1])]
    events = merge_bursts(time_ns, taxel, polarity)
    if events.columns.sum(dtype=np.int64) != len(time_ns):  # they are counted in 16 bits
        raise BadRecording("has one event in more than 65,535 columns")
    return events


def read_variables(content: bytes, fits) -> dict:
    """Read some variables of a MATLAB 5 file.

    Parameters
    ----------
    content : bytes
    fits : callable
        ``fits(name, shape)`` is True for a variable to read, of which only its name, its shape and
        its size are known.

    Returns
    -------
    dict of str to ndarray

    Raises
    ------
    BadRecording
        The content is not a MAT file, is damaged, or declares more than a recording can have.
    """
    if not content:
        raise BadRecording("is an empty file")
    if len(content) > MAX_FILE_BYTES:
        raise BadRecording(f"is larger than a recording of {DURATION_S:g} s can be")
    try:
        if content[512:520] == b"\x89HDF\r\n\x1a\n":
            raise BadRecording("is a MATLAB 7.3 file; save it with '-v7', as ST-MNIST's are")
        if not content.startswith(HEADER):
            raise BadRecording(
                "is not a MATLAB 5 file; if it is one of MATLAB 4, save it with '-v7'"
            )
        return _read_mat5(content, fits)
    except (BadRecording, MemoryError):
        raise
    except Exception as error:  # SciPy fails in many ways on damaged files
        raise BadRecording(f"is a damaged MAT file ({type(error).__name__})") from error


def _read_mat5(content, fits):
    file = io.BytesIO(content)
    names = []
    for name, shape, matlab_class in scipy.io.whosmat(file):
        if matlab_class in ITEM_SIZES and fits(name, shape):
            _refuse_too_large(name, shape, ITEM_SIZES[matlab_class])
            names.append(name)
    variables = scipy.io.loadmat(file, variable_names=names)
    return {name: variables[name] for name in names}


def _refuse_too_large(name, shape, item_size):
    if math.prod(map(int, shape)) * item_size > MAX_FILE_BYTES:
        raise BadRecording(
            f"declares {' x '.join(map(str, shape))} values of {name!r}, more than a recording of "
            f"{DURATION_S:g} s can have"
        )


def make_spiketrain(events: Events, n_taxels: int = N_TAXELS) -> np.ndarray:
    """The published form of a recording, shape (n_taxels + 1, n_columns).

    Inverse of :func:`read_spiketrain`.
    """
    time_ns, taxel, polarity = expand_bursts(events)
    spiketrain = np.zeros((n_taxels + 1, len(time_ns)))
    spiketrain[taxel, np.arange(len(time_ns))] = RISE * polarity
    spiketrain[-1] = time_ns * 1e-9
    return spiketrain


def encode_recording(recording: MatRecording) -> bytes:
    """A recording as a compressed MATLAB 5 file; inverse of :func:`read_recording`."""
    # The events come last: a truncated file then has no events.
    variables: dict[str, float | np.ndarray] = {}
    if recording.simulated:
        variables["simulated"] = 1.0
    if recording.writer >= 0:
        variables["writer"] = float(recording.writer)
    if recording.written:
        variables["written"] = 1.0
    variables[VARIABLE] = make_spiketrain(recording.events, recording.n_taxels)
    return _encode(variables)


def read_lookup_table(content: bytes) -> TaxelMap:
    """Read ``LUT.mat``: a row of X and Y, or of address, X and Y, for each taxel, in one variable.

    Raises
    ------
    BadRecording
        No variable has that form, or its entries are not positions of different taxels.
    """
    tables = read_variables(content, _is_table).values()
    table = next((v for v in tables if v.dtype.kind in "fiub"), None)
    if table is None:
        raise BadRecording("has no table of rows with X and Y, or address, X and Y, one per taxel")
    n = len(table)
    if table.shape[1] == 3:
        if sorted(table[:, 0]) != list(range(1, n + 1)):
            raise BadRecording(f"its first column is not the addresses 1 to {n}")
        table = table[np.argsort(table[:, 0]), 1:]
    places = {tuple(row) for row in table.tolist()}
    is_whole = np.isfinite(table).all() and (table == np.rint(table)).all()
    if len(places) != n or not is_whole or table.min() < 1 or table.max() > MAX_SIDE:
        raise BadRecording(f"X and Y are not {n} different positions from 1 to {MAX_SIDE}")
    x, y = (table[:, i].astype(int) - 1 for i in (0, 1))
    return TaxelMap(x, y)


def _is_table(_, shape):
    """True for a shape that a look-up table may have, of which nothing is read yet."""
    if len(shape) != 2 or shape[1] not in (2, 3) or not shape[0]:
        return False
    if shape[0] > MAX_TAXELS:
        raise BadRecording(f"has {shape[0]} rows, more than the {MAX_TAXELS} taxels of any array")
    return True


def encode_lookup_table(taxels: TaxelMap) -> bytes:
    """A lookup table as a MATLAB 5 file; inverse of :func:`read_lookup_table`."""
    address = np.arange(1, len(taxels) + 1)
    return _encode({"LUT": np.stack([address, taxels.row + 1, taxels.column + 1], 1).astype(float)})


def _encode(variables):
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, variables, do_compression=True)
    content = bytearray(buffer.getvalue())
    # SciPy writes the time of day into the header's text; the same recording has the same bytes.
    content[:116] = b"MATLAB 5.0 MAT-file, written by stmnist-loihi".ljust(116)
    return bytes(content)
