"""The page in a real Chromium, written on as a hand would."""

import json
import re
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from deploy.errors import UserError
from pipeline.recordings.events import Events
from pipeline.recordings.files.reading import read_source
from pipeline.recordings.formats.mat import read_recording
from pipeline.recordings.sensor import Sensor
from pipeline.simulation import handwriting, parameters, simulate
from tests.own_sensor import CLASSES
from tests.pipeline.live.conftest import served

pytest.importorskip("uvicorn", reason="the extra 'live' is not installed")

from pipeline.live.examples import Example
from pipeline.look import STYLE
from tests import robot

P = parameters.read_parameters()
STEP_S = 1 / 500


@pytest.fixture(scope="module")
def browser():
    """Playwright keeps an event loop in its thread, so that it has to be this one alone."""
    try:
        with robot.chromium() as browser:
            yield browser
    except UserError as error:
        pytest.skip(str(error))


# A clock of the page that can be put forward: `putForward(ms)`.
CLOCK = """
let ahead = 0;
const now = performance.now.bind(performance);
performance.now = () => now() + ahead;
const { get } = Object.getOwnPropertyDescriptor(Event.prototype, "timeStamp");
Object.defineProperty(Event.prototype, "timeStamp", { get() { return get.call(this) + ahead; } });
window.putForward = (ms) => { ahead += ms; };
"""
# From the pen's last point to the time when the skin is at rest, at the most.
REST_MS = 1500


@contextmanager
def page_of(browser, server, **options):
    """A page that is ready; what it complains of fails the test."""
    options = {"viewport": {"width": 1280, "height": 1000}, **options}
    context = browser.new_context(**options)
    context.add_init_script(CLOCK)
    page = context.new_page()
    page.complaints = []
    page.on("console", lambda message: page.complaints.append(message.text))
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    page.told, page.said = [], []
    page.on("websocket", lambda s: s.on("framereceived", lambda frame: page.told.append(frame)))
    page.on("websocket", lambda s: s.on("framesent", lambda frame: page.said.append(frame)))
    robot.opened(page, server.url)
    yield page
    assert page.complaints == []
    context.close()


def messages(page, kind):
    """Messages of a type that the page has received from the server."""
    return of_kind(page.told, kind)


def sent(page, kind):
    """Messages of a type that the page has sent to the server."""
    return of_kind(page.said, kind)


def of_kind(frames, kind):
    every = [json.loads(frame) for frame in frames]
    return [message for message in every if message["type"] == kind]


def digit(number, index=0):
    """A simulated hand's motion in a third of its time."""
    who = handwriting.draw_writer(np.random.default_rng([0, 1, index]), P)
    sample = simulate.PlannedRecording(number, index, index)
    rng = np.random.default_rng([0, 2, number, index])
    motion = simulate.draw_motion(sample, who, rng, P.forms[number], P)
    return replace(motion, time_s=motion.time_s / 3)


def until(page, condition, seconds=120):
    """Wait for a condition in the page's language; Playwright's own way is against its policy."""
    end = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < end, f"never: {condition}"
        page.wait_for_timeout(20)


ALL_IS_ANSWERED = (
    "document.querySelector('#race').dataset.events > 0 &&"
    " document.querySelector('#announce').textContent.includes("
    "document.querySelector('#decision').textContent) &&"
    " document.querySelector('#race').dataset.events =="
    " document.querySelector('#decision').dataset.events"
)


def settled(page):
    """Let the skin come to rest, and wait until the network has answered to it all."""
    page.evaluate(f"putForward({REST_MS})")
    until(page, ALL_IS_ANSWERED)


def label(page, number):
    before = page.inner_text("#saved")
    page.click(f"#label-{number}")
    until(page, f"document.querySelector('#saved').textContent !== '{before}'")


# A sensor of somebody's own.
OWN = Sensor(9, 12, classes=CLASSES)


@pytest.fixture
def page(browser, server):
    with page_of(browser, server) as page:
        page.server = server
        yield page


