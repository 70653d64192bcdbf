// The recorded traffic on the map: some moments, one after another.
import { get } from "./api.js";
import { corners, mapView } from "./desk_map.js";
import { h } from "./dom.js";
import { button } from "./fields.js";
import { readable } from "./numbers.js";
import { attempt, data, update } from "./store.js";

/** What is shown, and the ranking that it belongs to. @type {{ranking: any, traffic: any, at: number, timer: number}|null} */
let replay = null;

const redraw = () => update({ ranking: data.ranking });

/** Controls below the ranking. @returns {HTMLElement} */
export function drawReplay() {
  if (replay && replay.ranking !== data.ranking) stopReplay();
  if (!replay) return h("section", {}, button("Show the traffic on the map", start, { key: "replay" }));
  const { traffic, timer } = replay;
  const text = h("p.quiet", { id: "moment-text" }, describe());
  const slider = h("input", { id: "moment", type: "range", min: 0, max: traffic.moments.length - 1, step: 1, value: replay.at, "data-key": "moment", "aria-describedby": "moment-text" });
  slider.addEventListener("input", () => {
    turnToMoment(Number(slider.value));
    text.textContent = describe();
  });
  return h("section.card", {}, h("h2", {}, "Traffic of this run"),
    h("div.slider", {}, h("label", { for: "moment" }, "Moment"), slider),
    text,
    h("div.tools", {}, button(timer ? "Pause" : "Play", timer ? pause : play, { key: "play" }), button("Hide the traffic", hide, { key: "hide" })));
}

/** Take the road users off the map. */
export function stopReplay() {
  if (!replay) return;
  clearInterval(replay.timer);
  replay = null;
  mapView().setVehicles([]);
}

function describe() {
  if (!replay) return "";
  const { traffic, at } = replay;
  return `${readable(traffic.first_s + at * traffic.period_s, traffic.period_s < 1 ? 1 : 0)} s: ${traffic.moments[at].length} road users`;
}

async function start() {
  const { ranking } = data;
  const traffic = await attempt(() => get("traffic"));
  if (!traffic || ranking !== data.ranking || data.step !== "run") return;
  replay = { ranking, traffic, at: 0, timer: 0 };
  turnToMoment(0);
  redraw();
}

/** @param {number} at */
function turnToMoment(at) {
  if (!replay) return;
  replay.at = at;
  mapView().setVehicles(replay.traffic.moments[at].map((/** @type {number[]} */ [x, y, yaw, length_m, width_m]) => corners([x, y], yaw, length_m, width_m)));
}

function play() {
  if (!replay) return;
  replay.timer = setInterval(() => {
    if (!replay) return;
    turnToMoment((replay.at + 1) % replay.traffic.moments.length);
    const slider = document.getElementById("moment");
    if (slider instanceof HTMLInputElement) slider.value = String(replay.at);
    const text = document.getElementById("moment-text");
    if (text) text.textContent = describe();
  }, 250);
  redraw();
}

function pause() {
  if (!replay) return;
  clearInterval(replay.timer);
  replay.timer = 0;
  redraw();
}

function hide() {
  stopReplay();
  redraw();
}
