"""The report of the small run: complete, self-contained, and read by a real browser."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html import escape
from html.parser import HTMLParser
from pathlib import Path

import pytest

from deploy.check.bundle import read_bundle
from deploy.check.results import read_result
from deploy.preflight.plan import make_plan
from pipeline.data.library import recordings_of
from pipeline.results.report import page as report
from pipeline.results.report.gather import _outdated, gather
from pipeline.results.report.replay import replay
from pipeline.run import RunFolder
from pipeline.settings import read_settings, write_settings
from pipeline.training.history import read_history
from tests.command import call

BROWSER = next(filter(shutil.which, ("chromium", "chromium-browser", "google-chrome")), None)


@pytest.fixture(scope="module")
def html(tiny_run, tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "report.html"
    assert call("report", tiny_run, "--out", out) == 0
    return out


class Outline(HTMLParser):
    """Checks that tags close, and collects what a reader and a browser see."""

    VOID = frozenset({"meta", "link", "br"})

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.text, self.loads = [], [], "", []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.loads += [v for k, v in attrs if k in ("src", "href", "xlink:href", "data")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.text += data + " "


def test_it_is_whole_and_needs_nothing_else(html):
    page = html.read_text()
    outline = Outline(page)
    assert all(load.startswith(("#", "data:")) for load in outline.loads)
    assert "script" not in outline.tags
    assert "@import" not in page
    assert "url(" not in page
    assert "None" not in outline.text.replace("None is a figure", "")
    assert "nan" not in outline.text.split()


def test_rates_of_each_layer_and_curves_of_held_out_samples(html, tiny_run):
    page = html.read_text()
    drawn = re.findall(r'<path class="points" d="([^"]*)"', page)
    rates = json.loads((tiny_run / "ladder.json").read_text())["rates"]
    assert [d.count("M") for d in drawn] == [len(points) for points in rates.values()]
    assert len(drawn) == 2
    for network in ("cnn", "snn"):
        rows = read_history(tiny_run / network / "history.csv")
        assert {"loss", "accuracy", "test_loss", "test_accuracy"} <= set(rows[0])
    curve = page.split('aria-label="Learning curve of CNN, loss"')[1].split("</svg>")[0]
    assert curve.count("<polyline") == 2


def test_rates_of_another_bundle_are_left_out(tiny_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)
    ladder = json.loads((run / "ladder.json").read_text())
    (run / "ladder.json").write_text(json.dumps({**ladder, "bundle": "0" * 64}))
    assert call("report", run, "--out", tmp_path / "r.html") == 0
    assert 'class="points"' not in (tmp_path / "r.html").read_text()


@pytest.mark.parametrize(
    "damaged", [[[None, 0.0]], [[1.0, -1.0]], [[1.0]], [1.0], "x", 3, [[1e99, 1]]]
)
def test_damaged_rates_are_refused(tiny_run, tmp_path, capsys, damaged):
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)
    ladder = json.loads((run / "ladder.json").read_text())
    for rates in ({**ladder["rates"], "conv1": damaged}, damaged):
        (run / "ladder.json").write_text(json.dumps({**ladder, "rates": rates}))
        assert call("report", run, "--out", tmp_path / "r.html") == 2
        assert "ladder.json" in capsys.readouterr().err
    assert not (tmp_path / "r.html").exists()


def test_it_says_what_was_measured(html, tiny_run):
    text = " ".join(Outline(html.read_text()).text.split())
    assert "Simulated" in text
    bundle = read_bundle(tiny_run / "bundle")
    assert bundle.id in text
    for stage in ("cnn", "emulator"):
        assert f"{read_result(tiny_run / f'checks/{stage}.json')['accuracy']:.3f}" in text
    assert "0.713 (0.018)" in text or "0.712 (0.018)" in text
    assert "0.89 (0.01)" in text  # the paper's CNN
    assert "0.654" in text  # new writers
    assert "1738 (1366)" not in text  # the paper's ON events of 0; these are simulated
    assert "stmnist data stats --against-paper" in text
    assert re.search(r"ANN-SNN on Loihi \D+ 0\.86 \(0\.02\)", text)
    assert "seed = 4 (run: 0)" in text
    assert "snn.batch_size 0" in text
    used = make_plan(bundle.spec).cores[0].used
    assert f"core 0 {used['compartments']} {used['input axons']}" in text
    assert "estimate" in text
    assert "data.samples_per_digit 60" in text
    metrics = json.loads((tiny_run / "cnn/metrics.json").read_text())
    assert f"{100 * metrics['accuracy']['test']:.1f} %" in text


def test_a_run_that_is_not_there(tmp_path, capsys):
    assert call("report", tmp_path / "nowhere") == 2
    assert "nowhere" in capsys.readouterr().err


def browse(page, *arguments):
    command = [BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    command += ["--enable-logging=stderr", *arguments, page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout, done.stderr


@pytest.mark.skipif(BROWSER is None, reason="no Chromium here (Debian: apt install chromium)")
@pytest.mark.parametrize("width", [390, 1280, 1920])
def test_a_browser_shows_it_without_errors(html, tmp_path, width):
    """No console message, nothing wider than the page or to be scrolled, a picture not blank."""
    # In a frame, since the browser's own window is never narrower than 500 pixels.
    wrapper = tmp_path / "wrapper.html"
    wrapper.write_text(
        f'<iframe style="width: {width}px; height: 900px; border: 0" '
        f'srcdoc="{escape(html.read_text())}" onload="'
        "const page = this.contentDocument.documentElement;"
        "const wide = [...page.querySelectorAll('.wide')];"
        "const cut = wide.filter(table => table.scrollWidth > table.clientWidth);"
        "document.title = [page.scrollWidth, page.clientWidth, page.scrollHeight, cut.length]"
        ".join(' ')"
        '"></iframe>'
    )
    page, log = browse(wrapper, "--dump-dom")
    content, window, height, cut = map(int, re.search(r"<title>([\d ]+)</title>", page)[1].split())
    assert "CONSOLE" not in log
    assert window == width
    assert content == width
    assert cut == 0
    assert height > 3000
    picture = tmp_path / "picture.png"
    _, log = browse(html, f"--window-size={width},1200", f"--screenshot={picture}")
    assert "CONSOLE" not in log
    from PIL import Image

    with Image.open(picture) as image:
        assert image.size == (width, 1200)
        assert len(image.convert("L").getcolors(256)) > 20


def test_a_right_and_a_wrong_sample_are_chosen_early_in_their_streams():
    samples = [{"label": 1, "prediction": p} for p in (1, 1, 0, 1, 0, 1)]
    assert report.choose_samples({"samples": samples}, 4) == [0, 4]
    assert report.choose_samples({"samples": samples[:2]}, 4) == [0]


@pytest.mark.parametrize("n", [1, 2, 99, 100, 199, 200, 203, 1000])
def test_a_drawn_curve_ends_with_the_last_step(n):
    """Its last value is the probability in the sample's title."""
    drawn = report.drawn_steps(n)
    assert (drawn[0], drawn[-1]) == (0, n - 1)
    assert len(set(drawn.tolist())) == len(drawn) <= min(n, 201)


