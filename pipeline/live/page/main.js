// The page: messages of the server, input of the user, and what is displayed.

import { Connection } from "./connection.js";
import { describeDecision } from "./decision.js";
import { count, onColours, setSensor } from "./drawing.js";
import { Pen } from "./pen.js";
import { drawRace } from "./race.js";
import { drawSkin } from "./skin.js";
import { readWriter, storeLoss, storeWriter, takeLoss } from "./storage.js";

const $ = (id) => document.getElementById(id);
const AGAIN_MS = 2000; // until the page tries to connect again
const [REFUSED, TOO_MANY] = [1008, 1013]; // codes with which the server ends a connection
const SCORES = 5; // number of displayed classes, with the highest scores, if there is no room for all
const BUTTONS = 12; // with more classes, their buttons can be searched
const SHORT = 3; // characters of a name that is shown large

history.scrollRestoration = "manual"; // after reloading, start at the skin

const server = new Connection();
let about = null; // the data set: rows, columns, classes and the like
let ready = null; // description of the network, once it is ready
let writer = null; // the writer, and the number of its saved recordings
let examples = null; // number of examples of each class, once they are known
let recording = null; // number of the recording that is written or played
let isKept = false;
let hasWarned = false; // of writing that the network does not receive
let isOver = false; // the recording has been cut at its maximum duration
let strokes = [], flashes = [], counts = [];
let events = { s: [], taxel: [], polarity: [] };
let time = 0;
let answer = null; // the latest answer, until it is displayed
let spikes = null; // the latest spikes, which do not come with every answer
let recalled = null; // the stored writer, until the server has taken it over
const latencies = [];
let lastCounted = -Infinity;
const stale = { skin: true, rest: true };

function forget() {
  const taxels = about === null ? 0 : about.rows * about.columns;
  strokes = [];
  flashes = Array(taxels).fill(null);
  events = { s: [], taxel: [], polarity: [] };
  counts = Array(taxels).fill(0);
  time = 0;
  answer = displayed = spikes = null;
  delete $("shown").dataset.label;
  isKept = isOver = hasWarned = false;
  $("undo").disabled = true;
  $("announce").textContent = $("shown").textContent = "";
  showDecision(null);
  redraw();
}

// ---- texts that depend on the data set

function describe() {
  const { rows, columns, classes, digits } = about;
  document.title = digits ? "Write a digit on the sensor" : `${about.trained_on}: play or draw`;
  $("title").textContent = digits ? "Write a digit" : document.title;
  $("falls").hidden = about.polarities === 1;
  showHint();
  $("keep-title").textContent = digits ? "It was a …" : "It was …";
  $("keep-say").textContent = `Press the ${digits ? "digit that you wrote" : "class that you drew"} to save the recording.`;
  const long = classes.some((name) => [...name].length > SHORT);
  document.body.classList.toggle("long", long);
  document.body.classList.toggle("digits", digits);
  document.body.classList.toggle("many", classes.length > BUTTONS);
  const style = document.documentElement.style;
  // A strip is drawn high enough to be seen; a sensor whose taxels' places are known is in a square.
  style.setProperty("--rows", about.positions ? columns : Math.max(rows, columns / 8));
  style.setProperty("--columns", columns);
  style.setProperty("--buttons", Math.min(classes.length, 10));
  $("search").hidden = classes.length <= BUTTONS;
  $("search").placeholder = `Search ${classes.length} classes`;
  $("labels").replaceChildren(...classes.map(labelButton));
  $("scores").replaceChildren(...classes.slice(0, classes.length > (long ? 6 : 10) ? SCORES : 10).map(scoreItem));
  const keys = classes.map((_, label) => keyOf(label)).filter((key) => key !== null);
  $("keys").textContent = keys.length
    ? `${keys[0]} to ${keys.at(-1)} save the recording as ${digits ? "that digit" : "that class"},`
    : "";
  $("example-class").replaceChildren(
    new Option("any", ""), ...classes.map((name, label) => new Option(name, label)),
  );
}

