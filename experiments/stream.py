"""The latency of a stream's decisions, and the highest event rate that keeps real time.

The samples of a bundle's check are played to :class:`deploy.stream.stream.Stream` at their own
speed.  To reach a rate, each event is repeated within its step, where repetitions are one spike, so
that the decisions do not depend on the rate.  One thread plays the sensor and runs the network.
"""

import bisect
import itertools
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from deploy.check.bundle import read_bundle
from deploy.errors import CheckFailed
from deploy.files import write_json
from deploy.stream.presentation import SharedNetwork
from deploy.stream.stream import Stream
from deploy.tables import align_rows
from deploy.targets.emulation import Emulation
from experiments.results import RESULTS, Store, name_processor
from pipeline.commands import options
from pipeline.live.network import SHIPPED

# Target of the latency and the share of decisions that meet it.
TARGET_MS = 20.0
TARGET_SHARE = 0.99

# Seconds between two samples, in addition to the silence that ends a touch.
PAUSE_S = 0.1

# Time in seconds between two looks at the clock while no event is due.
TICK_S = 0.0005

# Samples, and seconds between them, with which processor time is measured: a sensor that is touched
# nearly all the time.
LOAD_SAMPLES = 5
LOAD_PAUSE_S = 0.4

# Time for which a driver that pushes arrays collects events, in nanoseconds.
BLOCK_NS = 1_000_000

# Ways to push events: whether one by one, and the rates at which the share of processor time is
# measured for the highest rate.
WAYS = {
    "single events": (True, (20_000, 200_000)),
    "arrays, each 1 ms": (False, (200_000, 1_000_000)),
}

# A highest rate is given as at most this many times the largest rate that was measured.
MAX_EXTRAPOLATION = 3


def make_events_at(bundle, rate: float, samples: int, pause_s: float):
    """Events of samples one after the other, at a rate while each lasts.

    Parameters
    ----------
    bundle : Bundle
    rate : float
        Events per second from the first to the last step of a sample.
    samples : int
    pause_s : float

    Returns
    -------
    columns : tuple of ndarray, shape (n_events,)
        t in nanoseconds, x, y, p, in order of time.
    """
    rng = np.random.default_rng(0)
    step_ns = round(1e9 * bundle.spec.stimulus.step_seconds)
    parts = []
    start_ns = 0
    for frames in bundle.checks.inputs[:samples]:
        step, row, column, polarity = np.nonzero(frames)
        if not len(step):
            continue
        steps = int(step[-1]) + 1
        n_events = max(len(step), round(rate * steps * step_ns * 1e-9))
        indices = np.concatenate([np.arange(len(step)), _draw_repetitions(rng, step, n_events)])
        within_ns = rng.integers(0, step_ns, len(indices))
        within_ns[0] = 0  # the first event, from which the steps are counted
        time_ns = start_ns + step[indices] * step_ns + within_ns
        order = np.argsort(time_ns, kind="stable")
        columns = (time_ns, column[indices], row[indices], polarity[indices] == 0)
        parts.append([values[order] for values in columns])
        start_ns += steps * step_ns + round(1e9 * pause_s)
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def _draw_repetitions(rng, step, n_events):
    """Events to repeat, evenly over the time from the first step to the last."""
    n_repeated = n_events - len(step)
    moments = rng.integers(0, int(step[-1]) + 1, n_repeated)
    return np.minimum(np.searchsorted(step, moments), len(step) - 1)


def play(stream, columns, one_by_one: bool) -> dict:
    """Play events at their own speed.

    Parameters
    ----------
    stream : Stream
        With times in nanoseconds.
    columns : tuple of ndarray
        From :func:`make_events_at`.
    one_by_one : bool
        True to push single events, False to push arrays, once a millisecond.

    Returns
    -------
    dict
        ``latency_ms``: for each decision the time from the last event in its step, or from the
        moment at which it is due, to its return; ``busy``: share of the time in which the processor
        works; ``decisions``: the classes.
    """
    times = columns[0].tolist()
    events = list(zip(*(column.tolist() for column in columns), strict=True))
    timed_decisions = []
    done = 0
    pushed_ns = 0
    begun = time.perf_counter()
    processor_s = time.thread_time()

    def passed_ns():
        return (time.perf_counter() - begun) * 1e9

    def note(decisions):
        now_ns = passed_ns()
        timed_decisions.extend((decision, now_ns) for decision in decisions)

    while done < len(times):
        now_ns = passed_ns()
        next_ns = times[done] if one_by_one else max(times[done], pushed_ns + BLOCK_NS)
        if next_ns > now_ns:
            if times[done] > now_ns:  # no event waits to be pushed
                note(stream.advance(now_ns))
            time.sleep(min(TICK_S, max(next_ns - passed_ns(), 0) * 1e-9))
        elif one_by_one:
            note(stream.push(*events[done]))
            done += 1
        else:
            arrived = bisect.bisect_right(times, now_ns)
            note(stream.push(*(column[done:arrived] for column in columns)))
            done = arrived
            pushed_ns = now_ns
    busy = (time.thread_time() - processor_s) / (passed_ns() * 1e-9)
    at_end = stream.finish()  # at no time of its own
    latency = [
        now_ns - _find_moment(decision, times, stream.step_ns)
        for decision, now_ns in timed_decisions
    ]
    return {
        "latency_ms": np.array(latency) / 1e6,
        "busy": busy,
        "decisions": [decision.number for decision, _ in timed_decisions]
        + [d.number for d in at_end],
    }


