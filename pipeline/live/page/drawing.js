// What is drawn on canvases. Colours come from the style sheet, so that dark is dark here too.

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

// Taxel addresses run down the columns.
const row = (taxel) => taxel % 10;
const column = (taxel) => Math.floor(taxel / 10);

// Returns whether something on it still moves.
export function drawSkin(canvas, strokes, flashes, now) {
  const { context, width } = fitted(canvas);
  const cell = width / 10;
  let moves = false;
  context.fillStyle = colour("--rest");
  for (let taxel = 0; taxel < 100; taxel++) {
    context.beginPath();
    context.arc((column(taxel) + 0.5) * cell, (row(taxel) + 0.5) * cell, cell * 0.07, 0, 7);
    context.fill();
  }
  context.strokeStyle = colour("--trace");
  context.lineWidth = cell * 0.5;
  context.lineCap = context.lineJoin = "round";
  for (const stroke of strokes) {
    context.beginPath();
    for (const [right, down] of stroke) context.lineTo((right + 0.5) * cell, (down + 0.5) * cell);
    if (stroke.length === 1) context.lineTo((stroke[0][0] + 0.5) * cell, (stroke[0][1] + 0.5) * cell);
    context.stroke();
  }
  flashes.forEach(({ on, off }, taxel) => {
    const [x, y] = [(column(taxel) + 0.5) * cell, (row(taxel) + 0.5) * cell];
    for (const [since, name] of [[on, "--on"], [off, "--off"]]) {
      let left = 1 - (now - since) / FLASH_MS;
      if (since === -Infinity) continue;
      if (still.matches) left = name === (on > off ? "--on" : "--off") ? 1 : 0; // the last one stays
      else if (left > 0) moves = true;
      if (left <= 0) continue;
      context.globalAlpha = Math.min(1, 1.4 * left);
      context.beginPath();
      if (name === "--on") {
        context.fillStyle = colour(name);
        context.arc(x, y, cell * 0.22, 0, 7);
        context.fill();
      } else {
        context.strokeStyle = colour(name);
        context.lineWidth = cell * 0.09;
        context.arc(x, y, cell * 0.34, 0, 7);
        context.stroke();
      }
      context.globalAlpha = 1;
    }
  });
  return moves;
}

// Only what is new, as long as everything else stands where it stood.
const raster = { key: null, drawn: 0 };
export function drawRaster(canvas, events, time, afresh) {
  const last = time > 4 ? 10 : time > 2 ? 4 : 2;
  const key = `${last} ${canvas.clientWidth} ${canvas.clientHeight} ${devicePixelRatio}`;
  if (afresh || key !== raster.key || events.taxel.length < raster.drawn) {
    Object.assign(raster, { key, drawn: 0 });
    drawAxes(canvas, last);
  }
  const context = canvas.getContext("2d");
  const { x, tall } = scales(canvas, last);
  for (const [polarity, name] of [[-1, "--off"], [1, "--on"]]) {
    context.fillStyle = colour(name);
    for (let i = raster.drawn; i < events.taxel.length; i++) {
      if (events.polarity[i] !== polarity) continue;
      // ON stands, OFF lies: told apart without colour.
      const [wide, high] = polarity > 0 ? [2, Math.max(1.4 * tall, 4)] : [4, Math.max(0.7 * tall, 2)];
      context.fillRect(x(events.ns[i] * 1e-9), (events.taxel[i] + 0.5) * tall - high / 2, wide, high);
    }
  }
  raster.drawn = events.taxel.length;
}

function scales(canvas, last) {
  const [left, below] = [4, 20];
  const { clientWidth: width, clientHeight: height } = canvas;
  const x = (seconds) => left + (seconds / last) * (width - 2 * left);
  return { left, below, x, tall: (height - below) / 100 };
}

function drawAxes(canvas, last) {
  const { context, width, height } = fitted(canvas);
  const { left, below, x } = scales(canvas, last);
  context.fillStyle = colour("--paper");
  context.fillRect(left, 0, width - 2 * left, height - below);
  context.font = "12px system-ui, sans-serif";
  context.textAlign = "center";
  for (let tick = 0; tick <= last; tick += last / 4) {
    context.fillStyle = colour("--line");
    context.fillRect(x(tick) - 0.5, 0, 1, height - below);
    context.fillStyle = colour("--soft");
    context.textAlign = tick === 0 ? "left" : tick === last ? "right" : "center";
    context.fillText(`${tick} s`, x(tick), height - 5);
  }
}

export function drawImage(canvas, counts) {
  const { context, width } = fitted(canvas);
  const cell = width / 10;
  const most = Math.max(1, ...counts);
  context.fillStyle = colour("--paper");
  context.fillRect(0, 0, width, width);
  context.fillStyle = colour("--on");
  counts.forEach((count, taxel) => {
    context.globalAlpha = count / most;
    context.fillRect(column(taxel) * cell, row(taxel) * cell, cell + 0.5, cell + 0.5);
  });
  context.globalAlpha = 1;
  context.strokeStyle = colour("--line");
  context.lineWidth = 1;
  context.strokeRect(0.5, 0.5, width - 1, width - 1);
}

// rows: for each step the spikes of eight neurons a byte; returns how many there are.
export function drawLayer(canvas, rows, neurons, steps, firstStep) {
  const { context, width, height } = fitted(canvas);
  const wide = width / steps;
  const tall = height / neurons;
  const bytes = rows.length / steps;
  let spikes = 0;
  context.fillStyle = colour("--panel");
  context.fillRect(0, 0, -firstStep * wide, height);
  context.fillStyle = colour("--ink");
  for (let step = 0; step < steps; step++)
    for (let place = 0; place < bytes; place++) {
      const eight = rows[step * bytes + place];
      if (eight === 0) continue;
      for (let bit = 0; bit < 8; bit++)
        if (eight & (128 >> bit)) {
          spikes++;
          context.fillRect(step * wide, (8 * place + bit) * tall, Math.max(wide * 0.8, 1), Math.max(tall, 1));
        }
    }
  return spikes;
}
