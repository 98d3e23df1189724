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
import math
import os
import queue
import socket
import sys
import threading
import time

import numpy as np

import stmnist

# Seconds between two looks at the clock, less than a network's step.
TICK_S = 0.002

# Seconds between two recordings that are played, in addition to the silence that ends a touch.
PAUSE_S = 0.2

# Largest datagram of UDP in bytes.
DATAGRAM = 65535

# What is pushed in place of a malformed event: the stream counts it, and reports the number.
NO_EVENT = (math.nan, 0, 0, 0)

# Decimals of a printed time.
DECIMALS = 6

END = None


def events_of(line):
    """The events in a line of JSON, each as t, x, y, p."""
    try:
        values = json.loads(line)
    except (ValueError, RecursionError):
        return [NO_EVENT]
    is_list = isinstance(values, list) and all(isinstance(item, (list, dict)) for item in values)
    return [event_of(value) for value in (values if is_list else [values])]


def event_of(value):
    """t, x, y, p of an event."""
    if isinstance(value, dict):
        value = [value.get(name) for name in "txyp"]
    if not isinstance(value, list) or len(value) != 4:
        return NO_EVENT
    return value if all(isinstance(number, (int, float)) for number in value) else NO_EVENT


def print_line(values):
    """Print a decision as a line of JSON, at once."""
    times = {name: round(values[name], DECIMALS) for name in ("time", "start")}
    print(json.dumps(values | times), flush=True)


def say(decisions):
    """Print decisions as JSON lines, at once."""
    for decision in decisions:
        print_line(decision.to_dict())


def follow(stream, lines):
    """Push the events of a queue's lines as they come until its end, and print the decisions."""
    while True:
        try:
            line = lines.get(timeout=TICK_S)
        except queue.Empty:
            say(stream.advance())  # by the clock of this machine
            continue
        if line is END:
            break
        if events := line.strip() and events_of(line):
            say(stream.push(*zip(*events, strict=True)))
    say(stream.finish())


def put_input(lines):
    """Put each line of standard input into a queue, and at last its end."""
    for line in sys.stdin.buffer:
        lines.put(line)
    lines.put(END)


def put_datagrams(receiving, lines):
    """Put each line of each datagram into a queue."""
    while True:
        for line in receiving.recv(DATAGRAM).splitlines():
            lines.put(line)


def listen(port):
    """A socket that receives the datagrams to a port of the loopback address."""
    receiving = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        receiving.bind(("127.0.0.1", port))
    except (OSError, OverflowError) as error:
        raise stmnist.UserError(f"--udp {port}: {error}; give another port") from error
    address = "{}:{}".format(*receiving.getsockname())
    print(f"stream: listening on {address}; Ctrl-C ends", file=sys.stderr, flush=True)
    return receiving


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


def replay(stream, recordings, speed):
    """Play recordings one after the other, each event at its time; speed 0 plays at once.

    The stream counts in nanoseconds; times are printed in seconds.
    """
    columns, starts = schedule(recordings, stream.silence + PAUSE_S)
    time_ns = columns[0]

    def say_with_name(decisions):
        for decision in decisions:
            index = int(np.searchsorted(starts, decision.start, side="right")) - 1
            values = {"recording": recordings.ids[index], **decision.to_dict()}
            for name in ("time", "start"):
                values[name] *= 1e-9
            print_line(values)

    begun = time.monotonic()
    done = 0
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
    parser.add_argument(
        "--unit", default="s", choices=("s", "ms", "us", "ns"), help="unit of the times"
    )
    parser.add_argument("--silence", type=float, help="seconds without events that end a touch")
    parser.add_argument("--replay", metavar="DATA", help="recordings to play, a zip or folder")
    parser.add_argument(
        "--speed",
        type=float,
        default=1.0,
        help="with --replay: times the speed of the recordings; 0 plays them at once",
    )
    arguments = parser.parse_args()
    stream = stmnist.Stream(
        arguments.bundle, "ns" if arguments.replay else arguments.unit, arguments.silence
    )
    if arguments.replay:
        replay(stream, stmnist.Recordings.read(arguments.replay), arguments.speed)
        return
    lines = queue.SimpleQueue()
    if arguments.udp is None:
        reader = threading.Thread(target=put_input, args=(lines,), daemon=True)
    else:
        reader = threading.Thread(
            target=put_datagrams, args=(listen(arguments.udp), lines), daemon=True
        )
    reader.start()
    try:
        follow(stream, lines)
    except KeyboardInterrupt:
        say(stream.finish())


if __name__ == "__main__":
    try:
        main()
    except stmnist.UserError as error:
        print(f"stream: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # the reader of the decisions has ended, such as `head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