def _find_moment(decision, times, step_ns):
    """Time of the last event in the step of an early decision, or at which the decision is due.

    Without events in its step, a decision comes from spikes that were on their way to the readout.
    """
    before = bisect.bisect_left(times, decision.time) - 1
    if decision.early and times[before] >= decision.time - step_ns:
        return times[before]
    return decision.time


def measure_pushing_at_once(stream, columns, one_by_one: bool) -> float:
    """Processor time as a share of the events' time, if they are pushed without waiting."""
    time_ns = columns[0]
    begun = time.thread_time()
    if one_by_one:
        for event in zip(*(column.tolist() for column in columns), strict=True):
            stream.push(*event)
    else:
        edges = np.arange(time_ns[0], time_ns[-1] + BLOCK_NS, BLOCK_NS)
        starts = np.unique(np.searchsorted(time_ns, edges)).tolist()
        for first, end in itertools.pairwise([*starts, len(time_ns)]):
            stream.push(*(column[first:end] for column in columns))
    stream.finish()
    return (time.thread_time() - begun) / (time_ns[-1] * 1e-9)


def measure(bundle, rate: float, samples: int) -> dict:
    """Latencies at a rate in real time, and the highest rate, for both ways to push events."""
    network = SharedNetwork(Emulation(bundle.spec, bundle.seed))

    def open_stream():
        return Stream(bundle, "ns", network=network)

    pause_s = open_stream().silence + PAUSE_S
    columns = make_events_at(bundle, rate, samples, pause_s)
    expected = [decision.number for decision in _push_at_once(open_stream(), columns)]
    rows = []
    for name, (one_by_one, rates) in WAYS.items():
        played = play(open_stream(), columns, one_by_one)
        latency = played["latency_ms"]
        loads = []
        for load in rates:
            events = make_events_at(bundle, load, LOAD_SAMPLES, LOAD_PAUSE_S)
            loads.append(measure_pushing_at_once(open_stream(), events, one_by_one))
        slope, intercept = np.polyfit(rates, loads, 1)
        highest = float((1 - intercept) / slope) if slope > 0 else np.inf
        rows.append(
            {
                "pushed": name,
                "decisions": len(latency),
                "median_ms": float(np.median(latency)),
                "percentile99_ms": float(np.quantile(latency, 0.99)),
                "largest_ms": float(latency.max()),
                "share_within_target": float(np.mean(latency <= TARGET_MS)),
                "busy": played["busy"],
                "highest_rate": min(highest, MAX_EXTRAPOLATION * rates[-1]),
                "is_extrapolation_cut": highest > MAX_EXTRAPOLATION * rates[-1],
                "busy_at": dict(zip(map(str, rates), loads, strict=True)),
                "same_decisions": played["decisions"] == expected,
            }
        )
    return {
        "experiment": "stream",
        "rate": rate,
        "samples": samples,
        "step_ms": 1000 * bundle.spec.stimulus.step_seconds,
        "architecture": bundle.spec.architecture,
        "rows": rows,
        "measured": {"processor": name_processor()},
    }


def _push_at_once(stream, columns):
    return stream.push(*columns) + stream.finish()


def make_cells(result: dict) -> list:
    """The rows of a result as lists of text, the heads first."""
    lines = [["pushed", "median", "99 %", "largest", "within 20 ms", "busy", "highest rate"]]
    for row in result["rows"]:
        at_least = "above " if row["is_extrapolation_cut"] else ""
        lines.append(
            [
                row["pushed"],
                f"{row['median_ms']:.1f} ms",
                f"{row['percentile99_ms']:.1f} ms",
                f"{row['largest_ms']:.1f} ms",
                f"{row['share_within_target']:.1%}",
                f"{row['busy']:.0%}",
                f"{at_least}{round(row['highest_rate'], -4):,.0f} events/s",
            ]
        )
    return lines


def format_result(result: dict) -> str:
    """The result as a table."""
    title = (
        f"Latency of the decisions on {result['samples']} touches, {result['rate']:,.0f} events "
        f"per second, {result['architecture']}, steps of {result['step_ms']:g} ms, one core"
    )
    return "\n".join([title, *align_rows(make_cells(result))])


def main(
    bundle: Annotated[Path, typer.Argument(help="Folder of a bundle or run on events.")] = SHIPPED,
    rate: Annotated[float, typer.Option(help="Events per second during a touch.", min=1)] = 20_000,
    samples: Annotated[int, typer.Option(help="Samples of the check to play.", min=2)] = 60,
    store: Store = "",
    as_json: options.Json = False,
):
    """Measure the latency of a stream's decisions, and the highest rate of events."""
    result = measure(read_bundle(options.find_bundle(bundle)), rate, samples)
    if store:
        write_json(RESULTS / f"{store}.json", result)
    options.print_result(result, format_result, as_json)
    for row in result["rows"]:
        if not row["same_decisions"]:
            raise CheckFailed("the decisions in real time differ from those at once")
        if row["share_within_target"] < TARGET_SHARE:
            raise CheckFailed(
                f"{row['pushed']}: {row['share_within_target']:.1%} of the decisions are within "
                f"{TARGET_MS:g} ms, fewer than {TARGET_SHARE:.0%}"
            )
