// The counts: numbers at the arrows of the junction's approaches, and their totals.
import { bendOf, isDrawn } from "./arrows.js";
import { byId, h, s, show } from "./dom.js";
import { choiceField, numberField } from "./fields.js";
import { readable } from "./numbers.js";
import { boxAround, mapView } from "./desk_map.js";
import { change, data, isBusy, update } from "./store.js";
import { drawSignals, showBars } from "./signals.js";

/** Numbers that are being typed, by the index of their movement. @type {Map<number, number>} */
const draft = new Map();
/** What the draft belongs to. @type {any} */
let drawnProject = null;
let fitted = "";
/** Name of the period whose counts are shown. */
let period = "";

/** Movements and approaches of the period. @returns {any} */
export const counts = () => data.project.counts.find((/** @type {any} */ each) => each.period === period) ?? data.project.counts[0];

/** @type {Record<string, string>} arrows of a driver who looks up the page */
const TURNS = {
  left: "M15 20V12Q15 8 11 8H5M9 4L5 8L9 12", right: "M9 20V12Q9 8 13 8H19M15 4L19 8L15 12",
  straight: "M12 20V4M8 8L12 4L16 8", "u-turn": "M16 20V10A4 4 0 0 0 8 10V17M4 13L8 17L12 13",
};

/** @param {any} movement */
const countOf = (movement) => draft.get(movement.index) ?? movement.count_per_h;
/** @param {string} approach */
const movementsOf = (approach) => counts().movements.filter((/** @type {any} */ movement) => movement.approach === approach);
/** Vehicles per hour, as typed. @param {any} approach */
export const sumOf = (approach) => movementsOf(approach.approach).reduce((/** @type {number} */ sum, /** @type {any} */ movement) => sum + countOf(movement), 0);

/** @param {any} approach what is wrong with it, also while numbers are typed */
function problemOf(approach) {
  if (approach.limit_per_h && sumOf(approach) > approach.limit_per_h) return `More than its ${approach.lanes} lanes can carry, about ${readable(approach.limit_per_h)}.`;
  return draft.size ? "" : approach.problem;
}

// ---------------------------------------------------------------- panel

/** @param {HTMLElement} panel */
export function drawCounts(panel) {
  const { project } = data;
  const { approaches, reason } = counts();
  if (drawnProject !== project) draft.clear();
  drawnProject = project;
  const isAssumed = project.assumed.some((/** @type {string} */ text) => text.startsWith("traffic"));
  show(panel,
    h("h1", {}, "Traffic"),
    !reason
      ? h("p.todo", {}, isAssumed ? "Numbers that you have not typed are assumed from the map. Type your counts at the arrows, in vehicles per hour." : "Vehicles per hour, at the arrows.")
      : h("p.note", {}, reason),
    approaches.length > 0 && h("div.table", {}, h("table", {}, h("caption.unseen", {}, `Vehicles per hour by approach ${counts().period}`),
      h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "From"), h("th.n", { scope: "col" }, "Lanes"), h("th.n", { scope: "col" }, "Vehicles/h"))),
      h("tbody", {}, approaches.map((/** @type {any} */ approach) => h("tr", {},
        h("th", { scope: "row" }, approach.approach, h("small.reason", { "data-problem": approach.approach }, problemOf(approach))),
        h("td.n", {}, approach.lanes), h("td.n", { "data-sum": approach.approach }, readable(sumOf(approach)))))),
      h("tfoot", {}, h("tr", {}, h("th", { scope: "row" }, "All"), h("td"), h("td.n", { "data-sum": "" }, readable(total())))))),
    drawSignals());
}

function total() {
  return counts().movements.reduce((/** @type {number} */ sum, /** @type {any} */ movement) => sum + countOf(movement), 0);
}

/** Show totals and problems of what is being typed. */
function showTotals() {
  for (const approach of counts().approaches) {
    for (const cell of document.querySelectorAll(`[data-sum="${CSS.escape(approach.approach)}"]`)) cell.textContent = readable(sumOf(approach));
    for (const cell of document.querySelectorAll(`[data-problem="${CSS.escape(approach.approach)}"]`)) cell.textContent = problemOf(approach);
  }
  for (const cell of document.querySelectorAll('[data-sum=""]')) cell.textContent = readable(total());
  placeArrows();
  showBars();
}

// ---------------------------------------------------------------- diagram on the map

const arrows = s("svg.arrows", { "aria-hidden": "true" });
const cards = h("div.cards");
const periods = h("div.periods");
const diagram = h("div.diagram", {}, arrows, periods, cards);
const sizes = new ResizeObserver(() => place());
/** Size of the map on which the cards had no room beside each other. */
let crowded = "";

