// The signal plans: who has green when, as bars over the cycle, and the stages with their times.
import { h, s, show } from "./dom.js";
import { numberField } from "./fields.js";
import { readable } from "./numbers.js";
import { bendOf, isDrawn } from "./arrows.js";
import { counts, sumOf } from "./counts.js";
import { change, data, isBusy } from "./store.js";

const SIZE = 76;
const WIDTH = 300;
const ROW = 31;
const TOP = 16;

/** Plans that are shown, with the times as they are typed. @type {{signal: any, bars: HTMLElement}[]} */
let shown = [];

export function drawSignals() {
  const [editable, others] = [true, false].map((isEditable) => data.project.signals.filter((/** @type {any} */ { phases }) => isEditable === phases.length > 0));
  shown = editable.map((/** @type {any} */ signal) => ({ signal: structuredClone(signal), bars: h("div") }));
  showBars();
  return data.project.signals.length > 0 && h("section", {},
    shown.map(({ signal, bars }) => signalCard(signal, bars)),
    others.length > 0 && h("section.card", {}, h("h2", {}, shown.length ? "Other signals" : "Signals"), others.map((/** @type {any} */ { title, file }) => h("p.quiet", {}, `The plan of ${title} is in ${file}; edit it there.`))));
}

/** Draw the bars for the numbers that are being typed. */
export function showBars() {
  for (const { signal, bars } of shown) show(bars, diagram(signal), problems(signal));
}

/** @param {any} signal */
const lengthsOf = (signal) => signal.phases.map((/** @type {any} */ phase) => phase.green_s + signal.yellow_s + signal.all_red_s);
/** @param {number[]} numbers */
const sum = (numbers) => numbers.reduce((total, number) => total + number, 0);

/** @param {any} signal @param {HTMLElement} bars */
function signalCard(signal, bars) {
  const columns = h("div.stages", {}, signal.phases.map((/** @type {any} */ phase, /** @type {number} */ number) => h("div", {}, stage(phase), time(signal, number))));
  columns.style.gridTemplateColumns = lengthsOf(signal).map((/** @type {number} */ length) => `minmax(4.75rem, ${length}fr)`).join(" ");
  return h("section.card", {}, h("h2", {}, "Signals"),
    h("p.quiet", {}, !/^\d+$/.test(signal.title) && `${signal.title}. `, signal.assumed && "Times that you have not typed are assumed.", signal.actuated && " Green lasts longer while vehicles arrive, so that the cycle changes."),
    columns, bars,
    h("div.pair", {}, time(signal, "yellow_s"), time(signal, "all_red_s")));
}

// ---------------------------------------------------------------- bars

/**
 * Movements of an approach that are green in the same stages.
 * @typedef {{approach: string, label: string, isGreen: boolean[]}} Row
 * @param {any} signal @returns {Row[]}
 */
function rowsOf(signal) {
  /** @type {Map<string, Map<string, boolean[]>>} turns of each approach, and the stages in which they are green */
  const approaches = new Map();
  for (const [number, { green }] of signal.phases.entries())
    for (const { approach, turns } of green) {
      const known = approaches.get(approach) ?? new Map();
      approaches.set(approach, known);
      for (const turn of turns) {
        if (!known.has(turn)) known.set(turn, signal.phases.map(() => false));
        known.get(turn)[number] = true;
      }
    }
  return [...approaches].flatMap(([approach, known]) => {
    const patterns = [...new Map([...known.values()].map((isGreen) => [isGreen.join(), isGreen])).values()];
    const turnsOf = (/** @type {boolean[]} */ isGreen) => [...known].filter(([, other]) => other.join() === isGreen.join()).map(([turn]) => turn).join(", ");
    return patterns.map((isGreen) => ({ approach, isGreen, label: patterns.length > 1 ? `${approach}: ${turnsOf(isGreen)}` : approach }));
  });
}

/** Green, yellow and red of a row: kind, begin and length. @param {any} signal @param {Row} row @returns {[string, number, number][]} */
function partsOf(signal, { isGreen }) {
  const lengths = lengthsOf(signal);
  let start = 0;
  return lengths.flatMap((/** @type {number} */ length, /** @type {number} */ number) => {
    const begin = start;
    start += length;
    if (!isGreen[number]) return [["red", begin, length]];
    if (isGreen[(number + 1) % lengths.length]) return [["green", begin, length]];
    const { green_s } = signal.phases[number];
    return [["green", begin, green_s], ["yellow", begin + green_s, signal.yellow_s], ["red", begin + green_s + signal.yellow_s, signal.all_red_s]];
  });
}

