"""Real touch: Braille letters from a public repository, from its files to a ladder and a report.

Clone ``tasbolat1/letter-spike`` (80 taxels) and give its folder::

    python examples/real_touch.py letter-spike

The arrays of ``clear-nus/TactileSGNet`` and ``GuoFM/DeepTactile`` need no script::

    stmnist ladder runs/objects --data TactileSGNet/Ev-Objects.zip --input events
"""

import json
import sys
from pathlib import Path

import numpy as np

import stmnist


def read_letters(folder):
    """Events, class and part of each recording.

    Files have lines ``timestamp, isNeg, taxel_id, adc``; the split is the published trial0.
    """
    trial = json.loads((folder / "data" / "splits.txt").read_text())["trial0"]
    for letter, split in trial.items():
        for path in sorted((folder / "data" / letter).glob("*.csv")):
            lines = path.read_text().splitlines()[1:]
            if not lines:  # two files are empty
                continue
            is_test = int(path.stem.split("_")[1]) in split["test"]
            yield read_events(lines), letter, "test" if is_test else "train"


def read_events(lines):
    """Arrays x, y, t and p of a file: a taxel's reading rises, or is its first, or falls."""
    table = np.loadtxt(lines, delimiter=",", ndmin=2)
    table = table[np.lexsort((table[:, 0], table[:, 2]))]  # each taxel in order of time
    time, taxel, value = table[:, 0], table[:, 2].astype(int), table[:, 3]
    is_first = np.diff(taxel, prepend=-1) != 0
    rises = is_first | (np.diff(value, prepend=0) > 0)
    order = np.argsort(time, kind="stable")
    time_us = (1e6 * (time - time.min())).astype(int)
    return (taxel - 1)[order], 0 * taxel, time_us[order], rises[order]


if __name__ == "__main__":
    events, labels, parts = zip(*read_letters(Path(sys.argv[1])), strict=True)
    recordings = list(zip(events, labels, strict=True))
    data = stmnist.write_recordings("letters.zip", recordings, time_unit="us", parts=parts)
    run = stmnist.Run("runs/letters", data=data, input="events")
    print(run.ladder())
    print(run.report())
