// Running the stages, and the ranking that comes of them.
import { get } from "./api.js";
import { h, show } from "./dom.js";
import { button, numberField, pagedTable, turnTo } from "./fields.js";
import { capitalised, duration, readable } from "./numbers.js";
import { choosePole, siteOf } from "./desk_map.js";
import { drawReplay } from "./replay.js";
import { save } from "./take.js";
import { attempt, change, data, isBusy, runJob, say, update } from "./store.js";

/** What the files say before a run. @type {{key: string, errors: any[], warnings: any[]}|null} */
let checked = null;
/** @type {string|null} */
let listed = null;

/** @param {HTMLElement} panel */
export function drawRun(panel) {
  const { project, ranking, job } = data;
  const { run, settings } = project;
  const canRun = !isBusy() && project.sites.length > 0;
  show(panel,
    h("h1", {}, "Run"),
    h("p.todo", {}, sentence(project)),
    run.state !== "complete" && numberField({
      key: "frames", label: `Moments of traffic to record, one every ${readable(settings.frame_period_s, settings.frame_period_s < 1 ? 2 : 0)} s`, value: settings.frames,
      limits: { whole: true, min: 10, max: 1000000 }, isDisabled: isBusy(), send: (frames, refuse) => change("PUT", "settings", { frames }, refuse),
    }),
    run.state !== "complete" && h("p.quiet", {}, `${duration(settings.traffic_s)} of traffic. 500 moments are enough for a first look, 5000 for a decision.`),
    h("div.tools", {},
      run.state !== "complete" && button(RUN_TEXTS[run.state], start, { key: "run", isMain: true, isDisabled: !canRun }),
      run.state !== "complete" && button("Check the files", check, { isDisabled: !canRun }),
      run.state === "complete" && button("Save the report", () => save({ id: "report", title: "Report" }), { isDisabled: isBusy() })),
    job?.kind === "run" && job.state === "failed" && h("p.reason", { role: "alert" }, job.message, job.hint && ` ${job.hint}`),
    checked?.key === filesKey() && problems(checked),
    ranking?.warnings.length > 0 && h("details.card.warnings", {},
      h("summary", {}, ranking.warnings.length === 1 ? "1 warning" : `${ranking.warnings.length} warnings, the most serious first`),
      h("ul", {}, ranking.warnings.map((/** @type {string} */ text) => h("li", {}, text)))),
    ranking && drawRanking(ranking),
    ranking && drawReplay());
}

/** @type {Record<string, string>} */
const RUN_TEXTS = { none: "Start the run", partial: "Continue the run", outdated: "Run again" };

/** @param {any} project */
function sentence({ run, sites }) {
  if (isBusy()) return "You can look around while it works.";
  if (!sites.length) return "Add poles first.";
  if (run.state === "complete") return "The results are up to date. Next, decide how many sensors.";
  if (run.state === "outdated") {
    const what = run.changed.length ? ` (${run.changed.join(", ")})` : "";
    return `Something has changed since the run${what}. A new run replaces its results; undo makes them current again.`;
  }
  if (run.state === "partial") return "The last run did not end. Continue where it stopped.";
  return "Simulate the traffic, and score every pole.";
}

const filesKey = () => JSON.stringify(data.project.files);

async function check() {
  const key = filesKey();
  const answer = await attempt(() => get("check"));
  if (!answer) return;
  checked = { key, ...answer };
  if (!answer.errors.length && !answer.warnings.length) say("Nothing to correct.");
  update({ project: data.project });
}

async function start() {
  const job = await runJob("run");
  if (job) say("The run is complete.");
}

/** @param {{errors: any[], warnings: any[]}} answer */
function problems({ errors, warnings }) {
  const item = (/** @type {any} */ { where, problem, hint }) => h("li", {}, h("b", {}, where), `: ${problem}. `, hint && h("small", {}, hint));
  return (errors.length + warnings.length > 0) && h("section.card.warnings", {},
    errors.length > 0 && h("h2", {}, "To correct before the run"), errors.length > 0 && h("ul", {}, errors.map(item)),
    warnings.length > 0 && h("h2", {}, "Warnings"), warnings.length > 0 && h("ul", {}, warnings.map(item)));
}

// ---------------------------------------------------------------- ranking

/** @param {any} ranking */
function drawRanking(ranking) {
  const at = ranking.poles.findIndex((/** @type {any} */ pole) => siteOf(pole.pole) === data.selected);
  if (data.selected !== listed) turnTo("ranking", at);
  listed = data.selected;
  return h("section", {}, h("h2", {}, ranking.outdated ? "Ranking before the changes" : "Ranking"),
    h("p.quiet", {}, `${capitalised(ranking.noun)} ± standard error.`),
    h("p.quiet.colours", {}, "On the map, worse", ["q0", "q1", "q2", "q3", "q4"].map((colour) => h(`i.${colour}`)), "better"),
    pagedTable({
      key: "ranking", caption: "Poles, best first", rows: ranking.poles, redraw: () => update({ ranking }), isSelected: (pole) => siteOf(pole.pole) === data.selected,
      columns: [
        { title: "Rank", isNumber: true, cell: (pole) => pole.rank },
        { title: "Pole", isHead: true, cell: (pole) => h("button.link", {
          type: "button", "data-key": `rank.${pole.pole}`, "aria-pressed": String(siteOf(pole.pole) === data.selected), onclick: () => choosePole(siteOf(pole.pole)),
        }, pole.pole) },
        { title: "Best mount", cell: (pole) => pole.mount_text },
        { title: capitalised(ranking.label), isNumber: true, cell: (pole) => pole.score_text },
      ],
    }));
}
