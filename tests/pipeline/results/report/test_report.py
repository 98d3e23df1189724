"""The report of the small run: its figures, that it is complete, and that a browser shows it."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html import escape
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from deploy.check.bundle import read_bundle
from deploy.check.results import read_result
from deploy.files import read_json, write_json
from deploy.preflight.plan import make_plan
from deploy.targets.registry import run_target
from pipeline.results.report import page as report
from pipeline.results.report import prose
from pipeline.results.report.figures import animation
from pipeline.results.report.gather import gather_report_data
from pipeline.results.report.samples import choose_samples, replay_samples
from pipeline.settings import format_automatic
from pipeline.storage.run_folder import RunFolder
from tests.command import call
from tests.deploy.results import make_result

BROWSER = next(filter(shutil.which, ("chromium", "chromium-browser", "google-chrome")), None)


@pytest.fixture(scope="module")
def html(tiny_run, tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "report.html"
    assert call("report", tiny_run, "--out", out) == 0
    return out


@pytest.fixture(scope="module")
def inputs(tiny_run):
    return gather_report_data(RunFolder(tiny_run))


class Outline(HTMLParser):
    """Checks that tags close, and collects what a reader and a browser see."""

    VOID = frozenset({"meta", "link", "br", "img", "input"})

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.text, self.loads = [], [], "", []
        self.ids, self.links = set(), set()
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        attrs = dict(attrs)
        self.loads += [attrs[k] for k in ("src", "href", "xlink:href", "data") if k in attrs]
        self.ids.add(attrs.get("id"))
        self.links.add(attrs.get("href", ""))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.text += data + " "


def test_the_page_loads_nothing_else(html):
    page = html.read_text()
    outline = Outline(page)
    assert all(load.startswith(("#", "data:")) for load in outline.loads)
    assert "script" not in outline.tags
    assert "@import" not in page
    assert "url(" not in page
    assert {link[1:] for link in outline.links if link.startswith("#")} <= outline.ids


def test_the_page_has_every_figure(html, tiny_run):
    text = " ".join(Outline(html.read_text()).text.split())
    assert not {"None", "nan", "Undefined"} & set(text.split())
    bundle = read_bundle(tiny_run / "bundle")
    assert bundle.id in text
    for stage in ("cnn", "emulator"):
        assert f"{100 * read_result(tiny_run / f'checks/{stage}.json')['accuracy']:.1f} %" in text
    used = make_plan(bundle.spec).cores[0].used
    assert f"core 0 {used['compartments']} {used['input axons']}" in text


def test_each_sample_is_among_those_of_its_class(html, tiny_run):
    """Some are again next to their spikes."""
    page = html.read_text()
    bundle = read_bundle(tiny_run / "bundle")
    stories = page.count('class="story"')
    assert 0 < stories < len(bundle.checks)
    assert page.count('class="thumb"') == len(bundle.checks) + stories


def test_other_recordings_of_one_name_are_told_apart(tiny_run, tmp_path):
    copied = tmp_path / "run"
    shutil.copytree(tiny_run, copied)
    result = read_json(copied / "checks/emulator.json", "")
    others = copied / "checks/other"
    others.mkdir(exist_ok=True)
    for number, (name, sha256) in enumerate(
        (("arrays", "aaaaaa1"), ("arrays", "bbbbbb2"), ("b", "c"))
    ):
        data = {"source": name, "sha256": sha256, "recordings": 9}
        write_json(others / f"{number}.json", {**result, "data": data, "per_class": []})
    titles = [each.data.source for each in gather_report_data(RunFolder(copied)).others]
    assert titles == ["arrays (aaaaaa)", "arrays (bbbbbb)", "b"]


def test_the_verdict_compares_the_same_samples(inputs):
    """Ten samples: eight right, and nine in the reference; one sample differs."""
    predictions = [0] * 8 + [1, 1]
    counts = {"conv1": 1000, "output": 500}
    deployed = make_result(predictions, [0] * 10, target="emulator", synaptic_operations=counts)
    reference = make_result([0] * 9 + [1], [0] * 10, target="rate-lif")
    found = report.make_verdict([reference, deployed], inputs.bundle)
    assert found["operations"] == 150
    (against,) = found["against"]
    assert against["change"] == pytest.approx(-0.1)
    assert (against["p"], against["significant"]) == (1.0, False)


def test_what_is_wrong_with_the_recordings_is_said(inputs):
    bundle = inputs.bundle
    provenance = bundle.spec.provenance.with_entries(warnings=["3 of 9 are cut"])
    changed = replace(bundle, spec=replace(bundle.spec, provenance=provenance))
    assert "3 of 9 are cut" in report.render_report(replace(inputs, bundle=changed))


def test_a_setting_that_the_program_chooses_is_listed_as_automatic(inputs):
    page = report.render_report(inputs)
    values = dict(re.findall(r"<dt>([\w.]+)</dt><dd>(.*?)</dd>", page))
    assert values["skin.rows"] == "automatic (0)"
    assert format_automatic("data.time_unit", "") == "automatic"
    assert values["split.validation_fraction"] == "0.0"  # where 0 is a number


def test_recall_and_precision_are_those_of_the_answers(inputs):
    pairs = [(0, 0), (0, 1), (1, 1), (1, 1), (2, 1)]
    labels, predictions = zip(*pairs, strict=True)
    results = [make_result(predictions, labels, synaptic_operations={})]
    rows = report.make_class_table(replace(inputs, results=results))
    assert [(r["recall"], r["precision"]) for r in rows[:4]] == [
        (0.5, 1.0), (1.0, 0.5), (0.0, None), (None, None)
    ]  # fmt: skip
    page = report.render_report(replace(inputs, results=results, replays={}))
    text = " ".join(Outline(page).text.split())
    assert "2 1 0.0 % never predicted" in text
    assert "3 0 no samples never predicted" in text


def test_right_samples_are_of_the_classes_that_are_mixed_up():
    pairs = [(0, 0), (3, 3), (2, 2), (3, 2), (1, 1), (2, 2)]
    labels, predictions = zip(*pairs, strict=True)
    assert choose_samples(make_result(predictions, labels)) == [3, 1, 2]
    assert choose_samples(make_result(predictions[:3], labels[:3])) == [0, 1]


def test_the_most_frequent_mistakes_are_shown_first():
    pairs = [(0, 1), (4, 2), (1, 3), (4, 2), (1, 3), (4, 2)]
    labels, predictions = zip(*pairs, strict=True)
    assert choose_samples(make_result(predictions, labels), wrong=4) == [1, 3, 5, 2]


def test_a_replay_has_the_spikes_that_the_check_counted(tiny_run):
    bundle = read_bundle(tiny_run / "bundle")
    spec = bundle.spec.with_presentation(steps=12, gap=0, readout_start=3, stream_length=2)
    counted = run_target(spec, bundle.checks.inputs[:4], "emulator").spikes
    played = replay_samples(replace(bundle, spec=spec), [3, 2])
    assert list(played) == [3, 2]
    for index, sample in played.items():
        assert sample.probabilities.shape == (9, 10)
        np.testing.assert_allclose(sample.probabilities.sum(1), 1)
        for layer in sample.layers:
            ((_, steps, neurons),) = layer.groups
            assert len(steps) == counted[layer.name][index]
            assert neurons.max(initial=0) < layer.size
            assert steps.max(initial=0) < 12


def test_no_markup_is_shown_as_text(html):
    text = html.read_text(encoding="utf-8")
    assert "&amp;nbsp;" not in text
    assert "p&nbsp;=&nbsp;" in text or "p&nbsp;&lt;" in text


def test_a_run_without_results_is_one_line(tmp_path, refused, run):
    shutil.rmtree(run / "checks")
    assert "stmnist ladder" in refused("report", run)
    assert ".html" in refused("report", run, "--out", tmp_path / "report.pdf")
    assert "nowhere" in refused("report", tmp_path / "nowhere")
    assert "is a bundle" in refused("report", shutil.copytree(run / "bundle", tmp_path / "copy"))


def test_an_animation_ends_with_the_answer(tiny_run, tmp_path, refused, monkeypatch):
    monkeypatch.setattr(animation, "FRAMES", 8)
    sample = json.loads((tiny_run / "checks/emulator.json").read_text())["samples"][3]["id"]
    path = tmp_path / "a.gif"
    assert call("animate", tiny_run, "--out", path, "--sample", sample) == 0
    with Image.open(path) as film:
        assert film.n_frames >= 8
        first, begin, last = (
            np.asarray((film.seek(at), film.convert("L"))[1]).astype(int)
            for at in (0, 1, film.n_frames - 1)
        )
    assert np.abs(begin - last).max() > 50
    assert np.abs(first - last).max() < 20  # for programs that show one frame
    assert "no sample 'x'" in refused("animate", tiny_run, "--out", path, "--sample", "x")
    assert ".gif" in refused("animate", tiny_run, "--out", tmp_path / "a.png")


@pytest.mark.skipif(BROWSER is None, reason="no Chromium here (Debian: apt install chromium)")
@pytest.mark.parametrize("width", [390, 1280, 1920])
def test_a_browser_shows_it_without_errors(html, tmp_path, width):
    """No console message; page, ladder and plots fit; cells of a table can be tapped."""
    wrapper = tmp_path / "wrapper.html"  # the browser's own window is never narrower than 500
    wrapper.write_text(
        f'<iframe style="width: {width}px; height: 900px; border: 0" '
        f'srcdoc="{escape(html.read_text())}" onload="'
        "const page = this.contentDocument.documentElement;"
        "const ladder = this.contentDocument.querySelector('.ladder').parentNode;"
        "let hidden = ladder.scrollWidth - ladder.clientWidth;"
        "const plot = this.contentDocument.querySelector('figure:has(svg.timeline)');"
        "hidden += plot.scrollWidth - plot.clientWidth;"
        "const cells = [...this.contentDocument.querySelectorAll('.confusion a')];"
        "const sides = cells.flatMap(a => [a.offsetWidth, a.offsetHeight]);"
        "const sizes = [page.scrollWidth, page.scrollHeight, hidden, Math.min(...sides)];"
        "document.title = sizes.join(' ')"
        '"></iframe>'
    )
    command = [BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    command += ["--enable-logging=stderr", "--dump-dom", wrapper.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    title = re.search(r"<title>([\d ]+)</title>", done.stdout)[1]
    content, height, hidden, side = map(int, title.split())
    assert "CONSOLE" not in done.stderr
    assert content == width
    assert hidden == 0
    assert side >= 24  # of a cell that is tapped, WCAG 2.2
    assert height > 3000


def test_words_of_correct_and_wrong_are_no_names_of_classes_and_mistakes_are_counted():
    """A class may be called right."""
    groups = [{"right": False, "samples": [1]}, {"right": True, "samples": [2, 3]}]
    stories = [{"right": False}, {"right": True}]
    text = prose.describe_stories(groups, stories, None, False)
    assert text.startswith("1 mistake, then correct predictions.")
    groups[0]["samples"] = [1, 4]
    text = prose.describe_stories(groups, stories, None, False)
    assert text.startswith("1 of the 2 mistakes, then correct predictions.")


def test_a_p_value_is_not_broken_over_two_lines():
    assert " " not in prose.format_p_value(0.0001) + prose.format_p_value(0.2)
