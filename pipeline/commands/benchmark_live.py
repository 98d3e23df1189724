"""``stmnist benchmark live``: from an event of the skin to the decision on the screen."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from deploy.errors import UserError
from pipeline.commands import options
from pipeline.progress import progress
from pipeline.skin import handwriting, parameters, simulate


def live(
    run: options.Run = Path("runs/default"),
    digits: Annotated[int, typer.Option(help="Digits to write.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the simulated hands.", min=0)] = 0,
    as_json: options.Json = False,
):
    """Measure in Chromium how soon a decision is on the screen: simulated hands at their own pace.

    Counted is each decision that new events led to, from the last of them to the frame that shows
    it.  Needs Chromium and Playwright, and a machine with nothing else to do.
    """
    from pipeline.live import robot

    with tempfile.TemporaryDirectory() as kept, robot.chromium() as browser:
        command = [sys.executable, "-m", "pipeline", "live", str(run), "--no-browser"]
        command += ["--port", "0", "--record", kept]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            try:
                line = server.stdout.readline().split()
                if not line:
                    raise UserError(f"{run}: the page could not be served; see above")
                page = browser.new_page(viewport={"width": 1280, "height": 1000})
                robot.opened(page, line[1])
                with progress("write", digits) as advance:
                    for motion in _motions(digits, seed):
                        page.click("#clear")
                        robot.write(page, motion)
                        page.wait_for_timeout(300)
                        advance(1)
                told = page.locator("#latency").evaluate("element => ({...element.dataset})")
            finally:
                server.terminate()
    facts = {
        "median_ms": float(told["median"]),
        "ninetieth_percentile_ms": float(told["ninetieth"]),
        "decisions": int(told["count"]),
        "digits": digits,
    }
    text = (
        f"last event to decision on the screen: {facts['median_ms']:.0f} ms at the median, "
        f"{facts['ninetieth_percentile_ms']:.0f} ms at the 90th percentile of "
        f"{facts['decisions']} decisions while {digits} digits were written"
    )
    options.tell(facts, lambda _: text, as_json)


def _motions(n, seed):
    """Simulated hands, each digit in turn."""
    p = parameters.load()
    people = handwriting.writers(np.random.default_rng([seed, 1]), p.writers)
    for index in range(n):
        sample = simulate.Sample(index % 10, index, index % len(people))
        rng = np.random.default_rng([seed, 2, sample.digit, index])
        yield simulate.motion(sample, people[sample.writer], rng, p)
