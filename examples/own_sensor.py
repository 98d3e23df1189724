"""Recordings of your own event-based sensor: from events and labels to ladders and reports.

The recordings are simulated here: four gestures on 9 rows of 12 taxels.  Replace them by your own
events and labels, or by a data set of Tonic.  Run it as a script (``python
examples/own_sensor.py``); docs/tutorials/2-own-sensor.ipynb explains the steps.
"""

# %% The public names of this project
import numpy as np

from stmnist import (
    RunFolder,
    Settings,
    compare_runs,
    ladder_text,
    measure_ladder,
    read_runs,
    runs_text,
    stages,
    write_recordings,
    write_report,
)

CLASSES = ("swipe to the right", "swipe to the left", "swipe down", "circle")


# %% Recordings: a pair (events, label) each; x is the column from the left, y the row from the top
def gesture(label, rng, n=80):
    """Made-up events of one gesture: x, y, t in microseconds, p (1 for ON, 0 for OFF)."""
    along = np.sort(rng.uniform(0, 1, n))
    x0, y0 = rng.normal(5.5, 0.8), rng.normal(4, 0.6)
    x, y = (
        (11 * along, y0 + 0 * along),
        (11 - 11 * along, y0 + 0 * along),
        (x0 + 0 * along, 8 * along),
        (x0 + 4 * np.cos(2 * np.pi * along), y0 + 3 * np.sin(2 * np.pi * along)),
    )[label]
    x, y = (
        np.clip(np.rint(place + rng.normal(0, 0.4, n)), 0, last).astype(int)
        for place, last in ((x, 11), (y, 8))
    )
    return x, y, (1e6 * rng.uniform(0.4, 1.6) * along).astype(int), rng.integers(0, 2, n)


rng = np.random.default_rng(0)
recordings = [(gesture(label, rng), label) for label in range(4) for _ in range(75)]
data = write_recordings("gestures.zip", recordings, CLASSES, "us", simulated=True)

# %% A network on images of the events, and one on the events themselves
for kind in ("image", "events"):
    run = RunFolder(f"runs/gestures-{kind}")
    settings = Settings().with_values(
        {"data": {"source": str(data.absolute())}, "input": {"kind": kind}}
    )
    with run.locked():
        ladder = measure_ladder(stages.open_run(run, settings))
    print(ladder_text(ladder))

# %% Both side by side, and a page of each with all results
print(runs_text(compare_runs(read_runs(["runs/gestures-image", "runs/gestures-events"]))))
for kind in ("image", "events"):
    print(write_report(f"runs/gestures-{kind}"))

# %% The same works on the command line, and two things more:
#
#     stmnist report runs/gestures-events
#     stmnist live runs/gestures-events              # in Python: live("runs/gestures-events")
#     stmnist check run runs/gestures-events --target fast --data other-recordings.zip
#
# On images the two swipes along x look alike; the events' order tells them apart.