export function drawDiagram() {
  const stage = byId("stage");
  if (!data.project || data.step !== "traffic" || !data.map) {
    diagram.remove();
    if (fitted && data.map && data.project) mapView().fit(boxAround());
    fitted = "";
    return;
  }
  if (!diagram.isConnected) stage.append(diagram);
  const isLocked = !!counts().reason || isBusy();
  sizes.disconnect();
  show(periods, data.project.counts.length > 1 && periodChoice());
  show(cards, counts().approaches.map((/** @type {any} */ approach) => approachCard(approach, isLocked)));
  for (const card of cards.children) sizes.observe(card); // a message makes a card taller
  const map = mapView();
  map.onPlace = place;
  if (fitted !== data.project.id + data.map.key) {
    fitted = data.project.id + data.map.key;
    crowded = "";
    map.fit(boxOfMovements());
  } else place();
}

function periodChoice() {
  const names = data.project.counts.map((/** @type {any} */ each) => each.period);
  return choiceField({ key: "period", label: "Period", value: counts().period, choices: names.map((/** @type {string} */ name) => [name, name]), send(name) {
    period = name;
    draft.clear();
    update({ project: data.project });
  } });
}

/** Space around the junction for the cards. @returns {[number, number, number, number]} */
function boxOfMovements() {
  const points = counts().movements.filter(isDrawn).flatMap((/** @type {any} */ movement) => [movement.from_m, movement.to_m]);
  if (!points.length) return boxAround();
  const [xs, ys] = [0, 1].map((axis) => points.map((/** @type {number[]} */ point) => point[axis]));
  const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const [x, y, half] = [(x0 + x1) / 2, (y0 + y1) / 2, Math.max(x1 - x0, y1 - y0, 20) * (crowded ? 0.6 : 0.85)];
  const taken = crowded ? cards.offsetWidth / Math.max(1, mapView().width - cards.offsetWidth) : 0; // left of the map
  return [x - half - 2 * half * taken, y - half, x + half, y + half];
}

/** @param {any} approach @param {boolean} isLocked */
function approachCard(approach, isLocked) {
  const movements = movementsOf(approach.approach);
  const rows = movements.map((/** @type {any} */ movement) => {
    const label = `${approach.approach}, ${movement.turn || "all turns"}${movement.to ? ` to ${movement.to}` : ""}`;
    const isTwice = movements.filter((/** @type {any} */ other) => other.turn === movement.turn).length > 1;
    const row = h("div.count", { title: movement.to ? `${movement.turn} to ${movement.to}` : movement.turn },
      s("svg.turn", { viewBox: "0 0 24 24", "aria-hidden": "true" }, s("path", { d: TURNS[movement.turn.toLowerCase()] ?? TURNS.straight })),
      numberField({
        key: `count.${counts().period}.${movement.index}`, label, hasUnseenLabel: true, value: movement.count_per_h, isDisabled: isLocked,
        limits: { min: 0, max: 100000 },
        send(value, refuse) {
          change("PUT", "counts", { period: counts().period, counts: { [movement.index]: value } }, refuse);
        },
        onInput(value) {
          draft.set(movement.index, value ?? 0);
          showTotals();
        },
      }), isTwice && movement.to && h("small", {}, `to ${movement.to}`));
    row.addEventListener("focusin", () => highlight(movement.index));
    row.addEventListener("focusout", () => highlight(null));
    row.addEventListener("pointerenter", () => highlight(movement.index));
    row.addEventListener("pointerleave", () => highlight(null));
    return row;
  });
  return h("fieldset.approach", { "data-approach": approach.approach }, h("legend", {}, approach.approach), rows,
    h("p.sum", {}, h("b", { "data-sum": approach.approach }, readable(sumOf(approach))), " vehicles/h"),
    h("p.reason", { "data-problem": approach.approach }, problemOf(approach)));
}

/** @param {number|null} index */
function highlight(index) {
  for (const path of arrows.querySelectorAll(".flow")) path.classList.toggle("lit", path.getAttribute("data-index") === String(index));
  arrows.classList.toggle("dimmed", index !== null);
}

function place() {
  if (!diagram.isConnected) return;
  const map = mapView();
  const size = `${map.width} ${map.height}`;
  const wasListed = diagram.classList.contains("listed");
  if (crowded !== size) crowded = placeCards() ? "" : size;
  if (diagram.classList.toggle("listed", crowded !== "") === wasListed) placeArrows();
  else map.fit(boxOfMovements()); // calls this again
}

