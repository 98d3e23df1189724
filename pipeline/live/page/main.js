// The page: what comes from the server and from the person, and what is shown of it.

import { drawImage, drawLayer, drawRaster, drawSkin, onColours } from "./drawing.js";
import { Link } from "./link.js";
import { Pen } from "./pen.js";

const $ = (id) => document.getElementById(id);
const DIGITS = [...Array(10).keys()];
const BY_ITSELF_MS = 1000;
const LAYERS_MS = 60;
const REMEMBERED = "stmnist-writer";

history.scrollRestoration = "manual"; // a page that begins anew begins at the skin

const link = new Link();
let ready = null; // what the network is like, once it is ready
let writer = null; // who writes, and what is asked for
let recording = null; // the number of what is being written
let kept = false;
let strokes, flashes, events, counts;
let time = 0;
let answer = null; // the latest, until it is shown
let byItself = null;
const latencies = [];
let lastCounted = -Infinity;
const stale = { skin: true, rest: true, all: true };

function forget() {
  strokes = [];
  flashes = DIGITS.flatMap(() => DIGITS.map(() => ({ on: -Infinity, off: -Infinity })));
  events = { ns: [], taxel: [], polarity: [] };
  counts = Array(100).fill(0);
  time = 0;
  answer = shown = null;
  kept = false;
  clearTimeout(byItself);
  $("announce").textContent = "";
  showDecision(null);
  showLayers(null);
  stale.skin = stale.rest = stale.all = true;
  draw();
}

// ---- from the person

const pen = new Pen($("skin"), (points, now) => {
  if (!ready) return;
  clearTimeout(byItself);
  for (const [, right, down, , touches] of points) {
    if (!touches) {
      pen.lifted = true;
      continue;
    }
    if (pen.lifted !== false || !strokes.length) strokes.push([]); // or cleared in the middle
    pen.lifted = false;
    strokes.at(-1).push([right, down]);
  }
  if (points.length) {
    stale.skin = true;
    draw();
  }
  link.send({ type: "pen", now, points });
});

for (const digit of DIGITS) {
  const button = document.createElement("button");
  button.type = "button";
  button.id = `label-${digit}`;
  button.textContent = digit;
  button.setAttribute("aria-label", `It was a ${digit}`);
  button.addEventListener("click", () => label(digit));
  $("labels").append(button);
  const item = document.createElement("li");
  item.innerHTML = '<span></span><span class="track"><div class="bar"></div></span><span></span>';
  item.firstChild.textContent = digit;
  $("scores").append(item);
}

function label(digit) {
  clearTimeout(byItself);
  link.send({ type: "label", digit });
}

function clear() {
  clearTimeout(byItself);
  link.send({ type: "clear" });
}

$("clear").addEventListener("click", clear);
$("undo").addEventListener("click", () => link.send({ type: "undo" }));

$("learn").addEventListener("change", () => link.send({ type: "learning", on: $("learn").checked }));
$("forget").addEventListener("click", () => link.send({ type: "forget" }));

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
  if (event.target.matches("input, select, textarea")) return;
  if (/^[0-9]$/.test(event.key)) label(Number(event.key));
  else if (event.key === "c" || event.key === "Escape") clear();
  else if (event.key === "u") link.send({ type: "undo" });
});

function tellWriter(each) {
  const chosen = $("writer").value;
  link.send({
    type: "writer",
    number: chosen === "new" ? null : Number(chosen || 1),
    handedness: $("handedness").value,
    each,
  });
}

$("session").addEventListener("submit", (event) => {
  event.preventDefault();
  tellWriter(Number($("each").value));
  clear();
  scrollTo({ top: 0 }); // from the form, at the end of the page, to the skin
});
$("stop").addEventListener("click", () => tellWriter(0));
$("writer").addEventListener("change", () => tellWriter(writer?.each ?? 0));
$("handedness").addEventListener("change", () => tellWriter(writer?.each ?? 0));

// ---- from the server

link.on("hello", (about) => {
  $("folder").textContent = about.folder;
  const hands = about.simulated
    ? `${about.trained_on}: it has seen simulated hands only, and is less often right with real ones`
    : about.trained_on;
  $("trained").textContent = `Network ${about.architecture}, trained on ${hands}.`
    + (about.outdated ? ` ${about.outdated}.` : "");
  $("each").max = about.most_each;
});

