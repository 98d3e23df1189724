"""Make the pictures of the documents.

``docs/pictures.json`` has, for each picture, a hash of the files that determine how it looks; a
test fails if one of them has changed since the picture was made.
"""

import hashlib
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from deploy.check.bundle import read_bundle
from deploy.errors import UserError
from deploy.files import read_json, write_json
from deploy.targets.registry import run_target
from deploy.terminal import show
from pipeline.live.network import SHIPPED
from pipeline.look import find_colour
from pipeline.paper import SAMPLES_PER_DIGIT
from pipeline.recordings.sensor import GRID
from pipeline.results.report import figures
from pipeline.results.report.figures import SHADES, animation, recordings
from pipeline.simulation import handwriting, parameters, simulate
from pipeline.sources import load_simulated

ROOT = Path(__file__).resolve().parent.parent
FIGURES = ("pipeline/results/report/figures/recordings.py", "pipeline/look.css")
# For each picture in docs/, patterns of the files that determine how it looks.
PICTURES = {
    "recording.png": FIGURES,
    "sheet.png": FIGURES,
    "fidelity.png": (*FIGURES, "results/fidelity.json"),
    "operations.png": (*FIGURES, "results/table2-stmnist-published.json"),
    "live.png": ("pipeline/live/page/*", "pipeline/look.css"),
    "touch.gif": ("pipeline/results/report/figures/animation.py", "pipeline/look.css"),
}
# Rows of Table 2 in the figure of accuracy and operations, with their names there.
NETWORKS = {
    "loihi": "the paper's CNN and\nrecipe, converted",
    "own-loihi": "one image",
    "slices": "slices of time",
    "events-small-loihi": "events, small",
    "events-loihi": "events, standard",
}
# Classifiers without spikes in that figure, as lines.
BASELINES = {"kernel": "kernel classifier, no spikes", "counts": "logistic regression on counts"}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
MAX_WRITERS = 12  # simulated people who write the digit of the picture until it is recognised


def compute_stamps() -> dict:
    """The hash of the files that determine how each picture looks, by its name."""
    hashes = {}
    for name, patterns in PICTURES.items():
        paths = sorted(path for pattern in patterns for path in ROOT.glob(pattern))
        hashes[name] = hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()
    return hashes


def _draw_hand(seed):
    """A simulated person's 8 in 1.2 s: milliseconds, and shares of the width and height."""
    p = parameters.read_parameters()
    rng = np.random.default_rng(seed)
    writer = handwriting.draw_writer(rng, p)
    sample = simulate.PlannedRecording(8, 0, 0)
    motion = simulate.draw_motion(sample, writer, rng, p.forms[8], p)
    first, last = np.flatnonzero(motion.force > 0.3 * motion.force.max())[[0, -1]]
    samples = np.linspace(first, last, 120).astype(int)
    positions = (motion.right[samples] + 0.5) / 10, (motion.down[samples] + 0.5) / 10
    return np.stack([np.linspace(0, 1200, 120), *positions], axis=1).tolist()


# Points go in from inside the page, without the round trips of a browser's driver.
WRITE = """async (points) => {
  const skin = document.querySelector("#skin"), box = skin.getBoundingClientRect();
  const begun = performance.now();
  const send = (kind, x, y) => skin.dispatchEvent(new PointerEvent(kind, {
    pointerId: 9, pointerType: "mouse", pressure: kind === "pointerup" ? 0 : 0.5,
    clientX: box.left + x * box.width, clientY: box.top + y * box.height,
  }));
  for (const [index, [since, x, y]] of points.entries()) {
    while (performance.now() - begun < since) await new Promise((done) => setTimeout(done, 2));
    send(index ? "pointermove" : "pointerdown", x, y);
  }
  send("pointerup", ...points.at(-1).slice(1));
}"""


def _write_until_right(page):
    """Write 8s of several simulated people until the page decides for an 8.

    Not every person is recognised, and a busy machine delays the pen.
    """
    for seed in range(MAX_WRITERS):
        page.click("#clear")
        page.evaluate(WRITE, _draw_hand(seed))
        page.wait_for_timeout(2500)
        if page.inner_text("#decision") == "8" and page.is_hidden("#decision.open"):
            return
    raise UserError("the page has not recognised an 8; leave the machine to it and try again")


