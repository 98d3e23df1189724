"""The board: chips, connection, probes, and the run."""

import types

import numpy as np
from nxsdk.core import N2Core
from nxsdk.faults import FAULTS, BoardError
from nxsdk.graph.nxprobes import N2SpikeProbe

CORES_PER_CHIP = 128


class N2Chip:
    def __init__(self, parent, index, n_cores, n_synapses):
        if n_cores > CORES_PER_CHIP:
            raise BoardError(f"{n_cores} cores asked for: a chip has {CORES_PER_CHIP}")
        self.parent = parent
        self.id = 2 * index + 1  # not its position
        self.n2Cores = [N2Core(self, i, n_synapses[i]) for i in range(n_cores)]
        self.n2CoresAsList = self.n2Cores


class Executor:
    def __init__(self):
        self.started = False
        self._host_coordinator = types.SimpleNamespace(hostAddr="stand-in")

    def hasStarted(self):
        return self.started


class Probe:
    """The time series of one compartment."""

    def __init__(self):
        self.timeSeries = types.SimpleNamespace(data=[])


class Recorder:
    """Takes down ``u``, ``v`` or ``spike`` of some compartments of a core, for their probes."""

    def __init__(self, core, compartments, attribute):
        self.core, self.compartments, self.attribute = core, compartments, attribute
        self.probes = [Probe() for _ in compartments]
        self.rows = []

    def record(self):
        self.rows.append(getattr(self.core, self.attribute)[self.compartments])

    def hand_over(self, missing, spike=1):
        """Give the rows since the last time to the probes, without the last ``missing``."""
        kept = self.rows[: len(self.rows) - missing] + self.rows[-1:] * -missing
        rows = np.array(kept, dtype=np.int64)
        if self.attribute == "spike":
            rows *= spike
        for probe, column in zip(self.probes, rows.T):
            probe.timeSeries.data += column.tolist()
        self.rows.clear()


class Monitor:
    def __init__(self):
        self.recorders = []

    def probe(self, core, compartments, attribute):
        if attribute not in ("u", "v", "spike"):
            raise BoardError(f"no such state: {attribute}")
        recorder = Recorder(core, np.array(compartments, dtype=int), attribute)
        self.recorders.append(recorder)
        if attribute == "spike":
            N2SpikeProbe.probeDict[len(N2SpikeProbe.probeDict)] = recorder.probes
        return recorder.probes


class N2Board:
    """A board of chips.

    Parameters
    ----------
    board_id : int
    n_chips : int
    n_cores_per_chip : list of int
    n_synapses_per_core : list of list of int
    """

    def __init__(self, board_id, n_chips, n_cores_per_chip, n_synapses_per_core):
        self.id = board_id
        self.n2Chips = [
            N2Chip(self, i, n_cores_per_chip[i], n_synapses_per_core[i]) for i in range(n_chips)
        ]
        self.monitor = Monitor()
        self.executor = Executor()
        self.step = 0
        self.input_spikes = {}  # time: list of (chip, core, type, axon, atom)
        self.in_flight = []
        self.compiled = False

    def probe(self, probeType, probeCondition):
        """An energy probe, where one was asked for; it reports what it was told to."""
        if FAULTS.power is None:
            raise BoardError("this board has no energy probes")
        if self.executor.started:
            raise BoardError("energy probes must be placed before the board starts")
        stats = types.SimpleNamespace(power=FAULTS.power, timePerTimestep=10.0)
        self.energyTimeMonitor = types.SimpleNamespace(powerProfileStats=stats)
        return types.SimpleNamespace(parameter=probeType, condition=probeCondition)

    def start(self):
        FAULTS.connect()
        if not self.compiled:
            self.cores = {}
            for chip in self.n2Chips:
                for core in chip.n2Cores:
                    core.compile()
                    self.cores[chip.id, core.id] = core
            self.compiled = True
        self.executor.started = True

    def disconnect(self):
        self.executor.started = False

    def createSnip(self, *args, **kwargs):
        raise BoardError("the stand-in runs no snips; use precompute=True")

    createChannel = createSnip

    def add_spike(self, time, chip, core, kind, axon, atom=0):
        if time <= self.step:
            raise BoardError(f"an input spike for step {time} came at step {self.step}")
        if not FAULTS.loses_spike():
            self.input_spikes.setdefault(time, []).append((chip, core, kind, axon, atom))

    def run(self, steps, aSync=False):
        if not self.executor.started:
            raise BoardError("run before start")
        if aSync:
            raise BoardError("the stand-in runs no snips; use precompute=True")
        for _ in range(steps):
            try:
                FAULTS.step()
            except BoardError:
                self.executor.started = False
                raise
            self._advance()
        missing, spike = FAULTS.probed()
        for recorder in self.monitor.recorders:
            recorder.hand_over(missing, spike)

    def _advance(self):
        self.step += 1
        # sent in the step before, by cores and by the host
        for chip, core, kind, axon, atom in self.in_flight + self.input_spikes.pop(
            self.step - 1, []
        ):
            self.cores[chip, core].receive(kind, axon, atom)
        for core in self.cores.values():
            core.update()
        self.in_flight = [spike for core in self.cores.values() for spike in core.sent()]
        for recorder in self.monitor.recorders:
            recorder.record()

    def finishRun(self):
        pass
