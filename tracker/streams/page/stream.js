// The connection to the server, the poses that come over it, and the moment that is shown.
// What the bytes mean stands in protocol.py.

const MAGIC = 0x47505454; // "TTPG"
const VERSION = 1;
const FIRST_PAUSE_MS = 250, LONGEST_PAUSE_MS = 3000;
const SEEN_PERIOD_MS = 250;
const SILENCE_MS = 5000; // the server speaks once a second

// The names and meanings of tracker/pose.py, PoseStatus and CoilState.
export const STATUSES = [
  ["lost", "bad"], ["tracking", "good"], ["held", "warn"], ["relaxing", "warn"],
];
export const COIL_STATES = [
  ["ok", "good"], ["missing", "bad"], ["wild", "bad"], ["misfit", "warn"], ["stuck", "warn"], ["returning", "warn"],
];

/** A binary message as a pose; null where it is none, or one of another version. */
export function decodePose(buffer) {
  const view = new DataView(buffer);
  if (buffer.byteLength < 64 || view.getUint32(0, true) !== MAGIC || view.getUint8(4) !== VERSION) return null;
  const k = view.getUint16(8, true), n = view.getUint16(10, true), vertices = view.getUint32(24, true);
  const statesAt = 64 + 4 * (k + 4 * n), meshAt = statesAt + Math.ceil(n / 4) * 4;
  if (buffer.byteLength !== meshAt + 6 * vertices) return null;
  const floats = new Float32Array(buffer, 64, k + 4 * n);
  let mesh = null;
  if (vertices) {
    const step = view.getFloat32(28, true), steps = new Int16Array(buffer, meshAt, 3 * vertices);
    mesh = Float32Array.from(steps, (value) => value * step);
  }
  return {
    status: view.getUint8(5),
    fixed: (view.getUint8(6) & 1) === 1,
    number: view.getUint32(12, true),
    sequence: view.getUint32(16, true),
    model: view.getUint32(20, true),
    timeS: view.getFloat64(32, true),
    solvedMs: view.getFloat64(40, true) * 1000,
    solveMs: view.getFloat32(48, true),
    ageMs: view.getFloat32(52, true),
    residualMm: view.getFloat32(56, true),
    weights: floats.subarray(0, k),
    coils: floats.subarray(k, k + 3 * n),
    residuals: floats.subarray(k + 3 * n),
    states: new Uint8Array(buffer, statesAt, n),
    vertices: mesh, // (V, 3) mm, model frame, or null: then the weights and model.glb are the tongue
  };
}

/** The last seconds of poses, from which the one to be shown is picked. */
export class Timeline {
  constructor(keptMs) {
    this.keptMs = keptMs;
    this.poses = [];
    this.offsetMs = Infinity; // from the server's clock to ours, and the quickest way here
    this.heardMs = 0;
  }

  clear() {
    this.poses = [];
    this.offsetMs = Infinity;
  }

  add(pose, nowMs) {
    // Clocks drift apart by at most some ten parts in a million: the least offset is forgotten a little faster.
    const relaxed = this.offsetMs + 1e-4 * Math.max(0, nowMs - this.heardMs);
    this.offsetMs = Math.min(relaxed, nowMs - pose.solvedMs);
    this.heardMs = nowMs;
    this.poses.push(pose);
    const oldest = pose.solvedMs - this.keptMs;
    let first = 0;
    while (this.poses[first].solvedMs < oldest) first += 1;
    if (first) this.poses.splice(0, first);
  }

  /** The newest pose, or with a delay the newest of those that were solved so long ago. */
  at(nowMs, delayMs) {
    if (!delayMs) return this.poses.at(-1) ?? null;
    const until = nowMs - this.offsetMs - delayMs;
    for (let i = this.poses.length - 1; i >= 0; i -= 1) {
      if (this.poses[i].solvedMs <= until) return this.poses[i];
    }
    return this.poses[0] ?? null;
  }

  /** Poses of the last milliseconds before one, oldest first. */
  before(pose, lengthMs) {
    return this.poses.filter((other) => other.solvedMs <= pose.solvedMs && other.solvedMs > pose.solvedMs - lengthMs);
  }
}

/** Keeps a connection open; connects again by itself. */
export class Stream {
  /** heard: {pose(pose, nowMs), text(message), connection(word, kind)} */
  constructor(heard) {
    this.heard = heard;
    this.pauseMs = FIRST_PAUSE_MS;
    this.over = false;
    this.open();
    setInterval(() => this.watch(), 1000);
  }

  open() {
    const address = new URL("socket", document.baseURI);
    address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.number = 0;
    this.acknowledged = 0;
    this.acknowledgedMs = this.heardMs = performance.now();
    this.seenEvery = 1;
    socket.onmessage = (event) => this.receive(event.data);
    socket.onclose = () => this.lost(socket);
  }

  receive(data) {
    const nowMs = performance.now();
    this.heardMs = nowMs;
    if (typeof data === "string") {
      const message = JSON.parse(data);
      if (message.type === "hello") {
        this.over = false;
        this.pauseMs = FIRST_PAUSE_MS;
        this.seenEvery = message.seen_every;
        this.heard.connection("connected", "good");
      }
      if (message.type === "over") {
        this.over = true;
      }
      this.heard.text(message);
    } else {
      const pose = decodePose(data);
      if (!pose) return;
      this.number = pose.number;
      this.heard.pose(pose, nowMs);
    }
    if (this.number - this.acknowledged >= this.seenEvery || nowMs - this.acknowledgedMs > SEEN_PERIOD_MS) {
      this.acknowledged = this.number;
      this.acknowledgedMs = nowMs;
      this.send({ seen: this.number });
    }
  }

  send(message) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  lost(socket) {
    if (socket !== this.socket) return;
    this.heard.connection(this.over ? "run has ended" : "reconnecting", this.over ? "warn" : "bad");
    setTimeout(() => this.open(), this.pauseMs);
    this.pauseMs = Math.min(this.pauseMs * 1.6, LONGEST_PAUSE_MS);
  }

  /** A network that is gone closes no socket: silence does. */
  watch() {
    const socket = this.socket;
    if (socket.readyState > WebSocket.OPEN || performance.now() - this.heardMs < SILENCE_MS) return;
    socket.onmessage = socket.onclose = null;
    socket.close();
    this.lost(socket);
  }
}
