"""What a probe can measure."""

import enum


class ProbeParameter(enum.Enum):
    ENERGY = 1
    EXECUTION_TIME = 2
