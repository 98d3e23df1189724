"""A running sensor: events in as JSON lines, decisions of a network out as JSON lines.

Each line is one event, ``{"t": 12.5, "x": 3, "y": 4, "p": 1}`` or ``[12.5, 3, 4, 1]``, or a list of
such events; ``x`` is the column from the left and ``y`` the row from the top.  Events come from
standard input, from datagrams to a UDP port of this machine, or from recordings, which are played
at their own speed::

    my-driver | python examples/stream.py runs/mine
    python examples/stream.py runs/mine --udp 5005 --unit us
    python examples/stream.py runs/mine --replay recordings.zip --speed 2
"""

import argparse
import json
import queue
import socket
import sys
import threading
import time

import numpy as np

import stmnist

# Seconds between two looks at the clock, less than a network's step.
TICK_S = 0.002

# Seconds between two recordings that are played, beside the silence that ends a touch.
PAUSE_S = 0.2

# Largest datagram of UDP in bytes.
DATAGRAM = 65535

TICKS_PER_SECOND = {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}

# Largest time on a sensor's clock, in seconds: some 30 years.
MAX_TIME_S = 1e9

END = None


def lines_of_input(lines):
    """Put each line of standard input into a queue, and at last its end."""
    for line in sys.stdin.buffer:
        lines.put(line)
    lines.put(END)


def lines_of_port(receiving, lines):
    """Put each line of each datagram into a queue."""
    while True:
        for line in receiving.recv(DATAGRAM).splitlines():
            lines.put(line)


def columns_of(line):
    """Columns t, x, y, p of the events in a line, or None if it has none."""
    try:
        events = json.loads(line)
        if isinstance(events, dict) or not isinstance(events[0], (list, dict)):
            events = [events]
        rows = [[e["t"], e["x"], e["y"], e["p"]] if isinstance(e, dict) else e for e in events]
        return [list(column) for column in zip(*rows, strict=True)] if rows else None
    except (ValueError, KeyError, IndexError, TypeError, RecursionError):
        return None


def say(decisions):
    """Print decisions as JSON lines, at once."""
    for decision in decisions:
        print(json.dumps(decision.to_dict()), flush=True)


class PresentTime:
    """The present time on the sensor's clock, from its last event and this machine's clock."""

    def __init__(self, ticks_per_second):
        self._ticks_per_second = ticks_per_second
        self._last = None

    def note(self, t):
        """Note that an event of a time has just arrived."""
        self._last = t, time.monotonic()

    def now(self):
        """The present time, or None before the first event."""
        if self._last is None:
            return None
        t, arrived = self._last
        return t + (time.monotonic() - arrived) * self._ticks_per_second


class UnreadableLines:
    """Lines that are no events in JSON: their number is told once a second at most."""

    def __init__(self):
        self._lines = 0
        self._told = 0
        self._due_s = 0.0

    def count(self):
        """Count a line."""
        self._lines += 1

    def tell(self, at_once=False):
        """Print the number of lines on standard error if there are new ones."""
        if self._lines == self._told or (not at_once and time.monotonic() < self._due_s):
            return
        print(f"stream: {self._lines} lines are not events in JSON", file=sys.stderr, flush=True)
        self._told = self._lines
        self._due_s = time.monotonic() + 1


def is_time(t, ticks_per_second):
    """True if t is a number that a sensor's clock may have."""
    if isinstance(t, bool) or not isinstance(t, (int, float)):
        return False
    return abs(t) < MAX_TIME_S * ticks_per_second  # False for NaN


def follow(stream, lines, ticks_per_second):
    """Push the events of lines as they come until their end, and print the decisions."""
    unreadable = UnreadableLines()
    try:
        follow_lines(stream, lines, ticks_per_second, unreadable)
    finally:
        unreadable.tell(at_once=True)


