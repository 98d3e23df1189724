"""What shall go wrong, from the environment variable ``NXSDK_STANDIN`` (a JSON object)."""

import dataclasses
import json
import os
import threading


class BoardError(RuntimeError):
    """What the board, or the way to it, does not put up with."""


@dataclasses.dataclass
class Faults:
    """Faults to inject; counted over the life of the process.

    Attributes
    ----------
    version : str
        The version that the stand-in reports.
    refuse : int
        How many times the connection is refused before it succeeds.
    lose_at_step : int or None
        Lose the connection, once, after that many executed steps.
    kill_at_step : int or None
        End the process then, without clean-up, as a cluster ends a job that is out of time.
    drop_spikes : int
        How many of the input spikes sent get lost on the way.
    short_probes : int
        How many of the last rows of every probe are missing after a run; below 0, how many rows too
        many there are.
    spikes_twice : bool
        Whether every spike is reported as two.
    hang_at_step : int or None
        Never come back from that step, once.
    from_connection : int
        The faults above begin with this connection, counted from 0, and are counted from there.
    times : int or None
        In how many runs probes are wrong, from there on; None: in all.
    share_axon_cfgs : bool
        Whether members of a population share AxonCfg registers.  NengoLoihi counts on it; that
        boards refused networks which it had passed (its issue 326) makes one doubt it.
    power : dict or None
        What the energy probe reports, ``powerProfileStats.power`` in mW; ``None``: no such probe.
    """

    version: str = "1.0.0"
    refuse: int = 0
    lose_at_step: int = None
    kill_at_step: int = None
    drop_spikes: int = 0
    short_probes: int = 0
    share_axon_cfgs: bool = True
    power: dict = None
    spikes_twice: bool = False
    hang_at_step: int = None
    from_connection: int = 0
    times: int = None

    steps: int = 0
    connections: int = 0

    @property
    def begun(self):
        """Whether the connection from which on there are faults has been reached."""
        return self.connections > self.from_connection

    def connect(self):
        if self.refuse > 0 and self.connections >= self.from_connection:
            self.refuse -= 1
            raise BoardError("connection refused")
        self.connections += 1
        if self.connections == self.from_connection + 1:
            self.steps = 0

    def step(self):
        self.steps += 1
        if not self.begun:
            return
        if self.hang_at_step is not None and self.steps > self.hang_at_step:
            self.hang_at_step = None
            threading.Event().wait()
        if self.kill_at_step is not None and self.steps > self.kill_at_step:
            os._exit(137)
        if self.lose_at_step is not None and self.steps > self.lose_at_step:
            self.lose_at_step = None
            raise BoardError("connection to the board lost")

    def probed(self):
        """(missing rows, what a spike is reported as) of a run."""
        if not self.begun or self.times == 0:
            return 0, 1
        if self.times is not None and (self.short_probes or self.spikes_twice):
            self.times -= 1
        return self.short_probes, 2 if self.spikes_twice else 1

    def loses_spike(self):
        if self.begun and self.drop_spikes > 0:
            self.drop_spikes -= 1
            return True
        return False


FAULTS = Faults(**json.loads(os.environ.get("NXSDK_STANDIN", "{}")))
