"""The words for recordings and their classes in messages: written digits or the user's own."""

from __future__ import annotations

from pipeline.recordings.events import DIGITS


def is_written(classes) -> bool:
    """True if the classes are the ten digits, which people write."""
    return tuple(classes) == DIGITS


def recording_word(classes) -> str:
    """The word for the period until a network decides: ``"writing"``, or ``"recording"``."""
    return "writing" if is_written(classes) else "recording"


def shortened(name: str, width: int) -> str:
    """A name of at most ``width`` characters, shortened in its middle.

    Both ends remain, since names of a set often begin or end alike.
    """
    if len(name) <= width:
        return name
    head = (width - 1) * 2 // 3
    return f"{name[:head]}…{name[len(name) - (width - 1 - head) :]}"


def shortened_apart(names, width: int) -> list:
    """Shortened names that are still different, in the same order.

    Names that would become equal are numbered at their end.
    """
    short = [shortened(name, width) for name in names]
    for index, name in enumerate(short):
        if short.count(name) > 1:
            number = f"~{index}"
            short[index] = shortened(names[index], max(width - len(number), 1)) + number
    return short
