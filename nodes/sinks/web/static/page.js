// The page: bodies on a floor that can be rotated, their events, and the health of the nodes.
import { connect } from "./steadypose.js";

const [LEFT, RIGHT, MIDDLE, CONTACT] = ["#56b4e9", "#f08c2e", "#d7dbe4", "#f0c808"];
const [INFERRED, FAINT] = [3, 0.3]; // the state of a joint that was not observed, and its opacity
const TALL = 2.1; // height of the space shown above the floor, metres
const KEPT = 40; // number of events in the list
const STALE_S = 3;

const canvas = document.getElementById("canvas");
const notice = document.getElementById("notice");
const pen = canvas.getContext("2d");
const eye = { yaw: -0.9, pitch: 0.25, distance: 2.6, zoom: 1, target: [0, 0, 0.9] };
const worlds = new Map(); // the newest poses by source: a server's clients come in turn, and number bodies each from 1
const doing = new Map(); // by source, then by body
let world = null;
let asked = false;
let ended = false;

const pose = connect();

pose.on("state", (state) => {
  if (ended) return; // the last poses stay
  notice.textContent = state === "open" ? "" : "no connection: is `steadypose run web` running, and is this the address that it printed?";
});
pose.on("world", (message) => {
  message.at = performance.now();
  if (!message.end) worlds.set(message.source, (world = message));
  const gone = (of) => (of === message.source ? message.end : worlds.get(of).at < message.at - 1000 * STALE_S);
  for (const source of worlds.keys()) if (worlds.size > 1 && gone(source)) worlds.delete(source);
  ended = message.end && [...worlds.keys()].every(gone);
  notice.textContent = ended ? "the stream has ended: these are its last poses" : "";
  draw();
});
pose.on("events", ({ source, events }) => {
  const now = new Map();
  doing.set(source, now);
  for (const event of events) {
    if (event.phase !== "ENDS") now.set(event.body, [...(now.get(event.body) ?? []), label(event)]);
    if (event.phase !== "HOLDS") entry(source, event);
  }
});
function entry(source, event) {
  const list = document.getElementById("events");
  const item = document.createElement("li");
  item.className = event.phase;
  item.textContent = `${named(source, event.body)}: ${label(event)}${event.phase === "ENDS" ? ", no longer" : ""}`;
  list.prepend(item);
  while (list.children.length > KEPT) list.lastChild.remove();
}

const rows = new Map();
pose.on("health", ({ node, level, message, values }) => {
  const rate = Object.entries(values).find(([key]) => key.startsWith("rate."))?.[1];
  const late = values["latency_ms.p50"];
  const row = rows.get(node) ?? document.getElementById("health").insertRow();
  rows.set(node, row);
  row.className = level;
  row.title = message;
  row.replaceChildren();
  const cells = [node, rate ? `${Number(rate).toFixed(0)} Hz` : values.state ?? "", late ? `${Number(late).toFixed(0)} ms` : ""];
  for (const text of cells) row.insertCell().textContent = text;
});

// A body's id, with its source if there are several.
function named(source, id) {
  return worlds.size > 1 ? `${source} ${id}` : `${id}`;
}

function label({ kind, hand }) {
  const words = kind === "LEFT" ? "is gone" : kind.toLowerCase().replaceAll("_", " ");  // left is also a side
  return hand === "NONE" ? words : `${hand.toLowerCase()} ${words}`;
}

function draw() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => {
    asked = false;
    paint();
  });
}

function paint() {
  const scale = devicePixelRatio;
  const width = canvas.clientWidth;
  const height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, width, height);
  follow([...worlds.values()].flatMap(({ bodies }) => bodies));
  const project = camera(width, height);
  floor(project);
  for (const [source, { bodies }] of worlds) for (const body of bodies) person(source, body, project);
}

