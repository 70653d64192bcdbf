// What the page knows, and the only place that changes it.
import { ApiError, get, getIfAny, post, request } from "./api.js";
import { ask, byId, h, show } from "./dom.js";

/**
 * @typedef {Object} Data
 * @property {number} revision
 * @property {any} project null on the start page
 * @property {import("./api.js").Job|null} job
 * @property {any} start answer of /api/start
 * @property {any} map answer of /api/map
 * @property {any} upload map that was dropped on the start page, with its streets once it was read
 * @property {any} ranking
 * @property {any} plan
 * @property {any} downloads
 * @property {any[]|null} suggestions kerb positions that are shown
 * @property {any} keptPlan a plan to compare with
 * @property {any} trial what another sensor on one pole of the plan would change
 * @property {any} whatIf
 * @property {string|null} three address of the 3D view that is shown
 * @property {{site: string, x_m: number, y_m: number}|null} dropped pole whose new position is on its way to the server
 * @property {string} step
 * @property {string|null} selected name of the chosen site or junction
 * @property {boolean} isAdding
 * @property {string[]} log
 */

/** @type {Data} */
export const data = {
  revision: -1, project: null, job: null, start: null, map: null, upload: null, ranking: null, plan: null,
  downloads: null, suggestions: null, keptPlan: null, trial: null, whatIf: null, three: null, dropped: null, step: "poles", selected: null, isAdding: false,
  log: [],
};

/** @type {((changed: Set<string>) => void)[]} */
const listeners = [];
/** @type {Set<string>} */
let changed = new Set();

/** Call a function after changes, with the names of what changed. @param {(changed: Set<string>) => void} listener */
export function onChange(listener) {
  listeners.push(listener);
}

/** @param {Partial<Data>} values */
export function update(values) {
  Object.assign(data, values);
  if (!changed.size) queueMicrotask(tell);
  for (const key of Object.keys(values)) changed.add(key);
}

function tell() {
  const keys = changed;
  changed = new Set();
  for (const listener of listeners) listener(keys);
}

// ---------------------------------------------------------------- messages

/** @type {number} */
let messageTimer = 0;

/** Show a message; information disappears by itself. @param {string} text @param {"info"|"error"} [kind] */
export function say(text, kind = "info") {
  clearTimeout(messageTimer);
  const box = byId("message");
  box.className = kind;
  const close = h("button", { type: "button", "aria-label": "Close the message", onclick: () => say("") }, "×");
  show(box, text && [h("p", {}, text), close]);
  if (kind === "info" && text) messageTimer = setTimeout(() => say(""), 6000);
}

/** Tell a screen reader. @param {string} text */
export function announce(text) {
  byId("spoken").textContent = text;
}

/**
 * Do something with the server; a refusal becomes a message, or goes to `onRefusal`.
 * @template T
 * @param {() => Promise<T>} action
 * @param {(error: ApiError) => void} [onRefusal]
 * @returns {Promise<T|null>} null if refused
 */
export async function attempt(action, onRefusal) {
  try {
    return await action();
  } catch (error) {
    if (!(error instanceof ApiError)) throw error;
    if (onRefusal && error.status) onRefusal(error);
    else say(error.message, "error");
    return null;
  }
}

// ---------------------------------------------------------------- state of the server

/** Take over a state that the server sent. @param {any} state */
export function takeState(state) {
  if (state.revision < data.revision) return;
  const isOther = state.project?.id !== data.project?.id;
  update({ revision: state.revision, project: state.project, job: state.job });
  if (state.job?.log) update({ log: state.job.log });
  if (isOther) resultsKey = "";
  if (isOther) update({ map: null, ranking: null, plan: null, suggestions: null, selected: null, isAdding: false, keptPlan: null, whatIf: null, three: null });
  if (state.project) refreshResults();
}

/** @type {string} */
let resultsKey = "";

