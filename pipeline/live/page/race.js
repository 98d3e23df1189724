// The drawing of everything on one time axis: events of the sensor, spikes of each layer, how sure the network is.

import { colour, columnOf, count, fitCanvas, rowOf, sensor } from "./drawing.js";

const rowByRow = (taxel) => rowOf(taxel) * sensor.columns + columnOf(taxel); // the order of the network's input
const SPANS = [0.1, 0.2, 0.5, 1, 2, 4, 10, 20, 60]; // lengths of a time axis in seconds
const spanOf = (seconds) => SPANS.find((span) => seconds <= span * 1.001) ?? seconds;
const [LEFT, BELOW, ABOVE, GAP] = [10, 36, 18, 5];
const LINES = ["--s1", "--s2", "--s3", "--s4"];
const DASHES = [[], [7, 3], [2, 3], [9, 3, 2, 3]]; // as in the report, for those who do not see the colours
const FONT = "13px system-ui, sans-serif"; // of a page whose text has 16 pixels

// Everything on one time axis: events of the sensor, spikes of each layer, how sure the network is of
// the likeliest classes; the end of what the network receives, and the decision as a line.
// race: { events, time, layers: [{name, neurons, packed}], steps, firstStep, windowS, usualS, seconds, chances,
//         threshold, classes, verdict }
// A network on images is presented the image so far again and again: its spikes have an axis of their own.
export function drawRace(canvas, drawn) {
  const { context, width: wide, height: tall } = fitCanvas(canvas);
  const scale = parseFloat(getComputedStyle(document.body).fontSize) / 16;
  context.scale(scale, scale);
  const [width, height] = [wide / scale, tall / scale];
  const onEvents = drawn.windowS !== null;
  const start = drawn.events.s[0] ?? 0; // the network's time begins with the first event
  const isSlow = onEvents && drawn.events.s.at(-1) > start + drawn.usualS; // slower than the recordings of the training
  const usual = isSlow ? drawn.seconds.filter((at) => at <= start + drawn.usualS) : drawn.seconds;
  const race = { ...drawn, seconds: usual }; // confidence has no meaning after that
  const window = onEvents ? start + race.windowS : Infinity;
  const end = onEvents ? Math.max(start + race.usualS, race.time) : spanOf(Math.max(race.time, 1));
  context.font = FONT;
  const names = race.classes.map((name) => context.measureText(name.slice(0, 12)).width);
  const right = Math.max(...names) + 20;
  const curves = race.seconds.length ? curvesOf(race) : [];
  const lane = width - LEFT - right;
  const x = (seconds) => LEFT + (seconds / end) * lane;
  const at = race.verdict ? x(Math.min(race.verdict.seconds, end)) : null; // the line of the verdict
  const parts = ["touch", ...race.layers, "sure"];
  const free = height - BELOW - parts.length * (ABOVE + GAP);
  const weights = parts.map((part) => (part === "sure" ? 2 : 1));
  const unit = free / weights.reduce((a, b) => a + b);
  let top = 0;
  parts.forEach((part, i) => {
    const [y, high] = [top + ABOVE, unit * weights[i]];
    top = y + high + GAP;
    context.fillStyle = colour("--paper");
    context.fillRect(LEFT, y, lane, high);
    context.save();
    context.beginPath();
    context.rect(LEFT, top - high - ABOVE - GAP, lane, high + ABOVE + 1); // recordings may last longer than the axis
    context.clip();
    if (!race.events.s.length && high > 20) explain(context, part, lane, y + high / 2);
    if (part === "touch") drawEvents(context, race, x, y, high, lane);
    else if (part === "sure") drawSureness(context, race, curves, x, y, high, lane);
    else drawSpikes(context, part, race, onEvents ? x : null, y, high, lane);
    if (race.verdict && (onEvents || typeof part === "string")) drawVerdict(context, at, y, high);
    context.restore();
    if (part === "sure") nameCurves(context, race, curves, LEFT + lane + 6, y, high);
  });
  const bottom = top - GAP;
  context.font = FONT;
  const mark = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10].find((step) => end <= step * Math.min(5, lane / 45)) ?? end / 5;
  for (let tick = 0; tick <= end * 1.001; tick += mark) {
    context.fillStyle = colour("--soft");
    context.textAlign = tick === 0 ? "left" : tick > end - mark / 4 ? "right" : "center";
    if (at === null || Math.abs(x(tick) - at) >= 22) context.fillText(`${+tick.toFixed(3)} s`, x(tick), bottom + 16);
    context.fillStyle = colour("--line");
    context.fillRect(x(tick), bottom, 1, 4);
  }
  if (isSlow) {
    context.strokeStyle = context.fillStyle = colour("--soft");
    context.lineWidth = 1;
    context.setLineDash([4, 4]);
    context.beginPath();
    context.moveTo(x(start + race.usualS), ABOVE);
    context.lineTo(x(start + race.usualS), bottom);
    context.stroke();
    context.setLineDash([]);
    labelUsualEnd(context, x(start + race.usualS), x(end), ABOVE + 14);
  }
  if (end > window) { // what the network does not receive
    context.fillStyle = colour("--note");
    context.globalAlpha = 0.75;
    context.fillRect(x(window), ABOVE, x(end) - x(window), bottom - ABOVE);
    context.globalAlpha = 1;
    context.fillStyle = colour("--note-ink");
    context.textAlign = "left";
    context.fillText("not received", x(window) + 4, ABOVE + 32);
  }
  if (race.verdict) {
    const { early, seconds } = race.verdict;
    context.fillStyle = colour("--ink");
    context.fillRect(at - 1, bottom, 2, 20);
    context.textAlign = at > width / 2 ? "right" : "left";
    context.fillText(early ? `decided after ${seconds.toFixed(2)} s` : "end of the recording", at, height - 4);
  }
}

