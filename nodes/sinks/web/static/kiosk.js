// Example of a kiosk: a person nearby raises a hand to start, and the session ends when they leave.
import { connect } from "./steadypose.js";

const text = document.getElementById("text");
let visitor = null;

const pose = connect();
pose.on("event", ({ body, kind, phase, hand }) => {
  if (visitor === null && kind === "HAND_RAISED" && phase === "BEGINS") {
    visitor = body;
    document.getElementById("who").textContent = `started by visitor ${body}, with the ${hand.toLowerCase()} hand`;
  } else if (body === visitor && kind === "LEFT") {
    visitor = null;
    document.getElementById("who").textContent = "";
  }
});
pose.on("events", ({ events }) => {
  const somebody = events.some(({ kind, phase }) => kind === "FACES_SENSOR" && phase !== "ENDS");
  document.body.className = visitor === null ? "" : "started";
  text.textContent = visitor !== null ? "Here we go!" : somebody ? "Raise a hand to start" : "Welcome";
});
