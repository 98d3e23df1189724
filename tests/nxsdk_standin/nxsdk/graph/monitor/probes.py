"""When an energy probe measures."""

import dataclasses


@dataclasses.dataclass
class PerformanceProbeCondition:
    tStart: int
    tEnd: int
    bufferSize: int
    binSize: int
