"""Numbers and short texts in MATLAB 5 files, every type and size checked before it is used.

The format is MathWorks' "MAT-File Format" (level 5).  A file is a header and elements; an element
is a tag (type and size) and data; a variable is an element of elements: flags, dimensions, name,
values; a compressed variable is such an element packed by zlib.  SciPy's reader crashes on some
invalid element types, and reads any size that a file declares.  This reader stops at `LARGEST`
bytes, and skips variables that were not requested.
"""

from __future__ import annotations

import math
import zlib

import numpy as np

LARGEST = 170_000_000
"""Bytes of one variable, and of a file: 101 rows of 200,000 columns in double precision, which is a
hundred taxels that each report an event every 5 ms for 2 s, in five columns each."""

MOST_VARIABLES = 1000
HEADER = b"MATLAB 5.0 MAT-file"

_MATRIX, _COMPRESSED = 14, 15
_INT8, _INT32, _UINT32, _UTF8 = 1, 5, 6, 16
_VALUES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_NUMERIC_CLASSES = range(6, 16)
_TEXT_CLASS = 4
_LONGEST_TEXT = 200
_COMPLEX = 0x800
_HEAD = 4096
"""Bytes that are unpacked to read a variable's name and size, which take far fewer."""


class Damaged(ValueError):
    """The content is no MAT file of level 5, or is damaged."""


class TooLarge(ValueError):
    """A variable is larger than `LARGEST`; the message has its declared size."""


def read(content: bytes, names=None, fits=None) -> dict:
    """Read variables.

    Parameters
    ----------
    content : bytes
    names : collection of str, optional
        Default: all variables of numbers.
    fits : callable, optional
        ``fits(shape)``: only the first variable whose declared shape fits is read.

    Returns
    -------
    dict of str to ndarray, str or None
        Numbers in the type that the file stores them in; text if it is one short line in ASCII;
        None for a named variable that is neither.

    Raises
    ------
    Damaged, TooLarge
    """
    if not content.startswith(HEADER) or len(content) < 128:
        raise Damaged("no header")
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise Damaged("no byte order")
    found, place, content = {}, 128, memoryview(content)
    most = 1 if fits is not None else None if names is None else len(names)
    for _ in range(MOST_VARIABLES):
        if place == len(content) or len(found) == most:
            return found
        kind, size, start = _tag(content, place, order)
        if start + size > len(content) or kind not in (_MATRIX, _COMPRESSED):
            raise Damaged("an element that is not a variable, or is cut short")
        name, array = _variable(content[place : start + size], kind, order, names, fits)
        asked = names is not None or isinstance(array, np.ndarray)
        if name is not None and name not in found and asked:
            found[name] = array
        place = start + size
    raise Damaged(f"more than {MOST_VARIABLES} variables")


def _variable(element, kind, order, names, fits):
    """(name, array, str or None) of a variable; (None, None) if it was not requested."""
    unpacker = None
    if kind == _COMPRESSED:
        unpacker = zlib.decompressobj()
        element = unpacker.decompress(element[8:], _HEAD)
    kind, size, start = _tag(element, 0, order)
    if kind != _MATRIX:
        raise Damaged("a compressed element that is not a variable")
    whole = start + size
    head = _head(element, start, order)
    if head is None:
        return None, None
    name, shape, place, is_text = head
    if not name or (names is not None and name not in names):
        return None, None
    if fits is not None and (shape is None or is_text or not fits(shape)):
        return None, None
    if shape is None:
        return name, None
    if whole > LARGEST:
        raise TooLarge(f"declares {_times(shape)} values of {name!r}")
    if unpacker is not None:
        element = _unpacked(unpacker, element, whole)
    if is_text:
        return name, _text(element, place, order, shape)
    return name, _values(element, place, order, shape)


def _unpacked(unpacker, begun, whole):
    """The unpacked content of a compressed variable, after checking its checksum."""
    rest = unpacker.decompress(unpacker.unconsumed_tail, max(1, whole - len(begun) + 1))
    if len(begun) + len(rest) != whole or not unpacker.eof:
        raise Damaged("a compressed variable of another size than it declares")
    return begun + rest if rest else begun


def _head(element, place, order):
    """(name, shape, position of the values, True if they are letters).

    The shape is None for what is neither a real array of numbers nor a short line of text.

    None for what MATLAB keeps in another form: functions and objects.
    """
    flags, place = _data(element, place, order, {_UINT32})
    if len(flags) != 2:
        raise Damaged("no flags")
    kind = int(flags[0]) & 0xFF
    if not 1 <= kind <= 15:
        return None
    shape, place = _data(element, place, order, {_INT32, _UINT32})
    name, place = _data(element, place, order, {_INT8, _UTF8})
    if not 2 <= len(shape) <= 32 or (shape < 0).any():
        raise Damaged("no dimensions")
    numeric = kind in _NUMERIC_CLASSES and not int(flags[0]) & _COMPLEX
    text = bytes(name).decode("utf-8", errors="replace")
    # as Python's integers, whose product cannot overflow
    is_text = kind == _TEXT_CLASS and len(shape) == 2 and shape[0] == 1
    is_text = is_text and shape[1] <= _LONGEST_TEXT
    return text, tuple(shape.tolist()) if numeric or is_text else None, place, is_text


def _values(element, place, order, shape):
    values, _ = _data(element, place, order, _VALUES)
    if len(values) != math.prod(shape):
        raise Damaged("a number of values that does not fit its dimensions")
    return values.reshape(shape, order="F")


def _text(element, place, order, shape):
    """Text as SciPy and MATLAB write it; None if it has letters outside of ASCII."""
    codes, _ = _data(element, place, order, {*_VALUES, _UTF8})
    known = len(codes) == math.prod(shape) and bool(((codes >= 32) & (codes < 127)).all())
    return "".join(map(chr, codes.astype(int))) if known else None


def _data(element, place, order, kinds):
    """The array of an element of certain types, and the place after its padding."""
    kind, size, start = _tag(element, place, order)
    if kind not in kinds or start + size > len(element):
        raise Damaged("an element of a wrong type or size")
    dtype = np.dtype("i1" if kind == _UTF8 else order + _VALUES[kind])
    if size % dtype.itemsize:
        raise Damaged("an element that ends within a number")
    array = np.frombuffer(element, dtype, size // dtype.itemsize, start)
    small = start == place + 4
    return array, place + 8 if small else start + -(-size // 8) * 8


def _tag(content, place, order):
    """Type, size and start of the data of the element at a place."""
    if place + 8 > len(content):
        raise Damaged("cut short")
    words = np.frombuffer(content, order + "u4", 2, place).tolist()
    if words[0] >> 16:  # a small element: type and size in one word, at most four bytes of data
        kind, size = words[0] & 0xFFFF, words[0] >> 16
        if size > 4:
            raise Damaged("a small element of more than four bytes")
        return kind, size, place + 4
    return (*words, place + 8)


def _times(shape):
    return " x ".join(map(str, shape))
