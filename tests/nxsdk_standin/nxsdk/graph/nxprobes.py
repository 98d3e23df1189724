"""The class whose registry of spike probes NengoLoihi clears."""


class N2SpikeProbe:
    probeDict = {}  # noqa: RUF012  (NxSDK keeps it on the class, NengoLoihi clears it there)
