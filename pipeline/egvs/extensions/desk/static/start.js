// The start page: a new scenario from a map, or one that exists.
import { get, post, request } from "./api.js";
import { h, show } from "./dom.js";
import { pictureCard, refuseLarge } from "./aerial.js";
import { button, choiceField, dropZone, numberField, pagedTable, radioField, textInput, turnTo } from "./fields.js";
import { shortTitle } from "./junctions.js";
import { attempt, change, data, isBusy, runJob, say, update } from "./store.js";

/** What was chosen for the new scenario. */
const choice = { name: "", poles: "existing", traffic: "medium", filter: "" };
const place = { lat_deg: /** @type {number|null} */ (null), lon_deg: /** @type {number|null} */ (null) };

/** @param {HTMLElement} panel */
export function drawStart(panel) {
  if (data.upload?.streets) drawJunctions(panel);
  else if (data.start) drawLists(panel);
  else show(panel, h("p.quiet", {}, "Loading …"));
}

// ---------------------------------------------------------------- first page

/** @param {HTMLElement} panel */
function drawLists(panel) {
  const { start } = data;
  show(panel,
    h("h1", {}, "Where should the LiDARs of a junction stand?"),
    h("section.card.new", {}, h("h2", {}, "Start with a map"),
      dropZone({ id: "map-file", label: "Choose a map file", kinds: [...start.map_kinds, ".gz", ".zip"], isDisabled: isBusy(), send: ([file]) => takeFile(file, start) }),
      h("p.quiet", {}, "On ", h("b", {}, "openstreetmap.org"), " choose Export, draw a square of about 700 m around the junction, and save it. Or drop a scenario (.zip) that a colleague sent."),
      downloadForm()),
    start.scenarios.length > 0 && h("section.card", {}, h("h2", {}, "Continue"), h("ul.rows", {}, start.scenarios.map(scenarioRow))),
    h("section.card", {}, h("h2", {}, "Try an example"), h("ul.rows", {}, start.shipped.map(exampleRow))),
    h("p.quiet.folder", {}, "Everything is saved in ", h("code", {}, start.folder), "."));
}

/** @param {File} file @param {any} start */
async function takeFile(file, start) {
  if (refuseLarge(file, start)) return;
  const query = `name=${encodeURIComponent(file.name)}`;
  say(`Loading ${file.name} …`);
  if (file.name.endsWith(".zip")) return change("POST", `import?${query}`, file);
  const map = await attempt(() => request("POST", `maps?${query}`, file));
  if (map) await readMap(map.id);
}

/** @param {string} id */
async function readMap(id) {
  const job = await runJob(`maps/${encodeURIComponent(id)}/read`);
  if (!job) return;
  const upload = await attempt(() => get(`maps/${encodeURIComponent(id)}`));
  if (!upload) return;
  choice.name = nameOf(upload.name);
  choice.poles = "existing";
  choice.filter = "";
  update({ upload, selected: upload.streets.junctions[0]?.id ?? null });
}

/** @param {string} file */
function nameOf(file) {
  return file.replace(/\..*$/, "").normalize("NFKD").replace(/[^A-Za-z0-9_-]+/g, "_").replace(/^_+|_+$/g, "") || "junction";
}

function downloadForm() {
  const field = (/** @type {"lat_deg"|"lon_deg"} */ key, /** @type {string} */ label, /** @type {number} */ limit) => numberField({
    key, label, value: place[key], unit: "°", limits: { min: -limit, max: limit }, send: (value) => {
      place[key] = value;
    },
  });
  return h("details", {}, h("summary", {}, "Or by coordinates"), h("div.pair", {}, field("lat_deg", "Latitude", 90), field("lon_deg", "Longitude", 180)),
    button("Download the map", async () => {
      const job = await runJob("maps/download", place);
      if (job) await readMap(job.result.map);
    }, { isDisabled: isBusy() }));
}

/** @type {Record<string, string>} */
const RUN_STATES = { complete: "has results", partial: "run not finished", outdated: "changed since its run" };

