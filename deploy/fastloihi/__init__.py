"""A fast emulator of Intel's Loihi 1 for every NengoLoihi network, bit for bit NengoLoihi's own.

>>> from stmnist import FastSimulator
>>> with FastSimulator(network) as sim:
...     sim.run(1.0)

It needs NumPy, Nengo and NengoLoihi, and Numba to be fast, and nothing else of this project.

`simulator` is what users call; `emulator` takes the place of NengoLoihi's emulator; `layout` makes
flat arrays of a network, `link` has them with the state, `kernel_numba` advances them.
"""

from .emulator import FastEmulator, NotAccelerated
from .simulator import FastSimulator, accelerate

__all__ = ["FastEmulator", "FastSimulator", "NotAccelerated", "accelerate"]
