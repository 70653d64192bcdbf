// Obstacles that are dropped on the map, and what they change.
import { h } from "./dom.js";
import { get } from "./api.js";
import { button, numberField } from "./fields.js";
import { mapView } from "./desk_map.js";
import { capitalised } from "./numbers.js";
import { attempt, change, data, isBusy, runJob, update } from "./store.js";

/** @type {Record<string, {title: string, length_m: number, width_m: number, height_m: number}>} */
const OBSTACLES = {
  lorry: { title: "Parked lorry", length_m: 12, width_m: 2.5, height_m: 3.8 },
  bus: { title: "Bus", length_m: 12, width_m: 2.5, height_m: 3.1 },
  crane: { title: "Crane", length_m: 12, width_m: 3, height_m: 15 },
};

export function drawWhatIf() {
  const { project, whatIf } = data;
  return h("section.card", {}, h("h2", {}, "What if something stands in the way?"),
    h("div.tools", {}, Object.entries(OBSTACLES).map(([kind, { title }]) => button(title, () => addObstacle(kind), { key: `add.${kind}`, isDisabled: isBusy() }))),
    project.obstacles.length > 0 && [
      h("p.quiet", {}, "Drag it where it would stand."),
      h("ul.rows", {}, project.obstacles.map(obstacleRow)),
      button("What changes?", compute, { key: "what_if", isMain: true, isDisabled: isBusy() }),
    ],
    whatIf && !whatIf.outdated && result(whatIf));
}

/** @param {any[]} obstacles @param {import("./fields.js").Refuse} [refuse] */
export async function saveObstacles(obstacles, refuse) {
  const state = await change("PUT", "obstacles", { obstacles }, refuse);
  if (state) update({ whatIf: null }); // it was about the others
  return state;
}

/** @param {string} kind */
async function addObstacle(kind) {
  const { length_m, width_m, height_m } = OBSTACLES[kind];
  const [x_m, y_m] = mapView().center_m;
  const taken = new Set(data.project.obstacles.map((/** @type {any} */ other) => other.name));
  let number = 1;
  while (taken.has(`${kind}${number}`)) number += 1;
  const name = `${kind}${number}`;
  const state = await saveObstacles([...data.project.obstacles, { name, kind, x_m, y_m, yaw_deg: 0, length_m, width_m, height_m }]);
  if (state) update({ selected: `obstacle ${name}` });
}

/** @param {any} obstacle */
function obstacleRow(obstacle) {
  const others = data.project.obstacles.filter((/** @type {any} */ other) => other.name !== obstacle.name);
  const field = (/** @type {string} */ key, /** @type {string} */ label, /** @type {string} */ unit) => numberField({
    key: `${obstacle.name}.${key}`, label, unit, value: obstacle[key], limits: { min: unit === "m" ? 0.1 : -360, max: unit === "m" ? 100 : 360 },
    send: (value, refuse) => saveObstacles(data.project.obstacles.map((/** @type {any} */ other) => (other.name === obstacle.name ? { ...other, [key]: value } : other)), refuse),
  });
  return h("li", {}, h("div", {}, h("b", {}, obstacle.name), h("div.pair", {}, field("yaw_deg", "Direction (0° east, 90° north)", "°"), field("height_m", "Height", "m"), field("length_m", "Length", "m"), field("width_m", "Width", "m"))),
    button("Remove", () => saveObstacles(others), { key: `remove.${obstacle.name}`, isDisabled: isBusy(), title: `Remove ${obstacle.name}` }));
}

async function compute() {
  const job = await runJob("what_if");
  if (!job) return;
  const whatIf = await attempt(() => get("what_if"));
  if (whatIf) update({ whatIf });
}

/** @param {any} whatIf */
function result(whatIf) {
  return h("div", {}, (whatIf.text ?? []).map((/** @type {string} */ text) => h("p", {}, capitalised(text))),
    h("div.table", {}, h("table", {}, h("caption.unseen", {}, "Scores with and without the obstacles"),
      h("thead", {}, h("tr", {}, ["Sensor", "Before", "After", "Change"].map((title) => h("th", { scope: "col" }, title)))),
      h("tbody", {}, whatIf.sites.slice(0, 10).map((/** @type {any} */ site) => h("tr", {}, h("th", { scope: "row" }, site.site), h("td", {}, site.before_text), h("td", {}, site.after_text), h("td", {}, site.change_text)))))));
}