link.on("ready", (network) => {
  ready = network;
  for (const { name, neurons } of network.layers) {
    const part = document.createElement("div");
    const title = document.createElement("h3");
    title.append(`${name}: ${neurons} neurons`, document.createElement("span"));
    const canvas = document.createElement("canvas");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `Spikes of layer ${name}`);
    part.append(title, canvas);
    $("layers").append(part);
  }
  $("about").textContent = `One row for each neuron, every mark is a spike; ${network.about}`;
  $("status").textContent = "Ready: write on the square with finger, pen or mouse.";
  $("status").classList.add("ready");
  document.body.dataset.ready = "yes";
  draw();
});

link.on("cleared", (message) => {
  const started = strokes.slice(-1); // the stroke that began it is here already
  forget();
  if (message.recording !== null) strokes = started;
  recording = message.recording;
  $("hint").classList.toggle("gone", recording !== null);
  complain(null);
});

link.on("events", (message) => {
  if (message.recording !== recording) return;
  const now = performance.now();
  time = message.time_s;
  message.taxel.forEach((taxel, i) => {
    events.ns.push(message.ns[i]);
    events.taxel.push(taxel);
    events.polarity.push(message.polarity[i]);
    counts[taxel]++;
    flashes[taxel][message.polarity[i] > 0 ? "on" : "off"] = now;
  });
  pen.settled = message.settled;
  if (message.over && pen.writes) {
    complain("The time for one recording is over: say what it was, or lift the pen and write again.");
    pen.settled = true;
  }
  stale.skin = stale.rest = true;
  draw();
  if (message.settled && !pen.writes) settle();
});

link.on("answer", (message) => {
  if (message.recording !== recording) return;
  answer = message;
  stale.rest = true;
  draw();
});

link.on("saved", (message) => {
  kept = true;
  clearTimeout(byItself); // the last events of what is kept now came just before
  $("told").textContent = `Kept as a ${message.digit}: ${message.name}, ${message.events} events.`;
  complain(null);
});

link.on("learned", (message) => {
  if (message.writer !== writer?.number) return;
  $("learned").dataset.digits = message.digits;
  $("learned").textContent = message.digits
    ? `Learning your handwriting: ${message.digits} digits, ${message.right} of the last ${message.of} right before they were learned${message.own_readout ? "" : "; your own readout is not better yet"}.`
    : "Nothing learned of your handwriting yet: write, and press the digit.";
});

link.on("undone", (message) => {
  $("told").textContent = `Removed the last, a ${message.digit}: ${message.name}.`;
});

link.on("writer", (state) => {
  const first = writer === null;
  writer = state;
  $("saved").textContent = state.saved;
  $("learning").hidden = !state.can_learn;
  if (state.can_learn) $("learn").checked = state.learns;
  const known = [...new Set([...state.known, state.number])].sort((a, b) => a - b);
  $("writer").replaceChildren(
    ...known.map((number) => new Option(`Writer ${number}`, number, false, number === state.number)),
    new Option("somebody new", "new"),
  );
  $("handedness").value = state.handedness;
  showSession();
  if (first) recall();
  else remember();
});

link.on("problem", (message) => complain(message.text));

link.on("gone", (reason) => {
  ready = null;
  delete document.body.dataset.ready;
  $("status").classList.remove("ready");
  $("status").textContent = "Not connected.";
  if ($("problem").hidden)
    complain(`The server has gone${reason ? ` (${reason})` : ""}. What was kept is safe; start it again and open the address that it prints.`);
  if (!reason) setTimeout(comeBack, 2000);
});

// Back again, such as after the machine has slept: the page begins anew, with the same writer.
async function comeBack() {
  try {
    if ((await fetch(location.href)).ok) location.reload();
  } catch {
    setTimeout(comeBack, 2000);
  }
}

// The writer is remembered by this browser, so that a session goes on where it was left.
function recall() {
  try {
    const { number, handedness, each } = JSON.parse(localStorage.getItem(REMEMBERED)) ?? {};
    if (Number.isInteger(number)) link.send({ type: "writer", number, handedness, each });
  } catch {
    // nothing is remembered here
  }
}

function remember() {
  try {
    const { number, handedness, each } = writer;
    localStorage.setItem(REMEMBERED, JSON.stringify({ number, handedness, each }));
  } catch {
    // this browser keeps nothing
  }
}

// ---- what is shown

function complain(text) {
  $("problem").hidden = text === null;
  if (text !== null) $("problem").textContent = text;
}

function settle() {
  announce();
  clearTimeout(byItself);
  if (writer?.asked !== null && !kept && events.taxel.length && $("by-itself").checked)
    byItself = setTimeout(() => label(writer.asked), BY_ITSELF_MS);
}

