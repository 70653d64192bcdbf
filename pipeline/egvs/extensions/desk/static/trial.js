// Another sensor on one pole of the plan, as a trial.
import { h } from "./dom.js";
import { button, choiceField } from "./fields.js";
import { siteOf } from "./desk_map.js";
import { announce, change, data, isBusy, runJob, say, update } from "./store.js";

/** What is tried. */
const choice = { site: "", sensor: "" };

/** @param {any} plan */
export function drawTrial(plan) {
  const { project, trial } = data;
  if (plan.outdated || !project.sites_editable) return null;
  /** @type {Map<string, string>} */
  const present = new Map(plan.sensors.map((/** @type {any} */ sensor) => [siteOf(sensor.site), sensor.sensor]));
  if (!present.has(choice.site)) choice.site = [...present.keys()][0] ?? "";
  const others = project.sensors.filter((/** @type {string} */ name) => name !== present.get(choice.site));
  if (!others.includes(choice.sensor)) choice.sensor = "";
  const field = (/** @type {"site"|"sensor"} */ key, /** @type {string} */ label, /** @type {[string, string][]} */ choices) => choiceField({
    key: `trial.${key}`, label, value: choice[key], choices, isDisabled: isBusy(), send(value) {
      choice[key] = value;
      update({ trial: null });
    },
  });
  return h("section.card", {}, h("h2", {}, "Another sensor on one pole?"),
    h("p.quiet", {}, "A trial: it changes no file."),
    h("div.pair", {},
      field("site", "Pole", [...present.keys()].map((name) => [name, name])),
      field("sensor", "Sensor to try", [["", "choose"], ...others.map((/** @type {string} */ name) => [name, name])])),
    h("div.tools", {}, button("Try it", tryIt, { key: "try", isDisabled: isBusy() || !choice.sensor })),
    trial && [
      h("p", {}, sentence(trial)),
      h("p.quiet", {}, "To keep it, write it to the list of poles; then run, and find the plan again."),
      button("Write it to the list of poles", keep, { key: "keep_trial", isDisabled: isBusy() }),
    ]);
}

/** @param {any} trial */
const sentence = ({ site, sensor, label, before_text, after_text, change_text }) => `With ${sensor} on ${site}, ${label} is ${after_text} instead of ${before_text} (${change_text}).`;

async function tryIt() {
  const job = await runJob("trial", choice);
  if (!job) return;
  update({ trial: job.result });
  announce(sentence(job.result));
}

async function keep() {
  const { site, sensor } = data.trial;
  if (await change("PATCH", `sites/${encodeURIComponent(site)}`, { sensor })) say(`${site} has the sensor ${sensor} now. Run again, then find the plan.`);
}
