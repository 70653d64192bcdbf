// The poles: a list of the candidates, what can be changed of the chosen one, and what holds for all.
import { get } from "./api.js";
import { h, show } from "./dom.js";
import { pictureCard } from "./aerial.js";
import { button, checkField, choiceField, numberField, pagedTable, textInput, turnTo } from "./fields.js";
import { fieldText, parseNumber, readable } from "./numbers.js";
import { choosePole, kindOf, removePole } from "./desk_map.js";
import { attempt, change, data, isBusy, update } from "./store.js";

/** @type {[string, string][]} */
const USES = [["may", "may be chosen"], ["must", "must be chosen"], ["must_not", "must not be chosen"]];

/** Site whose row the list shows. @type {string|null} */
let listed = null;

/** @param {HTMLElement} panel */
export function drawPoles(panel) {
  const { project } = data;
  const { sites } = project;
  const isLocked = !project.sites_editable || isBusy();
  const chosen = sites.find((/** @type {any} */ site) => site.site === data.selected);
  if (data.selected !== listed) turnTo("poles", sites.indexOf(chosen));
  listed = data.selected;
  show(panel,
    h("h1", {}, "Poles"),
    project.sites_editable
      ? h("p.todo", {}, sites.length ? "Which poles could carry a sensor? Click one to change it, drag it to move it." : "Add the poles that could carry a sensor.")
      : h("p.note", {}, project.sites_reason),
    h("div.tools", {},
      button("Add a pole", () => update({ isAdding: !data.isAdding }), { isDisabled: isLocked, pressed: data.isAdding }),
      button(data.suggestions ? "Hide kerb positions" : "Show kerb positions", showKerbs, { key: "kerbs", isDisabled: isLocked })),
    data.isAdding && h("p.quiet", {}, "Click on the map where it stands. Or go to the map, move the cross with the arrow keys, and press Enter."),
    data.suggestions && h("p.quiet", {}, data.suggestions.length ? "Click a ring on the map to add a pole there." : "No other position at the kerbs is free."),
    sites.length > 0 && legend(),
    chosen && details(chosen, isLocked),
    sites.length > 0 && h("h2", {}, sites.length === 1 ? "1 candidate" : `${sites.length} candidates`),
    sites.length > 0 && pagedTable({
      key: "poles", caption: "Candidate poles", rows: sites, redraw: () => update({ project }), isSelected: (site) => site.site === data.selected,
      columns: [
        { title: "Pole", isHead: true, cell: (site) => h("button.link", {
          type: "button", "data-key": `pole.${site.site}`, "aria-pressed": String(site.site === data.selected), onclick: () => choosePole(site.site),
        }, site.site) },
        { title: "Kind", cell: (site) => h("span", {}, kindOf(site), site.moved_m > 0 && h("small", {}, `assumed, moved ${readable(site.moved_m, 1)} m`)) },
        { title: "Height, m", isNumber: true, cell: (site) => (site.z_m === null ? h("span.quiet", {}, listText(project.mounts.heights_m)) : fieldText(site.z_m)) },
        { title: "Use", cell: (site) => (site.must ? "must" : site.must_not ? "must not" : "") },
      ],
    }),
    forAll(project, isLocked),
    pictureCard(),
    assumptions(project));
}

/** What the new scenario assumed, and what was noticed in its map. @param {any} project */
function assumptions({ assumed, notes }) {
  const list = (/** @type {string} */ title, /** @type {string[]} */ texts) => texts.length > 0 && [h("h2", {}, title), h("ul.notes", {}, texts.map((text) => h("li", {}, text)))];
  return (assumed.length > 0 || notes.length > 0) && h("details.card", {}, h("summary", {}, "Assumed, not measured"), list("Assumed", assumed), list("Noticed in the map", notes));
}

function legend() {
  const key = (/** @type {string} */ name, /** @type {string} */ text) => h("li", {}, h(`i.key.${name}`), text);
  return h("ul.legend", {}, key("existing", "existing pole"), key("new", "new pole"), key("assumed", "position assumed"));
}

async function showKerbs() {
  if (data.suggestions) return update({ suggestions: null });
  const answer = await attempt(() => get("suggestions"));
  if (!answer) return;
  const isFree = (/** @type {any} */ pole) => data.project.sites.every((/** @type {any} */ site) => Math.hypot(site.x_m - pole.x_m, site.y_m - pole.y_m) > 1);
  update({ suggestions: answer.poles.filter(isFree) });
}

