"""examples/real_touch.py reads the repository of letters as published; here a hand-made one."""

import json
import runpy

from tests.command import ROOT

EXAMPLE = runpy.run_path(str(ROOT / "examples" / "real_touch.py"))


def test_letters(tmp_path):
    (tmp_path / "data" / "A").mkdir(parents=True)
    split = {"trial0": {"A": {"test": [1]}}}
    (tmp_path / "data" / "splits.txt").write_text(json.dumps(split))
    lines = ["timestamp,isNeg,taxel_id,adc", "10.5,0,5,30", "10.75,0,5,40", "11,0,5,20"]
    (tmp_path / "data" / "A" / "A_0.csv").write_text("\n".join([*lines, "10.25,0,80,7"]))
    (tmp_path / "data" / "A" / "A_1.csv").write_text("\n".join(lines[:2]))
    (tmp_path / "data" / "A" / "A_2.csv").write_text(lines[0])  # empty: left out
    first, second = EXAMPLE["read_letters"](tmp_path)
    (x, y, t, p), label, part = first
    assert (x.tolist(), y.tolist(), label, part) == ([79, 4, 4, 4], [0] * 4, "A", "train")
    assert t.tolist() == [0, 250_000, 500_000, 750_000]
    assert p.tolist() == [True, True, True, False]
    assert second[2] == "test"
