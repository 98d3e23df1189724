// What all drawings on canvases use. Colours come from the style sheet, also in dark mode.

export const still = matchMedia("(prefers-reduced-motion: reduce)");
const dark = matchMedia("(prefers-color-scheme: dark)");

let colours = null;
export function colour(name) {
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
export function fitCanvas(canvas) {
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

// The sensor: taxels are counted down the columns.  `positions`, if they are known, are those of the taxels on the
// sensor, whose larger extent is 1.
export const sensor = { rows: 10, columns: 10, positions: null };
export function setSensor({ rows, columns, positions }) {
  Object.assign(sensor, { rows, columns, positions });
}
export const rowOf = (taxel) => taxel % sensor.rows;
export const columnOf = (taxel) => Math.floor(taxel / sensor.rows);

// A number with its noun.
export const count = (number, noun) => `${number.toLocaleString("en")} ${noun}${number === 1 ? "" : "s"}`;