def test_events_and_decisions_come_while_the_pen_is_still_down(page):
    skin = page.locator("#skin").bounding_box()
    x, y = skin["x"] + skin["width"] / 2, skin["y"] + 20
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(30):
        page.mouse.move(x, y + 10 * step)
        page.wait_for_timeout(10)
    until(page, "document.querySelector('#decision').textContent !== ''")
    assert int(page.get_attribute("#race", "data-events")) > 0
    assert re.fullmatch(r"\d+(\.\d)? %", page.inner_text("#confidence"))
    page.mouse.up()


def test_pointer_events_of_any_origin_write(page):
    """Such as those of a stylus's driver or of an assistive technology: no raw ones, no capture."""
    page.evaluate(
        """async () => {
          const skin = document.querySelector("#skin"), box = skin.getBoundingClientRect();
          const tell = (kind, share) => skin.dispatchEvent(new PointerEvent(kind, {
            pointerId: 7, pointerType: "pen", pressure: kind === "pointerup" ? 0 : 0.6,
            clientX: box.left + box.width / 2, clientY: box.top + share * box.height,
          }));
          tell("pointerdown", 0.1);
          for (let n = 0; n < 30; n++) {
            await new Promise((done) => setTimeout(done, 10));
            tell("pointermove", 0.1 + 0.8 * n / 30);
          }
          tell("pointerup", 0.9);
        }"""
    )
    settled(page)
    label(page, 1)
    kept = read_recording(next(page.server.keeper.folder.rglob("w*.mat")).read_bytes())
    assert len(kept.events) > 20


def test_clear_empties_the_decision(page):
    robot.write(page, digit(1))
    settled(page)
    page.click("#clear")
    until(page, "document.querySelector('#decision').textContent === ''")
    assert page.inner_text("#confidence") == ""
    page.click("#label-3")
    page.wait_for_selector("#problem:not([hidden])")
    assert page.inner_text("#problem")
    assert page.inner_text("#saved") == "0"


def test_everything_but_writing_goes_by_keyboard(page):
    robot.replay(page, digit(7))
    settled(page)
    page.locator("body").press("7")
    until(page, "document.querySelector('#saved').textContent === '1'")
    assert "7" in page.inner_text("#told")
    reached = set()
    for _ in range(40):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id"))
    expected = {"clear", "undo", "example-class", "writer"}
    assert expected | {f"label-{number}" for number in range(10)} <= reached
    page.locator("body").press("u")
    until(page, "document.querySelector('#saved').textContent === '0'")
    robot.replay(page, digit(1))
    settled(page)
    page.locator("body").press("c")
    until(page, "document.querySelector('#decision').textContent === ''")
    assert page.inner_text("#saved") == "0"


def test_every_browser_is_a_writer_of_its_own_and_stays_it(page, browser):
    robot.replay(page, digit(1))
    settled(page)
    label(page, 1)
    with page_of(browser, page.server) as other:
        until(other, "document.querySelector('#writer').value === '2'")
    page.select_option("#writer", "new")
    until(page, "document.querySelector('#writer').value === '3'")
    page.reload()
    page.wait_for_selector("body[data-ready]")
    until(page, "document.querySelector('#writer').value === '3'")
    robot.replay(page, digit(1))
    settled(page)
    label(page, 1)
    assert read_source(page.server.keeper.folder, jobs=1).writers.tolist() == [1, 3]


@pytest.mark.parametrize("sensor", [Sensor(), OWN])
@pytest.mark.parametrize("size", [(844, 390), (1280, 800), (1920, 1080)])
def test_decision_spikes_and_labels_are_on_one_screen(browser, tmp_path, size, sensor):
    width, height = size
    with (
        served(tmp_path / "kept", sensor=sensor) as server,
        page_of(browser, server, viewport={"width": width, "height": height}) as page,
    ):
        last = f"#label-{len(sensor.classes) - 1}"
        for part in ("#skin", "#decision", "#race", "#example", last):
            box = page.locator(part).first.bounding_box()
            assert box["y"] + box["height"] <= height, part
        assert page.locator("main").bounding_box()["width"] >= 0.85 * width
        assert page.evaluate("scrollY") == 0


