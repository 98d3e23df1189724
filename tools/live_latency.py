"""Delay of decisions on the screen while simulated writers use the page in Chromium.

``python -m tools.live_latency runs/default`` needs Chromium, Playwright, and an otherwise idle
machine.
"""

import contextlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from deploy.children import PARENT
from deploy.errors import UserError
from pipeline.commands.main import run_tool
from pipeline.progress import progress
from pipeline.skin import handwriting, parameters, simulate
from tests import robot

SIZE = {"width": 1280, "height": 1000}
AFTER_MS = 300
"""Milliseconds between two digits, in which the last decisions reach the screen."""


def measure_latency(run, digits: int, seed: int = 0) -> dict:
    """Serve the page of a run, write on it at the writers' speed, and read the measured delays.

    Parameters
    ----------
    run : path-like
    digits : int
        Number of digits, 0 to 9 in turn.
    seed : int
        Seed of the simulated writers.

    Returns
    -------
    dict
        ``median_ms`` and ``ninetieth_percentile_ms`` from the last event that led to a decision to
        the frame that displays it; number of ``decisions`` and ``digits``.

    Raises
    ------
    UserError
        Chromium or Playwright is missing or fails, or the page cannot be served.
    """
    with robot.chromium() as browser, _served(run) as url:
        page = browser.new_page(viewport=SIZE)
        robot.opened(page, url)
        with progress("write", digits) as advance:
            for motion in hands(digits, seed):
                page.click("#clear")
                robot.write(page, motion)
                page.wait_for_timeout(AFTER_MS)
                advance(1)
        told = page.locator("#latency").evaluate("element => ({...element.dataset})")
    if not told:
        raise UserError(
            f"{run}: the page showed no decision; open it with 'stmnist live {run}' to see why"
        )
    return {
        "median_ms": float(told["median"]),
        "ninetieth_percentile_ms": float(told["ninetieth"]),
        "decisions": int(told["count"]),
        "digits": digits,
    }


def latency_text(measured: dict) -> str:
    """The result of :func:`measure_latency` in one line."""
    return (
        f"last event to decision on the screen: {measured['median_ms']:.0f} ms at the median, "
        f"{measured['ninetieth_percentile_ms']:.0f} ms at the 90th percentile of "
        f"{measured['decisions']} decisions while {measured['digits']} digits were written"
    )


def hands(n: int, seed: int):
    """Motions of simulated writers: the digits in turn, each by the next writer.

    Yields
    ------
    pipeline.skin.handwriting.Motion
    """
    p = parameters.load()
    people = handwriting.writers(np.random.default_rng([seed, 1]), p.writers, p.shapes)
    for index in range(n):
        sample = simulate.Sample(index % 10, index, index % len(people))
        rng = np.random.default_rng([seed, 2, sample.digit, index])
        yield simulate.motion(sample, people[sample.writer], rng, p)


@contextlib.contextmanager
def _served(run):
    """The page's address, while a separate process serves it; its recordings are deleted."""
    with tempfile.TemporaryDirectory() as kept:
        command = [sys.executable, "-m", "pipeline", "live", str(run), "--no-browser"]
        command += ["--port", "0", "--record", kept]
        environment = {**os.environ, PARENT: str(os.getpid())}
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, env=environment
        ) as server:
            try:
                line = server.stdout.readline().split()
                if not line:
                    raise UserError(f"{run}: the page could not be served; see above")
                yield line[1]
            finally:
                server.terminate()


def main(
    run: Annotated[Path, typer.Argument(help="The run's folder.")] = Path("runs/default"),
    digits: Annotated[int, typer.Option(help="Number of digits to write.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the simulated writers.", min=0)] = 0,
):
    """Measure the delay of decisions on the screen in Chromium, with simulated writers.

    The delay is from the last event before a decision to the frame that displays the decision.
    """
    print(latency_text(measure_latency(run, digits, seed)))


if __name__ == "__main__":
    run_tool(main)
