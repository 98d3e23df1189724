"""The target ``fast``: NengoLoihi's emulator bit for bit, many streams at once.

``from_nengo`` compiles a network: the chip's blocks become the flat arrays of ``arrays`` (in
``from_loihi``), the host's side becomes the populations and the output stage of ``host_stage``.
``kernel_numba`` and ``kernel_numpy`` advance the arrays; ``emulation`` shows streams of samples.
"""