def test_a_finger_writes_on_a_phone_and_the_page_does_not_scroll(browser, server):
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    with page_of(browser, server, **phone) as page:
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        skin = page.locator("#skin").bounding_box()
        assert skin["y"] + skin["height"] < 844
        hand = page.context.new_cdp_session(page)

        def touch(kind, *points):
            hand.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})

        x = skin["x"] + skin["width"] / 2
        touch("touchStart", {"x": x, "y": skin["y"] + 30})
        for step in range(25):
            touch("touchMove", {"x": x, "y": skin["y"] + 30 + 11 * step})
            page.wait_for_timeout(12)
        touch("touchEnd")
        settled(page)
        assert page.evaluate("scrollY") == 0
        assert messages(page, "events")[-1]["settled"]
        label(page, 1)
    assert len(server.keeper) == 1


@pytest.mark.parametrize("sensor", [Sensor(), OWN])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_part_is_too_wide_and_every_part_says_what_it_is(browser, tmp_path, scheme, sensor):
    options = {"viewport": {"width": 390, "height": 800}, "color_scheme": scheme}
    with (
        served(tmp_path / "kept", sensor=sensor, host="127.0.0.2") as server,
        page_of(browser, server, reduced_motion="reduce", **options) as page,
    ):
        robot.replay(page, digit(2))
        settled(page)
        for width in (390, 768, 1280, 1920):
            page.set_viewport_size({"width": width, "height": 800})
            assert page.evaluate("document.documentElement.scrollWidth") == width
            beyond = page.evaluate(
                "[...document.querySelectorAll('main section *')].filter(e => e.offsetParent &&"
                " e.getBoundingClientRect().right > innerWidth + 1).map(e => e.id || e.tagName)"
            )
            assert beyond == []
            sections = page.locator("main section:visible")
            for index in range(sections.count()):
                assert sections.nth(index).inner_text().strip()
            small = page.evaluate(
                "[...document.querySelectorAll('button')].filter(b => b.offsetParent &&"
                " (b.offsetHeight < 40 || b.offsetWidth < 40)).map(b => b.id)"
            )
            assert small == []


def test_a_sensor_and_classes_of_ones_own(browser, tmp_path):
    with served(tmp_path / "kept", sensor=OWN) as server, page_of(browser, server) as page:
        box = page.locator("#skin").bounding_box()
        assert box["width"] / box["height"] == pytest.approx(12 / 9, rel=0.03)
        words = page.inner_text("body").lower()
        assert "digit" not in words
        assert "handwriting" not in words
        robot.replay(page, digit(0))
        settled(page)
        assert page.inner_text("#decision") in CLASSES
        assert page.locator("#label-2").inner_text().endswith(CLASSES[2])
        page.locator("body").press("3")
        until(page, "document.querySelector('#saved').textContent === '1'")
        robot.replay(page, digit(1))
        settled(page)
        label(page, 0)
    kept = read_source(server.keeper.folder, jobs=1)
    assert kept.ids == (f"{CLASSES[0]}/w001-0002", f"{CLASSES[2]}/w001-0001")
    assert (kept.sensor.rows, kept.sensor.columns) == (9, 12)
    assert len(np.unique(kept[1].taxel)) > 10


def test_many_classes_are_searched(browser, tmp_path):
    names = tuple(f"Klasse {n} mit Übergröße und {'x' * (n % 20)}" for n in range(300))
    with (
        served(tmp_path / "kept", sensor=Sensor(classes=names)) as server,
        page_of(browser, server) as page,
    ):
        robot.replay(page, digit(3))
        settled(page)
        page.fill("#search", "klasse 217 ")
        assert page.locator("#labels button:visible").count() == 1
        page.press("#search", "Enter")
        until(page, "document.querySelector('#saved').textContent === '1'")
        assert page.locator("#scores li").count() < 20
        assert page.evaluate("document.documentElement.scrollWidth") == 1280
    assert [path.parent.name for path in server.keeper.folder.rglob("w*.mat")] == [names[217]]


