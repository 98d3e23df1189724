"""A fast emulator of Intel's Loihi 1 for every NengoLoihi network, bit-identical to NengoLoihi's.

>>> from fastloihi import FastSimulator
>>> with FastSimulator(network) as sim:
...     sim.run(1.0)

`simulator` has the public names; `emulator` replaces NengoLoihi's emulator; `layout` converts a
network to flat arrays, `arrays` has these arrays and the state, and `compiled` advances them.  The
import of this package lets NengoLoihi 1.1 run on NumPy 2 (`numpy1`); Numba is imported when a
network is first built.
"""

from .emulator import FastEmulator, NotAccelerated
from .numpy1 import put_back_for_nengo_loihi
from .simulator import FastSimulator, accelerate

put_back_for_nengo_loihi()

__all__ = ["FastEmulator", "FastSimulator", "NotAccelerated", "accelerate"]
