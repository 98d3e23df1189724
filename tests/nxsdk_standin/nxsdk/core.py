"""A neuromorphic core: its registers, and the execution of what is written in them.

The arithmetic is Loihi's, in integers (Davies et al. 2018; widths as in NengoLoihi 1.1's
``builder.discretize``): a synaptic accumulator of 21 bits and sign, a current ``u`` of 23 bits
and sign which wrap around, a voltage ``v`` which is clipped, and decays by multiplication with
a 12-bit fraction, rounded towards zero.
"""

import numpy as np

from .faults import FAULTS, BoardError
from .registers import Register, RegisterFile

COMPARTMENTS = 1024
INPUT_AXONS = 4096
AXON_CFGS = 4096
SYNAPSE_WORDS = 16384
WORD_BITS = 64

ACCUMULATOR_BITS = 21
CURRENT_BITS = 23
VTH_SHIFT = 6
WEIGHT_SHIFT = 6
INDEX_BITS = (0, 6, 7, 8, 9, 10, 11, 12)
WEIGHT_BITS = (0, 1, 2, 3, 4, 5, 6, 8)

DISCRETE, POP16, POP32 = 0, 16, 32
AXON_CFGS_PER_AXON = {DISCRETE: 1, POP16: 1, POP32: 2}

ANY = (-(2**31), 2**32)
BIT = (0, 1)

SYNAPSE_FORMAT = {
    "wgtLimitMant": ANY, "wgtLimitExp": ANY, "wgtExp": (-8, 7), "discMaxWgt": ANY,
    "learningCfg": ANY, "tagBits": (0, 3), "dlyBits": (0, 7), "wgtBits": (0, 7),
    "reuseSynData": BIT, "numSynapses": (0, 63), "cIdxOffset": (0, 15), "cIdxMult": (0, 15),
    "skipBits": ANY, "idxBits": (0, 7), "synType": ANY, "fanoutType": (0, 3),
    "compression": (0, 3), "stdpProfile": ANY, "ignoreDly": BIT,
}  # fmt: skip

SYNAPSE_MAP = {
    "synapsePtr": (0, 2**31),
    "synapseLen": (0, COMPARTMENTS),
    "popSize": (0, 1024),
    "discreteMapEntry": {"cxBase": (0, 255)},
    "population16MapEntry": {"cxBase": (0, 63), "atomBits": (0, 0)},
    "population32MapEntry": {"cxBase": (0, 255)},
}

RANDOM = {"random0": ANY, "random1": ANY, "random2": ANY, "word": ANY}


def wrap(values, bits):
    """Two's complement of ``bits`` bits and sign."""
    half = 1 << bits
    return ((values + half) & (2 * half - 1)) - half


def decay(values, fraction):
    """``values * fraction / 4096``, rounded towards zero."""
    return np.sign(values) * ((np.abs(values) * fraction) >> 12)