def test_an_example_is_played_at_its_own_pace_and_kept_no_second_time(browser, tmp_path):
    time_ns = 200_000_000 + 20_000_000 * np.arange(40)
    line = Events(time_ns, 10 * np.arange(40) % 100, np.tile([1, -1], 20), np.ones(40))
    tests = [Example(line, 3, "3/0007"), Example(line, 4, "4/0001")]
    with served(tmp_path / "kept", tests=tests) as server, page_of(browser, server) as page:
        until(page, "!document.querySelector('#example').disabled")
        page.select_option("#example-class", "4")
        begun = page.evaluate("performance.now()")
        page.click("#example")
        until(page, "document.querySelector('#race').dataset.events === '40'")
        assert page.evaluate("performance.now()") - begun > 780
        until(page, ALL_IS_ANSWERED)
        assert page.locator("#shown").get_attribute("data-label") == "4"
        assert page.get_attribute("#race", "data-events") == "40"
        assert max(len(m["ns"]) for m in messages(page, "events")) < 40  # not all at once
        page.click("#label-4")
        robot.replay(page, digit(1))
        settled(page)
        label(page, 1)
        page.locator("body").press("e")
        until(page, "document.querySelector('#shown').dataset.label !== undefined")
        settled(page)
        assert len(server.keeper) == 1


def test_the_page_says_when_the_server_has_gone(browser, tmp_path):
    with served(tmp_path / "kept") as server:
        context = browser.new_context()
        page = context.new_page()
        robot.opened(page, server.url)
        threading.Timer(0.1, lambda: setattr(server, "should_exit", True)).start()
        until(page, "document.querySelector('#status').textContent === 'Not connected.'")
        assert "recordings" in page.inner_text("#problem")
        context.close()


# Notes the page's connections; the first REFUSED of them cannot be opened.
SOCKETS = """
const Real = WebSocket;
window.sockets = [];
window.WebSocket = class extends Real {
  constructor(address) {
    super(sockets.length < REFUSED ? `${address}/nowhere` : address);
    sockets.push(this);
  }
};
"""


def with_sockets(browser, refused=0):
    page = browser.new_page()
    page.add_init_script(CLOCK)
    page.add_init_script(SOCKETS.replace("REFUSED", str(refused)))
    return page


@pytest.mark.parametrize("saved", [False, True])
def test_what_was_lost_with_the_connection_is_said(browser, server, saved):
    page = with_sockets(browser)
    robot.opened(page, server.url)
    robot.replay(page, digit(1))
    settled(page)
    if saved:
        label(page, 1)
    with page.expect_navigation():
        page.evaluate("sockets.at(-1).close()")
    page.wait_for_selector("body[data-ready]")
    if saved:
        assert page.is_hidden("#problem")
    else:
        assert "drawing" in page.inner_text("#problem")
        page.reload()
        page.wait_for_selector("body[data-ready]")
        assert page.is_hidden("#problem")
    page.close()


def luminance(colour):
    """WCAG 2.2, relative luminance."""
    parts = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def test_text_and_marks_stand_out_from_what_is_behind_them():
    schemes = [dict(re.findall(r"--([\w-]+): (#\w{6});", block)) for block in STYLE.split("}")[:2]]
    light, dark = schemes[0], {**schemes[0], **schemes[1]}
    assert dark["paper"] != light["paper"]
    for colours in (light, dark):
        for front, behind, least in [
            ("ink", "paper", 7), ("ink", "panel", 7), ("soft", "paper", 4.5),
            ("soft", "panel", 4.5), ("key-ink", "key", 4.5), ("note-ink", "note", 4.5),
            ("on", "paper", 3), ("off", "paper", 3), ("on", "panel", 3), ("off", "panel", 3),
        ]:  # fmt: skip
            bright, dim = sorted(map(luminance, (colours[front], colours[behind])), reverse=True)
            assert (bright + 0.05) / (dim + 0.05) >= least, (front, behind)


def test_a_tap_is_too_short_and_the_direction_of_strokes_is_said(browser, server):
    with page_of(browser, server) as page:
        assert "direction of strokes" in page.inner_text("#hint")
        box = page.locator("#skin").bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.mouse.down()
        page.wait_for_timeout(100)  # a finger's tap; a shorter one may have no event at all
        page.mouse.up()
        until(page, "document.querySelector('#confidence').textContent === 'Too short'")
        assert page.inner_text("#decision") == ""


