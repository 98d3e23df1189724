"""A hand for the page: writes motions in a real Chromium at their own pace (Playwright)."""

from __future__ import annotations

import contextlib
import shutil
import time
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from pipeline.simulation.handwriting import Motion

ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
RATE_HZ = 100
# Force from which the pen counts as on the skin, as a share of a motion's greatest.
TOUCH = 0.3


@contextlib.contextmanager
def chromium(executable=None):
    """A Chromium without a window, as Playwright's ``Browser``.

    Parameters
    ----------
    executable : path-like, optional
        Default: the one on the path, else the one that Playwright has installed for itself.

    Raises
    ------
    UserError
        Chromium or Playwright is not here, Chromium does not start, or what is done with it in the
        block takes too long or fails.
    """
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError as error:
        raise UserError(f"{error.name} is not here: pip install playwright") from error
    executable = executable or next(filter(None, map(shutil.which, BROWSERS)), None)
    with sync_playwright() as playwright:
        executable = executable or playwright.chromium.executable_path
        if not Path(executable).exists():
            raise UserError(
                "no Chromium here; install one (on Debian and Ubuntu: apt install chromium)"
            )
        try:
            browser = playwright.chromium.launch(executable_path=executable, args=list(ARGUMENTS))
        except Error as error:
            raise UserError(
                f"{executable}: cannot be started ({_what(error)}); see what it says by itself"
            ) from error
        try:
            yield browser
        except Error as error:
            raise UserError(
                f"the page in Chromium: {_what(error)}; leave the machine to it and try again"
            ) from error
        finally:
            browser.close()


def _what(error):
    """Playwright's error without the log below it."""
    return str(error).partition("\n")[0].rstrip(".")


def opened(page, url, timeout_s=120):
    """Open the page and wait until it says that it is ready."""
    page.goto(url)
    page.wait_for_selector("body[data-ready]", timeout=1000 * timeout_s)


def replay(page, motion: Motion):
    """Like :func:`write`, but with events that the page makes itself.

    Points go in without the round trips of a browser's driver, as densely and as evenly as the
    machine lets them; a browser's own input is left out.
    """
    page.evaluate(_REPLAY, points_of(motion))


def points_of(motion: Motion) -> list:
    """What a pointer tells of a motion: [ms, share of the width, of the height, kind of event]."""
    touches = motion.force > TOUCH * motion.force.max()
    first, last = np.flatnonzero(touches)[[0, -1]]
    step = max(1, round(1 / RATE_HZ / (motion.time_s[1] - motion.time_s[0])))
    points, down = [], False
    for at in [*range(first, last, step), last]:
        lands, lifts = touches[at] and not down, down and not touches[at]
        down = bool(touches[at])
        if down or lifts:
            x, y = np.clip((motion.right[at] + 0.5, motion.down[at] + 0.5), 0.02, 9.98) / 10
            kind = "pointerdown" if lands else "pointerup" if lifts else "pointermove"
            since_ms = 1e3 * (motion.time_s[at] - motion.time_s[first])
            points.append([float(since_ms), float(x), float(y), kind])
    if down:
        points.append([*points[-1][:3], "pointerup"])
    return points


_REPLAY = """async (points) => {
  const skin = document.querySelector("#skin"), box = skin.getBoundingClientRect();
  const begun = performance.now();
  for (const [since, x, y, kind] of points) {
    while (performance.now() - begun < since) await new Promise((done) => setTimeout(done, 2));
    skin.dispatchEvent(new PointerEvent(kind, {
      pointerId: 9, pointerType: "mouse", pressure: kind === "pointerup" ? 0 : 0.5,
      clientX: box.left + x * box.width, clientY: box.top + y * box.height,
    }));
  }
}"""


def write(page, motion: Motion):
    """Write a motion on the page's skin, in as much time as it takes.

    Parameters
    ----------
    page : playwright.sync_api.Page
    motion : Motion
        Parts where the force is small are in the air.
    """
    skin = page.locator("#skin")
    skin.scroll_into_view_if_needed()
    box = skin.bounding_box()
    touches = motion.force > TOUCH * motion.force.max()
    first, last = np.flatnonzero(touches)[[0, -1]]
    begun, down = time.perf_counter(), False
    for when in np.arange(motion.time_s[first], motion.time_s[last], 1 / RATE_HZ):
        at = np.searchsorted(motion.time_s, when)
        lag = time.perf_counter() - begun - (when - motion.time_s[first])
        if lag > 1 / RATE_HZ and down == touches[at]:
            continue  # a busy machine gets fewer points, not a slower hand
        share = (np.array([motion.right[at], motion.down[at]]) + 0.5) / 10
        x, y = np.clip(share, 0.002, 0.998) * (box["width"], box["height"])
        if lag < 0:
            time.sleep(-lag)
        if down and not touches[at]:
            page.mouse.up()
        page.mouse.move(box["x"] + x, box["y"] + y)
        if touches[at] and not down:
            page.mouse.down()
        down = bool(touches[at])
    if down:
        page.mouse.up()
