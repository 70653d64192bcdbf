// The bar of the job that runs: how far it is, how long it will take, and a button that stops it.
import { post } from "./api.js";
import { byId, h, show } from "./dom.js";
import { duration, readable } from "./numbers.js";
import { announce, attempt, data } from "./store.js";

/** What a planner would call the stages. @type {Record<string, string>} */
const STAGES = {
  check: "Checking the files", statics: "Building houses and trees", scan: "Scanning from every pole",
  traffic: "Simulating traffic", tpog: "Counting where vehicles are", score: "Scoring the poles", report: "Writing the report",
};

const title = h("strong");
const what = h("span.what");
const bar = h("progress", { max: 1, "aria-label": "Progress" });
const time = h("span.time");
const stop = h("button", { type: "button", onclick: () => attempt(() => post("stop")) }, "Stop");
const lines = h("pre", { tabindex: "0", role: "region", "aria-label": "Messages of the program" });
const log = h("details", {}, h("summary", {}, "Messages of the program"), lines);

let lastSpoken = "";

export function drawJob() {
  const box = byId("job");
  const { job } = data;
  const runs = job?.state === "runs" && job.kind !== "live";
  if (!box.firstChild) show(box, h("div.line", {}, title, what, bar, time, stop), log);
  box.hidden = !runs;
  if (!runs) {
    if (lastSpoken && job) announce(`${job.title}: ${job.state === "done" ? "done" : job.state}`);
    lastSpoken = "";
    return;
  }
  title.textContent = job.title;
  const stage = STAGES[job.stage] ?? job.stage;
  const counted = job.total > 0 ? ` ${readable(job.done)} of ${readable(job.total)} ${job.what}` : "";
  what.textContent = stage + counted;
  const share = job.share ?? (job.total > 0 ? job.done / job.total : null);
  if (share === null) bar.removeAttribute("value");
  else bar.value = share;
  time.textContent = job.remaining_s === null || job.remaining_s === undefined ? duration(job.elapsed_s) : `${duration(job.remaining_s)} left`;
  const text = data.log.join("\n");
  if (lines.textContent !== text) {
    lines.textContent = text;
    lines.scrollTop = lines.scrollHeight;
  }
  log.hidden = !text;
  const spoken = `${job.title}. ${stage}`;
  if (spoken !== lastSpoken) announce(spoken);
  lastSpoken = spoken;
}
