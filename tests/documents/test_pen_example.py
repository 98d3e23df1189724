"""examples/pen.py writes trajectories of people as recordings; a hand-made file here."""

import subprocess
import sys

import numpy as np

from pipeline.sources import load_recordings
from tests.command import ROOT, environment
from tests.experiments.test_unipen import SEVEN

# Another person's 1.
ONE = """\
.SEGMENT DIGIT 3 ? "1"
.COMMENT 1 3 225
.PEN_DOWN
 100 200
 100 0
.PEN_UP
"""


def test_pen(tmp_path):
    (tmp_path / "digits").write_text(SEVEN + ONE)
    read = {}
    for how in ((), ("reversed",)):
        out = tmp_path / f"{len(how)}.zip"
        command = [sys.executable, "-m", "examples.pen", str(tmp_path / "digits"), str(out), *how]
        subprocess.run(command, cwd=ROOT, env=environment(PYTHONPATH=""), check=True)
        recordings = read[how] = load_recordings(str(out))
        assert recordings.source.simulated
        assert [recordings.sensor.classes[n] for n in recordings.labels] == ["1", "7"]
        assert sorted(recordings.writers) == [2, 11]

    def third(recordings, index, first):  # the mean row in a third of the time
        events, rows = recordings[index], recordings.taxels.row
        order = np.argsort(events.time_ns)
        order = order[: len(order) // 3] if first else order[-len(order) // 3 :]
        return rows[events.taxel[order]].mean()

    for index in (0, 1):  # both are written from the top to the bottom
        assert third(read[()], index, True) < third(read[()], index, False)
        assert third(read["reversed",], index, True) > third(read["reversed",], index, False)
