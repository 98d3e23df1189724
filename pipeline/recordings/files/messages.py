"""Lines for the user about how a source was read: refused files, doubts and remarks."""

import re
from collections.abc import Sequence

from deploy.terminal import WARNING, escape_control
from pipeline.recordings.interpretation.interpretation import Interpretation
from pipeline.recordings.recordings import Recordings

# Number of reasons, and of files that were left out, that are listed individually.
MAX_LISTED = 10

# Number of files that are named in one line.
MAX_NAMED = 3

ALL_OFF_WARNING = (
    "all events are OFF, since their polarity is 0 or -1; write 1 if the sensor does not tell ON "
    "and OFF apart, and name the columns if another column is the polarity"
)


def describe_reading(path, recordings: Recordings) -> list:
    """Messages about how a source was read and which files were left out, a line each.

    Parameters
    ----------
    path : path-like
        Path of the source.
    recordings : Recordings
        From :func:`pipeline.recordings.files.reading.read_source`.
    """
    left_out = recordings.source.left_out
    lines = [f"{path}: {remark}" for remark in recordings.source.remarks]
    lines += [f"{WARNING}{path}: {text}" for text in recordings.source.warnings]
    lines += [f"{WARNING}{path}: left out {line}" for line in left_out[:MAX_LISTED]]
    if len(left_out) > MAX_LISTED:
        lines.append(f"{WARNING}{path}: left out {len(left_out) - MAX_LISTED} more")
    return lines


def describe_refusals(
    path, refused: Sequence[tuple[str, str]], total: int, can_skip: bool = True
) -> list:
    """A line for each reason to refuse files: their number, the first ones, and the reason.

    If there are several reasons, a line with the remedy precedes them.

    Parameters
    ----------
    path : path-like
        Path of the source.
    refused : sequence of (str, str)
        Path of each refused file, and the reason.
    total : int
        Number of all files.
    can_skip : bool
        True if the source can be read without the files.
    """
    by_reason: dict = {}
    for member, reason in sorted(refused):
        kind = re.sub(r"'[^']*'|-?[\d.]+", "*", reason)
        by_reason.setdefault(kind, []).append((member, reason))
    lines = [
        f"{len(files)} of {total} files refused: {_name_refused(files)}"
        for files in list(by_reason.values())[:MAX_LISTED]
    ]
    if len(by_reason) > MAX_LISTED:
        lines.append(f"and files refused for {len(by_reason) - MAX_LISTED} more reasons")
    remedy = "correct them"
    if can_skip:
        remedy += (
            ", or leave them out: --set data.skip_bad=true (of 'adapt', 'check run' and 'predict' "
            "--skip-bad)"
        )
    if len(lines) == 1:
        return [f"{path}: {lines[0]}; {remedy}"]
    head = f"{len(refused)} of {total} files refused, for {len(by_reason)} reasons; {remedy}"
    return [f"{path}: {line}" for line in (head, *lines)]


def _name_refused(files):
    """The first of several files that were refused for one reason, and the reason."""
    member, reason = files[0]
    others = [shorten(other) for other, _ in files[1:MAX_NAMED]]
    if len(files) > MAX_NAMED:
        others.append(f"{len(files) - MAX_NAMED} more")
    also = f" (also {', '.join(others)})" if others else ""
    return f"{shorten(member)}{also} {reason}"


def describe_doubts(interpretation: Interpretation, members: Sequence[str]) -> tuple:
    """Lines on what may be wrong with recordings, with the names of the files.

    Parameters
    ----------
    interpretation : Interpretation
    members : sequence of str
        Path of each recording in the source.
    """
    lines = []
    for indices, text in interpretation.doubts:
        names = [members[index] for index in indices]
        have = "alone has" if len(names) == 1 else "alone have"
        lines.append(f"{_list_first(names)} {have} {text}")
    are_off = all((events.polarity < 0).all() for events in interpretation.events)
    if interpretation.time_unit and are_off:
        lines.append(ALL_OFF_WARNING)
    return tuple(lines)


def _list_first(names):
    """The first names, and the number of the others."""
    listed = [shorten(name) for name in names[:MAX_NAMED]]
    if len(names) > MAX_NAMED:
        listed.append(f"{len(names) - MAX_NAMED} more files")
    return ", ".join(listed)


def shorten(name, longest: int = 120) -> str:
    """A path for a message: without control characters, and only its end if it is long."""
    name = escape_control(str(name))
    return name if len(name) <= longest else f"...{name[3 - longest :]}"
