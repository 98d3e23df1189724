"""The public names `FastSimulator` and `accelerate`."""

from __future__ import annotations

import nengo_loihi
from nengo.exceptions import ValidationError
from nengo_loihi.emulator.interface import EmulatorInterface

from .emulator import FastEmulator, take_over, warn_once


class FastSimulator(nengo_loihi.Simulator):
    """NengoLoihi's `Simulator` with a fast emulator; its results are bit-identical.

    Parameters
    ----------
    network : nengo.Network
    *args, **kwargs
        As `nengo_loihi.Simulator` takes them.  ``target`` is ``"sim"`` unless it is given, also
        where NxSDK is installed.

    Notes
    -----
    The first step on a machine takes about five seconds more, because its steps are compiled.
    """

    def __init__(self, network, *args, **kwargs):
        if len(args) < 5 and kwargs.get("target") is None:  # target is the sixth parameter
            kwargs["target"] = "sim"
        super().__init__(network, *args, **kwargs)
        if "emulator" in self.sims:
            accelerate(self)


def accelerate(simulator):
    """Let a `nengo_loihi.Simulator` continue with the fast emulator.

    Parameters
    ----------
    simulator : nengo_loihi.Simulator
        With any target but ``"loihi"``.  It may have run before.

    Returns
    -------
    nengo_loihi.Simulator
        The same simulator.

    Raises
    ------
    nengo.exceptions.ValidationError
        The simulator runs on a board.
    """
    if "emulator" not in simulator.sims:
        raise ValidationError("must have an emulator to be accelerated", attr="target")
    emulator = simulator.sims["emulator"]
    if isinstance(emulator, FastEmulator) or emulator.closed:
        return simulator
    if type(emulator) is not EmulatorInterface:
        warn_once(f"an emulator of the class {type(emulator).__name__} is left as it is")
        return simulator
    take_over(emulator)
    return simulator