class N2Core:
    """One core.

    Parameters
    ----------
    parent : N2Chip
    index : int
        Position on the chip.  The identifier differs from it, as on a real chip, so that a mix-up
        of the two shows.
    n_synapses : int
        Entries asked for in the table of synapses.
    """

    def __init__(self, parent, index, n_synapses):
        self.parent = parent
        self.id = index + 4

        self.cxProfileCfg = RegisterFile(
            "cxProfileCfg", 32,
            {"decayV": (0, 4095), "decayU": (0, 4095), "refractDelay": (1, 63),
             "enableNoise": BIT, "bapAction": ANY},
        )  # fmt: skip
        vth = {"staticCfg": {"vth": (0, 2**17 - 1)}}
        self.vthProfileCfg = RegisterFile("vthProfileCfg", 8, vth)
        self.synapseFmt = RegisterFile("synapseFmt", 16, SYNAPSE_FORMAT)
        self.cxCfg = RegisterFile(
            "cxCfg", COMPARTMENTS,
            {"bias": (-4096, 4095), "biasExp": (0, 7), "vthProfile": (0, 7), "cxProfile": (0, 31)},
        )  # fmt: skip
        phases = {f"phase{i}": (0, 3) for i in range(4)}
        self.cxMetaState = RegisterFile("cxMetaState", COMPARTMENTS // 4, phases)
        synapse = {"CIdx": (0, 4095), "Wgt": (-256, 255), "synFmtId": (1, 15), "LrnEn": (0, 0)}
        self.synapses = RegisterFile("synapses", n_synapses, synapse)
        self.synapseMap = RegisterFile("synapseMap", INPUT_AXONS, SYNAPSE_MAP)
        self.dendriteSharedCfg = Register(
            "dendriteSharedCfg",
            {"posVmLimit": (0, 7), "negVmLimit": (0, 31), "noiseExp0": ANY,
             "noiseMantOffset0": ANY, "noiseAtDendOrVm": BIT},
        )  # fmt: skip
        self.dendriteAccumCfg = Register("dendriteAccumCfg", {"delayBits": (0, 7)})
        self.numUpdates = Register(
            "numUpdates", {"numUpdates": (0, COMPARTMENTS // 4), "numStdp": (0, 0)}
        )
        self.dendriteTimeState = RegisterFile("dendriteTimeState", 1, {"tepoch": ANY})
        self.timeState = RegisterFile("timeState", 1, {"tepoch": ANY})
        self.stdpPreRandom = Register("stdpPreRandom", RANDOM)
        self.stdpPostRandom = Register("stdpPostRandom", RANDOM)
        self.somaRandom = Register("somaRandom", RANDOM)
        self.synapseRepackRandom = Register("synapseRepackRandom", RANDOM)

        self.cxState = self  # what a probe is given to say where it looks
        self.axons = {}  # source compartment: list of (type, population, atom, chip, core, axon)

    # --- output axons, as NengoLoihi asks for them

    def createDiscreteAxon(self, srcCxId, dstChipId, dstCoreId, dstSynMapId):
        self._axon(DISCRETE, None, srcCxId, 0, dstChipId, dstCoreId, dstSynMapId)

    def createPop16Axon(self, popId, srcCxId, srcRelCxId, dstChipId, dstCoreId, dstSynMapId):
        # sixteen bits hold the axon and five bits of the source within its population
        if srcRelCxId >= 32 or dstSynMapId >= 1024:
            raise BoardError("a pop16 axon reaches atoms below 32 and input axons below 1024")
        self._axon(POP16, popId, srcCxId, srcRelCxId, dstChipId, dstCoreId, dstSynMapId)

    def createPop32Axon(self, popId, srcCxId, srcRelCxId, dstChipId, dstCoreId, dstSynMapId):
        if srcRelCxId >= 1024:
            raise BoardError("a pop32 axon reaches atoms below 1024")
        self._axon(POP32, popId, srcCxId, srcRelCxId, dstChipId, dstCoreId, dstSynMapId)

    def _axon(self, kind, population, source, atom, chip, core, axon):
        if not 0 <= axon < INPUT_AXONS:
            raise BoardError(f"input axon {axon}: a core has {INPUT_AXONS}")
        targets = self.axons.setdefault(int(source), [])
        targets.append((kind, population, int(atom), int(chip), int(core), int(axon)))

    def axon_cfgs(self):
        """AxonCfg registers that the output axons need.

        A source compartment's axonMap register points at one contiguous run of AxonCfg registers,
        one or two (pop32) for each destination, and holds one atom for the whole run.  Members of
        a population with the same destinations share a run.
        """
        runs = set()
        for source, targets in self.axons.items():
            if len({(population, atom) for _, population, atom, *_ in targets}) > 1:
                raise BoardError(f"compartment {source} belongs to more than one population")
            population = targets[0][1]
            shared = population is not None and FAULTS.share_axon_cfgs
            owner = ("population", population) if shared else ("compartment", source)
            destinations = tuple((kind, *where) for kind, _, _, *where in targets)
            runs.add((owner, destinations))
        return sum(AXON_CFGS_PER_AXON[kind] for _, run in runs for kind, *_ in run)

    def synapse_words(self):
        """64-bit words of synapse memory: every list of synapses begins with a new word."""
        lists = set()
        for entry in self.synapseMap.registers.values():
            for atom in range(max(1, entry.popSize)):
                lists.add((entry.synapsePtr + atom * entry.synapseLen, entry.synapseLen))
        words = 0
        for start, length in lists:
            if length == 0:
                continue
            form = self.synapseFmt[self.synapses[start].synFmtId]
            bits = WEIGHT_BITS[form.wgtBits] + form.dlyBits + form.tagBits
            bits += INDEX_BITS[form.idxBits] if form.compression == 0 else 0
            per_block = form.numSynapses + 1
            for first in range(0, length, per_block):
                n = min(per_block, length - first)
                words += -(-(n * bits + 10) // WORD_BITS)  # 4 bits of format, 6 of length
        return words

    # --- execution

    def compile(self):
        """Check the limits, and turn the registers into arrays to run on."""
        axon_cfgs = self.axon_cfgs()
        if axon_cfgs > AXON_CFGS:
            raise BoardError(
                f"Number of AxonCfg registers exceeded: core {self.id} needs {axon_cfgs}, "
                f"it has {AXON_CFGS}"
            )
        words = self.synapse_words()
        if words > SYNAPSE_WORDS:
            raise BoardError(
                f"Synapse memory exceeded: core {self.id} needs {words} words, "
                f"it has {SYNAPSE_WORDS}"
            )

        n = 4 * self.numUpdates.numUpdates  # compartments beyond are never updated
        configured = sorted(self.cxCfg.registers)
        if configured and configured[-1] >= n:
            raise BoardError(f"compartment {configured[-1]} is beyond the {n} that are updated")
        self.n = n
        self.active = np.zeros(n, dtype=bool)
        for group, register in self.cxMetaState.registers.items():
            for i in range(4):
                self.active[4 * group + i] = getattr(register, f"phase{i}") == 2
        zeros = np.zeros(n, dtype=np.int64)
        self.bias, self.vth, self.refractory = zeros.copy(), zeros.copy(), zeros.copy()
        self.keep_u, self.keep_v = zeros.copy(), zeros.copy()
        for i in configured:
            register = self.cxCfg[i]
            profile = self.cxProfileCfg[register.cxProfile]
            if profile.enableNoise:
                raise BoardError("the stand-in has no noise")
            self.bias[i] = register.bias << register.biasExp
            self.vth[i] = self.vthProfileCfg[register.vthProfile].staticCfg.vth << VTH_SHIFT
            self.refractory[i] = profile.refractDelay
            self.keep_u[i] = 4096 - 1 - profile.decayU  # the chip adds one to this decay
            self.keep_v[i] = 4096 - profile.decayV
        self.vmin = -(1 << self.dendriteSharedCfg.negVmLimit) + 1
        self.vmax = (1 << (9 + 2 * self.dendriteSharedCfg.posVmLimit)) - 1

        self.u, self.v, self.wait = zeros.copy(), zeros.copy(), zeros.copy()
        self.input = zeros.copy()
        self.spike = np.zeros(n, dtype=bool)
        self.fanout = {}

    def receive(self, kind, axon, atom):
        """A spike arrives at an input axon: its synapses add their weights to the accumulators."""
        key = (kind, axon, atom)
        if key not in self.fanout:
            self.fanout[key] = self._fanout(kind, axon, atom)
        compartments, weights = self.fanout[key]
        self.input[compartments] += weights

    def _fanout(self, kind, axon, atom):
        entry = self.synapseMap[axon]
        places = {
            DISCRETE: entry.discreteMapEntry,
            POP16: entry.population16MapEntry,
            POP32: entry.population32MapEntry,
        }
        if [k for k, place in places.items() if place.written] != [kind]:
            raise BoardError(f"core {self.id}: input axon {axon} does not take such spikes")
        if kind != DISCRETE and atom >= entry.popSize:
            raise BoardError(f"core {self.id}: atom {atom} of a population of {entry.popSize}")
        base = places[kind].cxBase * (4 if kind == POP16 else 1)
        start = entry.synapsePtr + atom * entry.synapseLen
        compartments, weights = [], []
        for i in range(start, start + entry.synapseLen):
            synapse = self.synapses[i]
            form = self.synapseFmt[synapse.synFmtId]
            if form.compression == 0 and synapse.CIdx >= 1 << INDEX_BITS[form.idxBits]:
                raise BoardError(f"synapse {i}: index {synapse.CIdx} does not fit its format")
            unused = 8 - WEIGHT_BITS[form.wgtBits] + (form.fanoutType == 1)  # a sign takes a bit
            mantissa = (synapse.Wgt >> unused) << unused
            scaled = mantissa << form.wgtExp if form.wgtExp >= 0 else mantissa >> -form.wgtExp
            compartments.append(base + synapse.CIdx)
            weights.append(scaled << WEIGHT_SHIFT)
        if compartments and max(compartments) >= self.n:
            raise BoardError(f"core {self.id}: a synapse reaches compartment {max(compartments)}")
        if len(set(compartments)) < len(compartments):
            raise BoardError(f"core {self.id}: a list of synapses reaches a compartment twice")
        return np.array(compartments, dtype=np.int64), np.array(weights, dtype=np.int64)

    def update(self):
        """One time step of every compartment."""
        self.u = decay(self.u, self.keep_u) + wrap(self.input, ACCUMULATOR_BITS)
        self.u = wrap(self.u, CURRENT_BITS)
        self.input[:] = 0
        drive = wrap(self.u + self.bias, CURRENT_BITS)
        self.v = np.clip(decay(self.v, self.keep_v) + drive, self.vmin, self.vmax)
        self.v[self.wait > 0] = 0
        self.spike = (self.v > self.vth) & self.active
        self.v[self.spike] = 0
        self.wait[self.spike] = self.refractory[self.spike]
        self.wait = np.maximum(self.wait - 1, 0)

    def sent(self):
        """Spikes on their way: ``(chip, core, type, axon, atom)`` of each."""
        for source in np.flatnonzero(self.spike).tolist():
            for kind, _, atom, chip, core, axon in self.axons.get(source, ()):
                yield chip, core, kind, axon, atom
