// The signal plans: the stages of a cycle, with the movements that are green in each.
import { h, s } from "./dom.js";
import { numberField } from "./fields.js";
import { readable } from "./numbers.js";
import { bendOf, isDrawn } from "./arrows.js";
import { change, data, isBusy } from "./store.js";

const SIZE = 76;

export function drawSignals() {
  const signals = data.project.signals ?? [];
  return signals.length > 0 && h("section", {}, signals.map(signalCard));
}

/** @param {any} signal */
function signalCard(signal) {
  const isLocked = isBusy();
  const cycle = signal.phases.reduce((/** @type {number} */ sum, /** @type {any} */ phase) => sum + phase.green_s + phase.yellow_s + phase.all_red_s, 0);
  return h("section.card", {}, h("h2", {}, "Signals"),
    h("p.quiet", {}, `${/^\d+$/.test(signal.title) ? "Cycle" : `${signal.title}: cycle`} ${readable(cycle)} s.`, signal.assumed && " Assumed: type the real times if you know them.", !signal.editable && ` ${signal.reason}`),
    cycleBar(signal, cycle),
    h("ol.phases", {}, signal.phases.map((/** @type {any} */ phase, /** @type {number} */ number) => h("li", {}, stage(phase),
      h("div.times", {}, ["green_s", "yellow_s", "all_red_s"].map((name) => time(signal, number, name, isLocked)))))));
}

/** Greens of the cycle, one after the other. @param {any} signal @param {number} cycle */
function cycleBar(signal, cycle) {
  let start = 0;
  const parts = signal.phases.flatMap((/** @type {any} */ phase) => [["green", phase.green_s], ["yellow", phase.yellow_s], ["red", phase.all_red_s]].map(([kind, length]) => {
    const part = s(`rect.${kind}`, { x: (300 * start) / cycle, width: (300 * length) / cycle, height: 14 });
    start += length;
    return part;
  }));
  return s("svg.cycle", { viewBox: "0 0 300 14", preserveAspectRatio: "none", "aria-hidden": "true" }, parts);
}

/** Small map of the junction with the arrows that are green. @param {any} phase */
function stage(phase) {
  const { movements } = data.project;
  const drawn = movements.filter(isDrawn);
  const points = drawn.flatMap((/** @type {any} */ movement) => [movement.from_m, movement.to_m]);
  const [xs, ys] = [0, 1].map((axis) => points.map((/** @type {number[]} */ point) => point[axis]));
  const [x, y] = [(Math.min(...xs) + Math.max(...xs)) / 2, (Math.min(...ys) + Math.max(...ys)) / 2];
  const scale = (SIZE - 16) / Math.max(1, Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys));
  const at = (/** @type {number[]} */ point) => [SIZE / 2 + (point[0] - x) * scale, SIZE / 2 - (point[1] - y) * scale];
  /** @type {string[]} */
  const names = [];
  const paths = drawn.map((/** @type {any} */ movement) => {
    const isGreen = phase.green.includes(movement.index);
    if (isGreen) names.push(`${movement.approach} ${movement.turn}`);
    const [from, via, to] = [movement.from_m, movement.via_m, movement.to_m].map(at);
    const bend = bendOf(from, via, to);
    const angle = Math.atan2(to[1] - bend[1], to[0] - bend[0]);
    const corner = (/** @type {number} */ turn) => `${to[0] + 5 * Math.cos(angle + turn)} ${to[1] + 5 * Math.sin(angle + turn)}`;
    return s(`g${isGreen ? ".green" : ".waits"}`, {}, s("path.line", { d: `M${from.join(" ")}Q${bend.join(" ")} ${to.join(" ")}` }),
      isGreen && s("path.head", { d: `M${corner(0)}L${corner(2.3)}L${corner(-2.3)}Z` }));
  });
  const waiting = paths.filter((/** @type {Element} */ path) => path.classList.contains("waits"));
  const green = paths.filter((/** @type {Element} */ path) => path.classList.contains("green"));
  return s("svg.stage", { viewBox: `0 0 ${SIZE} ${SIZE}`, role: "img", "aria-label": `Green: ${names.join(", ") || "none"}` }, waiting, green);
}

const NAMES = { green_s: "Green", yellow_s: "Yellow", all_red_s: "All red" };

/** @param {any} signal @param {number} number @param {string} name @param {boolean} isLocked */
function time(signal, number, name, isLocked) {
  return numberField({
    key: `signal.${signal.name}.${number}.${name}`, label: /** @type {any} */ (NAMES)[name], labelMore: `, stage ${number + 1}`, unit: "s", value: signal.phases[number][name],
    isDisabled: isLocked, limits: { min: name === "green_s" ? 1 : 0, max: 300 },
    send(value, refuse) {
      const phases = signal.phases.map((/** @type {any} */ phase, /** @type {number} */ other) => (other === number ? { ...phase, [name]: value } : phase));
      change("PUT", "signals", { name: signal.name, phases }, refuse);
    },
  });
}
