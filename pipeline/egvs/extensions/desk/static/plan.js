// The plan: how many sensors, which poles they take, and what each of them adds.
import { h, s, show } from "./dom.js";
import { latestWins } from "./api.js";
import { button, numberField, radioField } from "./fields.js";
import { capitalised, fieldText, percent, readable } from "./numbers.js";
import { choosePole, siteOf } from "./desk_map.js";
import { change, data, isBusy, runJob, update } from "./store.js";
import { drawTrial } from "./trial.js";
import { drawWhatIf } from "./what_if.js";

/** Approximate number of steps of the budget's slider. */
const STEPS = 40;
/** What is being chosen. */
const request = { by: "count", count: 2, budget: /** @type {number|null} */ (null) };
/** Plan whose request was taken over. @type {any} */
let shownPlan = null;

/** @param {HTMLElement} panel */
export function drawPlan(panel) {
  const { project, plan, ranking } = data;
  if (plan !== shownPlan) {
    shownPlan = plan;
    if (plan?.requested.count) Object.assign(request, { by: "count", count: plan.requested.count });
    if (plan?.requested.budget) Object.assign(request, { by: "budget", budget: Number(plan.requested.budget) });
  }
  const hasResults = project.run.state === "complete" || (project.run.state === "outdated" && ranking);
  show(panel,
    h("h1", {}, "Decide"),
    hasResults
      ? h("p.todo", {}, !plan ? "How many sensors? The best poles for them follow." : plan.outdated ? "Something has changed since. Find the plan again, or undo the change." : "The best poles for these sensors. Try other numbers, or drag a sensor to see what it would find alone.")
      : h("p.todo", {}, "Run first: the plan needs the scores of the poles."),
    hasResults && chooser(),
    plan && drawResult(plan),
    plan && drawTrial(plan),
    data.keptPlan && plan && comparison(data.keptPlan, plan),
    project.obstacles && drawWhatIf());
}

const choose = latestWins(async (/** @type {Record<string, unknown>} */ body) => {
  await runJob("plan", body);
});

// ---------------------------------------------------------------- count or budget

function chooser() {
  const most = Math.max(1, Math.min(data.project.costs.most_sensors, data.project.sites.length));
  request.count = Math.min(request.count, most);
  const redraw = () => update({ plan: data.plan });
  return h("section.card", {},
    radioField({ name: "by", label: "Limited by", value: request.by, choices: [["count", "number of sensors"], ["budget", "budget"]], send(by) {
      request.by = by;
      redraw();
    } }),
    request.by === "count" ? countSlider(most) : budgetFields(),
    button(request.by === "count" ? countText() : "Find the best plan for the budget", () => choose(body()), {
      key: "find", isMain: true, isDisabled: isBusy() || (request.by === "budget" && !request.budget),
    }));
}

const countText = () => `Find the best ${request.count === 1 ? "pole" : `${request.count} poles`}`;

function body() {
  return request.by === "count" ? { count: request.count } : { budget: request.budget };
}

/** @param {number} most */
function countSlider(most) {
  const output = h("output", { for: "count" }, request.count);
  const slider = h("input", { id: "count", type: "range", min: 1, max: most, step: 1, value: request.count, "data-key": "count" });
  whenSlid(slider, () => {
    request.count = Number(slider.value);
    output.textContent = slider.value;
    const find = document.querySelector('[data-key="find"]');
    if (find) find.textContent = countText();
  });
  return h("div.slider", {}, h("label", { for: "count" }, "Sensors"), slider, output);
}

/** Call a function while a slider moves; find the plan again in the end, if there is one. @param {HTMLInputElement} slider @param {() => void} onInput */
function whenSlid(slider, onInput) {
  slider.addEventListener("input", onInput);
  slider.addEventListener("change", () => data.plan && choose(body()));
}

function budgetFields() {
  const { costs } = data.project;
  const used = Object.keys(costs.sensor_costs);
  const money = (/** @type {string} */ key, /** @type {string} */ label, /** @type {number|null} */ value, /** @type {(value: number|null) => object} */ setting) => numberField({
    key, label, value, limits: { min: 0 }, placeholder: "not given", send: (typed, refuse) => change("PUT", "settings", setting(typed), refuse),
  });
  return [
    h("div.pair", {}, money("pole_cost", "A new pole costs", costs.pole_cost, (pole_cost) => ({ pole_cost })),
      used.map((name) => money(`cost.${name}`, `A ${used.length > 1 ? name : "sensor"} costs`, costs.sensor_costs[name], (cost) => ({ sensor_costs: { [name]: cost } })))),
    budgetSlider(costs),
  ];
}

/** Budgets from the cheapest plan to the dearest one, with round numbers between them. @param {number} least @param {number} most */
function budgets(least, most) {
  const power = 10 ** Math.floor(Math.log10((most - least) / STEPS || 1));
  const step = power * ([1, 2, 5].find((factor) => (most - least) / STEPS <= factor * power) ?? 10);
  const round = [];
  for (let number = Math.floor(least / step) + 1; number * step < most; number += 1) round.push(number * step);
  return [...new Set([least, ...round, most])];
}

