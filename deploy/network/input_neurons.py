"""Neurons of Nengo on the host that make the input spikes of a stimulus."""

from __future__ import annotations

import nengo
import numpy as np


class EvenSpikes(nengo.SpikingRectifiedLinear):
    """Neurons with evenly spaced spikes that restart from the same phase after a blank input.

    Parameters
    ----------
    phase : float
        Voltage without input, as a share of the threshold.
    amplitude : float
    """

    phase = nengo.params.NumberParam("phase", low=0, high=1)

    def __init__(self, phase=0.5, amplitude=1.0):
        super().__init__(
            amplitude=amplitude, initial_state={"voltage": nengo.dists.Choice([phase])}
        )
        self.phase = phase

    def step(self, dt, J, output, voltage):
        """One step of Nengo's neurons, then the reset; arrays of any one shape."""
        super().step(dt, J, output, voltage)
        voltage[J <= 0] = self.phase


class Relay(nengo.neurons.NeuronType):
    """Neurons without memory that spike in each step with an input.

    Parameters
    ----------
    amplitude : float
        Area of a spike.
    """

    spiking = True
    amplitude = nengo.params.NumberParam("amplitude", low=0, low_open=True)

    def __init__(self, amplitude=1.0):
        super().__init__()
        self.amplitude = amplitude

    def gain_bias(self, max_rates, intercepts):
        """Not implemented: gain and bias are always set."""
        raise NotImplementedError

    def max_rates_intercepts(self, gain, bias):
        """Not meaningful for these neurons."""
        return np.full_like(gain, np.nan), np.full_like(bias, np.nan)

    def step(self, dt, J, output):
        """One step; arrays of any one shape."""
        output[...] = (J > 0) * (self.amplitude / dt)