/** Draw an arrow for each movement, as wide as its count. */
function placeArrows() {
  const map = mapView();
  const movements = counts().movements.filter(isDrawn);
  const most = Math.max(1, ...movements.map(countOf));
  arrows.setAttribute("viewBox", `0 0 ${map.width} ${map.height}`);
  const flows = movements.map((/** @type {any} */ movement) => {
    const [from, via, to] = [movement.from_m, movement.via_m, movement.to_m].map((point) => map.toPixel(point));
    const bend = bendOf(from, via, to);
    const width = countOf(movement) > 0 ? 2 + (10 * countOf(movement)) / most : 1;
    const angle = Math.atan2(to[1] - bend[1], to[0] - bend[0]);
    const size = 6 + width * 0.6;
    const corner = (/** @type {number} */ turn) => `${to[0] + size * Math.cos(angle + turn)} ${to[1] + size * Math.sin(angle + turn)}`;
    const head = `M${corner(0)}L${corner(2.3)}L${corner(-2.3)}Z`;
    return s(`g.flow${countOf(movement) > 0 ? "" : ".none"}`, { "data-index": movement.index },
      s("path.line", { d: `M${from.join(" ")}Q${bend.join(" ")} ${to.join(" ")}`, "stroke-width": width }), s("path.head", { d: head }));
  });
  show(arrows, flows, [...cards.children].map(leader));
}

/** A line from a card to its approach. @param {Element} card */
function leader(card) {
  const element = /** @type {HTMLElement} */ (card);
  const approach = counts().approaches.find((/** @type {any} */ other) => other.approach === element.dataset.approach);
  if (getComputedStyle(element).position !== "absolute" || !approach) return null;
  const [x, y] = mapView().toPixel(approach.at_m);
  const nearest = (/** @type {number} */ at, /** @type {number} */ low, /** @type {number} */ size) => Math.min(Math.max(at, low), low + size);
  const end = [nearest(x, element.offsetLeft, element.offsetWidth), nearest(y, element.offsetTop, element.offsetHeight)];
  return s("path.leader", { d: `M${x} ${y}L${end.join(" ")}` });
}

/** Put each card at the edge of the map, on the side of its approach. @returns {boolean} whether no two overlap, and the middle is free */
function placeCards() {
  const map = mapView();
  diagram.classList.remove("listed");
  if (!cards.firstElementChild || getComputedStyle(cards.firstElementChild).position !== "absolute") return true; // on phones they are below it
  const places = /** @type {HTMLElement[]} */ ([...cards.children]).map((card, number) => {
    const [x, y] = map.toPixel(counts().approaches[number].at_m);
    const [dx, dy] = [x - map.width / 2, y - map.height / 2];
    const [w, height] = [card.offsetWidth, card.offsetHeight];
    const [roomX, roomY] = [Math.max(1, (map.width - w) / 2 - 12), Math.max(1, (map.height - height) / 2 - 12)];
    const scale = 1 / Math.max(Math.abs(dx) / roomX, Math.abs(dy) / roomY, 1e-6);
    return { card, x: map.width / 2 + dx * scale - w / 2, y: map.height / 2 + dy * scale - height / 2, w, h: height };
  });
  let rounds = 80;
  while (rounds > 0 && pushApart(places, map)) rounds -= 1;
  for (const { card, x, y } of places) {
    card.style.left = `${Math.round(x)}px`;
    card.style.top = `${Math.round(y)}px`;
  }
  const isInMiddle = (/** @type {number} */ at, /** @type {number} */ size, /** @type {number} */ room) => at < (2 * room) / 3 && at + size > room / 3;
  return rounds > 0 && !places.some(({ x, y, w, h: height }) => isInMiddle(x, w, map.width) && isInMiddle(y, height, map.height));
}

/** @typedef {{card: HTMLElement, x: number, y: number, w: number, h: number}} Place */

/** @param {Place[]} places @param {{width: number, height: number}} room @returns {boolean} whether one was moved */
function pushApart(places, room) {
  let moved = false;
  for (const [number, a] of places.entries()) for (const b of places.slice(number + 1)) {
    const overX = Math.min(a.x + a.w, b.x + b.w) - Math.max(a.x, b.x) + 8;
    const overY = Math.min(a.y + a.h, b.y + b.h) - Math.max(a.y, b.y) + 8;
    if (overX <= 0.5 || overY <= 0.5) continue;
    moved = true;
    if (overX < overY) shift(a, b, "x", overX / 2);
    else shift(a, b, "y", overY / 2);
  }
  for (const spot of places) {
    spot.x = Math.max(8, Math.min(spot.x, room.width - spot.w - 8));
    spot.y = Math.max(8 + periods.offsetTop + periods.offsetHeight, Math.min(spot.y, room.height - spot.h - 8));
  }
  return moved;
}

/** @param {Place} a @param {Place} b @param {"x"|"y"} axis @param {number} by */
function shift(a, b, axis, by) {
  const sign = a[axis] <= b[axis] ? -1 : 1;
  a[axis] += sign * by;
  b[axis] -= sign * by;
}