/** Fetch map, ranking and plan where they changed. */
function refreshResults() {
  const { project } = data;
  const ignoreIfClosed = (/** @type {ApiError} */ error) => {
    if (data.project?.id === project.id) say(error.message, "error");
  };
  if (data.map?.key !== project.map_key) attempt(async () => update({ map: await get("map") }), ignoreIfClosed);
  const key = JSON.stringify([project.id, project.run]);
  if (key === resultsKey) return;
  resultsKey = key;
  attempt(async () => {
    const hasRun = ["complete", "outdated"].includes(project.run.state); // a run that was stopped may lack scores
    const ranking = hasRun ? await getIfAny("ranking") : null;
    const plan = hasRun && project.run.has_plan ? await getIfAny("plan") : null;
    if (data.project?.id === project.id) update({ ranking, plan, downloads: null, trial: null });
  }, ignoreIfClosed);
}

export const fetchState = () => attempt(async () => takeState(await get("state")));
export const fetchStart = () => attempt(async () => update({ start: await get("start") }));

/** Changes are sent one after the other. @type {Promise<any>} */
let changes = Promise.resolve();

/** Resolves when no change is on its way. */
export const settled = () => changes;

/**
 * Send a change. The server refuses the first one after which the results of a run are out of date, until that is agreed to.
 * @param {"POST"|"PUT"|"PATCH"|"DELETE"} method
 * @param {string} path
 * @param {any} body
 * @param {(error: ApiError) => void} [onRefusal]
 * @param {boolean} [keep_results]
 * @returns {Promise<any>}
 */
async function send(method, path, body, onRefusal, keep_results = true) {
  let question = "";
  const answer = await attempt(() => request(method, path, body instanceof Blob ? body : { ...body, keep_results }), (error) => {
    if (error.field === "keep_results") question = error.message;
    else if (onRefusal) onRefusal(error);
    else say(error.message, "error");
  });
  if (!question) return answer;
  const text = `${question} ${path === "undo" ? "Redo" : "Undo"} brings them back.`;
  if (await ask("The results will be out of date", text, "Change", "Keep the results")) return send(method, path, body, onRefusal, false);
  update({ project: data.project }); // puts the fields back
  return null;
}

/**
 * Change the project; every change answers with the new state.
 * @param {"POST"|"PUT"|"PATCH"|"DELETE"} method
 * @param {string} path
 * @param {unknown} [body]
 * @param {(error: ApiError) => void} [onRefusal]
 * @returns {Promise<any>} the state; null if refused
 */
export function change(method, path, body = {}, onRefusal) {
  const state = changes.then(async () => {
    const answer = await send(method, path, body, onRefusal);
    if (!answer) return null;
    say("");
    takeState(answer);
    return answer;
  });
  changes = state.catch(() => undefined);
  return state;
}

// ---------------------------------------------------------------- jobs

/** @type {Map<number, (job: any) => void>} */
const waiting = new Map();

/** @param {import("./api.js").Job} job */
export function takeJob(job) {
  update({ job });
  if (job.state === "runs") return;
  if (job.state === "done" && ["run", "plan", "additions"].includes(job.kind) && data.project) {
    resultsKey = "";
    refreshResults();
  }
  waiting.get(job.id)?.(job);
  waiting.delete(job.id);
}

/**
 * Start a job, wait for its end, and return it; null if it was refused, failed or was stopped (a message says so).
 * @param {string} path
 * @param {unknown} [body]
 * @param {(error: ApiError) => void} [onRefusal]
 * @returns {Promise<any>}
 */
export async function runJob(path, body = {}, onRefusal) {
  update({ log: [] });
  const answer = await attempt(() => post(path, body), onRefusal);
  if (!answer) return null;
  say("");
  if (!answer.job) return { state: "done", result: answer }; // it was ready
  /** @type {import("./api.js").Job} */
  const started = answer.job;
  const isOver = data.job?.id === started.id && data.job.state !== "runs";
  if (!isOver) takeJob(started);
  const latest = /** @type {import("./api.js").Job} */ (isOver ? data.job : started);
  const job = latest.state !== "runs" ? latest : await new Promise((resolve) => waiting.set(started.id, resolve));
  if (job.state === "failed") {
    const refusal = new ApiError(422, job.message, job.hint);
    if (onRefusal) onRefusal(refusal);
    else say(refusal.message, "error");
  } else if (job.state === "stopped") say(`${job.title}: stopped. Start it again to continue.`);
  return job.state === "done" ? job : null;
}

/** Whether a job runs that changes may not disturb. */
export const isBusy = () => data.job?.state === "runs" && data.job.kind !== "live";