/** @param {{least: number|null, most: number|null}} costs of the cheapest and the dearest plan; null where they are not known */
function budgetSlider({ least, most }) {
  const stops = least === null || most === null ? [] : budgets(least, most);
  request.budget ??= data.plan?.cost || least;
  const field = numberField({ key: "budget", label: "Budget", value: request.budget, limits: { min: 0 }, send(value) {
    request.budget = value;
    update({ plan: data.plan });
  } });
  if (stops.length < 2) return field;
  const at = stops.findIndex((stop) => stop >= (request.budget ?? 0));
  const slider = h("input", {
    type: "range", min: 0, max: stops.length - 1, step: 1, value: at < 0 ? stops.length - 1 : at, "data-key": "budget_slider",
    "aria-label": "Budget from the cheapest to the dearest plan", "aria-valuetext": readable(request.budget),
  });
  whenSlid(slider, () => {
    request.budget = stops[Number(slider.value)];
    slider.setAttribute("aria-valuetext", readable(request.budget));
    const input = field.querySelector("input");
    if (input) input.value = fieldText(request.budget);
  });
  return h("div.slider.budget", {}, slider, field);
}

// ---------------------------------------------------------------- result

/** @param {any} plan */
function drawResult(plan) {
  const hasCost = plan.sensors.some((/** @type {any} */ sensor) => sensor.cost);
  return h("section", {},
    h("h2", {}, plan.outdated ? "Plan before the changes" : `${plan.sensors.length} ${plan.sensors.length === 1 ? "sensor" : "sensors"}: ${plan.score_text} ${plan.label}`),
    !plan.outdated && h("p", {}, `${plan.headline}.`),
    h("p.quiet", {}, `${capitalised(plan.certificate_text)}.`, hasCost && ` Costs ${readable(plan.cost)}.`),
    h("ol.sensors", {}, plan.sensors.map((/** @type {any} */ sensor) => sensorItem(sensor, ` ${plan.change_unit}`))),
    curve(plan),
    h("div.tools", {},
      !plan.outdated && !plan.sensors.some((/** @type {any} */ sensor) => sensor.adds_text.length) && button("What does each sensor add?", () => runJob("additions"), { key: "adds", isDisabled: isBusy() }),
      button(data.keptPlan ? "Compare with this one instead" : "Keep, to compare with another", () => update({ keptPlan: plan }), { key: "keep" })));
}

/** @param {any} sensor @param {string} points unit of gains */
function sensorItem(sensor, points) {
  const name = siteOf(sensor.pole ?? sensor.site);
  return h("li", {}, h("div", {},
    h("button.link", { type: "button", "data-key": `sensor.${sensor.site}`, "aria-pressed": String(name === data.selected), onclick: () => choosePole(name) }, sensor.pole ?? sensor.site),
    ` ${sensor.sensor}, ${readable(sensor.z_m, 1)} m up, tilt ${readable(sensor.pitch_deg)}°`,
    h("small", {}, `Adds ${sensor.gain_text}${points}`, sensor.loss_text && `; if it fails, ${sensor.loss_text}${points} are lost`, sensor.cost ? `; costs ${readable(sensor.cost)}` : "", sensor.forced && "; it must be chosen"),
    sensor.adds_text.map((/** @type {string} */ text) => h("small", {}, text))));
}

/** What 1, 2, ... sensors reach. @param {any} plan */
function curve(plan) {
  const points = plan.curve;
  if (points.length < 2) return null;
  const most = Math.max(...points.map((/** @type {any} */ point) => point.score));
  const [step, height] = [Math.min(60, 300 / points.length), 90];
  const bars = points.map((/** @type {any} */ point, /** @type {number} */ at) => {
    const tall = most > 0 ? (height * point.score) / most : 0;
    return s(`g${point.count === plan.sensors.length ? ".chosen" : ""}`, {},
      s("rect", { x: at * step + 4, y: 16 + height - tall, width: step - 8, height: tall, rx: 2 }),
      s("text", { x: at * step + step / 2, y: 12 + height - tall }, plan.unit === "%" ? percent(point.score) : readable(point.score)),
      s("text", { x: at * step + step / 2, y: height + 30 }, point.count));
  });
  const label = points.map((/** @type {any} */ point) => `${point.count}: ${point.score_text}`).join("; ");
  return h("figure", {}, s("svg.curve", { viewBox: `0 0 300 ${height + 36}`, role: "img", "aria-label": `${plan.label} by number of sensors. ${label}` }, bars), h("figcaption", {}, `${capitalised(plan.label)} by number of sensors`));
}

/** @param {any} a @param {any} b */
function comparison(a, b) {
  const names = (/** @type {any} */ plan) => plan.sensors.map((/** @type {any} */ sensor) => sensor.site).join(", ");
  /** @type {[string, (plan: any) => import("./dom.js").Child][]} */
  const lines = [["Sensors", (plan) => plan.sensors.length], [capitalised(b.label), (plan) => plan.score_text], ["Costs", (plan) => (plan.cost ? readable(plan.cost) : "–")], ["Poles", names]];
  return h("section.card", {}, h("h2", {}, "Two plans"), h("div.table", {}, h("table.compare", {}, h("caption.unseen", {}, "The plan that was kept, and this one"),
    h("thead", {}, h("tr", {}, h("td"), h("th", { scope: "col" }, "Kept"), h("th", { scope: "col" }, "This one"))),
    h("tbody", {}, lines.map(([title, cell]) => h("tr", {}, h("th", { scope: "row" }, title), h("td", {}, cell(a)), h("td", {}, cell(b))))))),
  button("Forget the one that was kept", () => update({ keptPlan: null })));
}