/** @param {any} site @param {boolean} isLocked */
function details(site, isLocked) {
  const { project } = data;
  const path = `sites/${encodeURIComponent(site.site)}`;
  const field = (/** @type {string} */ name, /** @type {string} */ label, /** @type {any} */ options = {}) => numberField({
    key: `${site.site}.${name}`, label, value: site[name], isDisabled: isLocked, ...options, limits: { optional: true, ...options.limits },
    send: (value, refuse) => change("PATCH", path, { [name]: value }, refuse),
  });
  const heights = listText(project.mounts.heights_m);
  const tilts = listText(project.mounts.pitch_deg);
  const sensor = choiceField({
    key: `${site.site}.sensor`, label: "Sensor", value: site.sensor ?? "", isDisabled: isLocked,
    choices: [["", `as for all (${project.mounts.sensor})`], ...project.sensors.map((/** @type {string} */ name) => [name, name])],
    send: (name) => change("PATCH", path, { sensor: name || null }),
  });
  const use = choiceField({
    key: `${site.site}.use`, label: "In a plan, it", value: site.must ? "must" : site.must_not ? "must_not" : "may", choices: USES, isDisabled: isLocked,
    send: (value) => change("PATCH", path, { must: value === "must", must_not: value === "must_not" }),
  });
  return h("section.card.details", { "aria-label": `Pole ${site.site}` },
    h("h2", {}, site.site),
    h("p.quiet", {}, [kindOf(site), site.moved_m > 0 && `position assumed, moved ${readable(site.moved_m, 1)} m`, site.source].filter(Boolean).join(" · ")),
    textInput({ key: `${site.site}.site`, label: "Name", text: site.site, isDisabled: isLocked, send: async (text, refuse) => {
      const state = await change("PATCH", path, { site: text.trim() }, refuse);
      if (state) update({ selected: text.trim() });
    } }),
    h("div.pair", {},
      field("z_m", "Height", { unit: "m", limits: { min: 0.5, max: 100 }, placeholder: heights }),
      field("pitch_deg", "Tilt (negative looks down)", { unit: "°", limits: { min: -90, max: 90 }, placeholder: tilts })),
    h("div.pair", {},
      field("x_m", "East", { unit: "m", limits: { optional: false } }),
      field("y_m", "North", { unit: "m", limits: { optional: false } })),
    sensor,
    use,
    h("div.pair", {}, field("cost", "Cost", { limits: { min: 0 }, placeholder: "as for all" }), checkField(`${site.site}.exists`, "The pole exists already", site.exists, (isChecked) => change("PATCH", path, { exists: isChecked }), isLocked)),
    button("Remove this pole", () => removePole(site.site), { isDisabled: isLocked }));
}

// ---------------------------------------------------------------- what holds for all poles

/** @param {(number|string)[]} values */
function listText(values) {
  return values.map((value) => (typeof value === "number" ? fieldText(value) : value)).join("; ");
}

/**
 * @param {string} text numbers with semicolons, spaces, or commas and spaces between them @param {boolean} hasAim
 * @param {import("./numbers.js").Limits} limits
 */
function readList(text, hasAim, limits) {
  const parts = text.split(/;|,?\s+/).filter(Boolean);
  if (!parts.length) throw new Error("Type at least one number.");
  return parts.map((part) => (hasAim && part.toLowerCase() === "aim" ? "aim" : parseNumber(part, limits)));
}

/** @param {any} project @param {boolean} isLocked */
function forAll(project, isLocked) {
  const { mounts, sensors } = project;
  const list = (/** @type {"heights_m"|"pitch_deg"} */ name, /** @type {string} */ label, /** @type {import("./numbers.js").Limits} */ limits) => textInput({
    key: `all.${name}`, label, text: listText(mounts[name]), isDisabled: isLocked, send(text, refuse) {
      try {
        change("PUT", "settings", { [name]: readList(text, name === "pitch_deg", limits) }, refuse);
      } catch (error) {
        refuse(/** @type {any} */ (error));
      }
    },
  });
  return h("section.card", {}, h("h2", {}, "For all poles"),
    h("p.quiet", {}, "Every pole is tried at each height and tilt, unless it has its own."),
    choiceField({ key: "all.sensor", label: "Sensor", value: mounts.sensor, isDisabled: isLocked, choices: sensors.map((/** @type {string} */ name) => [name, name]), send: (sensor) => change("PUT", "settings", { sensor }) }),
    h("div.pair", {}, list("heights_m", "Heights, m", { min: 0.5, max: 100 }), list("pitch_deg", "Tilts, °", { min: -90, max: 90 })));
}
