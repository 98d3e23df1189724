"""A sink that packs spikes and writes them itself: Lava's own hand them over number by number."""

import numpy as np
from lava.magma.core.decorator import implements, requires, tag
from lava.magma.core.model.py.model import PyLoihiProcessModel
from lava.magma.core.model.py.ports import PyInPort
from lava.magma.core.model.py.type import LavaPyType
from lava.magma.core.process.ports.ports import InPort
from lava.magma.core.process.process import AbstractProcess
from lava.magma.core.resources import CPU
from lava.magma.core.sync.protocols.loihi_protocol import LoihiProtocol


class Recorder(AbstractProcess):
    """Writes the spikes of ``steps`` steps to ``path``, uint8 of shape (steps, n / 8).

    Parameters
    ----------
    shape : tuple of int
    steps : int
    path : str
    """

    def __init__(self, *, shape, steps, path):
        super().__init__(shape=shape, steps=steps, path=path)
        self.a_in = InPort(shape=shape)


@implements(proc=Recorder, protocol=LoihiProtocol)
@requires(CPU)
@tag("fixed_pt")
class PyRecorder(PyLoihiProcessModel):
    """Its model."""

    a_in: PyInPort = LavaPyType(PyInPort.VEC_DENSE, np.int32)

    def __init__(self, proc_params):
        super().__init__(proc_params)
        self.kept = []

    def run_spk(self):
        """Keep a step; write all at the last one."""
        self.kept.append(np.packbits(self.a_in.recv().ravel() != 0))
        if self.time_step == self.proc_params["steps"]:
            np.save(self.proc_params["path"], np.array(self.kept))
