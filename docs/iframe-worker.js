// A page that is opened as a file may not start a worker, in which the search runs.  Here a hidden frame takes its place.
// The plugin "offline" of MkDocs would load such a script from another server, unless one of this name is given.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    #messages = [];

    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      const script = document.createElement("script");
      script.src = url;
      frame.contentDocument.open();
      frame.contentDocument.write(script.outerHTML);
      frame.contentWindow.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      frame.onload = () => {
        this.#send = (data) => frame.contentWindow.dispatchEvent(new MessageEvent("message", { data }));
        this.#messages.splice(0).forEach(this.#send);
      };
      frame.contentDocument.close();
    }

    #send = (data) => this.#messages.push(data);

    postMessage(data) {
      this.#send(data);
    }
  };
}
