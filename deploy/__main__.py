"""``python deploy.pyz`` or ``python -m deploy``: look at the host, then run the command."""

import sys

from .interrupts import end_at_once
from .requirements import complaint
from .terminal import prepare, remark

if __name__ == "__main__":
    end_at_once("deploy")
    prepare()
    problem = complaint()
    if problem is not None:
        remark("deploy: " + problem)
        sys.exit(2)
    from .cli import main

    sys.exit(main())
