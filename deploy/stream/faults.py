"""Faults of a sensor's events: counted, and reported once a second at most."""

from __future__ import annotations

import logging
import time
from collections import Counter

LOG = logging.getLogger("stmnist.stream")

# Minimum seconds between two reports.
REPORT_INTERVAL_S = 1.0

# What a report calls each kind of fault.
FAULTS = {
    "outside": "outside the sensor",
    "polarity": "of a polarity that the network does not have",
    "unreadable": "without numbers for time and place",
    "late": "out of order",
    "future": "from the future",
    "jump": "at which the clock jumped back",
    "surplus": "after the end of a presentation",
}


class Faults:
    """Counts of events with a fault, by the names of :data:`FAULTS`.

    Reports are warnings of the logger "stmnist.stream", which Python prints on standard error
    unless the program configures it otherwise.

    Attributes
    ----------
    counts : collections.Counter
        All faults so far.
    """

    def __init__(self):
        self.counts = Counter()
        self._unreported = Counter()
        self._next_report_s = -float("inf")

    def record(self, fault: str, number: int = 1):
        """Count some events with a fault, and report if the last report is long enough ago."""
        if number == 0:
            return
        self.counts[fault] += number
        self._unreported[fault] += number
        if time.monotonic() >= self._next_report_s:
            self.report()

    def report(self):
        """Report the faults since the last report, if there are any."""
        if not self._unreported:
            return
        counts = [f"{n} {FAULTS[fault]}" for fault, n in self._unreported.items()]
        LOG.warning("stream: events with a fault: %s", ", ".join(counts))
        self._unreported.clear()
        self._next_report_s = time.monotonic() + REPORT_INTERVAL_S
