"""Make the pictures of the documents.

``results/pictures.json`` has, for each picture, a hash of the files that determine how it looks; a
test fails if one of them has changed since the picture was made.
"""

from __future__ import annotations

import hashlib
import math
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from deploy.errors import UserError
from deploy.files import write_json
from deploy.terminal import show
from experiments.studies import RESULTS
from pipeline.data.library import simulated
from pipeline.paper import SAMPLES_PER_DIGIT
from pipeline.results.report import figures
from pipeline.results.report.figures import recordings

ROOT = Path(__file__).resolve().parent.parent
FIGURES = ("pipeline/results/report/figures/recordings.py", "pipeline/look.css")
# For each picture in docs/, patterns of the files that determine how it looks.
SHOWN = {
    "recording.png": FIGURES,
    "sheet.png": FIGURES,
    "live.png": ("pipeline/live/page/*", "pipeline/look.css"),
}
# Time in which the 8 is written.
WRITING_S = 1.3
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def stamps() -> dict:
    """The hash of the files that determine how each picture looks, by its name."""
    hashes = {}
    for name, patterns in SHOWN.items():
        paths = sorted(path for pattern in patterns for path in ROOT.glob(pattern))
        hashes[name] = hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()
    return hashes


def _live(path):
    """The live page after an 8."""
    from playwright.sync_api import sync_playwright

    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    command = [sys.executable, "-m", "pipeline", "live", "--port", "0", "--record"]
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        server = subprocess.Popen([*command, folder], stdout=subprocess.PIPE, text=True)
        try:
            url = re.search(r"http://\S+", server.stdout.readline())[0]
            browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.goto(url)
            page.wait_for_selector("body[data-ready]")
            box = page.locator("#skin").bounding_box()
            begun = share = 0.0
            while share < 1:
                share = min((time.monotonic() - begun) / WRITING_S, 1.0) if begun else 0.0
                angle = 2 * math.pi * (0.06 + share)
                x, y = 0.5 + 0.17 * math.sin(2 * angle), 0.5 - 0.4 * math.cos(angle)
                page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
                if not begun:
                    page.mouse.down()
                    begun = time.monotonic()
                page.wait_for_timeout(10)
            page.mouse.up()
            page.wait_for_timeout(2500)
            page.screenshot(path=path)
            browser.close()
        finally:
            server.terminate()
            server.wait()


def main():
    """Make the pictures of the documents again (needs Chromium)."""
    if not any(map(shutil.which, BROWSERS)):
        raise UserError(
            "no Chromium here; install one (on Debian and Ubuntu: apt install chromium)"
        )
    docs, sample = ROOT / "docs", simulated(0, SAMPLES_PER_DIGIT, 2)
    index = sample.ids.index("8/0000")
    figures.save(recordings.recording(sample, index), docs / "recording.png")
    figures.save(recordings.sheet(sample, 8), docs / "sheet.png")
    _live(docs / "live.png")
    write_json(RESULTS / "pictures.json", stamps())
    show("\n".join(f"docs/{name}" for name in SHOWN))
