// The 3D view of the run, below the map: the page of egvs explore in a frame. It follows the chosen pole.
import { latestWins, post } from "./api.js";
import { byId, h } from "./dom.js";
import { button } from "./fields.js";
import { candidateOf, mapView } from "./desk_map.js";
import { attempt, data, isBusy, say, update } from "./store.js";

/** Half the resolution: in software, a drag in the frame would take seconds. */
const COARSE = "&fixedDpr=0.5";

const tool = button("3D", toggle, { title: "3D view of the run", pressed: false });
/** @type {HTMLElement|null} */
let box = null;
/** What the frame shows. */
let shown = "";

/** Whether the browser draws in software, without a graphics card. */
function isSoftware() {
  const graphics = document.createElement("canvas").getContext("webgl2");
  const details = graphics?.getExtension("WEBGL_debug_renderer_info");
  const name = graphics && details ? graphics.getParameter(details.UNMASKED_RENDERER_WEBGL) : "";
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

/** The chosen pole as the run knows it, and where it stands now; empty without one. */
function sensor() {
  const pole = data.project.sites.find((/** @type {any} */ site) => site.site === data.selected);
  const site = pole && candidateOf(pole.site);
  const { x_m, y_m } = data.dropped?.site === data.selected ? data.dropped : pole ?? {};
  return site ? { site, x_m, y_m, z_m: pole.z_m, pitch_deg: pole.pitch_deg } : {};
}

/** Start it, or let it show the chosen pole. */
const follow = latestWins(async () => {
  const answer = await attempt(() => post("three", sensor()));
  if (answer) say("");
  update({ three: answer?.address ?? null });
});

function toggle() {
  if (data.three) return update({ three: null });
  shown = JSON.stringify(sensor());
  say("Opening the 3D view …");
  follow(null);
}

export function drawThree() {
  const { project, three, job } = data;
  if (three && isBusy() && job?.kind === "run") return update({ three: null }); // its results are replaced
  const hasTool = project && data.map && (three || project.run.state === "complete");
  tool.disabled = isBusy();
  tool.setAttribute("aria-pressed", String(!!three));
  if (!hasTool) tool.remove();
  else if (!tool.isConnected) mapView().tools.append(tool);
  if (!three) {
    box?.remove();
    box = null;
    return;
  }
  if (box?.dataset.address !== three) {
    box?.remove();
    const frame = h("iframe", { src: isSoftware() ? three + COARSE : three, title: "3D view of the run" });
    box = h("section.three", { "aria-label": "3D view", "data-address": three }, frame);
    byId("stage").after(box);
  }
  const wanted = JSON.stringify(sensor());
  if (wanted !== shown && wanted !== "{}") follow(null);
  shown = wanted;
}