// At the line where the recordings of the training end: the first text that fits beside it.
function labelUsualEnd(context, at, end, y) {
  const wide = (text) => context.measureText(text).width;
  const textAfter = ["slower than in training", "too slow"].find((text) => wide(text) + 8 <= end - at);
  const text = textAfter ?? "usual time";
  const left = textAfter ? at + 4 : at - 4 - wide(text);
  context.fillStyle = colour("--paper"); // the events below it would make it illegible
  context.fillRect(left - 2, y - 13, wide(text) + 4, 17);
  context.fillStyle = colour("--soft");
  context.textAlign = "left";
  context.fillText(text, left, y);
}

// The time of the decision as a line.
function drawVerdict(context, at, y, high) {
  context.fillStyle = colour("--ink");
  context.fillRect(at - 1, y, 2, high);
}

// Above a panel: the first text that is not wider than the panel, or the last one.
function caption(context, y, lane, ...texts) {
  context.font = FONT;
  context.fillStyle = colour("--soft");
  context.textAlign = "left";
  context.fillText(texts.find((text) => context.measureText(text).width <= lane) ?? texts.at(-1), LEFT, y - 5);
}

// The height of a share in a panel, in which those near 1 are seen.
const rise = (share, high) => high * (1 - share / 1.06);

// What will be seen, before there is anything to see.
function explain(context, part, lane, y) {
  context.font = FONT;
  context.fillStyle = colour("--soft");
  context.textAlign = "center";
  const [row, dot] = part === "touch" ? ["taxel", "event"] : [part.name === "input" ? "line" : "neuron", "spike"];
  const text = part === "sure" ? "a curve for each of the likeliest classes" : `a row for each ${row}, a dot for each ${dot}`;
  if (context.measureText(text).width <= lane) context.fillText(text, LEFT + lane / 2, y + 4);
}

function drawEvents(context, { events }, x, y, high, lane) {
  const taxels = sensor.rows * sensor.columns;
  const order = sensor.rows > 1 && sensor.columns > 1 ? " row by row" : "";
  caption(context, y, lane, `the touch: ${taxels} taxels${order}, ${count(events.s.length, "event")}`, `${taxels} taxels, ${count(events.s.length, "event")}`, `${taxels} taxels`);
  const tall = Math.max(high / taxels, 1.5);
  for (const [polarity, name] of [[-1, "--off"], [1, "--on"]]) {
    context.fillStyle = colour(name);
    for (let i = 0; i < events.s.length; i++)
      if (events.polarity[i] === polarity)
        context.fillRect(x(events.s[i]), y + ((rowByRow(events.taxel[i]) + 0.5) * high) / taxels, 2, tall);
  }
}

