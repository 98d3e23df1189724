"""Text with a line for each event: four columns, with or without their names in the first line."""

import re

import numpy as np

from pipeline.recordings.formats.column_order import make_array_recording
from pipeline.recordings.formats.recording import (
    ARRAYS,
    MAX_EVENTS,
    BadRecording,
    EventRecording,
    column_of,
    find_columns,
    make_recording,
)

SUFFIXES = (".csv", ".txt")

# Characters with which a remark begins: NumPy's, and Metavision's.
REMARKS = "#%"

_BOOLEAN = re.compile(r"\b(true|false)\b", re.IGNORECASE)


def read_csv(content: bytes, name: str = "") -> EventRecording:
    """Read columns by the names in the first line, or four columns of numbers.

    Raises
    ------
    BadRecording
    """
    columns = _read_columns(content)
    return make_recording(columns) if isinstance(columns, dict) else make_array_recording(columns)


def _read_columns(content):
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadRecording("is not text in UTF-8") from error
    text = _BOOLEAN.sub(lambda found: str(int(found[0].lower() == "true")), text)
    lines = [line.strip() for line in text.splitlines() if line.strip().strip(REMARKS).strip()]
    body = [line for line in lines if line[0] not in REMARKS]
    if not body:
        raise BadRecording("is empty: no events")
    last = body[-1].partition("#")[0]  # a remark may have commas
    separator = next((mark for mark in ",;\t" if mark in last), None)
    words = [word.strip().strip('"').lower() for word in body[0].split(separator)]
    above = lines[: lines.index(body[0])][-1:]
    has_names = any(map(column_of, words))
    if has_names:
        del body[0]
    elif above:  # NumPy writes the names as a comment
        words = re.findall(r"[^,;#%\s]+", above[0].lower())
        has_names = set(map(column_of, words)) >= set(ARRAYS)
    if not body:
        raise BadRecording("is empty: no events")
    wanted = read = None
    if has_names:
        wanted = list(find_columns(words).values())
        read = [words.index(name) for name in wanted]  # other columns may have text
        sizes = {len(line.partition("#")[0].split(separator)) for line in body}
        if odd := sizes - {len(words)}:
            raise BadRecording(f"has {min(odd)} columns below {len(words)} names")
    most = MAX_EVENTS + 1
    try:
        table = np.loadtxt(body, delimiter=separator, ndmin=2, max_rows=most, usecols=read)
    except ValueError as error:
        raise BadRecording(
            "has a line that is not numbers, or has more or fewer than the others"
        ) from error
    return dict(zip(wanted, table.T, strict=True)) if has_names else table