def test_a_tap_or_line_without_events_is_answered(page):
    """The network says nothing about it, so that the page has to."""
    box = page.locator("#skin").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.up()
    until(page, "document.querySelector('#confidence').textContent === 'Too short'")
    describe = """async (drawn) => {
      const { describeDecision } = await import(new URL("decision.js", location.href));
      const page = { classes: ["a", "b"], pauseS: 1, threshold: null, truth: null, canDraw: true };
      return describeDecision(null, { ...page, settled: true, writes: false, strokes: drawn });
    }"""
    assert page.evaluate(describe, [[[5, 5]]])["confidence"] == "Too short"
    assert page.evaluate(describe, [[[5, 5], [5, 8]]])["confidence"] == "No decision"
    assert page.evaluate(describe, [])["confidence"] == ""


DESCRIBE = """async ([message, settled]) => {
  const { describeDecision } = await import(new URL("decision.js", location.href));
  const page = {
    classes: [..."0123456789"], pauseS: 1, threshold: 0.9, truth: null, canDraw: true,
    nameClass: (label) => `a ${label}`, settled, writes: !settled, strokes: [[[5, 5], [5, 8]]],
  };
  return describeDecision(message, page);
}"""


@pytest.mark.parametrize(
    ("settled", "changes", "text", "confidence", "is_open"),
    [
        (False, {}, "6", "99.0 %", True),  # a longer digit may follow
        (True, {}, "6", "99.0 %", False),
        (True, {"confidence": 0.7}, "6", "70 %", False),  # that of all events
        (True, {"confidence": 0.26}, "6", "Not sure", True),
        (True, {"decision": 0}, "6", "Not sure", True),
        (False, {"decision": 0}, "0", "99.0 %", True),
        (True, {"exceeds_training": True}, "6", "Not sure", True),
        (False, {"exceeds_training": True}, "6", "Not sure", True),
        (True, {"exceeds_training": True, "verdict": {"early": False}}, "6", "Not sure", True),
    ],
)
def test_the_page_is_sure_only_of_what_has_ended_within_the_times_of_the_training(
    page, settled, changes, text, confidence, is_open
):
    verdict = {"label": 6, "confidence": 0.995, "seconds": 0.79, "early": True}
    verdict = {**verdict, **changes.pop("verdict", {})}
    message = {"decision": 6, "confidence": 0.99, "exceeds_training": False, "verdict": verdict}
    view = page.evaluate(DESCRIBE, [{**message, **changes}, settled])
    assert (view["text"], view["confidence"], view["open"]) == (text, confidence, is_open)


def test_a_page_speaks_of_one_event_and_of_the_time_of_its_confidence(page):
    count = """async (number) => {
      const { count } = await import(new URL("drawing.js", location.href));
      return count(number, "event");
    }"""
    assert [page.evaluate(count, n) for n in (0, 1, 2)] == ["0 events", "1 event", "2 events"]
    verdict = {"label": 6, "confidence": 0.93, "seconds": 0.79, "early": True}
    message = {"decision": 6, "confidence": 0.99, "exceeds_training": False, "verdict": verdict}
    assert "at the end" in page.evaluate(DESCRIBE, [message, True])["statement"]


def test_a_message_covers_neither_the_title_nor_what_is_pressed_or_drawn(browser, server):
    with page_of(browser, server, viewport={"width": 1280, "height": 800}) as page:
        page.evaluate("document.querySelector('#problem').hidden = false")
        page.evaluate(
            "document.querySelector('#problem-text').textContent = 'a message '.repeat(12)"
        )
        message = page.locator("#problem").bounding_box()
        for name in ("#title", "#skin", "#undo", "#writer", "#decision", "#race"):
            box = page.locator(name).bounding_box()
            is_beside = box["x"] + box["width"] <= message["x"]
            is_below = box["y"] >= message["y"] + message["height"]
            assert is_beside or is_below, name


def test_all_buttons_of_digits_are_whole_on_a_phone(browser, server):
    with page_of(browser, server, viewport={"width": 390, "height": 844}) as page:
        for label in range(10):
            box = page.locator(f"#label-{label}").bounding_box()
            assert box["y"] + box["height"] <= 844


def test_a_browser_is_one_writer_on_every_port(browser, server):
    with page_of(browser, server) as page:
        number = page.input_value("#writer")
        until(page, "document.cookie.includes('stmnist-writer-')")
        page.evaluate("localStorage.clear()")  # that of another port is empty
        page.reload()
        page.wait_for_selector("body[data-ready]")
        until(page, f"document.querySelector('#writer').value === '{number}'")
