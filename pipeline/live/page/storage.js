// What the browser stores of the page: the writer of each data set, and whether a drawing was lost.
// A browser may have no storage, or refuse even to name it; the page works without it.

const LOST = "stmnist-lost";
const YEAR_S = 365 * 24 * 3600;

function store(storage, key, value) {
  try {
    window[storage].setItem(key, JSON.stringify(value));
  } catch {
    // the page works without it
  }
}

function read(storage, key) {
  try {
    return JSON.parse(window[storage].getItem(key));
  } catch {
    return null;
  }
}

// A drawing that is lost when the page is loaded again.
export function storeLoss() {
  store("sessionStorage", LOST, true);
}

// Whether a drawing was lost; it is reported once.
export function takeLoss() {
  const isLost = read("sessionStorage", LOST);
  store("sessionStorage", LOST, null);
  return Boolean(isLost);
}

// Every browser is one writer, and stores its number for each data set.  A server on another port has
// another storage, but the same cookies.
const writerKey = (dataSet) => `stmnist-writer:${dataSet}`;
const writerCookie = (dataSet) => `stmnist-writer-${dataSet}`;

// The number of the writer, or null.
export function readWriter(dataSet) {
  const number = read("localStorage", writerKey(dataSet)) ?? readCookie(writerCookie(dataSet));
  return Number.isInteger(number) ? number : null;
}

function readCookie(name) {
  const cookie = document.cookie.split("; ").find((entry) => entry.startsWith(`${name}=`));
  return cookie === undefined ? null : Number(cookie.split("=")[1]);
}

export function storeWriter(dataSet, number) {
  store("localStorage", writerKey(dataSet), number);
  document.cookie = `${writerCookie(dataSet)}=${number}; path=/; max-age=${YEAR_S}; samesite=strict`;
}
