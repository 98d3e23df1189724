"""Text with a line for each event: four columns, with or without their names in the first line.

Columns are separated by commas, semicolons, tabs or blanks; with semicolons, a comma is the decimal
mark.  A polarity may be a word or a sign.
"""

import re
from typing import NamedTuple

import numpy as np

from pipeline.recordings.formats.column_order import make_array_recording
from pipeline.recordings.formats.recording import (
    ARRAYS,
    MAX_EVENTS,
    BadRecording,
    EventRecording,
    find_column,
    find_columns,
    make_recording,
)

ENDINGS = (".csv", ".txt")

# Characters with which a remark begins: NumPy's, and Metavision's.
REMARKS = "#%"

# Words and signs for polarities, and their numbers.
POLARITIES = {"true": "1", "false": "0", "on": "1", "off": "0", "+": "1", "-": "-1"}

# What a polarity may be, for an error.
POLARITY_TEXT = "1 and 0, 1 and -1, + and -, on and off, or true and false"

_POLARITY = re.compile(r"(?<![^\s,;])(true|false|on|off|[+-])(?![^\s,;#])", re.IGNORECASE)


def read_csv(content: bytes, name: str = "") -> EventRecording:
    """Read columns by the names in the first line, or four columns of numbers.

    Raises
    ------
    BadRecording
        The reason has the number of the line, if one is wrong.
    """
    columns, body = _read_columns(content)
    try:
        if isinstance(columns, dict):
            return make_recording(columns)
        return make_array_recording(columns)
    except BadRecording as error:
        if error.event is None:
            raise
        raise BadRecording(f"line {body[error.event].number} {error}", error.event) from error


class _NumberedLine(NamedTuple):
    """A line of a file.

    Attributes
    ----------
    number : int
        Its number in the file, from 1.
    text : str
    """

    number: int
    text: str


def _read_columns(content):
    """The columns by their names, or a table without names, and the lines that have them.

    Returns
    -------
    columns : dict of str to ndarray, or ndarray of shape (n_events, n_columns)
    body : list of _NumberedLine
    """
    lines = _read_lines(content)
    body = [line for line in lines if line.text[0] not in REMARKS]
    if not body:
        raise BadRecording("is empty: no events")
    separator = _find_separator(body[-1].text)
    names = _split_names(body[0].text, separator)
    if names:
        del body[0]
    else:
        above = lines[: lines.index(body[0])]
        names = _find_names_in_remark(above[-1].text) if above else []
    if not body:
        raise BadRecording("is empty: no events")
    body = _write_numbers(body, separator)
    if not names:
        return _load_table(body, separator), body
    event_columns = list(find_columns(names).values())
    _require_columns(body, separator, len(names))
    table = _load_table(body, separator, [names.index(name) for name in event_columns])
    return dict(zip(event_columns, table.T, strict=True)), body


def _read_lines(content):
    """The lines that have more than the mark of a remark."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadRecording("is not text in UTF-8") from error
    return [
        _NumberedLine(number, line.strip())
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip().strip(REMARKS).strip()
    ]


def _find_separator(line):
    """The mark between the values of a line; None for spaces."""
    values = line.partition("#")[0]  # a remark may have commas
    return next((mark for mark in ";,\t" if mark in values), None)


def _write_numbers(body, separator):
    """The lines with polarities as numbers, points in decimals, and without quotes."""
    text = "\n".join(line.text for line in body)
    if separator == ";":
        text = text.replace(",", ".")
    text = text.replace("\u2212", "-").replace('"', "")
    text = _POLARITY.sub(lambda match: POLARITIES[match[0].lower()], text)
    lines = zip(body, text.split("\n"), strict=True)
    return [_NumberedLine(line.number, changed) for line, changed in lines]


def _split_names(line, separator):
    """The names of columns in a line; empty if it has none."""
    words = [word.strip().strip('"').lower() for word in line.split(separator)]
    return words if any(map(find_column, words)) else []


def _find_names_in_remark(line):
    """The names of all columns in a remark, as NumPy writes them; empty if they are not there."""
    words = re.findall(r"[^,;#%\s]+", line.lower())
    return words if set(map(find_column, words)) >= set(ARRAYS) else []


def _split_values(line, separator):
    """The texts of the values in a line."""
    return line.text.partition("#")[0].split(separator)


def _require_columns(body, separator, number):
    """Refuse lines with another number of values than there are names."""
    for line in body:
        size = len(_split_values(line, separator))
        if size != number:
            raise BadRecording(f"line {line.number} has {size} columns below {number} names")


def _load_table(body, separator, columns=None):
    """The numbers of some columns, or of all; other columns may have text."""
    try:
        return np.loadtxt(
            [line.text for line in body],
            delimiter=separator,
            ndmin=2,
            max_rows=MAX_EVENTS + 1,
            usecols=columns,
        )
    except ValueError as error:
        raise BadRecording(_describe_bad_line(body, separator, columns)) from error


def _describe_bad_line(body, separator, columns):
    """The first line that is not numbers, or has more or fewer values than the first one."""
    size = len(_split_values(body[0], separator))
    for line in body:
        values = _split_values(line, separator)
        event_values = values if columns is None else [values[column] for column in columns]
        if len(values) != size:
            return f"line {line.number} has {len(values)} values, those above {size}"
        wrong = [not _is_number(value) for value in event_values]
        if columns is None and line is body[0] and all(wrong):
            names = ", ".join(value.strip() for value in values[:6])
            return f"line {line.number} has none of the names x, y, t and p among {names[:80]!r}"
        if any(wrong):
            at = wrong.index(True)
            value = repr(event_values[at].strip()[:40])
            if columns is not None and ARRAYS[at] == "p":
                return f"line {line.number}: {value} is not a polarity; write {POLARITY_TEXT}"
            return f"line {line.number}: {value} is not a number"
    return "has a line that is not numbers, or has more or fewer than the others"


def _is_number(text):
    try:
        float(text)
    except ValueError:
        return False
    return True
