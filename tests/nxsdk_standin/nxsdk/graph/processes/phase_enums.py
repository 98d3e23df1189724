"""When a snip runs; imported by NengoLoihi, unused without snips."""

import enum


class Phase(enum.Enum):
    EMBEDDED_MGMT = 1
    EMBEDDED_PRELEARN_MGMT = 2
    HOST_CONCURRENT_EXECUTION = 3
