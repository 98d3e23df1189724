"""``python deploy.pyz`` or ``python -m deploy``: look at the host, then run the command."""

import os
import sys

from .requirements import describe_missing
from .terminal import INTERRUPTED, INTERRUPTION, remark

if __name__ == "__main__":
    problem = describe_missing()
    if problem is not None:
        remark("deploy: " + problem)
        sys.exit(2)
    try:
        from .cli import main
    except KeyboardInterrupt:
        remark("deploy: " + INTERRUPTION)
        # Not sys.exit: if a C extension was being imported, Python would end by the signal instead.
        os._exit(INTERRUPTED)
    sys.exit(main())