// packed: spikes of each step, eight neurons per byte; x is null where the steps have an axis of their own.
function drawSpikes(context, { name, neurons, packed }, race, x, y, high, lane) {
  const { steps, firstStep, windowS, events } = race;
  const presentedSteps = steps + firstStep; // firstStep is negative: the network rests before the presentation
  const xOf = (step) => x === null
    ? LEFT + (step / presentedSteps) * lane
    : x((events.s[0] ?? 0) + (step / presentedSteps) * windowS);
  const tall = Math.max(high / neurons, 1.5);
  const bytes = packed.length / steps;
  let spikes = 0;
  context.fillStyle = colour("--ink");
  for (let step = -firstStep; step < steps; step++)
    for (let at = 0; at < bytes; at++) {
      const eight = packed[step * bytes + at];
      if (eight === 0) continue;
      for (let bit = 0; bit < 8; bit++)
        if (eight & (128 >> bit)) {
          spikes++;
          context.fillRect(xOf(step + firstStep), y + ((8 * at + bit) * high) / neurons, 2, tall);
        }
    }
  const axis = x === null ? `; across: the ${presentedSteps} steps of the last presentation` : "";
  const unit = name === "input" ? "lines" : "neurons";
  caption(context, y, lane, `${name}: ${neurons} ${unit}, ${count(spikes, "spike")}${axis}`, `${name}: ${neurons} ${unit}, ${count(spikes, "spike")}`, `${name}: ${neurons} ${unit}`, name);
}

// The decided class and its strongest rivals, at the decision and then at any time; before, the likeliest ones now.
function curvesOf({ seconds, chances, classes, verdict }) {
  const largest = classes.map((_, label) => seconds.reduce((share, _, step) => Math.max(share, chances[step * classes.length + label]), 0));
  const step = verdict ? seconds.findLastIndex((at) => at <= verdict.seconds + 1e-4) : seconds.length - 1;
  const rank = (label) => (label === verdict?.label ? 1000 : chances[Math.max(step, 0) * classes.length + label] + largest[label] / 1000);
  const top = [...classes.keys()].sort((a, b) => rank(b) - rank(a)).slice(0, LINES.length);
  lines = lines.map((label) => (top.includes(label) ? label : null));
  for (const label of top) if (!lines.includes(label)) lines[lines.indexOf(null)] = label;
  return top;
}

// The class of each colour: a class keeps its colour as long as it is drawn.
let lines = LINES.map(() => null);
const lineOf = (label) => colour(LINES[lines.indexOf(label)]);

function drawSureness(context, race, curves, x, y, high, lane) {
  const { seconds, chances, threshold, classes, verdict } = race;
  const decides = `decides at ${(100 * threshold).toFixed(1)} %`;
  if (threshold === null) caption(context, y, lane, "softmax of the outputs, 0 to 100 %", "softmax");
  else caption(context, y, lane, `how sure, 0 to 100 %; dotted: ${decides}`, `how sure; dotted: ${(100 * threshold).toFixed(1)} %`, "how sure");
  if (!seconds.length) return;
  context.fillStyle = colour("--line");
  for (const share of [0.5, 1]) context.fillRect(LEFT, y + rise(share, high), lane, 1);
  curves.forEach((label, i) => {
    context.strokeStyle = lineOf(label);
    context.lineWidth = i === 0 ? 2.5 : 1.4;
    context.setLineDash(DASHES[lines.indexOf(label)]);
    context.beginPath();
    seconds.forEach((at, step) => context.lineTo(x(at), y + rise(chances[step * classes.length + label] / 255, high)));
    context.stroke();
    context.setLineDash([]);
  });
  if (verdict && verdict.seconds <= seconds.at(-1) + 1e-3) {
    context.fillStyle = lineOf(verdict.label);
    context.beginPath();
    context.arc(x(verdict.seconds), y + rise(verdict.confidence, high), 5, 0, 7);
    context.fill();
  }
  if (threshold === null) return;
  context.strokeStyle = colour("--ink");
  context.lineWidth = 1.5;
  context.setLineDash([1, 3]);
  context.beginPath();
  context.moveTo(LEFT, y + rise(threshold, high));
  context.lineTo(LEFT + lane, y + rise(threshold, high));
  context.stroke();
}

// Names at the ends of the curves, moved apart where they would cover each other.
function nameCurves(context, { seconds, chances, classes }, curves, left, y, high) {
  const last = (seconds.length - 1) * classes.length;
  const ends = curves.map((label, i) => ({ label, i, at: y + rise(chances[last + label] / 255, high) }));
  ends.sort((a, b) => b.at - a.at || b.i - a.i); // from below
  let free = y + high + 4;
  context.textAlign = "left";
  for (const { label, at } of ends) {
    const baseline = Math.min(at + 4, free);
    free = baseline - 13;
    context.fillStyle = context.strokeStyle = lineOf(label);
    context.lineWidth = 1; // from the curve to its name
    context.beginPath();
    context.moveTo(left - 6, at);
    context.lineTo(left + 4, baseline - 4);
    context.stroke();
    context.fillText(classes[label].slice(0, 12), left + 6, baseline);
  }
}