def follow_lines(stream, lines, ticks_per_second, unreadable):
    """Push the events of lines until their end, and count the lines that are no events."""
    present = PresentTime(ticks_per_second)
    while True:
        unreadable.tell()
        try:
            line = lines.get(timeout=TICK_S)
        except queue.Empty:
            now = present.now()
            if now is not None:
                say(stream.advance(now))
            continue
        if line is END:
            break
        columns = columns_of(line)
        if columns is None or len(columns) != 4:
            if line.strip():
                unreadable.count()
            continue
        say(stream.push(*columns))
        if is_time(columns[0][-1], ticks_per_second):
            present.note(columns[0][-1])
    say(stream.finish())


def schedule(recordings, pause_s):
    """Columns t (in nanoseconds), x, y, p of recordings one after the other, and their starts."""
    times, starts, now_ns = [], [], 0
    for index in range(len(recordings)):
        time_ns = recordings[index].time_ns
        starts.append(now_ns)
        if len(time_ns):
            times.append(now_ns + time_ns - time_ns[0])
            now_ns = int(times[-1][-1] + 1e9 * pause_s)
    events, taxels = recordings.events, recordings.taxels
    x, y = taxels.column[events.taxel], taxels.row[events.taxel]
    return (np.concatenate(times), x, y, events.polarity > 0), starts


def replay(stream, recordings, speed, ticks_per_second):
    """Play recordings one after the other, each event at its time; speed 0 plays at once.

    The stream counts in nanoseconds; times are printed in the unit of the ticks.
    """
    columns, starts = schedule(recordings, stream.silence + PAUSE_S)
    time_ns = columns[0]

    def say_with_name(decisions):
        for decision in decisions:
            index = int(np.searchsorted(starts, decision.start, side="right")) - 1
            values = {"recording": recordings.ids[index], **decision.to_dict()}
            for name in ("time", "start"):
                values[name] *= ticks_per_second / 1e9
            print(json.dumps(values), flush=True)

    begun, done = time.monotonic(), 0
    while speed and done < len(time_ns):
        now_ns = int((time.monotonic() - begun) * speed * 1e9)
        arrived = int(np.searchsorted(time_ns, now_ns, side="right"))
        say_with_name(stream.push(*(column[done:arrived] for column in columns)))
        say_with_name(stream.advance(now_ns))
        done = arrived
        time.sleep(TICK_S)
    say_with_name(stream.push(*(column[done:] for column in columns)))
    say_with_name(stream.finish())


def main():
    """Read the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bundle", help="folder of a run or of a bundle on events")
    parser.add_argument("--udp", type=int, metavar="PORT", help="port on 127.0.0.1; 0 for any")
    parser.add_argument("--unit", default="s", help="unit of times: s, ms, us or ns (default: s)")
    parser.add_argument("--silence", type=float, help="seconds without events that end a touch")
    parser.add_argument("--replay", metavar="DATA", help="recordings to play, a zip or folder")
    parser.add_argument("--speed", type=float, default=1.0, help="of --replay; 0: at once")
    given = parser.parse_args()
    unit = "ns" if given.replay else given.unit
    if given.unit not in TICKS_PER_SECOND:
        raise stmnist.UserError(f"--unit {given.unit}: not one of {', '.join(TICKS_PER_SECOND)}")
    ticks_per_second = TICKS_PER_SECOND[given.unit]
    stream = stmnist.Stream(given.bundle, unit, given.silence)
    if given.replay:
        replay(stream, stmnist.Recordings.read(given.replay), given.speed, ticks_per_second)
        return
    lines = queue.SimpleQueue()
    if given.udp is None:
        reader = threading.Thread(target=lines_of_input, args=(lines,), daemon=True)
    else:
        receiving = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            receiving.bind(("127.0.0.1", given.udp))
        except (OSError, OverflowError) as error:
            raise stmnist.UserError(f"--udp {given.udp}: {error}; give another port") from error
        address = "{}:{}".format(*receiving.getsockname())
        print(f"stream: listening on {address}; Ctrl-C ends", file=sys.stderr, flush=True)
        reader = threading.Thread(target=lines_of_port, args=(receiving, lines), daemon=True)
    reader.start()
    try:
        follow(stream, lines, ticks_per_second)
    except KeyboardInterrupt:
        say(stream.finish())


if __name__ == "__main__":
    try:
        main()
    except stmnist.UserError as error:
        print(f"stream: {error}", file=sys.stderr)
        sys.exit(2)