def _draw_live_page(path):
    """The live page after an 8."""
    from playwright.sync_api import sync_playwright

    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    command = [sys.executable, "-m", "pipeline", "live", "--port", "0", "--record"]
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        server = subprocess.Popen([*command, folder], stdout=subprocess.PIPE, text=True)
        try:
            url = re.search(r"http://\S+", server.stdout.readline())[0]
            browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1040, "height": 760}, device_scale_factor=2)
            page.goto(url)
            page.wait_for_selector("body[data-ready]")
            _write_until_right(page)
            main = page.locator("main").bounding_box()
            clip = {"x": 0, "y": 0, "width": 1040, "height": main["y"] + main["height"] + 8}
            page.screenshot(path=path, full_page=True, clip=clip)
            browser.close()
        finally:
            server.terminate()
            server.wait()


def _animate_touch(path):
    """An animation of the first 8 of the included network's check that it decides early."""
    bundle = read_bundle(SHIPPED)
    responses = run_target(bundle.spec, bundle.checks.inputs, "fast", bundle.seed)
    is_right = (bundle.checks.labels == 8) & (responses.scores.argmax(1) == 8)
    is_early = responses.stopped_at < bundle.spec.presentation.steps
    animation.animate(path, bundle, int(np.flatnonzero(is_right & is_early)[0]))


def draw_maps(maps: dict) -> Figure:
    """How often each taxel is active in recordings of each digit, with five digits in a row.

    Parameters
    ----------
    maps : dict of list, shape (10, 100)
        Shares by kind of recordings, taxels by columns.
    """
    figure = Figure(figsize=(6, 5.8), layout="constrained")
    per_row = 5
    axes = figure.subplots(2 * len(maps), per_row)
    for number, (kind, shares) in enumerate(maps.items()):
        for digit, share in enumerate(shares):
            down, across = divmod(digit, per_row)
            panel = axes[len(maps) * down + number, across]
            image = np.reshape(share, (GRID, GRID)).T
            shown = panel.imshow(image, cmap=SHADES, vmin=0, vmax=1)
            panel.set(xticks=[], yticks=[])
            if across == 0:
                panel.set_ylabel(kind, size=12)
            if number == 0:
                panel.set_title(str(digit))
    scale = figure.colorbar(shown, ax=axes, location="bottom", aspect=40, ticks=[0, 0.5, 1])
    scale.set_ticklabels(["0 %", "50 %", "100 %"], size=11)
    scale.set_label("of the recordings in which the taxel has events", size=11)
    return figure


def draw_operations(rows: list) -> Figure:
    """Accuracy over synaptic operations of the networks of Table 2.

    Parameters
    ----------
    rows : list of dict
        Of one split, by :func:`experiments.tables.make_table`.
    """
    by_name = {row["name"]: row for row in rows}
    figure = Figure(figsize=(5.6, 4), layout="constrained")
    axes = figure.subplots()
    for name, title in NETWORKS.items():
        row = by_name[name]
        operations = row["costs"]["per_cnn"]
        axes.errorbar(
            operations, row["mean"], row["sd"], fmt="o", color=find_colour("on"), capsize=3
        )
        point = (operations, row["mean"])
        axes.annotate(title, point, (7, -9), textcoords="offset points")
    for name, title in BASELINES.items():
        accuracy = by_name[name]["mean"]
        axes.axhline(accuracy, color=find_colour("soft"), linestyle="--", linewidth=1, zorder=0)
        axes.annotate(
            title,
            (0.98, accuracy),
            (0, 3),
            ha="right",
            color=find_colour("soft"),
            textcoords="offset points",
            xycoords=("axes fraction", "data"),
        )
    axes.set(
        xlim=(0, 10.5),
        ylim=(0.88, 0.99),
        xlabel="synaptic operations per recording\nin multiples of the paper's CNN",
        ylabel="accuracy on the published split",
    )
    return figure


def main():
    """Make the pictures of the documents again (needs Chromium)."""
    if not any(map(shutil.which, BROWSERS)):
        raise UserError(
            "no Chromium here; install one (on Debian and Ubuntu: apt install chromium)"
        )
    docs = ROOT / "docs"
    sample = load_simulated(0, SAMPLES_PER_DIGIT, 2)
    index = sample.ids.index("8/0007")
    figures.save_figure(recordings.draw_recording(sample, index), docs / "recording.png")
    figures.save_figure(recordings.draw_sheet(sample), docs / "sheet.png")
    maps = read_json(ROOT / "results" / "fidelity.json", "run the experiment fidelity")["maps"]
    figures.save_figure(draw_maps(maps), docs / "fidelity.png")
    table = read_json(ROOT / "results" / "table2-stmnist-published.json", "run table2")
    figures.save_figure(draw_operations(table["rows"]), docs / "operations.png")
    _draw_live_page(docs / "live.png")
    _animate_touch(docs / "touch.gif")
    write_json(ROOT / "docs" / "pictures.json", compute_stamps())
    show("\n".join(f"docs/{name}" for name in PICTURES))