// What to do on the sensor, and what the network depends on, appears where one draws.
function showHint() {
  const verb = about.digits ? "Write" : "Draw";
  const text = document.createElement("span");
  text.textContent = canDraw() ? `${verb} here, large` : "Show an example";
  $("hint").replaceChildren(text);
  if (!canDraw() || ready === null || ready.window_s === null) return;
  const note = document.createElement("small");
  note.textContent = about.digits ? "from top to bottom, as usual: the direction of strokes counts"
    : "as in the recordings: the direction of strokes counts";
  $("hint").append(note);
}

const canDraw = () => about.rows * about.columns <= about.most_taxels;

function labelButton(name, label) {
  const button = document.createElement("button");
  button.type = "button";
  button.id = `label-${label}`;
  const key = keyOf(label);
  if (key !== null && key !== name) {
    const shortcut = document.createElement("kbd");
    shortcut.textContent = key;
    button.append(shortcut, " ");
  }
  button.append(name);
  button.setAttribute("aria-label", `It was ${about.digits ? "a " : ""}${name}`);
  button.addEventListener("click", () => keep(label));
  return button;
}

// A name of one character is its own key; otherwise the first nine classes have the digits 1 to 9.
function keyOf(label) {
  if (about.classes.every((name) => /^[0-9]$/.test(name))) return about.classes[label];
  if (about.classes.every((name) => /^[0-9]+$/.test(name))) return null; // 1 is not the class 00
  return label < 9 ? String(label + 1) : null;
}

function scoreItem() {
  const item = document.createElement("li");
  item.innerHTML = '<span></span><span class="track"><div class="bar"></div></span>';
  return item;
}

$("search").addEventListener("input", () => {
  const sought = $("search").value.trim().toLocaleLowerCase();
  for (const [label, button] of [...$("labels").children].entries())
    button.hidden = !about.classes[label].toLocaleLowerCase().includes(sought);
});
$("search").addEventListener("keydown", (event) => {
  if (event.key !== "Enter") return;
  event.preventDefault();
  const label = classSought($("search").value.trim());
  if (label !== null) keep(label);
});

// The class of this name or, if there is none, the only one that contains it; null if there are several.
function classSought(typed) {
  const lower = (name) => name.toLocaleLowerCase();
  for (const fits of [
    (name) => name === typed,
    (name) => lower(name) === lower(typed),
    (name) => typed !== "" && lower(name).includes(lower(typed)),
  ]) {
    const labels = [...about.classes.keys()].filter((label) => fits(about.classes[label]));
    if (labels.length) return labels.length === 1 ? labels[0] : null;
  }
  return null;
}

// ---- input of the user

const pen = new Pen($("skin"), (points, now) => {
  if (!ready) return;
  for (const [at, right, down, , touches] of points) {
    if (!touches) {
      pen.lifted = true;
      continue;
    }
    if (pen.lifted !== false || !strokes.length) strokes.push(Object.assign([], { at })); // or the skin was cleared during a stroke
    pen.lifted = false;
    strokes.at(-1).push([right, down]);
  }
  if (points.length) {
    stale.skin = true;
    draw();
  }
  const touches = points.some((point) => point[4]);
  server.send({ type: "pen", now, points }, touches ? ["events", "problem"] : []);
});

// Whatever is asked of the server decides about the drawing: nothing saves it afterwards, and the rest of
// a stroke that has not ended is no other recording.
function ask(message, answers) {
  pen.lift();
  server.send(message, answers);
}

function keep(label) {
  if (!document.body.classList.contains("example")) ask({ type: "label", label }, ["saved", "problem"]);
}
const clear = () => ask({ type: "clear" });
const undo = () => ask({ type: "undo" });

$("clear").addEventListener("click", clear);
$("undo").addEventListener("click", undo);

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
  if (event.target.matches("input:not([type=checkbox]), select")) return;
  const label = about?.classes.findIndex((_, label) => keyOf(label) === event.key) ?? -1;
  if (label >= 0) keep(label);
  else if (event.key === "e") $("examples").requestSubmit();
  else if (event.key === "c" || event.key === "Escape") clear();
  else if (event.key === "u") undo();
});

$("examples").addEventListener("submit", (event) => {
  event.preventDefault();
  if ($("example").disabled) return;
  const label = $("example-class").value;
  ask({
    type: "example",
    now: performance.now(),
    label: label === "" ? null : Number(label),
  });
});

