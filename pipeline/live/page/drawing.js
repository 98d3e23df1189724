// Drawings on canvases. Colours come from the style sheet, also in dark mode.

export const still = matchMedia("(prefers-reduced-motion: reduce)");
const dark = matchMedia("(prefers-color-scheme: dark)");
const FLASH_MS = 350;

let colours = null;
function colour(name) {
  colours ??= getComputedStyle(document.documentElement);
  return colours.getPropertyValue(name).trim();
}

export function onColours(redraw) {
  dark.addEventListener("change", () => {
    colours = null;
    redraw();
  });
}

// A context as large as the canvas is on the screen, in CSS pixels.
function fitted(canvas) {
  const scale = devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  const context = canvas.getContext("2d");
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

// The sensor: taxels are counted down the columns.
let rows = 10;
let columns = 10;
export function setSensor(sensor) {
  ({ rows, columns } = sensor);
}
const row = (taxel) => taxel % rows;
const column = (taxel) => Math.floor(taxel / rows);
const DOTS = 4096; // maximum number of taxels that are drawn at rest; more would not be visible

// Returns whether the drawing still changes.
export function drawSkin(canvas, strokes, counts, flashes, now) {
  const { context, width, height } = fitted(canvas);
  const [wide, high] = [width / columns, height / rows];
  const cell = Math.min(wide, high);
  const place = (taxel) => [(column(taxel) + 0.5) * wide, (row(taxel) + 0.5) * high];
  let moves = false;
  if (!strokes.length) fillTaxels(context, counts, wide, high, 0.3); // an example has no strokes
  context.fillStyle = colour("--rest");
  if (flashes.length <= DOTS)
    for (let taxel = 0; taxel < flashes.length; taxel++) {
      context.beginPath();
      context.arc(...place(taxel), Math.max(cell * 0.07, 0.7), 0, 7);
      context.fill();
    }
  context.strokeStyle = colour("--trace");
  context.lineWidth = cell * 0.5;
  context.lineCap = context.lineJoin = "round";
  for (const stroke of strokes) {
    context.beginPath();
    for (const [right, down] of stroke) context.lineTo((right + 0.5) * wide, (down + 0.5) * high);
    if (stroke.length === 1) context.lineTo((stroke[0][0] + 0.5) * wide, (stroke[0][1] + 0.5) * high);
    context.stroke();
  }
  flashes.forEach((flash, taxel) => {
    if (flash === null) return;
    const { on, off } = flash;
    for (const [since, name] of [[on, "--on"], [off, "--off"]]) {
      let left = 1 - (now - since) / FLASH_MS;
      if (since === -Infinity) continue;
      if (still.matches) left = name === (on > off ? "--on" : "--off") ? 1 : 0; // the last colour remains
      else if (left > 0) moves = true;
      if (left <= 0) continue;
      context.globalAlpha = Math.min(1, 1.4 * left);
      context.beginPath();
      if (name === "--on") {
        context.fillStyle = colour(name);
        context.arc(...place(taxel), cell * 0.22, 0, 7);
        context.fill();
      } else {
        context.strokeStyle = colour(name);
        context.lineWidth = cell * 0.09;
        context.arc(...place(taxel), cell * 0.34, 0, 7);
        context.stroke();
      }
      context.globalAlpha = 1;
    }
  });
  return moves;
}

const SPANS = [2, 4, 10, 20, 60]; // lengths of a time axis in seconds
const SPARE = 1.03; // a network's presentation of 2 s ends a little later, as it begins with the first event
// The last mark of a time axis, and its end.
function span(time) {
  const mark = SPANS.find((seconds) => time <= SPARE * seconds) ?? time;
  return { mark, end: Math.max(mark, time) };
}
const [LEFT, BELOW] = [4, 20];
const across = (canvas, end, left = LEFT) => (seconds) =>
  left + (seconds / end) * (canvas.clientWidth - left - LEFT);

// Draws only new events, as long as the others do not move.
const raster = { key: null, drawn: 0 };
export function drawRaster(canvas, events, time, afresh) {
  const { mark, end } = span(time);
  const key = `${end} ${canvas.clientWidth} ${canvas.clientHeight} ${devicePixelRatio}`;
  if (afresh || key !== raster.key || events.taxel.length < raster.drawn) {
    Object.assign(raster, { key, drawn: 0 });
    drawAxes(canvas, mark, end);
  }
  const context = canvas.getContext("2d");
  const x = across(canvas, end);
  const tall = (canvas.clientHeight - BELOW) / (rows * columns);
  for (const [polarity, name] of [[-1, "--off"], [1, "--on"]]) {
    context.fillStyle = colour(name);
    for (let i = raster.drawn; i < events.taxel.length; i++) {
      if (events.polarity[i] !== polarity) continue;
      // ON is upright, OFF horizontal: distinguishable without colour.
      const [wide, high] = polarity > 0 ? [2, Math.max(1.4 * tall, 4)] : [4, Math.max(0.7 * tall, 2)];
      context.fillRect(x(events.s[i]), (events.taxel[i] + 0.5) * tall - high / 2, wide, high);
    }
  }
  raster.drawn = events.taxel.length;
}

function drawAxes(canvas, mark, end, left = LEFT) {
  const { context, width, height } = fitted(canvas);
  const x = across(canvas, end, left);
  context.fillStyle = colour("--paper");
  context.fillRect(left, 0, width - left - LEFT, height - BELOW);
  context.font = "12px system-ui, sans-serif";
  for (let tick = 0; tick <= mark; tick += mark / 4) {
    context.fillStyle = colour("--line");
    context.fillRect(x(tick) - 0.5, 0, 1, height - BELOW);
    context.fillStyle = colour("--soft");
    context.textAlign = tick === 0 ? "left" : tick === mark ? "right" : "center";
    context.fillText(`${tick} s`, x(tick), height - 5);
  }
  return { context, x, width, height };
}

// answer: of the network, or null; threshold: null if it decides at the end.
export function drawCurve(canvas, answer, threshold, time) {
  const left = 44;
  const { mark, end } = span(time);
  const { context, x, width, height } = drawAxes(canvas, mark, end, left);
  const y = (share) => 4 + (1 - share) * (height - BELOW - 4);
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (const share of [0, 0.5, 1]) {
    context.fillStyle = colour("--line");
    context.fillRect(left, y(share) - 0.5, width - left - LEFT, 1);
    context.fillStyle = colour("--soft");
    context.fillText(`${100 * share} %`, left - 4, Math.max(y(share), 7));
  }
  context.textBaseline = "alphabetic";
  if (threshold !== null) {
    context.strokeStyle = colour("--off");
    context.lineWidth = 1.5;
    context.setLineDash([6, 4]);
    context.beginPath();
    context.moveTo(left, y(threshold));
    context.lineTo(width - LEFT, y(threshold));
    context.stroke();
    context.setLineDash([]);
  }
  if (answer === null) return;
  const [seconds, values] = answer.curve;
  context.strokeStyle = context.fillStyle = colour("--on");
  context.lineWidth = 2;
  context.beginPath();
  seconds.forEach((at, i) => context.lineTo(x(at), y(values[i])));
  context.stroke();
  context.beginPath();
  context.arc(x(seconds.at(-1)), y(values.at(-1)), 3, 0, 7);
  context.fill();
  if (answer.decided === null) return;
  const at = x(answer.decided.s);
  context.fillStyle = colour("--ink");
  context.fillRect(at - 1, y(1), 2, y(0) - y(1));
  context.textAlign = at > width / 2 ? "right" : "left";
  context.fillText(`${answer.decided.s.toFixed(2)} s`, at + (at > width / 2 ? -5 : 5), y(0) - 5);
}

export function drawImage(canvas, counts) {
  const { context, width, height } = fitted(canvas);
  context.fillStyle = colour("--paper");
  context.fillRect(0, 0, width, height);
  fillTaxels(context, counts, width / columns, height / rows, 1);
  context.strokeStyle = colour("--line");
  context.lineWidth = 1;
  context.strokeRect(0.5, 0.5, width - 1, height - 1);
}

function fillTaxels(context, counts, wide, high, opacity) {
  const most = counts.reduce((a, b) => Math.max(a, b), 1);
  context.fillStyle = colour("--on");
  counts.forEach((count, taxel) => {
    if (count === 0) return;
    context.globalAlpha = (opacity * count) / most;
    context.fillRect(column(taxel) * wide, row(taxel) * high, wide + 0.5, high + 0.5);
  });
  context.globalAlpha = 1;
}

// packed: spikes of each step, eight neurons per byte; returns the number of spikes.
export function drawLayer(canvas, packed, neurons, steps, firstStep) {
  const { context, width, height } = fitted(canvas);
  const wide = width / steps;
  const tall = height / neurons;
  const bytes = packed.length / steps;
  let spikes = 0;
  context.fillStyle = colour("--panel");
  context.fillRect(0, 0, -firstStep * wide, height);
  context.fillStyle = colour("--ink");
  for (let step = 0; step < steps; step++)
    for (let place = 0; place < bytes; place++) {
      const eight = packed[step * bytes + place];
      if (eight === 0) continue;
      for (let bit = 0; bit < 8; bit++)
        if (eight & (128 >> bit)) {
          spikes++;
          context.fillRect(step * wide, (8 * place + bit) * tall, Math.max(wide * 0.8, 1), Math.max(tall, 1));
        }
    }
  return spikes;
}
