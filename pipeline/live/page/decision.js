// What the page says about the network's decision, as plain values; no element is touched here.

const SURE = 0.5; // confidence below which a verdict is not sure
const FLICKER = 0.4; // confidence below which an open answer would only flicker
const GUESS = 1.02; // times the share of equal classes: below it an answer is no better than a guess
const TAP = 1; // taxels that a pen must move at least, or it has written nothing

// A confidence is below 1 and must not be displayed as 100 %.
export const percent = (share) => `${Math.min(100 * share, 99.9).toFixed(share < 0.95 ? 0 : 1)} %`;

// Whether the pen has only tapped: no stroke is longer than a taxel.
export function isTap(strokes) {
  const extent = (stroke, axis) => {
    const places = stroke.map((point) => point[axis]);
    return Math.max(...places) - Math.min(...places);
  };
  return strokes.length > 0 && strokes.every((stroke) => Math.max(extent(stroke, 0), extent(stroke, 1)) < TAP);
}

// message: an answer of the server, or null.  page: { classes, digits, pauseS, threshold, truth (the class of an
// example or of a saved recording, or null), settled, writes, drawn (strokes), canDraw, named (of a class) }.
// Returns { text (the class, or ""), confidence, said, open, mark ("right", "wrong" or ""), retracted, seconds }.
export function describeDecision(message, page) {
  if (page.settled && isTap(page.drawn))
    return open("", "Too short", `a tap is no ${page.digits ? "digit" : "drawing"}: draw a line`);
  if (message === null) return describeSilence(page);
  const verdict = message.verdict ?? null;
  return verdict === null ? describeAnswer(message, page) : describeVerdict(message, verdict, page);
}

const open = (text, confidence, said) => ({ text, confidence, said, open: true, mark: "", retracted: false, seconds: "" });

const isGuess = (confidence, page) => confidence < GUESS / page.classes.length;

// The network has not answered: nothing has been written, or nothing that the sensor feels.
function describeSilence(page) {
  if (page.settled && page.drawn.length) return open("", "No decision", "the sensor felt nothing: draw a longer line");
  return open("", "", waiting(page));
}

// Before anything has been written.
function waiting({ threshold, canDraw, truth, pauseS }) {
  const early = threshold === null ? "" : `when ${percent(threshold)} sure, or `;
  const end = canDraw && truth === null ? `${pauseS} s after the last stroke` : "at the end";
  return `Decides ${early}${end}.`;
}

// The answer so far, which is open.
function describeAnswer({ decision, confidence }, page) {
  const guess = isGuess(confidence, page);
  const sure = guess || confidence < FLICKER ? "…" : percent(confidence);
  const waits = !page.writes && page.drawn.length && page.truth === null;
  return open(guess ? "" : page.classes[decision], sure, waits ? `so far; waits ${page.pauseS} s for another stroke` : "so far");
}

// The verdict: the early decision, or else the answer at the end.
function describeVerdict(message, verdict, page) {
  const { label, confidence, early, seconds } = verdict;
  const guess = isGuess(confidence, page);
  const unsure = confidence < SURE;
  const retracted = early && page.settled && message.decision !== label; // by the answer at the end
  return {
    text: guess ? "?" : page.classes[label],
    confidence: confidenceText(confidence, guess, unsure, retracted),
    said: timeText(early, seconds, retracted, page) + truthText(label, guess, page) + retractionText(message, retracted, page),
    open: unsure || retracted,
    mark: markOf(label, unsure, page),
    retracted,
    seconds,
  };
}

function confidenceText(confidence, guess, unsure, retracted) {
  if (guess || retracted) return "Not sure";
  return unsure ? `Not sure (${percent(confidence)})` : percent(confidence);
}

function timeText(early, seconds, retracted, { threshold }) {
  if (early) return `${retracted ? "" : "sure, "}decided after ${seconds.toFixed(2)} s`;
  return threshold === null ? "softmax at the end" : "at the end";
}

function truthText(label, guess, { classes, truth, named }) {
  if (guess) return `; a guess: ${classes[label]}`;
  if (truth === null) return "";
  return truth === label ? ": right" : `: wrong, it was ${named(truth)}`;
}

function retractionText({ decision }, retracted, { named }) {
  return retracted ? `; at the end it would be ${named(decision)}` : "";
}

function markOf(label, unsure, { truth }) {
  if (truth === null || unsure) return "";
  return truth === label ? "right" : "wrong";
}
