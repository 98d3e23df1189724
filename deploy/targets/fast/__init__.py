"""The target ``fast``: bit-identical to NengoLoihi's emulator, with many streams at once.

``from_nengo`` compiles a network: the chip's blocks become the flat arrays of ``arrays`` (in
``from_loihi``), the host's part becomes the populations and the output stage of ``host_stage``.
``kernel_numba`` and ``kernel_numpy`` advance the arrays; ``emulation`` presents the samples.
"""
