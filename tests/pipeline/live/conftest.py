"""A network that answers at once, and a server to talk to."""

import threading
from contextlib import closing, contextmanager
from typing import ClassVar

import numpy as np
import pytest

from pipeline.live.deciding import Curve, NetworkOutput
from pipeline.recordings.sensor import DIGITS, Sensor
from pipeline.simulation import parameters


class Parrot:
    """Decides for the number of events, modulo that of the classes; early, after some of them."""

    layers: ClassVar = {"input": 100}
    steps, first_step, changes_with_time, threshold = 3, -1, False, 0.9
    window_s, usual_s = 2.0, 2.0

    def __init__(self, classes=10):
        self.classes = classes

    def begin(self):
        return self

    def compute_output(self, events, time_s):
        shares = np.full(self.classes, 0.1 / self.classes)
        label = len(events) % self.classes
        shares[label] += 0.9
        seconds, confidences = events.time_ns * 1e-9, np.linspace(0.1, 1, len(events))
        every = np.tile(shares, (len(events), 1))
        curve = Curve(seconds, confidences, np.full(len(events), label), every)
        spikes = {"input": np.zeros((3, 13), np.uint8)}
        return NetworkOutput(np.log(shares), spikes, curve, curve.find_first(self.threshold))


@contextmanager
def served(folder, make_decider=None, tests=(), sensor=None, host=None, port=0):
    """A server in a thread, and its keeper."""
    from pipeline.live.keeping import Keeper
    from pipeline.live.server import HOST, Live, Server, listen

    sensor, host = sensor or Sensor(), host or HOST
    make_decider = make_decider or (lambda: Parrot(len(sensor.classes)))
    about = {
        **{"folder": str(folder), "architecture": "x", "bundle": "0", "trained_on": "simulated"},
        **{"simulated": True, "classes": sensor.classes, "digits": sensor.classes == DIGITS},
        **{name: getattr(sensor, name) for name in ("rows", "columns", "polarities")},
    }
    with closing(Keeper(folder, sensor)) as keeper:
        live = Live(
            make_decider,
            keeper,
            parameters.read_parameters(),
            about,
            make_examples=lambda: list(tests),
        )
        server = Server(live, listen(port, host), host=host)
        thread = threading.Thread(target=server.run, daemon=True)
        thread.start()
        assert server.listens.wait(120)
        server.keeper, server.thread = keeper, thread
        try:
            yield server
        finally:
            server.should_exit = True
            thread.join(120)
            assert not thread.is_alive()


@pytest.fixture
def server(tmp_path):
    pytest.importorskip("uvicorn", reason="the extra 'live' is not installed")
    pytest.importorskip("websockets", reason="the extra 'live' is not installed")
    with served(tmp_path / "kept") as server:
        yield server


def stroke(right=4.5, start_ms=1000.0, seconds=0.3, per_message=3):
    """Messages of a line downwards, and of the moment after it."""
    times = start_ms + np.arange(0, 1000 * seconds, 10.0)
    points = [[t, right, 1 + 7 * (t - start_ms) / (1000 * seconds), 0.5, 1] for t in times.tolist()]
    points.append([start_ms + 1000 * seconds, right, 8.0, 0.5, 0])
    for first in range(0, len(points), per_message):
        part = points[first : first + per_message]
        yield {"type": "pen", "now": part[-1][0], "points": part}
    yield {"type": "pen", "now": points[-1][0] + 300, "points": []}