def test_only_closed_samples_lose_their_titles_in_print():
    """The first sample is open, and printed without its title nobody knows which it is."""
    style = Path(report.__file__).with_name("report.css").read_text("utf-8")
    printed = style[style.index("@media print") :]
    hidden = printed[: printed.index("{ display: none; }")].splitlines()[-1]
    assert [part.strip() for part in hidden.split(",")] == ["nav", "details:not([open]) > summary"]


def test_a_replay_has_the_spikes_that_the_check_counted(tiny_run):
    bundle = read_bundle(tiny_run / "bundle")
    spec = bundle.spec.with_presentation(steps=12, gap=5, readout_start=3, stream_length=2)
    short = replace(bundle, spec=spec)
    from deploy.targets.registry import answer

    counted = answer(spec, bundle.checks.inputs[:4], "emulator").spikes
    for index in (2, 3):
        played = replay(short, index)
        for layer, (times, units) in played.spikes.items():
            assert len(times) == counted[layer][index]
            assert units.max(initial=0) < played.neurons[layer]
            assert times.min(initial=0) >= -5
            assert times.max(initial=0) < 12
        # Nothing is shown in the gap, and the image is there from step 0.
        assert played.spikes["input"][0].min() >= 0


def test_an_early_decision_is_told_from_the_final_one(tiny_run):
    """The steps may be chosen by the program: the setting is then 0."""
    inputs = gather(RunFolder(tiny_run), 1)
    result, steps = inputs.results[-1], inputs.bundle.spec.presentation.steps
    (early, *others), step = inputs.replays, inputs.bundle.spec.stimulus.step_seconds
    for index, sample in enumerate(result["samples"]):
        sample |= {"stopped_at": 9 if index == early else steps, "decided_at": 13}
    inputs = replace(
        inputs, settings=inputs.settings.with_values({"presentation": {"steps": 0}}, "")
    )
    page = report.render(inputs)
    assert page.count("early decision in step 9") == 1
    assert page.count("undecided until the end") == len(others)
    assert page.count(f"decided after {13_000 * step:.0f} ms") == len(inputs.over_time)


def test_outdated_results_are_marked(tiny_run, tmp_path, capsys):
    """Also those of a run beside, and before an animation."""
    old = tmp_path / "old"
    shutil.copytree(tiny_run, old)
    settings = read_settings(old / "experiment.toml")
    write_settings(old / "experiment.toml", replace(settings, seed=settings.seed + 1))
    runs = RunFolder(tiny_run), RunFolder(old)
    assert _outdated(runs[0], None) == {}
    assert f"{old}/bundle" in _outdated(*runs)
    assert "bundle" in _outdated(runs[1], None)
    for run, said in ((old, True), (tiny_run, False)):
        assert call("animate", run, "--out", tmp_path / "a.gif", "--sample", "none") == 2
        assert ("bundle: outdated" in capsys.readouterr().err) is said


def test_digits_of_a_camera_are_not_st_mnist(tiny_run):
    """Such as N-MNIST: its classes are digits, but no paper's table is about its recordings."""
    ours = recordings_of(read_settings(tiny_run / "experiment.toml"))
    camera = replace(ours, source=replace(ours.source, time_unit="us"))
    assert [report._of_digits(r) for r in (ours, camera)] == [True, False]
    assert [report._word(r) for r in (ours, camera)] == ["writing", "recording"]
