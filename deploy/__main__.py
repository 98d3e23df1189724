"""``python deploy.pyz`` or ``python -m deploy``: look at the host, then run the command."""

import sys

from .requirements import complaint

if __name__ == "__main__":
    problem = complaint()
    if problem is not None:
        print("deploy: " + problem, file=sys.stderr)
        sys.exit(2)
    from .cli import main

    sys.exit(main())
