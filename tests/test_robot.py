"""The hand for the page, where there is nothing to write on."""

import shutil

import pytest

from deploy.errors import UserError
from tests import robot

pytest.importorskip("playwright", reason="playwright is not installed")


def test_a_chromium_that_does_not_start(tmp_path):
    broken = tmp_path / "chromium"
    broken.write_text("#!/bin/sh\nexit 1\n")
    broken.chmod(0o755)
    cannot = pytest.raises(UserError, match=rf"^{broken}: [^\n]+$")
    with cannot, robot.chromium(broken):
        pass


@pytest.mark.skipif(not any(map(shutil.which, robot.BROWSERS)), reason="no Chromium here")
def test_a_page_that_is_never_ready():
    late = pytest.raises(UserError, match=r"^[^\n]+ 1ms exceeded; [^\n]+$")
    with late, robot.chromium() as browser:
        robot.opened(browser.new_page(), "data:text/html,hello", timeout_s=0.001)
