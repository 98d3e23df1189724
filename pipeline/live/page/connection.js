// The connection to the server: messages as JSON.  Its own events are "gone" when it is lost or cannot
// be made, "silent" when there has been no answer for a while, and "heard" when one comes after all.

const SILENT_MS = 3000;

export class Connection extends EventTarget {
  constructor() {
    super();
    this.waiting = []; // messages that have not been answered
    this.silent = false;
    this.connect();
  }

  connect() {
    const address = new URL("pen", location.href);
    address.protocol = "ws:";
    let opened = false;
    this.socket = new WebSocket(address);
    this.socket.addEventListener("open", () => {
      opened = true;
    });
    this.socket.addEventListener("message", (event) => {
      const message = JSON.parse(event.data);
      this.endWaiting(({ answers }) => answers.includes(message.type));
      this.emit(message.type, message);
    });
    this.socket.addEventListener("close", ({ code, reason }) => {
      this.endWaiting(() => true);
      this.emit("gone", { code, reason, opened });
    });
  }

  on(type, listen) {
    this.addEventListener(type, (event) => listen(event.detail));
  }

  emit(type, detail = null) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  // answers: types of which the server sends one at once
  send(message, answers = []) {
    if (this.socket.readyState !== WebSocket.OPEN) return;
    this.socket.send(JSON.stringify(message));
    const { type } = message;
    if (!answers.length || this.waiting.some((message) => message.type === type)) return;
    const timer = setTimeout(() => {
      this.silent = true;
      this.emit("silent");
    }, SILENT_MS);
    this.waiting.push({ type, answers, timer });
  }

  // Ends the waiting of the messages that match.
  endWaiting(matches) {
    for (const { timer } of this.waiting.filter(matches)) clearTimeout(timer);
    this.waiting = this.waiting.filter((message) => !matches(message));
    if (this.silent && !this.waiting.length) {
      this.silent = false;
      this.emit("heard");
    }
  }
}
