"""Real touch: from a public repository, as published, to a ladder and a report.

Clone ``clear-nus/TactileSGNet`` (36 objects in a robot's hand, 39 taxels) or
``tasbolat1/letter-spike`` (Braille letters, 80 taxels) and give its folder::

    python examples/real_touch.py objects TactileSGNet
    python examples/real_touch.py letters letter-spike
"""

import io
import json
import sys
import zipfile
from pathlib import Path

import numpy as np

import stmnist


def objects(folder):
    """Events, class and part of each recording: arrays (taxel, polarity, step of 20 ms)."""
    with zipfile.ZipFile(folder / "Ev-Objects.zip") as archive:
        for name in archive.namelist():
            if name.endswith(".npy") and "__MACOSX" not in name:
                counts = np.load(io.BytesIO(archive.read(name)))
                step, taxel, channel = np.nonzero(counts.transpose(2, 0, 1))
                label = f"{int(name.split('_label_')[1][:-4]):02d}"
                yield (taxel, 0 * taxel, 20_000 * step, channel == 0), label, name.split("/")[-2]


def letters(folder):
    """The same of lines ``timestamp, isNeg, taxel_id, adc``; the split is the published trial0."""
    trial = json.loads((folder / "data" / "splits.txt").read_text())["trial0"]
    for letter, split in trial.items():
        for path in sorted((folder / "data" / letter).glob("*.csv")):
            lines = path.read_text().splitlines()[1:]
            if lines:  # two files are empty
                table = np.loadtxt(lines, delimiter=",", ndmin=2)
                table = table[np.lexsort((table[:, 0], table[:, 2]))]  # each taxel in order of time
                time, taxel, value = table[:, 0], table[:, 2].astype(int), table[:, 3]
                first = np.diff(taxel, prepend=-1) != 0
                rises = first | (np.diff(value, prepend=0) > 0)
                order = np.argsort(time, kind="stable")
                events = (taxel - 1, 0 * taxel, (1e6 * (time - time.min())).astype(int), rises)
                test = int(path.stem.split("_")[1]) in split["test"]
                yield tuple(column[order] for column in events), letter, "test" if test else "train"


if __name__ == "__main__":
    what, read = sys.argv[1], {"objects": objects, "letters": letters}[sys.argv[1]]
    events, labels, parts = zip(*read(Path(sys.argv[2])), strict=True)
    recordings = list(zip(events, labels, strict=True))
    data = stmnist.write_recordings(f"{what}.zip", recordings, time_unit="us", parts=parts)
    changes = {"data": {"source": str(data.absolute())}, "input": {"kind": "events"}}
    settings = stmnist.Settings().with_values(changes)
    with stmnist.stages.opened_run(f"runs/{what}", settings) as opened:
        print(stmnist.ladder_text(stmnist.measure_ladder(opened)))
    print(stmnist.write_report(f"runs/{what}"))
