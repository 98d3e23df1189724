"""A fast emulator of Intel's Loihi 1 for every NengoLoihi network, bit-identical to NengoLoihi's.

>>> from stmnist import FastSimulator
>>> with FastSimulator(network) as sim:
...     sim.run(1.0)

It needs NumPy, Nengo and NengoLoihi, and Numba for its speed, but no other part of this project.

`simulator` has the public names; `emulator` replaces NengoLoihi's emulator; `layout` converts a
network to flat arrays, `link` has these arrays and the state, and `kernel_numba` advances them.
"""

from .emulator import FastEmulator, NotAccelerated
from .simulator import FastSimulator, accelerate

__all__ = ["FastEmulator", "FastSimulator", "NotAccelerated", "accelerate"]
