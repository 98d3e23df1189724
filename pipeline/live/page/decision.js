// What the page says about the network's decision, as plain values; no element is touched here.

const SURE = 0.5; // confidence below which a verdict is not sure
const FLICKER = 0.4; // confidence below which an open answer would only flicker
const GUESS = 1.02; // times the share of equal classes: below it an answer is no better than a guess
const NOT_SURE = "Not sure";
const SLOW = "because this is slower than the digits of the training";
const SOFTMAX = "softmax"; // of a network without confidence: no probability
const TAP = 1; // taxels that a pen must move at least, or it has written nothing

// A confidence is below 1 and must not be displayed as 100 %.
export const percent = (share) => `${Math.min(100 * share, 99.9).toFixed(share < 0.95 ? 0 : 1)} %`;

// Whether the pen has only tapped: no stroke is longer than a taxel.
export function isTap(strokes) {
  const extent = (stroke, axis) => {
    const coordinates = stroke.map((point) => point[axis]);
    return Math.max(...coordinates) - Math.min(...coordinates);
  };
  return strokes.length > 0 && strokes.every((stroke) => Math.max(extent(stroke, 0), extent(stroke, 1)) < TAP);
}

// message: an answer of the server, or null.  page: { classes, digits, pauseS, threshold, truth (the class of an
// example or of a saved recording, or null), settled, writes, strokes, canDraw, nameClass }.
// Returns { text (the class, or ""), confidence, statement, open, mark ("right", "wrong" or ""), retracted, seconds }.
// `confidence` and the beginning of `statement` are read as one sentence: "97 %" and "sure at the end, decided after 0.52 s", or "Not sure".
export function describeDecision(message, page) {
  if (page.settled && isTap(page.strokes))
    return open("", "Too short", `a tap is no ${page.digits ? "digit" : "drawing"}: draw a line`);
  if (message === null) return describeSilence(page);
  return page.settled && message.verdict ? describeVerdict(message, page) : describeAnswer(message, page);
}

const open = (text, confidence, statement) => ({ text, confidence, statement, open: true, mark: "", retracted: false, seconds: "" });

const isGuess = (confidence, page) => confidence < GUESS / page.classes.length;

// The network has not answered: nothing has been written, or nothing that the sensor feels.
function describeSilence(page) {
  if (page.settled && page.strokes.length) return open("", "No decision", "the sensor felt nothing: draw a longer line");
  return open("", "", waiting(page));
}

// Before anything has been written.
function waiting({ threshold, canDraw, truth, pauseS }) {
  const early = threshold === null ? "" : `when ${percent(threshold)} sure, or `;
  const end = canDraw && truth === null ? `${pauseS}\u00a0s after the last stroke` : "at the end";
  return `It decides ${early}${end}.`;
}

// The answer so far, which is open, also if the network has decided: what follows may make another class of it.
function describeAnswer(message, page) {
  const { decision, confidence } = message;
  const guess = isGuess(confidence, page);
  const waits = !page.writes && page.strokes.length && page.truth === null;
  const number = guess || confidence < FLICKER ? "…" : percent(confidence);
  return {
    ...open(guess ? "" : page.classes[decision], message.exceeds_training ? NOT_SURE : number, ""),
    statement: soFarText(message, number, page) + (waits ? `; waits ${page.pauseS}\u00a0s for another stroke` : ""),
    seconds: message.verdict?.seconds ?? "",
  };
}

function soFarText({ decision, exceeds_training, verdict }, number, { nameClass, threshold }) {
  if (exceeds_training) return SLOW;
  const sure = number === "…" ? "so far" : `${threshold === null ? SOFTMAX : "sure"} so far`;
  if (!verdict) return sure;
  const decided = verdict.label === decision ? "decided" : `decided for ${nameClass(verdict.label)}`;
  return `${sure}; ${decided} after ${verdict.seconds.toFixed(2)}\u00a0s`;
}

// The verdict on a recording that has ended: the early decision, or else the answer at the end.  The confidence is
// that at the end, which has seen all events.
function describeVerdict(message, page) {
  const { label, early, seconds } = message.verdict;
  const guess = isGuess(message.confidence, page);
  const retracted = early && message.decision !== label; // by the answer at the end
  const doubted = guess || retracted || message.exceeds_training || isUnsure(message, page);
  const open = doubted || message.confidence < SURE;
  return {
    text: guess ? "?" : page.classes[label],
    confidence: doubted ? NOT_SURE : percent(message.confidence),
    statement: verdictText(message, guess, retracted, page) + truthText(label, guess, page) + retractionText(message, retracted, page),
    open,
    mark: markOf(label, open, page),
    retracted,
    seconds,
  };
}

// More probably wrong than right; a softmax is no probability.
const isUnsure = ({ confidence }, { threshold }) => threshold !== null && confidence < SURE;

function verdictText(message, guess, retracted, page) {
  const { exceeds_training, verdict, confidence } = message;
  const { threshold } = page;
  if (exceeds_training) return SLOW;
  const time = verdict.early ? `decided after ${verdict.seconds.toFixed(2)}\u00a0s` : "at the end";
  if (guess || retracted) return time;
  if (isUnsure(message, page)) return `${time} (${percent(confidence)})`;
  if (threshold === null) return `${SOFTMAX} ${time}`;
  return verdict.early ? `sure at the end, ${time}` : `sure ${time}`;
}

function truthText(label, guess, { classes, truth, nameClass }) {
  if (guess) return `; a guess: ${classes[label]}`;
  if (truth === null) return "";
  return truth === label ? ": right" : `: wrong, it was ${nameClass(truth)}`;
}

function retractionText({ decision }, retracted, { nameClass }) {
  return retracted ? `; at the end it would be ${nameClass(decision)}` : "";
}

function markOf(label, open, { truth }) {
  if (truth === null || open) return "";
  return truth === label ? "right" : "wrong";
}
