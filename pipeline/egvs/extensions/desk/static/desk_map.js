// What the map shows in each step, and what happens when one points at it.
import { latestWins, post } from "./api.js";
import { byId } from "./dom.js";
import { shortTitle } from "./junctions.js";
import { MapView } from "./mapview.js";
import { saveObstacles } from "./what_if.js";
import { announce, attempt, change, data, isBusy, say, update } from "./store.js";

/** @typedef {import("./mapview.js").Item} Item @typedef {import("./mapview.js").Point} Point */

const KINDS = { lamp: "street lamp", signal: "signal mast", pole: "utility pole", kerb: "new pole at the kerb" };
const STEPS_OF_SCORE = 5;

/** @type {MapView|null} */
let view = null;
/** What the shapes were drawn from. @type {any} */
let drawn = null;
let request = 0;

/** @param {any} site */
export function kindOf(site) {
  return /** @type {Record<string, string>} */ (KINDS)[site.kind] ?? (site.exists ? "existing pole" : "new pole");
}

/** @returns {MapView} */
export function mapView() {
  view ??= new MapView(byId("stage"), {
    onSelect: (id) => select(id),
    onMove: moveItem,
    onAdd: (at_m) => addPole(at_m),
    onDelete: (id) => data.step === "poles" && data.project?.sites.some((/** @type {any} */ site) => site.site === id) && removePole(id),
    onDrag: (id, at_m) => dragged({ id, at_m }),
    announce,
  });
  return view;
}

/** @param {Set<string>} changed */
export function drawMap(changed) {
  const source = data.project ? data.map : data.upload?.streets;
  byId("stage").hidden = !source;
  if (!source) {
    drawn = null;
    return;
  }
  const map = mapView();
  if (drawn !== source) {
    map.setShapes(data.project ? shapesOf(source) : { lanes: lanesOf(source), junctions: source.junctions.map((/** @type {any} */ junction) => junction.outline_m ?? []), solids: [], roi_m: null });
    map.credit.textContent = source.attribution ? `Map data ${source.attribution}` : "";
    map.fit(data.project ? boxAround() : source.bounds_m);
    drawn = source;
  } else if (changed.size === 1 && (changed.has("job") || changed.has("log"))) return;
  map.setAdding(data.isAdding);
  map.setItems(data.project ? deskItems() : junctionItems(source.junctions), data.selected);
}

/** @param {any} map */
function lanesOf(map) {
  return map.lanes.map((/** @type {any} */ lane) => ({ ...lane, kind: lane.road ? "road" : "walk" }));
}

/** @param {any} map */
function shapesOf(map) {
  const { center_m: [x, y], size_m: [dx, dy] } = data.project.roi;
  const solids = map.solids.map((/** @type {any} */ solid) => ({ kind: solid.kind, rings_m: solid.outline_m }));
  /** @type {Point[]} */
  const roi_m = [[x - dx / 2, y - dy / 2], [x + dx / 2, y - dy / 2], [x + dx / 2, y + dy / 2], [x - dx / 2, y + dy / 2]];
  return { lanes: lanesOf(map), junctions: map.junctions ?? [], solids, roi_m };
}

/** @returns {[number, number, number, number]} */
export function boxAround() {
  const { center_m: [x, y], size_m: [dx, dy] } = data.project.roi;
  const half = Math.max(dx, dy) / 2 + 15;
  return [x - half, y - half, x + half, y + half];
}

// ---------------------------------------------------------------- items

/** @param {string} text */
const shorten = (text) => (text.length > 40 ? `${text.slice(0, 40)}…` : text);

/** @param {any[]} junctions @returns {Item[]} */
function junctionItems(junctions) {
  return junctions.map((junction) => ({ id: junction.id, at_m: [junction.x_m, junction.y_m], label: shorten(shortTitle(junction.title)), kind: "junction", classes: ["quietly"], title: junction.title }));
}

/** @returns {Item[]} */
function deskItems() {
  const { step, project, suggestions, plan } = data;
  if (step === "traffic") return [];
  const chosen = new Map((step === "plan" || step === "take" ? plan?.sensors ?? [] : []).map((/** @type {any} */ sensor) => [siteOf(sensor.pole ?? sensor.site), sensor]));
  const ranks = new Map((step === "run" ? data.ranking?.poles ?? [] : []).map((/** @type {any} */ pole) => [siteOf(pole.pole), pole]));
  const scores = [...ranks.values()].map((pole) => pole.score);
  const [low, high] = [Math.min(...scores), Math.max(...scores)];
  const sites = project.sites.map((/** @type {any} */ site) => {
    const sensor = chosen.get(site.site);
    const pole = ranks.get(site.site);
    const classes = [site.exists && "existing", site.must && "must", site.must_not && "must_not", site.moved_m > 0 && "assumed"].filter(Boolean);
    if (pole) classes.push(`q${high > low ? Math.round((STEPS_OF_SCORE - 1) * (pole.score - low) / (high - low)) : STEPS_OF_SCORE - 1}`);
    if (step === "plan" && !sensor) classes.push("faint");
    const moved = site.moved_m > 0 ? `, position assumed, moved ${site.moved_m.toFixed(1)} m` : "";
    const score = pole ? `, rank ${pole.rank}: ${pole.score_text}` : sensor ? `, sensor ${sensor.order}` : "";
    return {
      id: site.site, at_m: [site.x_m, site.y_m], label: site.site, kind: sensor ? "sensor" : "pole", classes,
      movable: project.sites_editable && !isBusy(), text: sensor ? String(sensor.order) : pole && pole.rank <= 99 ? String(pole.rank) : "",
      title: `${site.site}, ${kindOf(site)}${moved}${score}`,
    };
  });
  const kerbs = (suggestions ?? []).map((pole, number) => ({ id: ` kerb ${number}`, at_m: [pole.x_m, pole.y_m], label: "", kind: "suggestion", title: "free position at the kerb" }));
  const sensors = sites.filter((/** @type {Item} */ item) => item.kind === "sensor");
  const obstacles = step === "plan" ? (project.obstacles ?? []).map(obstacleItem) : [];
  return [...kerbs, ...obstacles, ...sites.filter((/** @type {Item} */ item) => item.kind !== "sensor"), ...sensors];
}

