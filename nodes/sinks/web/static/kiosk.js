// Example of a kiosk: a person nearby raises a hand to start, and the session ends when they leave.
import { connect } from "./steadypose.js";

const text = document.getElementById("text");
let visitor = null; // the id of a body, and the source whose id it is
const facing = new Map(); // by source: whether somebody faces the sensor

const pose = connect();
pose.on("event", ({ source, body, kind, phase, hand }) => {
  if (visitor === null && kind === "HAND_RAISED" && phase === "BEGINS") {
    visitor = { source, body };
    document.getElementById("who").textContent = `started by visitor ${body}, with the ${hand.toLowerCase()} hand`;
  } else if (body === visitor?.body && source === visitor.source && kind === "LEFT") {
    visitor = null;
    document.getElementById("who").textContent = "";
  }
});
pose.on("events", ({ source, events }) => {
  facing.set(source, events.some(({ kind, phase }) => kind === "FACES_SENSOR" && phase !== "ENDS"));
  const somebody = [...facing.values()].includes(true);
  document.body.className = visitor === null ? "" : "started";
  text.textContent = visitor !== null ? "Here we go!" : somebody ? "Raise a hand to start" : "Welcome";
});
