"""Input spikes, sent by the host at given steps to given axons."""

from nxsdk.core import DISCRETE, POP16, POP32


class BasicSpikeGenerator:
    def __init__(self, board):
        self.board = board

    def addSpike(self, time, chipId, coreId, axonId):
        self.board.add_spike(time, chipId, coreId, DISCRETE, axonId)

    def addPop16Spike(self, time, chipId, coreId, axonId, srcAtom, atomBits):
        self.board.add_spike(time, chipId, coreId, POP16, axonId, int(srcAtom))

    def addPop32Spike(self, time, chipId, coreId, axonId, srcAtom):
        self.board.add_spike(time, chipId, coreId, POP32, axonId, int(srcAtom))