$("writer").addEventListener("change", () => {
  recalled = null;
  const chosen = $("writer").value;
  ask({ type: "writer", number: chosen === "new" ? null : Number(chosen) });
});

// ---- from the server

server.on("hello", (message) => {
  about = message;
  setSensor(about);
  describe();
  $("folder").textContent = about.folder;
  $("trained").textContent = `The network ${about.architecture} was trained on these recordings: ${about.trained_on}.`
    + (about.outdated ? ` ${about.outdated}.` : "");
  $("share").hidden = !about.shared;
  if (about.shared) $("qr").src = "qr.svg";
  forget();
  complain(describeLoss());
});

server.on("examples", (message) => {
  examples = message.counts;
  $("example").title = message.reason ? `No test samples: ${message.reason}` : "Key: e";
  showExamples();
});

server.on("ready", (network) => {
  ready = network;
  const neurons = network.layers.slice(1).reduce((sum, layer) => sum + layer.neurons, 0);
  $("lead").textContent =
    `A spiking network of ${neurons} neurons, computed as on the Loihi chip, reads the ${network.window_s === null ? "image" : "spikes"} of the touch${about.simulated ? " on a simulated sensor" : ""}.`;
  $("status").textContent = canDraw()
    ? about.digits ? "Ready: write with finger, pen or mouse."
      : `Ready: draw with finger, pen or mouse. This presses a simulated sensor of ${about.rows} x ${about.columns} taxels, not your sensor.`
    : "Ready: this sensor is too large for drawing; play examples instead.";
  $("meaning").textContent = network.threshold === null
    ? "“How sure” is the softmax of the outputs, which is no probability."
    : `“How sure” is estimated from the outputs and the time, on ${about.simulated && about.digits ? "simulated writers" : "recordings of the training"}.`;
  if (canDraw()) $("meaning").textContent += " Lifting the pen shakes the sensor, which can change the prediction.";
  $("meaning").textContent += ` Any other drawing is read as one of ${about.digits ? "the digits" : "these classes"}.`;
  showHint();
  pen.sensor = canDraw() ? about : null;
  document.body.classList.remove("offline");
  document.body.dataset.ready = "yes";
  showDecision(null);
  redraw();
});

server.on("cleared", (message) => {
  const started = strokes.filter((stroke) => stroke.at >= message.begun_ms); // received already
  forget();
  if (message.recording !== null && !message.example) strokes = started;
  recording = message.recording;
  if (recording === null) pen.settled = true; // no events will say so
  document.body.classList.toggle("example", Boolean(message.example));
  if (message.example) showExample(message.example);
  $("hint").classList.toggle("gone", recording !== null);
  $("status").classList.toggle("gone", recording !== null && about.digits); // else it says what is pressed
  $("told").textContent = message.example ? "An example cannot be saved." : "";
  unmark();
  complain(null);
});

function unmark() {
  for (const button of $("labels").children) button.removeAttribute("aria-pressed");
}

server.on("events", (message) => {
  if (message.recording !== recording) return;
  const now = performance.now();
  time = message.time_s - about.start_s;
  message.taxel.forEach((taxel, i) => {
    events.s.push(message.ns[i] * 1e-9 - about.start_s);
    events.taxel.push(taxel);
    events.polarity.push(message.polarity[i]);
    counts[taxel]++;
    flashes[taxel] ??= { on: -Infinity, off: -Infinity };
    flashes[taxel][message.polarity[i] > 0 ? "on" : "off"] = now;
  });
  if (message.settled) pen.settled = true;
  else pen.watch();
  if (message.settled && answer === null) showDecision(null); // without events, no answer will come
  const late = ready?.window_s != null && events.s.length && time > events.s[0] + ready.window_s;
  if (late && pen.writes && !hasWarned) {
    hasWarned = true;
    complain(`The network receives the first ${ready.window_s} s of a recording only: what you write now is saved, but does not count.`);
  }
  if (message.over && !isOver && !isKept) {
    isOver = true;
    complain("This recording has reached its maximum duration: press its class, or lift the pen and write again.");
  }
  stale.skin = stale.rest = true;
  draw();
});

server.on("answer", (message) => {
  if (message.recording !== recording) return;
  answer = message;
  stale.rest = true;
  draw();
});

