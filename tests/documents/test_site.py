"""The documentation site builds, and works where it is opened as a file."""

import os
import re
import shutil
import subprocess
import sys

import pytest

from tests.command import ROOT

BROWSER = next(filter(shutil.which, ("chromium", "chromium-browser", "google-chrome")), None)

# Types a word and shows what is found, in a page that is opened as a file.
SEARCH = """
addEventListener("load", () => {
  const field = document.querySelector(".md-search__input");
  field.focus();
  field.value = "readout_start";
  field.dispatchEvent(new Event("keyup"));
  setInterval(() => {
    const found = document.querySelectorAll("a.md-search-result__link");
    document.title = [...found].map((link) => link.hash).join(" ");
  }, 100);
});
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Broken links, anchors and references, and pages outside the navigation, are errors."""
    pytest.importorskip("mkdocs", reason="MkDocs is not installed (pip install -e '.[docs]')")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", folder]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=quiet)
    assert done.returncode == 0, done.stderr
    return folder


def test_the_site_has_pages_of_the_notebooks_and_no_files_of_its_own_making(site):
    assert (site / "tutorials" / "1-first-network.html").is_file()
    assert not (site / "notebooks.py").exists()
    assert not (site / "pictures.json").exists()


def test_pictures_are_links_to_themselves_and_files(site):
    for page in ("simulation.html", "tutorials/1-first-network.html"):
        text = (site / page).read_text()
        pictures = re.findall(r'<img [^>]*src="([^"]+)"', text.partition("<article")[2])
        assert pictures
        for picture in pictures:
            assert (site / page).parent.joinpath(picture).is_file()
            assert f'<a href="{picture}"' in text


def test_the_site_loads_nothing_from_other_servers(site):
    for page in site.rglob("*.html"):
        assert not re.search(r'<(?:script|link)[^>]+(?:src|href)="https?:', page.read_text()), page


@pytest.mark.skipif(BROWSER is None, reason="no Chromium here (Debian: apt install chromium)")
def test_the_search_of_a_site_that_is_opened_as_a_file(site):
    page = site / "search.html"
    text = (site / "index.html").read_text()
    page.write_text(text.replace("</body>", f"<script>{SEARCH}</script></body>"))
    command = [BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    command += ["--disable-background-networking", "--virtual-time-budget=20000", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    page.unlink()
    assert "#presentationreadout_start" in re.search(r"<title>(.*?)</title>", done.stdout)[1]