// The viewpoint follows the middle of the bodies, at a distance at which all are in view.
function follow(bodies) {
  if (!bodies.length) return;
  let spread = 0;
  for (const axis of [0, 1]) {
    const middle = bodies.reduce((sum, body) => sum + body.root[axis], 0) / bodies.length;
    eye.target[axis] += 0.1 * (middle - eye.target[axis]);
    spread = Math.max(spread, ...bodies.map((body) => Math.abs(body.root[axis] - middle)));
  }
  eye.distance += 0.1 * ((1.1 * TALL + 1.6 * spread) * eye.zoom - eye.distance);
}

function camera(width, height) {
  const [sy, cy, sp, cp] = [Math.sin(eye.yaw), Math.cos(eye.yaw), Math.sin(eye.pitch), Math.cos(eye.pitch)];
  const focal = 1.1 * Math.min(width, height);
  return ([x, y, z]) => {
    const [dx, dy, dz] = [x - eye.target[0], y - eye.target[1], z - eye.target[2]];
    const across = cy * dx + sy * dy;
    const along = -sy * dx + cy * dy;
    const depth = eye.distance + cp * along - sp * dz;
    if (depth < 0.1) return null;
    return [width / 2 + (focal * across) / depth, height / 2 - (focal * (sp * along + cp * dz)) / depth];
  };
}

function line(a, b, colour, thick) {
  if (!a || !b) return;
  pen.strokeStyle = colour;
  pen.lineWidth = thick;
  pen.beginPath();
  pen.moveTo(...a);
  pen.lineTo(...b);
  pen.stroke();
}

function floor(project) {
  const [cx, cy] = [Math.round(eye.target[0]), Math.round(eye.target[1])];
  for (let k = -3; k <= 3; k += 0.5) {
    line(project([cx + k, cy - 3, 0]), project([cx + k, cy + 3, 0]), "#2a2f3a", 1);
    line(project([cx - 3, cy + k, 0]), project([cx + 3, cy + k, 0]), "#2a2f3a", 1);
  }
}

function person(source, body, project) {
  const points = body.positions.map((p, joint) => (body.state[joint] && !p.includes(null) ? project(p) : null));
  pen.lineCap = "round";
  pose.names.parents.forEach((parent, joint) => {
    if (parent < 0) return;
    const name = pose.names.joints[joint];
    pen.globalAlpha = body.state[parent] === INFERRED || body.state[joint] === INFERRED ? FAINT : 1;
    line(points[parent], points[joint], name.startsWith("left") ? LEFT : name.startsWith("right") ? RIGHT : MIDDLE, 6);
  });
  pen.globalAlpha = 1;
  pose.names.contacts.forEach((name, index) => {
    const at = points[pose.names.joints.indexOf(name)];
    if (!at || body.contacts[index] < 0.5) return;
    pen.fillStyle = CONTACT;
    pen.beginPath();
    pen.arc(...at, 5, 0, 2 * Math.PI);
    pen.fill();
  });
  const head = points[pose.names.joints.indexOf("head")];
  if (!head) return;
  pen.fillStyle = "#dde3ee";
  pen.font = "13px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.fillText([named(source, body.id), ...(doing.get(source)?.get(body.id) ?? [])].join(" · "), head[0], head[1] - 26);
}

canvas.addEventListener("pointermove", (event) => {
  if (!event.buttons) return;
  eye.yaw -= 0.008 * event.movementX;
  eye.pitch = Math.min(1.5, Math.max(-0.1, eye.pitch + 0.008 * event.movementY));
  draw();
});
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  const zoom = Math.min(6, Math.max(0.5, eye.zoom * Math.exp(0.001 * event.deltaY)));
  eye.distance *= zoom / eye.zoom;
  eye.zoom = zoom;
  draw();
}, { passive: false });
addEventListener("resize", draw);

let last = 0;
let stamp = 0;
setInterval(() => {
  if (world && world.stamp === stamp && !ended && pose.state === "open") {
    if ((last += 1) >= STALE_S) notice.textContent = "no poses: nobody is seen, or the nodes are waiting";
  } else last = 0;
  stamp = world?.stamp;
}, 1000);
draw();