server.on("spikes", (message) => {
  if (message.recording !== recording) return;
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  spikes = {
    seconds: message.seconds,
    chances: bytes(message.chances),
    layers: ready.layers.map(({ name, neurons }) => ({ name, neurons, packed: bytes(message.layers[name]) })),
  };
  stale.rest = true;
  draw();
});

server.on("saved", (message) => {
  isKept = true;
  $("undo").disabled = false;
  $("shown").dataset.label = message.label; // right or wrong
  showDecision(displayed);
  unmark();
  $("told").textContent = `Saved as ${nameClass(message.label)}: ${message.name}, ${count(message.events, "event")}. Undo takes that back.`;
  $(`label-${message.label}`).setAttribute("aria-pressed", "true");
  complain(null);
});

server.on("undone", (message) => {
  isKept = false; // the drawing can be saved again
  delete $("shown").dataset.label;
  showDecision(displayed);
  $("undo").disabled = true;
  $("told").textContent = `Removed ${nameClass(message.label)}: ${message.name}.`;
  unmark();
  complain(null);
});

server.on("writer", (state) => {
  const first = writer === null;
  writer = state;
  $("saved").textContent = state.saved;
  const numbers = [...new Set([...state.known, state.number])].sort((a, b) => a - b);
  $("writer").replaceChildren(
    ...numbers.map((number) => new Option(`Writer ${number}`, number, false, number === state.number)),
    new Option("new writer", "new"),
  );
  if (first) recallWriter();
  else if (recalled === null || recalled === state.number) {
    recalled = null;
    storeWriter(about.data_set, writer.number);
  }
});

server.on("problem", (message) => complain(message.text));

server.on("silent", () => complain("The server does not answer: what you have written or saved in the last seconds may be lost."));
server.on("heard", () => complain(null));

server.on("gone", ({ code, reason, opened }) => {
  ready = null;
  delete document.body.dataset.ready;
  document.body.classList.add("offline");
  $("status").textContent = "Not connected.";
  $("status").classList.remove("gone");
  if (code !== REFUSED && code !== TOO_MANY) // of these, the server has said the reason itself
    complain(opened
      ? `The server has ended or cannot be reached${reason ? ` (${reason})` : ""}. Saved recordings are safe; start 'stmnist live' again and open the address that it prints.`
      : "The page cannot open its connection to the server: the server has ended, or a proxy or an extension of the browser blocks WebSockets. The page tries again by itself.");
  // Without the first message the page is as it was loaded, and reloading it would change nothing.
  if (code !== REFUSED) setTimeout(about === null ? () => server.connect() : comeBack, AGAIN_MS);
});

// The server can be reached again, for example after the machine has slept: reload, same writer.
async function comeBack() {
  try {
    if (!(await fetch(location.href)).ok) return; // another server, with another token
  } catch {
    setTimeout(comeBack, AGAIN_MS);
    return;
  }
  if (recording !== null && !isKept) storeLoss();
  location.reload();
}

// What the page has to say of the time before it was loaded again.
function describeLoss() {
  return takeLoss()
    ? "The connection was lost, and with it the drawing on the sensor. If you had just pressed its class, look at the number of saved recordings; otherwise write it again."
    : null;
}

function recallWriter() {
  recalled = readWriter(about.data_set); // earlier states are of the writer that every connection begins with
  server.send({ type: "writer", number: recalled });
}

// ---- what is shown

function complain(text) {
  $("problem").hidden = text === null;
  if (text !== null) $("problem-text").textContent = text[0].toUpperCase() + text.slice(1);
}
$("dismiss").addEventListener("click", () => complain(null));

// For screen readers: one sentence when the pen is lifted, not one per event.
function announce() {
  if (pen.settled && !pen.writes && $("decision").textContent !== "")
    $("announce").textContent = `Decision: ${$("decision").textContent}, ${$("confidence").textContent}`;
}

function nameClass(label) {
  const name = about.classes[label];
  return about.digits ? `${name === "8" ? "an" : "a"} ${name}` : name;
}

function showExamples() {
  for (const option of [...$("example-class").options].slice(1))
    option.disabled = examples[Number(option.value)] === 0;
  if ($("example-class").selectedOptions[0].disabled) $("example-class").value = "";
  $("example").disabled = !examples.some((n) => n > 0);
}

