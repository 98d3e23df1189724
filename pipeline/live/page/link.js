// The connection to the server: messages as JSON, and the event "gone" when it is lost.

export class Link extends EventTarget {
  constructor() {
    super();
    const address = new URL("pen", location.href);
    address.protocol = "ws:";
    this.socket = new WebSocket(address);
    this.socket.addEventListener("message", (event) => {
      const message = JSON.parse(event.data);
      this.dispatchEvent(new CustomEvent(message.type, { detail: message }));
    });
    this.socket.addEventListener("close", (event) => {
      this.dispatchEvent(new CustomEvent("gone", { detail: event.reason }));
    });
  }

  on(type, listen) {
    this.addEventListener(type, (event) => listen(event.detail));
  }

  send(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }
}
