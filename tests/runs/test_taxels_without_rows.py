"""A sensor without rows: ``taxels.csv`` says where its taxels are, and it is drawn so."""

import re

import numpy as np

from deploy.check.bundle import read_bundle
from deploy.network.provenance import read_positions
from pipeline.live.network import describe_for_page, find_sensor
from tests.command import call
from tests.pipeline.handmade import archive, npz

POSITIONS = "taxel,x,y\n0,0,-2\n1,-3,0\n2,3,0\n3,0,2\n"


def touch(label, rng):
    """Most events of a class are of its own two taxels."""
    x = np.where(rng.random(40) < 0.8, 2 * label + rng.integers(0, 2, 40), rng.integers(0, 4, 40))
    return npz(x=x, y=np.zeros(40, int), t=np.sort(rng.random(40)), p=rng.integers(0, 2, 40))


def test_positions_reach_the_report_and_the_page(tmp_path):
    rng = np.random.default_rng(0)
    members = {f"{label}/{i:02d}.npz": touch(label, rng) for label in (0, 1) for i in range(20)}
    source, run = tmp_path / "s.zip", tmp_path / "run"
    archive(source, {**members, "taxels.csv": POSITIONS})
    options = ("--data", source, "--input", "events", "--set", "events.epochs=1")
    assert call("convert", run, *options, "--samples", "6") == 0
    bundle = read_bundle(run / "bundle")
    expected = [[0.5, 0], [0, 1 / 3], [1, 1 / 3], [0.5, 2 / 3]]
    np.testing.assert_allclose(read_positions(bundle.spec), expected, atol=1e-9)
    page = describe_for_page(bundle, find_sensor(bundle), tmp_path)
    np.testing.assert_allclose(page["positions"], expected, atol=1e-9)
    assert call("check", "run", run, "--target", "fast") == 0
    assert call("report", run) == 0
    dots = re.findall(
        r'<circle class="on" cx="([\d.]+)" cy="([\d.]+)"', (run / "report.html").read_text()
    )
    assert set(dots) == {("0.50", "0.00"), ("0.00", "0.33"), ("1.00", "0.33"), ("0.50", "0.67")}
    assert len(dots) == 2 * 4 * 6  # among its class's, and beside its spikes
