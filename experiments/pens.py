"""Write recorded pen trajectories on the sensor of the live page, and count the right decisions.

Each trajectory is scaled, placed and timed at random and written point by point, as a visitor of
the page would write it; the decision is the one that the page shows.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from deploy.check.bundle import read_bundle
from deploy.files import hash_file, write_json
from deploy.tables import align_rows
from experiments import unipen
from experiments.results import RESULTS, Store, describe_machine
from pipeline.commands import options
from pipeline.live.deciding import PageDecider, make_decider
from pipeline.live.network import SHIPPED, find_sensor
from pipeline.progress import progress
from pipeline.recordings.sensor import Sensor
from pipeline.simulation import parameters
from pipeline.simulation.handwriting import Trace
from pipeline.simulation.pen import START_S, USUAL_PRESSURE, PenPoint, Writing

# Heights of the digits in taxels, and speeds of the pen in taxels per second, drawn evenly.
HEIGHT_RANGE_TAXELS = (6.0, 8.5)
SPEED_RANGE_TAXELS_PER_S = (18.0, 40.0)

# Standard deviation of the middle of a digit around that of the sensor, in taxels.
PLACE_SPREAD = 0.4

# Time through the air from one stroke to the next.
PAUSE_S = 0.15

# Duration of a stroke that is only a dot.
DOT_S = 0.05

# Digits that some people draw from the end to the beginning, each as a row of its own.
REVERSIBLE = (0, 8)

# Numbers of a row of the result.
COUNTS = ("written", "right", "wrong_and_sure")

# Confidence from which a wrong decision counts as one of which the network was sure.
SURE_CONFIDENCE = 0.95


@dataclass(frozen=True)
class WrittenDigit:
    """A digit as it was written, and the decision.

    Attributes
    ----------
    digit : int
    decision : int or None
        None if the network had no output.
    confidence : float
    is_doubted : bool
        True if the page says "not sure", because the digit took longer than those of the training.
    """

    digit: int
    decision: int | None
    confidence: float
    is_doubted: bool


def write_digit(decider: PageDecider, sensor: Sensor, trace: Trace, seed, p) -> WrittenDigit:
    """Write a trajectory on the sensor of the page.

    Parameters
    ----------
    decider : PageDecider
    sensor : Sensor
    trace : Trace
    seed : sequence of int
        Seed of size, place and speed, and of the sensor.
    p : pipeline.simulation.parameters.Parameters

    Returns
    -------
    WrittenDigit
    """
    rng = np.random.default_rng(seed)
    size = sensor.rows, sensor.columns
    writing = Writing([*seed, 1], p, size, sensor.polarities)
    points = make_points(trace, rng, size)
    for point in points:
        writing.add_point(point)
    writing.advance(writing.settled_s)
    output = decider.begin().compute_output(writing.events, np.inf)
    if output is None:
        return WrittenDigit(trace.digit, None, 0.0, False)
    verdict = output.decided or output.curve.find_last()
    return WrittenDigit(trace.digit, verdict.label, verdict.confidence, output.exceeds_training)


def make_points(trace: Trace, rng, size) -> list:
    """The points of a pen that draws a trajectory on a sensor with these rows and columns."""
    height = rng.uniform(*HEIGHT_RANGE_TAXELS)
    speed = rng.uniform(*SPEED_RANGE_TAXELS_PER_S)
    middle = (np.array(size) - 1) / 2 + PLACE_SPREAD * rng.standard_normal(2)
    points = []
    time_s = START_S
    for stroke in trace.strokes:
        places = np.clip(middle + height * stroke, -1, np.array(size))
        duration_s = max(np.hypot(*np.diff(places, axis=0).T).sum() / speed, DOT_S)
        for share, (down, right) in zip(np.linspace(0, 1, len(places)), places, strict=True):
            at_s = time_s + share * duration_s
            points.append(PenPoint(at_s, float(down), float(right), USUAL_PRESSURE, True))
        time_s += duration_s
        points.append(points[-1]._replace(time_s=time_s, touches=False))
        time_s += PAUSE_S
    return points


def reverse_trace(trace: Trace) -> Trace:
    """The same line, drawn from its end to its beginning."""
    strokes = tuple(stroke[::-1] for stroke in trace.strokes[::-1])
    return Trace(trace.digit, trace.writer, strokes)


def draw_traces(traces, each: int, seed: int) -> dict:
    """Trajectories of each digit by the name of their row, and reversed ones of some digits."""
    rng = np.random.default_rng(seed)
    rows = {}
    for digit in range(10):
        of_digit = [trace for trace in traces if trace.digit == digit]
        drawn = rng.permutation(len(of_digit))[:each]
        rows[str(digit)] = [of_digit[index] for index in drawn]
    for digit in REVERSIBLE:
        rows[f"{digit}, reversed"] = [reverse_trace(trace) for trace in rows[str(digit)]]
    return rows


def measure(decider: PageDecider, sensor: Sensor, rows: dict, seed: int, advance: Callable) -> list:
    """Write the digits of each row.

    Returns
    -------
    list of dict
        For each row its ``name``, the number ``written`` and ``right``, and of the wrong ones how
        many were ``wrong_and_sure``: above :data:`SURE_CONFIDENCE`, without a "not sure" of the
        page.
    """
    p = parameters.read_parameters()
    results = []
    for name, traces in rows.items():
        digits = []
        for number, trace in enumerate(traces):
            digits.append(write_digit(decider, sensor, trace, [seed, trace.digit, number], p))
            advance(1)
        wrong = [digit for digit in digits if digit.decision != digit.digit]
        results.append(
            {
                "name": name,
                "written": len(digits),
                "right": len(digits) - len(wrong),
                "wrong_and_sure": sum(
                    digit.confidence > SURE_CONFIDENCE and not digit.is_doubted for digit in wrong
                ),
            }
        )
    return results


def make_cells(result: dict) -> list:
    """The table of a result, and the sum of the digits that are not reversed."""
    heads = ["digit", "written", "right", f"wrong, above {100 * SURE_CONFIDENCE:.0f} % sure"]
    cells = [heads]
    as_written = np.zeros(len(COUNTS), int)
    for row in result["rows"]:
        counts = [row[count] for count in COUNTS]
        cells.append([row["name"], *map(str, counts)])
        if row["name"].isdigit():
            as_written += counts
    cells.append(["all as written", *map(str, as_written)])
    return cells


def main(
    pen: Annotated[Path, typer.Argument(help="UNIPEN file of digits.")],
    bundle: Annotated[Path, typer.Option(help="Folder of a bundle on events.")] = SHIPPED,
    each: Annotated[int, typer.Option(help="Trajectories of each digit.", min=1)] = 30,
    seed: Annotated[int, typer.Option(help="Seed of all that is drawn.", min=0)] = 0,
    store: Store = "",
    as_json: options.Json = False,
):
    """Count a network's right decisions on pen trajectories, written on the page's sensor."""
    network = read_bundle(bundle)
    sensor = find_sensor(network)
    decider = make_decider(network, sensor)
    traces = draw_traces(unipen.read(pen), each, seed)
    with progress("write", sum(map(len, traces.values())), "digits") as advance:
        rows = measure(decider, sensor, traces, seed, advance)
    result = {"experiment": "pens", "recordings": [hash_file(pen)], "simulated": True, "rows": rows}
    result["measured"] = describe_machine()
    if store:
        write_json(RESULTS / f"{store}.json", result)
    options.print_result(
        result, lambda value: "\n".join(align_rows(make_cells(value), left=1)), as_json
    )