/** @param {any} scenario */
function scenarioRow(scenario) {
  const state = RUN_STATES[scenario.run?.state] ?? "not run yet";
  return h("li", {}, h("div", {}, h("b", {}, scenario.name), h("small", {}, scenario.problem || scenario.description), h("small.state", {}, scenario.problem ? "cannot be opened" : state)),
    button("Open", () => open(scenario.id), { key: `open.${scenario.id}`, isDisabled: !!scenario.problem || isBusy(), title: `Open ${scenario.name}` }));
}

/** @param {string} id */
async function open(id) {
  location.hash = "poles";
  await change("POST", "open", { scenario: id });
}

/** @param {any} example */
function exampleRow(example) {
  const taken = new Set(data.start.scenarios.map((/** @type {any} */ other) => other.name));
  let name = example.id;
  for (let number = 2; taken.has(name); number += 1) name = `${example.id}_${number}`;
  return h("li", {}, h("div", {}, h("b", {}, example.id), h("small", {}, example.description)),
    button("Copy", () => change("POST", "copy", { shipped: example.id, name }), { key: `copy.${example.id}`, isDisabled: isBusy(), title: `Copy ${example.id} as ${name}, and open it` }));
}

// ---------------------------------------------------------------- choosing the junction

const chosenJunction = () => data.upload.streets.junctions.find((/** @type {any} */ junction) => junction.id === data.selected);

/** @param {HTMLElement} panel */
function drawJunctions(panel) {
  const { upload } = data;
  const { junctions } = upload.streets;
  const words = choice.filter.toLowerCase();
  const rows = junctions.filter((/** @type {any} */ junction) => junction.title.toLowerCase().includes(words));
  turnTo("junctions", rows.findIndex((/** @type {any} */ junction) => junction.id === data.selected));
  const redraw = () => update({ upload });
  const chosen = chosenJunction();
  show(panel,
    h("h1", {}, "Which junction?"),
    h("p.todo", {}, "Click a junction on the map, or choose it in the list."),
    junctions.length > 10 && textInput({ key: "filter", label: "Street", text: choice.filter, placeholder: "all streets", send: () => undefined, onInput(text) {
      choice.filter = text;
      redraw();
    } }),
    h("div.short", {}, pagedTable({
      key: "junctions", caption: "Junctions of the map, largest first", rows, redraw, isSelected: (row) => row.id === data.selected,
      columns: [
        { title: "Junction", isHead: true, cell: (row) => pick(shortTitle(row.title), row.id) },
        { title: "Arms", isNumber: true, cell: (row) => row.arms },
        { title: "Signals", cell: (row) => (row.signalised ? "yes" : "no") },
      ],
    })),
    pictureCard(),
    h("h2", {}, "New scenario"),
    textInput({ key: "name", label: "Name", text: choice.name, send(text) {
      choice.name = text.trim();
    } }),
    radioField({
      name: "poles", label: "Candidates to begin with", value: choice.poles,
      choices: [["existing", "Poles of the map", "Street lamps, signal masts and utility poles; where there are none, new poles at the kerbs."], ["kerbs", "New poles at the kerbs", "About every 10 m."]],
      send(value) {
        choice.poles = value;
      },
    }),
    choiceField({ key: "traffic", label: "Traffic, until you type counts", value: choice.traffic, choices: [["light", "light"], ["medium", "medium"], ["heavy", "heavy"]], send(value) {
      choice.traffic = value;
    } }),
    h("footer.next", {},
      button("Other map", () => update({ upload: null, selected: null })),
      button("Make the scenario", () => make(chosen), { isMain: true, isDisabled: !chosen || isBusy() })));
}

/** @param {string} text @param {string} id */
function pick(text, id) {
  return h("button.link", { type: "button", "data-key": `pick.${id}`, "aria-pressed": String(id === data.selected), onclick: () => update({ selected: id }) }, text);
}

/** @param {any} junction */
async function make(junction) {
  if (data.start.scenarios.some((/** @type {any} */ other) => other.name === choice.name)) return say(`“${choice.name}” exists already. Choose another name.`, "error");
  const body = { map: data.upload.id, name: choice.name, at: junction.at, poles: choice.poles, traffic: choice.traffic };
  location.hash = "poles";
  const job = await runJob("new", body);
  if (job) {
    update({ upload: null });
    say(job.result.note ?? "The scenario is ready.");
  }
}
