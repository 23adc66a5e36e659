// steadypose in a browser: poses, events and node health over a WebSocket. No dependencies, no build step.
//
//   import { connect } from "http://127.0.0.1:8766/steadypose.js";
//   const pose = connect({ token: "..." });
//   pose.on("world", ({ bodies }) => bodies.forEach((body) => console.log(body.joint("left_wrist"))));
//   pose.on("event", ({ source, body, kind, phase }) => console.log(source, body, kind, phase));
//
// Lengths are in metres, in a right-handed world with z up; stamps are capture times in seconds.

const HERE = new URL(import.meta.url);
const SHORTEST_MS = 500;
const LONGEST_MS = 8000;

class Body {
  constructor(data, names) {
    Object.assign(this, data);
    Object.defineProperty(this, "names", { value: names });
  }

  // Position [x, y, z] of a joint by name; null if there is no estimate. Throws if there is no such joint.
  joint(name) {
    const index = this.names.joints.indexOf(name);
    if (index < 0) throw new RangeError(`no joint ${name}: there are ${this.names.joints.join(", ")}`);
    const position = this.positions[index];
    return this.state[index] === 0 || position.includes(null) ? null : position;
  }
}

class Connection {
  #options;
  #handlers = new Map();
  #socket = null;
  #retry = SHORTEST_MS;
  #timer = 0;
  #closed = false;

  constructor(options) {
    this.#options = options;
    this.names = null; // { joints, parents, vrm, contacts, states, events }, once connected
    this.state = "connecting"; // or "open", "closed"
    this.#open();
  }

  // Calls a function with each message of a kind: "world", "events", "event" (each event that begins or ends),
  // "health", "state". Returns a function that unsubscribes.
  on(kind, handler) {
    if (!["world", "events", "event", "health", "state"].includes(kind)) {
      throw new RangeError(`no messages of kind ${kind}: there are world, events, event, health, state`);
    }
    const handlers = this.#handlers.get(kind) ?? this.#handlers.set(kind, new Set()).get(kind);
    handlers.add(handler);
    return () => handlers.delete(handler);
  }

  close() {
    this.#closed = true;
    clearTimeout(this.#timer);
    this.#socket?.close();
  }

  #open() {
    const { url, token } = this.#options;
    const socket = new WebSocket(`${url}?token=${encodeURIComponent(token)}`);
    this.#socket = socket;
    socket.onmessage = ({ data }) => this.#take(JSON.parse(data));
    socket.onclose = () => {
      this.#become("closed");
      if (this.#closed) return;
      this.#timer = setTimeout(() => this.#open(), this.#retry);
      this.#retry = Math.min(2 * this.#retry, LONGEST_MS);
    };
  }

  #become(state) {
    if (state === this.state) return;
    this.state = state;
    this.#tell("state", state);
  }

  #take(message) {
    if (message.topic === "hello") {
      this.names = message;
      this.#retry = SHORTEST_MS;
      this.#become("open");
    } else if (message.topic === "pose/world") {
      message.bodies = message.bodies.map((body) => new Body(body, this.names));
      this.#tell("world", message);
    } else if (message.topic === "pose/events") {
      const { source } = message; // ids of bodies are its own
      for (const event of message.events) if (event.phase !== "HOLDS") this.#tell("event", { source, ...event });
      this.#tell("events", message);
    } else if (message.topic === "diagnostics") {
      this.#tell("health", message);
    }
  }

  #tell(kind, value) {
    for (const handler of this.#handlers.get(kind) ?? []) handler(value);
  }
}

// Connects, and reconnects whenever the connection is lost.
// Options: token, which follows the # in the printed address; url of the WebSocket, by default on this file's host.
export function connect({ token = location.hash.slice(1), url = `${HERE.origin.replace(/^http/, "ws")}/ws` } = {}) {
  return new Connection({ token, url });
}