/** @param {any} signal */
function diagram(signal) {
  const lengths = lengthsOf(signal);
  const cycle = sum(lengths);
  const x = (/** @type {number} */ second) => (WIDTH * second) / cycle;
  const rows = rowsOf(signal);
  const bottom = TOP + rows.length * ROW;
  const starts = lengths.map((/** @type {number} */ _, /** @type {number} */ number) => sum(lengths.slice(0, number)));
  const greens = (/** @type {Row} */ row) => partsOf(signal, row).filter(([kind]) => kind === "green").map(([, begin, length]) => `${readable(begin)} to ${readable(begin + length)}`);
  const text = rows.map((row) => `${row.label}: green ${greens(row).join(" and ")} s`).join("; ");
  return s("svg.cycle", { viewBox: `0 0 ${WIDTH} ${bottom + 14}`, role: "img", "aria-label": `Cycle of ${readable(cycle)} s. ${text}` },
    starts.map((/** @type {number} */ start, /** @type {number} */ number) => [
      s("path.begin", { d: `M${x(start)} 2V${bottom}` }), s("text.number", { x: x(start) + 4, y: 11 }, number + 1), s("text", { x: x(start), y: bottom + 12 }, readable(start)),
    ]).flat(),
    s("text.end", { x: WIDTH, y: bottom + 12 }, `${readable(cycle)} s`),
    rows.flatMap((row, number) => [
      s("text.row", { x: 2, y: TOP + number * ROW + 11 }, row.label),
      ...partsOf(signal, row).map(([kind, begin, length]) => {
        const height = kind === "red" ? 3 : 11; // not only the colour tells them apart
        return s(`rect.${kind}`, { x: x(begin), y: TOP + number * ROW + 26 - height, width: x(length), height });
      }),
    ]));
}

/** Approaches with more vehicles than their green can carry. @param {any} signal */
function problems(signal) {
  const cycle = sum(lengthsOf(signal));
  return counts().approaches.flatMap((/** @type {any} */ approach) => {
    const rows = rowsOf(signal).filter((row) => row.approach === approach.approach);
    const isGreen = signal.phases.map((/** @type {any} */ _, /** @type {number} */ number) => rows.some((row) => row.isGreen[number]));
    const green = sum(partsOf(signal, { approach: "", label: "", isGreen }).filter(([kind]) => kind === "green").map(([, , length]) => length));
    const most = (approach.limit_per_h * green) / cycle;
    return rows.length && sumOf(approach) > most ? [h("p.reason", {}, `${approach.approach}: more vehicles than its green can carry, about ${readable(most)} an hour.`)] : [];
  });
}

// ---------------------------------------------------------------- stages

/** @param {any} phase @param {any} movement */
const isGreenIn = (phase, movement) => phase.green.some((/** @type {any} */ row) => row.approach === movement.approach && (row.turns.includes(movement.turn) || row.turns.includes("all")));

/** Small map of the junction with the arrows that are green. @param {any} phase */
function stage(phase) {
  const drawn = counts().movements.filter(isDrawn);
  const points = drawn.flatMap((/** @type {any} */ movement) => [movement.from_m, movement.to_m]);
  const [xs, ys] = [0, 1].map((axis) => points.map((/** @type {number[]} */ point) => point[axis]));
  const [x, y] = [(Math.min(...xs) + Math.max(...xs)) / 2, (Math.min(...ys) + Math.max(...ys)) / 2];
  const scale = (SIZE - 16) / Math.max(1, Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys));
  const at = (/** @type {number[]} */ point) => [SIZE / 2 + (point[0] - x) * scale, SIZE / 2 - (point[1] - y) * scale];
  /** @type {string[]} */
  const names = [];
  const paths = drawn.map((/** @type {any} */ movement) => {
    const isGreen = isGreenIn(phase, movement);
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

/** @param {any} signal @param {number|"yellow_s"|"all_red_s"} which number of a stage, for its green */
function time(signal, which) {
  const isGreen = typeof which === "number";
  const value = isGreen ? signal.phases[which].green_s : signal[which];
  const take = (/** @type {number} */ seconds) => {
    if (isGreen) signal.phases[which].green_s = seconds;
    else signal[which] = seconds;
  };
  return numberField({
    key: `signal.${signal.name}.${which}`, label: isGreen ? "Green" : which === "yellow_s" ? "Yellow" : "All red", labelMore: isGreen ? `, stage ${which + 1}` : "",
    unit: "s", value, isDisabled: isBusy(), limits: { min: isGreen ? 1 : 0, max: 300 },
    onInput(seconds) {
      take(seconds ?? 0);
      showBars();
    },
    send(seconds, refuse) {
      take(seconds ?? 0);
      const { name, yellow_s, all_red_s, phases } = signal;
      change("PUT", "signals", { name, yellow_s, all_red_s, green_s: phases.map((/** @type {any} */ phase) => phase.green_s) }, refuse);
    },
  });
}
