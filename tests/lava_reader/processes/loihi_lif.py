"""Lava's LIF with what Loihi 1 and NengoLoihi have besides: refractory steps and a lower bound."""

import numpy as np
from lava.magma.core.decorator import implements, requires, tag
from lava.magma.core.model.py.ports import PyOutPort
from lava.magma.core.model.py.type import LavaPyType
from lava.magma.core.process.variable import Var
from lava.magma.core.resources import CPU
from lava.magma.core.sync.protocols.loihi_protocol import LoihiProtocol
from lava.proc.lif.models import AbstractPyLifModelFixed
from lava.proc.lif.process import LIF


class LoihiLIF(LIF):
    """Lava's LIF that holds its voltage at 0 for ``refractory`` steps after a spike.

    Parameters
    ----------
    refractory : int
    v_min : int
        Lower bound of the voltage.
    **kwargs
        What `lava.proc.lif.process.LIF` takes.
    """

    def __init__(self, *, refractory, v_min, **kwargs):
        super().__init__(**kwargs)
        self.refractory = Var(shape=(1,), init=refractory)
        self.v_min = Var(shape=(1,), init=v_min)
        self.waiting = Var(shape=kwargs["shape"], init=0)


@implements(proc=LoihiLIF, protocol=LoihiProtocol)
@requires(CPU)
@tag("bit_accurate_loihi", "fixed_pt")
class PyLoihiLIF(AbstractPyLifModelFixed):
    """Its model; the decays, the bias and the clipping are Lava's own."""

    s_out: PyOutPort = LavaPyType(PyOutPort.VEC_DENSE, np.int32, precision=24)
    vth: int = LavaPyType(int, np.int32, precision=17)
    refractory: int = LavaPyType(int, np.int32)
    v_min: int = LavaPyType(int, np.int32)
    waiting: np.ndarray = LavaPyType(np.ndarray, np.int32)

    def scale_threshold(self):
        """As Lava's own LIF does."""
        self.effective_vth = np.left_shift(self.vth, self.vth_shift)
        self.isthrscaled = True

    def spiking_activation(self):
        """As Lava's own LIF does."""
        return self.v > self.effective_vth

    def subthr_dynamics(self, activation_in):
        """Lava's step, then the bound, then those that wait."""
        super().subthr_dynamics(activation_in)
        np.maximum(self.v, self.v_min, out=self.v)
        self.v[self.waiting > 0] = 0
        np.maximum(self.waiting - 1, 0, out=self.waiting)

    def reset_voltage(self, spike_vector):
        """Lava's reset; who spiked waits."""
        super().reset_voltage(spike_vector)
        self.waiting[spike_vector] = self.refractory
