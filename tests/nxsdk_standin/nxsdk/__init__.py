"""A stand-in for Intel's NxSDK, for tests only.  It is not NxSDK and holds none of it.

With the folder that holds this package on ``sys.path``, NengoLoihi 1.1 believes that NxSDK is
installed and runs with ``target="loihi"``: its own allocator and board builder write the registers
of chips and cores, and this package *executes what was written there* in integer arithmetic.  It
was written from the calls that NengoLoihi makes and from what is published on Loihi (Davies et
al. 2018, IEEE Micro 38(1)), and offers what a feed-forward network without snips needs.

What it shows: that the path through NengoLoihi's hardware interface is taken, that the registers
written describe the network which the emulator runs, that input spikes and probes reach their
places and times, that limits are raised and faults survived.  What it cannot show: the real
NxSDK's own limits and errors, the electronics, the network between host and board, times and
power, and anything about Loihi that neither NengoLoihi nor the paper says.  The delay of input
spikes (one step), for one, is taken from NengoLoihi's emulator.

Faults are asked for with the environment variable ``NXSDK_STANDIN``; see `nxsdk.faults`.
"""

from .faults import FAULTS

__version__ = FAULTS.version