/** @param {any} obstacle @returns {Item} */
function obstacleItem(obstacle) {
  return {
    id: `obstacle ${obstacle.name}`, at_m: [obstacle.x_m, obstacle.y_m], label: obstacle.name, kind: "obstacle", title: `obstacle ${obstacle.name}`,
    movable: !isBusy(), outline_m: corners([0, 0], (obstacle.yaw_deg * Math.PI) / 180, obstacle.length_m, obstacle.width_m),
  };
}

/** Corners of a rectangle. @param {Point} middle_m @param {number} yaw radians @param {number} length_m @param {number} width_m @returns {Point[]} */
export function corners([x, y], yaw, length_m, width_m) {
  const [c, s] = [Math.cos(yaw) / 2, Math.sin(yaw) / 2];
  return [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([along, across]) => [
    x + along * length_m * c - across * width_m * s, y + along * length_m * s + across * width_m * c,
  ]);
}

/** Site that a candidate or pole of the results belongs to. @param {string} name */
export function siteOf(name) {
  const sites = new Set(data.project.sites.map((/** @type {any} */ site) => site.site));
  return sites.has(name) ? name : name.replace(/@[^@]*$/, "");
}

// ---------------------------------------------------------------- what the pointer and the keys do

/** @param {string|null} id */
function select(id) {
  if (!data.project && id === null) return; // a junction stays chosen
  if (id?.startsWith(" kerb ")) {
    const pole = data.suggestions?.[Number(id.slice(6))];
    if (pole) addPole([pole.x_m, pole.y_m]);
    return;
  }
  update({ selected: id });
}

/** Choose a pole in a list. @param {string} id */
export function choosePole(id) {
  update({ selected: id });
  mapView().reveal(id);
}

/** @param {Point} at_m */
async function addPole([x_m, y_m]) {
  const map = mapView();
  map.clearRefusal();
  const state = await change("POST", "sites", { x_m, y_m }, (error) => refuse([x_m, y_m], error.reason));
  if (!state) return;
  update({ isAdding: false, selected: state.site, suggestions: data.suggestions && data.suggestions.filter((pole) => pole.x_m !== x_m || pole.y_m !== y_m) });
  announce(`Added ${state.site}.`);
}

/** @param {string} id @param {Point} at_m @param {boolean} isFine */
async function moveItem(id, at_m, isFine) {
  request += 1;
  if (id.startsWith("obstacle ")) {
    const obstacles = data.project.obstacles.map((/** @type {any} */ other) => (`obstacle ${other.name}` === id ? { ...other, x_m: at_m[0], y_m: at_m[1] } : other));
    await saveObstacles(obstacles);
    return;
  }
  const [x_m, y_m] = at_m.map((value) => Math.round(value * 100) / 100);
  if (isFine) update({ dropped: { site: id, x_m, y_m } });
  const state = await change("PATCH", `sites/${encodeURIComponent(id)}`, { x_m, y_m }, (error) => {
    update({ project: data.project }); // puts it back
    refuse(at_m, error.reason);
  });
  update({ dropped: null });
  if (state) announce(`Moved ${id}.`);
}

/** @param {string} id */
export async function removePole(id) {
  const state = await change("DELETE", `sites/${encodeURIComponent(id)}`);
  if (!state) return;
  update({ selected: null });
  say(`Removed ${id}. Undo brings it back.`);
}

/** @param {Point} at_m @param {string} reason */
function refuse(at_m, reason) {
  mapView().refuse(at_m, `Not here: ${reason}`);
  announce(`Not here: ${reason}`);
}

/** What the ranking calls the best candidate of a pole. @param {string} id @returns {string|null} */
export function candidateOf(id) {
  const pole = data.project.run.state === "none" ? null : data.ranking?.poles.find((/** @type {any} */ other) => siteOf(other.pole) === id);
  return pole?.site ?? null;
}

const dragged = latestWins(async (/** @type {{id: string, at_m: Point}} */ { id, at_m }) => {
  const [x_m, y_m] = at_m;
  if (id.startsWith("obstacle ")) return;
  const answer = await attempt(() => post("sites/check", { x_m, y_m, site: id }));
  const map = mapView();
  if (!answer || map.moving?.id !== id) return;
  const site = answer.ok ? candidateOf(id) : null;
  if (!site || !map.isFine) map.hint(answer.message ?? "", !answer.ok);
  request += 1;
  if (site) await attempt(() => post("score", { site, x_m, y_m, request }), () => undefined);
});

/** @param {any} score answer of the server to the latest position */
export function showScore(score) {
  if (score.request !== request || !view?.moving) return;
  view.hint(score.ok ? `${score.score_text}, rank ${score.rank}` : score.message, !score.ok);
}
