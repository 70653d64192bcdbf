// What to take along: the report, sheets and layers as files.
import { get } from "./api.js";
import { h, show } from "./dom.js";
import { button } from "./fields.js";
import { attempt, data, isBusy, runJob, say, update } from "./store.js";

let isLoading = false;

/** @param {HTMLElement} panel */
export function drawTake(panel) {
  const { downloads } = data;
  if (!downloads && !isLoading) load();
  show(panel,
    h("h1", {}, "Take along"),
    h("p.todo", {}, "Save what you need, for colleagues, the crew or QGIS."),
    !downloads && h("p.quiet", {}, "Loading …"),
    downloads && h("ul.rows", {}, downloads.items.map((/** @type {any} */ item) => h("li", {},
      h("div", {}, h("b", {}, item.title), h("small", {}, item.available ? item.file : item.reason)),
      button("Save", () => save(item), { key: `save.${item.id}`, isDisabled: !item.available || isBusy(), title: `Save ${item.title}` })))));
}

async function load() {
  isLoading = true;
  const downloads = await attempt(() => get("downloads"));
  isLoading = false;
  if (downloads) update({ downloads });
}

/** Make a file if necessary, and save it. @param {{id: string, title: string}} item */
export async function save(item) {
  const job = await runJob(`downloads/${encodeURIComponent(item.id)}`);
  const url = job?.result?.url;
  if (!url) return;
  const link = h("a", { href: url, download: "" });
  document.body.append(link);
  link.click();
  link.remove();
  say(`${item.title}: saved with your downloads.`);
  update({ downloads: null });
}
