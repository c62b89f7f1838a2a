// The one WebSocket. Rule: it reports its state, and connects again until the run is over. At most one request for a
// picture is on its way, so a slow page gets fewer pictures and makes nobody wait.

const FIRST_RETRY_MS = 500;
const LONGEST_RETRY_MS = 8000;
const STEADY_MS = 5000; // after a connection that lasted so long, the first retry comes soon again
const JSON_KIND = 1;
const PICTURE_KIND = 2;
const PICTURE_HEADER_BYTES = 21;

const encoder = new TextEncoder();
const decoder = new TextDecoder();

function token() {
  return new URLSearchParams(location.search).get("token") ?? "";
}

// A path of this server with the token, relative to the page.
export function withToken(path) {
  return `${path}?token=${encodeURIComponent(token())}`;
}

// Returns a binary message as {json} or {picture: {frame, mediaMs, ageMs, jpeg}}; null for an unknown kind.
function parse(buffer) {
  const view = new DataView(buffer);
  if (view.byteLength > 0 && view.getUint8(0) === JSON_KIND) {
    return { json: JSON.parse(decoder.decode(new Uint8Array(buffer, 1))) };
  }
  if (view.byteLength >= PICTURE_HEADER_BYTES && view.getUint8(0) === PICTURE_KIND) {
    const jpeg = new Blob([new Uint8Array(buffer, PICTURE_HEADER_BYTES)], { type: "image/jpeg" });
    const [frame, mediaMs, ageMs] = [view.getUint32(1, true), view.getFloat64(5, true), view.getFloat64(13, true)];
    return { picture: { frame, mediaMs, ageMs, jpeg } };
  }
  return null;
}

export class Connection {
  // on: callbacks {message(json), picture(picture), link(state, text), isOver()}. `state`: "connecting", "open", "lost"
  // or "over". isOver() returns whether the run is over.
  constructor(on) {
    this.on = on;
    this.retryMs = FIRST_RETRY_MS;
    this.socket = null;
    this.isPictureAsked = false;
    this.timer = 0;
    this.openedAt = null;
  }

  open() {
    clearTimeout(this.timer);
    this.on.link("connecting", "connecting");
    const url = new URL(withToken("live"), location.href);
    url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(url);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this.#opened();
    socket.onmessage = (event) => this.#received(event.data);
    socket.onclose = (event) => this.#closed(event);
    this.socket = socket;
    this.isPictureAsked = false;
  }

  #opened() {
    this.openedAt = performance.now();
    this.on.link("open", "connected");
  }

  #received(data) {
    const message = data instanceof ArrayBuffer ? parse(data) : null;
    if (message?.picture) {
      this.isPictureAsked = false;
      this.on.picture(message.picture);
    } else if (message?.json) this.on.message(message.json);
  }

  #closed(event) {
    this.isPictureAsked = false;
    if (this.openedAt !== null && performance.now() - this.openedAt > STEADY_MS) this.retryMs = FIRST_RETRY_MS;
    this.openedAt = null;
    if (this.on.isOver()) {
      this.on.link("over", "the run is over and its server gone; `trilane show` shows it again");
      return;
    }
    const why = event.reason ? ` (${event.reason})` : "";
    this.on.link("lost", `connection lost${why}; trying again in ${(this.retryMs / 1000).toFixed(1)} s`);
    this.timer = setTimeout(() => this.open(), this.retryMs);
    this.retryMs = Math.min(2 * this.retryMs, LONGEST_RETRY_MS);
  }

  get isOpen() {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  send(message) {
    if (!this.isOpen) return false;
    const text = encoder.encode(JSON.stringify(message));
    const bytes = new Uint8Array(text.length + 1);
    bytes[0] = JSON_KIND;
    bytes.set(text, 1);
    this.socket.send(bytes);
    return true;
  }

  // Requests the newest picture that this page has not had, unless a request is on its way.
  pullPicture() {
    if (!this.isPictureAsked && this.send({ type: "picture" })) this.isPictureAsked = true;
  }

  control(name, value = null) {
    return this.send({ type: "control", name, value });
  }

  restart(changes) {
    return this.send({ type: "restart", changes });
  }
}
