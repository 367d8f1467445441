// Search in pages that are opened from the disk, where browsers start no workers: the worker's script runs in a hidden frame instead.
// The name keeps the plugin `offline` from fetching its own such script, which is called the same, from the network.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      const before = "postMessage = data => parent.postMessage(data, '*');"
        + "importScripts = (...urls) => urls.reduce((done, url) => done.then(() => new Promise(loaded => {"
        + "  const script = document.createElement('script'); script.src = url; script.onload = loaded; document.body.append(script);"
        + "})), Promise.resolve());";
      frame.hidden = true;
      frame.srcdoc = `<body><script>${before}<\/script><script src="${new URL(url, document.baseURI)}"><\/script></body>`;
      this.frame = frame;
      this.ready = new Promise(loaded => { frame.onload = loaded; });
      window.addEventListener("message", event => {
        if (event.source !== frame.contentWindow) return;
        const message = new MessageEvent("message", {data: event.data});
        this.dispatchEvent(message);
        if (this.onmessage) this.onmessage(message);
      });
      document.body.append(frame);
    }
    postMessage(data) {
      this.ready.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", {data: structuredClone(data)})));
    }
    terminate() {
      this.frame.remove();
    }
  };
}
