"""The documentation site builds."""

import os
import subprocess
import sys

import pytest

from tests.command import ROOT


def test_the_site_builds_strictly(tmp_path):
    """Broken links, anchors and references, and pages outside the navigation, are errors."""
    pytest.importorskip("mkdocs", reason="MkDocs is not installed (pip install -e '.[docs]')")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", tmp_path]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=quiet)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "tutorials" / "1-first-network.html").is_file()
