// Starts the page: connects it with the server, and draws what changed.
import { listen } from "./api.js";
import { byId, focusHeading, h, keepingFocus, show } from "./dom.js";
import { change, data, fetchStart, fetchState, isBusy, onChange, say, settled, takeJob, update } from "./store.js";
import { takeRefused } from "./fields.js";
import { drawJob } from "./progress.js";
import { drawStart } from "./start.js";
import { drawPoles } from "./poles.js";
import { drawCounts, drawDiagram } from "./counts.js";
import { stopReplay } from "./replay.js";
import { drawRun } from "./run.js";
import { drawPlan } from "./plan.js";
import { drawTake } from "./take.js";
import { drawMap, showScore } from "./desk_map.js";
import { drawPicture } from "./aerial.js";
import { drawThree } from "./three.js";

/** Steps that were left for another one. @type {Set<string>} */
const visited = new Set();

/** Whether a step was left, now or before a run. @param {string} id @param {any} project */
const wasLeft = (id, project) => visited.has(id) || project.run.state !== "none";

/** @type {{id: string, title: string, isOptional?: boolean, draw: (panel: HTMLElement) => void, isDone: (project: any) => boolean}[]} */
const STEPS = [
  { id: "poles", title: "Poles", isOptional: true, draw: drawPoles, isDone: (project) => project.sites.length > 0 && wasLeft("poles", project) },
  { id: "traffic", title: "Traffic", isOptional: true, draw: drawCounts, isDone: (project) => project.counts.some((/** @type {any} */ period) => period.total_per_h > 0) && wasLeft("traffic", project) },
  { id: "run", title: "Run", draw: drawRun, isDone: (project) => project.run.state === "complete" },
  { id: "plan", title: "Decide", draw: drawPlan, isDone: (project) => project.run.has_plan && !project.run.plan_outdated },
  { id: "take", title: "Take along", draw: drawTake, isDone: () => false },
];

/** @param {string} id */
function go(id) {
  visited.add(data.step);
  if (location.hash !== `#${id}`) location.hash = id;
  else readStep();
}

function readStep() {
  const step = STEPS.some(({ id }) => `#${id}` === location.hash) ? location.hash.slice(1) : "poles";
  if (step === data.step) return;
  const refused = takeRefused();
  update({ step, isAdding: false, suggestions: null });
  if (refused.length) say(`Not taken: ${refused.join(" ")}`, "error");
  byId("panel").scrollTop = 0;
}

function drawHeader() {
  const { project, step } = data;
  document.title = project ? `${project.name} – egvs desk` : "egvs desk";
  byId("title").textContent = project ? project.title || project.name : "";
  byId("steps").hidden = byId("history").hidden = !project;
  if (!project) return;
  show(byId("steps"), h("ol", {}, STEPS.map(({ id, title, isDone }, number) => {
    const done = isDone(project);
    return h("li", {}, h(`button${done ? ".done" : ""}`, {
      type: "button", "data-key": `step.${id}`, "aria-current": id === step ? "step" : null, onclick: () => go(id),
    }, h("span.number", { "aria-hidden": "true" }, done ? "✓" : number + 1), title, done && h("span.unseen", {}, " (done)")));
  })));
  for (const name of /** @type {const} */ (["undo", "redo"])) {
    const button = byId(name);
    button.disabled = !project[name] || isBusy();
    button.title = project[name] ? `${name === "undo" ? "Undo" : "Redo"}: ${project[name]}` : "";
  }
}

function drawNext() {
  const at = STEPS.findIndex(({ id }) => id === data.step);
  const next = STEPS[at + 1];
  return next && h("footer.next", {},
    h(`button${STEPS[at].isOptional || STEPS[at].isDone(data.project) ? ".main" : ""}`, { type: "button", "data-key": "next", onclick: () => {
      go(next.id);
      setTimeout(() => focusHeading(byId("panel")));
    } }, `Next: ${next.title} `, h("span", { "aria-hidden": "true" }, "→")));
}

/** Project or map that is shown. */
let shownPage = "";

/** Whether a job ran when the page was drawn: until that changes, only its bar does. */
let wasBusy = false;

/** @param {Set<string>} changed */
function draw(changed) {
  const main = byId("main");
  const panel = byId("panel");
  main.className = data.project ? `desk ${data.step}` : data.upload?.streets ? "desk choosing" : "start";
  if (changed.size === 1 && changed.has("log")) return drawJob();
  drawJob();
  keepingFocus(byId("top"), drawHeader);
  if (data.revision < 0) return;
  if (changed.size === 1 && changed.has("job") && isBusy() === wasBusy) return;
  wasBusy = isBusy();
  if (data.step !== "run" || !data.ranking) stopReplay();
  keepingFocus(panel, () => {
    if (!data.project) return drawStart(panel);
    const step = STEPS.find(({ id }) => id === data.step);
    step?.draw(panel);
    if (data.project.problem) panel.prepend(h("p.note.problem", { role: "alert" }, data.project.problem));
    const next = drawNext();
    if (next) panel.append(next);
  });
  drawMap(changed);
  drawPicture();
  drawThree();
  keepingFocus(byId("stage"), drawDiagram);
}

/** Steps back and forth wait for one another. @type {Promise<void>} */
let steps = Promise.resolve();

/** @param {"undo"|"redo"} name */
function stepBack(name) {
  steps = steps.then(settled).then(async () => {
    const what = data.project?.[name];
    if (what && !isBusy() && (await change("POST", name))) say(`${name === "undo" ? "Undone" : "Done again"}: ${what}.`);
  });
}

/** @param {KeyboardEvent} event */
function shortcuts(event) {
  if (!(event.ctrlKey || event.metaKey) || event.altKey) return;
  const isTyping = event.target instanceof HTMLInputElement && event.target.type === "text" && event.target.value !== event.target.defaultValue;
  const key = event.key.toLowerCase();
  const name = key === "z" ? (event.shiftKey ? "redo" : "undo") : key === "y" ? "redo" : null;
  if (!name || isTyping || document.querySelector("dialog")) return;
  event.preventDefault();
  stepBack(name);
}

onChange(draw);
onChange((changed) => {
  if (changed.has("project") && !data.project) fetchStart();
  const page = data.project?.id ?? data.upload?.id ?? "";
  if (page !== shownPage) byId("panel").scrollTop = 0;
  if (page !== shownPage && document.activeElement === document.body) setTimeout(() => focusHeading(byId("panel")));
  shownPage = page;
});
byId("undo").addEventListener("click", () => stepBack("undo"));
byId("redo").addEventListener("click", () => stepBack("redo"));
byId("home").addEventListener("click", () => {
  update({ upload: null });
  if (data.project) change("POST", "close");
});
addEventListener("keydown", shortcuts);
addEventListener("hashchange", readStep);
readStep();
let wasLost = false;
listen({
  state: ({ revision }) => settled().then(() => revision === data.revision ? null : fetchState()), // answers to own changes have it
  job: takeJob,
  log: ({ line }) => update({ log: [...data.log, line].slice(-200) }),
  score: showScore,
}, (isConnected) => {
  if (isConnected && wasLost) fetchState().then(() => say("Connected again."));
  if (!isConnected && !wasLost) say("The desk does not answer. Is the command “egvs desk” still running?", "error");
  wasLost = !isConnected;
});
fetchState();