function showExample(example) {
  isKept = true;
  $("shown").textContent = `${about.simulated ? "Test sample" : "Recorded test sample"} ${example.name}: it is ${nameClass(example.label)}.`;
  $("shown").dataset.label = example.label;
  pen.watch();
}

// The verdict is the early decision, or else the answer at the end of the writing; until then the answer
// so far is shown as open.
function showDecision(message) {
  if (about === null) return;
  const truth = $("shown").dataset.label;
  const view = describeDecision(message, {
    classes: about.classes, digits: about.digits, pauseS: about.pause_s, threshold: ready?.threshold ?? null,
    truth: truth === undefined ? null : Number(truth),
    settled: pen.settled, writes: pen.writes, strokes, canDraw: canDraw(), nameClass,
  });
  const output = $("decision");
  output.textContent = view.text;
  output.dataset.events = message === null ? 0 : message.events; // to which it is the answer
  output.classList.toggle("open", view.open);
  output.classList.toggle("right", view.mark === "right");
  output.classList.toggle("wrong", view.mark === "wrong");
  $("confidence").textContent = view.confidence;
  $("decided").textContent = view.statement;
  $("decided").classList.toggle("changed", view.retracted);
  $("decided").dataset.s = view.seconds;
  showScores(message, view.text);
}

// The shares of the classes; if there are more than bars, of those with the highest shares.
function showScores(message, decided) {
  const items = [...$("scores").children];
  const hasMeaning = message !== null && !message.exceeds_training; // of the bars
  const shares = hasMeaning ? message.shares : about.classes.map(() => 0);
  const hasMore = about.classes.length > items.length;
  const labels = [...about.classes.keys()];
  if (hasMore) labels.sort((a, b) => shares[b] - shares[a]);
  items.forEach((item, i) => {
    const label = labels[i];
    item.style.visibility = hasMore && !(shares[label] >= 0.001) ? "hidden" : "";
    item.firstChild.textContent = about.classes[label];
    item.classList.toggle("best", message !== null && decided === about.classes[label]);
    item.lastChild.firstChild.style.transform = `scaleX(${shares[label]})`;
  });
}

let drawing = false;
let displayed = null; // the answer that is displayed
function draw() {
  if (drawing) return;
  drawing = true;
  requestAnimationFrame(() => {
    drawing = false;
    if (stale.skin) stale.skin = drawSkin($("skin"), strokes, counts, flashes, performance.now());
    if (stale.rest) {
      stale.rest = false;
      if (answer !== null && answer !== displayed) {
        displayed = answer;
        showDecision(answer);
        announce();
        afterPaint(answer.last_ms);
      }
      $("race").dataset.events = events.taxel.length;
      if (ready) drawRace($("race"), {
        events, time, classes: about.classes, steps: ready.steps, firstStep: ready.first_step,
        windowS: ready.window_s, usualS: ready.usual_s, threshold: ready.threshold, verdict: displayed?.verdict ?? null,
        ...(spikes ?? { seconds: [], chances: [], layers: ready.layers.map((layer) => ({ ...layer, packed: [] })) }),
      });
    }
    if (stale.skin) draw();
  });
}

// A message that the page sends to itself arrives after the frame has been painted.
const painted = new MessageChannel();
painted.port1.onmessage = ({ data: last }) => {
  if (last === null || last <= lastCounted) return; // no new event since the answer before
  lastCounted = last;
  latencies.push(performance.now() - last);
  if (latencies.length > 2000) latencies.splice(0, 1000);
  const sorted = latencies.toSorted((a, b) => a - b);
  const median = sorted[Math.floor(sorted.length / 2)];
  $("latency").textContent =
    `From the last event to the decision on this screen: ${median.toFixed(0)} ms (median of the last ${sorted.length} answers).`;
  $("latency").dataset.median = median.toFixed(2);
  $("latency").dataset.ninetieth = sorted[Math.floor(0.9 * sorted.length)].toFixed(2);
  $("latency").dataset.count = sorted.length;
};
function afterPaint(last) {
  painted.port2.postMessage(last);
}

function redraw() {
  stale.skin = stale.rest = true;
  draw();
}
addEventListener("resize", redraw);
onColours(redraw);
forget();