// For who does not see the page: one sentence when the pen is lifted, not one an event.
function announce() {
  if (pen.settled && !pen.writes && $("decision").textContent !== "")
    $("announce").textContent = `Decision: ${$("decision").textContent}, ${$("confidence").textContent}`;
}

function showSession() {
  const runs = writer.each > 0;
  $("session").hidden = runs;
  $("asking").hidden = !runs;
  for (const digit of DIGITS) $(`label-${digit}`).classList.toggle("asked", runs && digit === writer.asked);
  if (!runs) return;
  const all = 10 * writer.each;
  $("asked").replaceChildren(writer.asked === null ? "All done, thank you." : "Please write a ");
  if (writer.asked !== null) {
    const digit = document.createElement("b");
    digit.textContent = writer.asked;
    $("asked").append(digit);
  }
  $("progress").max = all;
  $("progress").value = writer.done;
  $("done").textContent = `Writer ${writer.number}: ${writer.done} of ${all} digits.`;
}

function percent(share) {
  return `${Math.round(100 * share)} %`;
}

function showDecision(message) {
  $("decision").textContent = message === null ? "" : message.decision;
  $("decision").dataset.events = message === null ? 0 : message.events; // that it is the answer to
  $("confidence").textContent = message === null ? "" : `${percent(message.confidence[message.decision])} sure`;
  const early = message?.sure_s == null ? "" : `; sure enough after ${message.sure_s.toFixed(2)} s`;
  $("since").textContent = message === null ? "" : `since ${message.since_s.toFixed(2)} s after the first touch${early}`;
  [...$("scores").children].forEach((item, digit) => {
    const share = message === null ? 0 : message.confidence[digit];
    item.classList.toggle("best", message !== null && digit === message.decision);
    item.children[1].firstChild.style.transform = `scaleX(${share})`;
    item.lastChild.textContent = message === null ? "" : percent(share);
  });
}

function showLayers(message) {
  if (!ready) return;
  ready.layers.forEach(({ name, neurons }, i) => {
    const part = $("layers").children[i];
    const text = message === null ? "" : atob(message.spikes[name]);
    const rows = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
    const spikes = drawLayer(part.querySelector("canvas"), rows, neurons, ready.steps, ready.first_step);
    part.querySelector("span").textContent = message === null ? "" : `${spikes} spikes`;
  });
}

// The picture of the spikes is the dearest, and nobody sees more of them a second.
let soon = null;
function showLayersSoon() {
  soon ??= setTimeout(() => {
    soon = null;
    if (shown !== null) showLayers(shown);
  }, LAYERS_MS);
}

let drawing = false;
let shown = null;
function draw() {
  if (drawing) return;
  drawing = true;
  requestAnimationFrame(() => {
    drawing = false;
    if (stale.skin) stale.skin = drawSkin($("skin"), strokes, flashes, performance.now());
    if (stale.rest) {
      stale.rest = false;
      if (answer !== null && answer !== shown) {
        shown = answer;
        showDecision(answer);
        announce();
        showLayersSoon();
        afterPaint(answer.last_ms);
      }
      drawRaster($("raster"), events, time, stale.all);
      stale.all = false;
      drawImage($("image"), counts);
      $("count").textContent = events.taxel.length ? `${events.taxel.length} events` : "";
    }
    if (stale.skin) draw();
  });
}

// A message to oneself is delivered after the frame has been painted.
const painted = new MessageChannel();
painted.port1.onmessage = ({ data: last }) => {
  if (last === null || last <= lastCounted) return; // no new event since the answer before
  lastCounted = last;
  latencies.push(performance.now() - last);
  if (latencies.length > 2000) latencies.splice(0, 1000);
  const sorted = latencies.toSorted((a, b) => a - b);
  const median = sorted[Math.floor(sorted.length / 2)];
  $("latency").textContent =
    `From the last event to the decision on this screen: ${median.toFixed(0)} ms at the median of ${sorted.length}.`;
  $("latency").dataset.median = median.toFixed(2);
  $("latency").dataset.ninetieth = sorted[Math.floor(0.9 * sorted.length)].toFixed(2);
  $("latency").dataset.count = sorted.length;
};
function afterPaint(last) {
  painted.port2.postMessage(last);
}

function redraw() {
  stale.skin = stale.rest = stale.all = true;
  showLayers(shown);
  draw();
}
addEventListener("resize", redraw);
onColours(redraw);
forget();
