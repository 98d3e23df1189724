"""Run the tests that NengoLoihi ships: ``python -m tests.peers --emulator fast|nengo-loihi|both``.

Exit status 0 if all passed but for those that `loihi.KNOWN` explains, which must fail.  Further
options go to pytest.  NengoLoihi's tests need pytest-rng, pytest-allclose and pytest-plt
(``requirements.txt``), which ``make test-peers`` installs into a folder of their own.
"""

import os
import subprocess
import sys
from pathlib import Path

from deploy.network.loihi_import import nengo_loihi

ROOT = Path(__file__).resolve().parents[2]
PLUGINS = ROOT / ".venv-peers"


def main(arguments):
    package = Path(nengo_loihi.__file__).parent
    command = [
        *(sys.executable, "-m", "pytest", "-q", "-p", "tests.peers.loihi"),
        *("-p", "no:nengo", "-p", "no:cacheprovider"),
        # The seeds of these tests depend on their names, and so on the folder that counts as root.
        *("-c", os.devnull, "--rootdir", str(package.parent), "--import-mode", "importlib"),
        *("-W", "ignore", str(package), *arguments),
    ]
    paths = [str(PLUGINS), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run(command, env=environment, cwd=package.parent).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
