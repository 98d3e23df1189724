"""A network that answers at once, and a server to talk to."""

import threading
from contextlib import closing, contextmanager

import numpy as np
import pytest

from pipeline.live.deciding import Answer, DrawnLayer
from pipeline.skin import parameters


class Parrot:
    """Decides for the number of events, modulo 10."""

    about = "It is shown nothing."
    layers = (DrawnLayer("input", 100),)
    steps, first_step, clocked = 3, -1, False

    def begin(self):
        return self

    def answer(self, events, time_s):
        confidence = np.full(10, 0.01)
        confidence[len(events) % 10] = 0.91
        return Answer(np.log(confidence), confidence, {"input": np.zeros((3, 13), np.uint8)})


@contextmanager
def served(folder, make_decider=Parrot, make_learner=None):
    """A server in a thread, and its keeper."""
    from pipeline.live.keeping import Keeper
    from pipeline.live.server import Live, Server, listen

    about = {"folder": str(folder), "architecture": "x", "bundle": "0", "trained_on": "simulated"}
    with closing(Keeper(folder)) as keeper:
        about["simulated"] = True
        live = Live(make_decider, keeper, parameters.load(), about, make_learner=make_learner)
        server = Server(live, listen(0))
        thread = threading.Thread(target=server.run, daemon=True)
        thread.start()
        assert server.listens.wait(120)
        server.keeper = keeper
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
