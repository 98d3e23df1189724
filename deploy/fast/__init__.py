"""The target ``fast``: NengoLoihi's emulator bit for bit, many streams at once.

``from_nengo`` compiles a built and discretised network into the flat arrays of ``arrays``;
``kernel_numba`` and ``kernel_numpy`` advance those; ``host`` is the host's side of the network;
``run`` shows it streams of samples.
"""
