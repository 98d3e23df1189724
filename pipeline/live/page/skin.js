// The drawing of the sensor: strokes, events as flashes, and how often each taxel has reported.

import { colour, columnOf, fitCanvas, rowOf, sensor, still } from "./drawing.js";

const FLASH_MS = 350;
const DOTS = 4096; // maximum number of taxels that are drawn at rest; more would not be visible

// Returns whether the drawing still changes.
export function drawSkin(canvas, strokes, counts, flashes, now) {
  const { context, width, height } = fitCanvas(canvas);
  const { rows, columns, positions } = sensor;
  const [wide, high] = [width / columns, height / rows];
  const isInPlace = positions && !strokes.length; // an example has no strokes
  const size = 0.88 * Math.min(width, height);
  const cell = isInPlace ? size / Math.sqrt(positions.length) : Math.min(wide, high);
  const middle = (axis) => Math.max(...positions.map((position) => position[axis])) / 2;
  const [right, down] = isInPlace ? [width / 2 - size * middle(0), height / 2 - size * middle(1)] : [0, 0];
  const centreOf = isInPlace
    ? (taxel) => [right + size * positions[taxel][0], down + size * positions[taxel][1]]
    : (taxel) => [(columnOf(taxel) + 0.5) * wide, (rowOf(taxel) + 0.5) * high];
  if (isInPlace) fillDots(context, counts, centreOf, cell * 0.3);
  else fillTaxels(context, counts, wide, high, 0.6);
  context.fillStyle = colour("--soft");
  if (flashes.length <= DOTS)
    for (let taxel = 0; taxel < flashes.length; taxel++) {
      context.beginPath();
      context.arc(...centreOf(taxel), Math.max(cell * 0.07, 0.7), 0, 7);
      context.fill();
    }
  drawStrokes(context, strokes, wide, high, cell);
  return drawFlashes(context, flashes, centreOf, cell, now);
}

function drawStrokes(context, strokes, wide, high, cell) {
  context.globalAlpha = 0.25;
  context.strokeStyle = context.fillStyle = colour("--ink");
  context.lineWidth = cell * 0.3;
  context.lineCap = context.lineJoin = "round";
  for (const stroke of strokes) {
    context.beginPath();
    for (const [right, down] of stroke) context.lineTo((right + 0.5) * wide, (down + 0.5) * high);
    context.stroke();
    if (stroke.length > 1) continue;
    context.arc((stroke[0][0] + 0.5) * wide, (stroke[0][1] + 0.5) * high, cell * 0.25, 0, 7); // a tap
    context.fill();
  }
  context.globalAlpha = 1;
}

// Returns whether a flash is fading.
function drawFlashes(context, flashes, centreOf, cell, now) {
  let moves = false;
  flashes.forEach((flash, taxel) => {
    if (flash === null) return;
    const { on, off } = flash;
    for (const [since, name] of [[on, "--on"], [off, "--off"]]) {
      let strength = 1 - (now - since) / FLASH_MS;
      if (since === -Infinity) continue;
      if (still.matches) strength = name === (on > off ? "--on" : "--off") ? 1 : 0; // the last colour remains
      else if (strength > 0) moves = true;
      if (strength <= 0) continue;
      context.globalAlpha = Math.min(1, 1.4 * strength);
      context.beginPath();
      if (name === "--on") {
        context.fillStyle = colour(name);
        context.arc(...centreOf(taxel), cell * 0.22, 0, 7);
        context.fill();
      } else {
        context.strokeStyle = colour(name);
        context.lineWidth = cell * 0.09;
        context.arc(...centreOf(taxel), cell * 0.34, 0, 7);
        context.stroke();
      }
      context.globalAlpha = 1;
    }
  });
  return moves;
}

function fillTaxels(context, counts, wide, high, opacity) {
  const largest = counts.reduce((a, b) => Math.max(a, b), 1);
  context.fillStyle = colour("--on");
  counts.forEach((count, taxel) => {
    if (count === 0) return;
    context.globalAlpha = (opacity * count) / largest;
    context.fillRect(columnOf(taxel) * wide, rowOf(taxel) * high, wide + 0.5, high + 0.5);
  });
  context.globalAlpha = 1;
}

function fillDots(context, counts, centreOf, radius) {
  const largest = counts.reduce((a, b) => Math.max(a, b), 1);
  context.fillStyle = colour("--on");
  counts.forEach((count, taxel) => {
    context.globalAlpha = (0.6 * count) / largest;
    context.beginPath();
    context.arc(...centreOf(taxel), radius, 0, 7);
    context.fill();
  });
  context.globalAlpha = 1;
}
