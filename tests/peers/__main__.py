"""Run the tests that NengoLoihi and NengoDL ship, as ``make test-peers`` does.

    python -m tests.peers loihi --emulator fast      (or nengo-loihi, or both)
    python -m tests.peers dl

Exit status 0 if all passed but for those that ``KNOWN`` in `loihi` and `dl` explains, which must
fail.  Further options go to pytest.  The tests need pytest-rng, pytest-allclose and pytest-plt
(``requirements.txt``), which ``make setup-peers`` installs into a folder of their own.
"""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PLUGINS = ROOT / ".venv-peers"
PEERS = {"loihi": "nengo_loihi", "dl": "nengo_dl"}


def main(peer, *arguments):
    package = Path(importlib.util.find_spec(PEERS[peer]).origin).parent
    command = [
        *(sys.executable, "-m", "pytest", "-q", "-p", f"tests.peers.{peer}"),
        *("-p", "no:nengo", "-p", "no:cacheprovider"),
        # The seeds of these tests depend on their names, and so on the folder that counts as root.
        *("-c", os.devnull, "--rootdir", str(package.parent), "--import-mode", "importlib"),
        *("-W", "ignore", str(package), *arguments),
    ]
    paths = [str(PLUGINS), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run(command, env=environment, cwd=package.parent).returncode


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in PEERS:
        sys.exit(f"which of {', '.join(PEERS)}?")
    sys.exit(main(*sys.argv[1:]))
