"""Overflows of the chip's integers: counted while a target runs, and reported in one line.

NengoLoihi's emulator and ``fast`` warn of each overflow where it happens.  An overflow wraps a
number around, on the chip too, so that a large excitation becomes an inhibition.
"""

from __future__ import annotations

import re
import warnings
from typing import TYPE_CHECKING, Iterator

if TYPE_CHECKING:
    from ..network.spec import NetworkSpec

# Numbers of the chip by the names in the warnings.
NUMBERS = {"q0": "synaptic input", "current": "current", "u2": "current with bias"}

# Beginnings of the messages of NengoLoihi and of ``fast``, and the names of the numbers in them.
_MESSAGE = re.compile(r"^(Overflow|layer .*: overflows)")
_NAME = re.compile(r"\bin (q0|current|u2)\b")


class OverflowWatch:
    """A context that keeps warnings of overflows to itself and passes on all others.

    Attributes
    ----------
    names : set of str
        The `NUMBERS` that have overflowed.
    """

    def __init__(self):
        self.names = set()

    def __enter__(self):
        self._catching = warnings.catch_warnings(record=True)
        self._caught = self._catching.__enter__()
        warnings.filterwarnings("default", _MESSAGE.pattern)  # once, not in every step
        return self

    def __exit__(self, *error):
        self._catching.__exit__(*error)
        for warning in self._caught:
            text = str(warning.message)
            if _MESSAGE.match(text):
                self.names.update(NUMBERS[name] for name in _NAME.findall(text))
            else:
                warnings.warn_explicit(
                    warning.message, warning.category, warning.filename, warning.lineno
                )

    def during(self, responses: Iterator) -> Iterator:
        """The items of an iterator, each of which is computed within this context."""
        responses = iter(responses)
        while True:
            with self:
                response = next(responses, None)
            if response is None:
                return
            yield response


def describe_overflows(spec: NetworkSpec, target: str, numbers) -> str:
    """A warning with its remedy, in one line.

    Parameters
    ----------
    spec : NetworkSpec
    target : str
    numbers : iterable of str
        Some of the `NUMBERS`.
    """
    remedy = "a lower --set deployment.input_rate"
    if not spec.stimulus.is_static:
        remedy = "a longer --set input.step or shorter time constants"
    which = " and ".join(sorted(numbers))
    return (
        f"{target}: numbers too large for the chip's integers ({which}) wrapped around, as they "
        f"would on the chip; smaller weights help, or {remedy}"
    )
