"""Properties and limits of a chip, for training, pre-flight and the energy estimate."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Dict


@dataclass(frozen=True)
class Chip:
    """A neuromorphic chip.

    Attributes
    ----------
    name : str
    dt : float
        Time step in seconds for which networks are made.
    cores : int
        Number of cores of one chip.
    limits : dict of str to int
        Resources of one core.
    weight_bits : int
        Bits of a weight, including its sign.
    bias_bits : int
        Bits of the mantissa of a bias current, without its sign.
    bias_exponents : int
        Number of exponents of a bias current: its unit is a power of two, from 1 on.
    weight_unit : int
        Increase of the current by a spike over a weight of 1 at the largest exponent, which is 0.
    weight_exponents : int
        Number of exponents of the weights, from 0 downwards.
    threshold_bits, threshold_unit : int
        Bits of the mantissa of a threshold, and its unit.
    decay_bits : int
    refractory_bits : int
        Bits of the number of steps from a spike to the first step that can have another one.
    input_bits, current_bits, voltage_bits : int
        Bits of one step's synaptic input, of the current and of the voltage, without signs; the
        first two wrap around, the voltage is clipped.
    synapse_word_bits, synapse_header_bits : int
        Bits of a word of synapse memory, and of the header of a list of synapses.
    synaptic_operation_joules, neuron_update_joules : float
        Energy of one operation.
    """

    name: str
    dt: float
    cores: int
    limits: Dict[str, int] = field(hash=False)
    weight_bits: int
    bias_bits: int
    bias_exponents: int
    weight_unit: int
    weight_exponents: int
    threshold_bits: int
    threshold_unit: int
    decay_bits: int
    refractory_bits: int
    input_bits: int
    current_bits: int
    voltage_bits: int
    synapse_word_bits: int
    synapse_header_bits: int
    synaptic_operation_joules: float
    neuron_update_joules: float

    @property
    def weight_levels(self) -> int:
        """Largest magnitude of a signed weight."""
        return 2 ** (self.weight_bits - 1) - 1

    @property
    def max_bias_mantissa(self) -> int:
        """Largest mantissa of a bias current."""
        return 2**self.bias_bits - 1

    @property
    def max_bias(self) -> int:
        """Largest bias current."""
        return self.max_bias_mantissa * 2 ** (self.bias_exponents - 1)

    @property
    def max_threshold(self) -> int:
        """Largest threshold less a unit, since NengoLoihi halves all values if it rounds one up."""
        return (2**self.threshold_bits - 2) * self.threshold_unit

    @property
    def decay_unit(self) -> int:
        """Denominator of a decay: a decay of this value per step would leave nothing."""
        return 2**self.decay_bits

    @property
    def decay_levels(self) -> int:
        """Largest decay."""
        return self.decay_unit - 1

    @property
    def input_limit(self) -> int:
        """Magnitude at which one step's synaptic input wraps around."""
        return 2**self.input_bits

    @property
    def current_limit(self) -> int:
        """Magnitude at which the current wraps around."""
        return 2**self.current_bits

    @property
    def voltage_limit(self) -> int:
        """Limit of the voltage, which is clipped; it should be well above the threshold."""
        return 2**self.voltage_bits - 1

    @property
    def refractory_steps(self) -> int:
        """Longest refractory period in steps: the chip counts one more, that of the spike."""
        return 2**self.refractory_bits - 2


# Davies et al. 2018, IEEE Micro 38(1): cores and limits, bits, and Table 2 for energies (see
# :mod:`deploy.check.energy`); NengoLoihi 1.1, ``block.py``, for the limits relevant to a network.
LOIHI = Chip(
    name="Loihi 1",
    dt=0.001,
    cores=128,
    limits={
        "compartments": 1024,
        "input axons": 4096,
        "output axons": 4096,
        "AxonCfg registers": 4096,
        "synapse words": 16384,
    },
    weight_bits=8,
    bias_bits=12,
    bias_exponents=8,
    weight_unit=128,  # NengoLoihi's weights are even and shifted by 6
    weight_exponents=8,
    threshold_bits=17,
    threshold_unit=64,
    decay_bits=12,
    refractory_bits=6,
    input_bits=21,
    current_bits=23,
    voltage_bits=23,
    synapse_word_bits=64,
    synapse_header_bits=10,
    synaptic_operation_joules=(23.6 + 3.5) * 1e-12,
    neuron_update_joules=81e-12,
)

# Time step in seconds, on which NengoLoihi's decays and the firing rates of training depend.
DT = LOIHI.dt
