// An aerial picture of the user's own below the map: chosen in a panel, or dropped on the map.
import { get, request } from "./api.js";
import { byId, h, s } from "./dom.js";
import { acceptDrop, button, dropZone } from "./fields.js";
import { mapView } from "./desk_map.js";
import { readable } from "./numbers.js";
import { attempt, change, data, say, update } from "./store.js";

const KINDS = [".tif", ".tiff", ".png", ".jpg", ".jpeg"];
const IS_WORLD = /\.(wld|\w{1,4}w)$/i;
const IS_SYSTEM = /\.prj$/i;
const MOST_CHARACTERS = 4000;

const tool = button("", () => {
  isHidden = !isHidden;
  drawPicture();
}, { key: "aerial", title: "Aerial picture", pressed: true });
tool.setAttribute("aria-label", "Aerial picture");
tool.append(s("svg.sign", { viewBox: "0 0 24 24", "aria-hidden": "true" }, s("path", { d: "M3 5H21V19H3ZM3 17L9 11L13 15L16 12L21 17M16 8.5V9" })));
let isHidden = false;
let isOpen = false;
let accepts = false;
/** Picture that is drawn. */
let drawn = "";

/** Address of the picture, of the project or of a dropped map. */
const address = () => (data.project ? "aerial" : `maps/${encodeURIComponent(data.upload.id)}/aerial`);
const pictureOf = () => (data.project ?? data.upload)?.aerial ?? null;

/** Say that a file is too large to be sent. @param {File} file @param {any} start @returns {boolean} */
export function refuseLarge(file, start) {
  const isLarge = file.size > start.max_upload_bytes;
  if (isLarge) say(`${file.name} has ${readable(file.size / 2 ** 20)} MB; at most ${readable(start.max_upload_bytes / 2 ** 20)} MB are allowed. Choose a smaller part.`, "error");
  return isLarge;
}

/** @param {File[]} files a picture, and what says where it is */
async function takePicture(files) {
  const file = files.find(({ name }) => KINDS.some((kind) => name.toLowerCase().endsWith(kind)));
  if (!file) return say(`${files[0].name} is no picture. Choose a GeoTIFF, or a PNG or JPEG with its world file.`, "error");
  const start = data.start ?? (await attempt(() => get("start")));
  if (!start || refuseLarge(file, start)) return;
  const textOf = (/** @type {RegExp} */ pattern) => files.find(({ name }) => pattern.test(name))?.slice(0, MOST_CHARACTERS).text() ?? "";
  const query = new URLSearchParams({ name: file.name, world: await textOf(IS_WORLD), crs: await textOf(IS_SYSTEM) });
  const path = `${address()}?${query}`;
  isHidden = false;
  say(`Loading ${file.name} …`);
  if (data.project) return change("POST", path, file);
  const upload = await attempt(() => request("POST", path, file));
  if (!upload) return;
  say("");
  update({ upload });
}

export function pictureCard() {
  const picture = pictureOf();
  const card = h("details.card", { open: isOpen || !!picture, ontoggle: () => {
    isOpen = card.open;
  } }, h("summary", {}, "Aerial picture"),
    dropZone({ id: "picture-file", label: picture ? "Choose another picture" : "Choose a picture", kinds: [...KINDS, ".wld", ".tfw", ".pgw", ".jgw", ".prj"], multiple: true, send: takePicture }),
    h("p.quiet", {}, "A GeoTIFF; or a PNG or JPEG and its world file, both at once. It lies below the map and changes no result."),
    picture && data.project && button("Remove the picture", () => change("DELETE", "aerial"), { key: "picture.remove" }));
  return card;
}

export function drawPicture() {
  if (!data.project && !data.upload?.streets) return;
  const map = mapView();
  const picture = pictureOf();
  if (!accepts) acceptDrop(byId("stage"), takePicture);
  accepts = true;
  tool.setAttribute("aria-pressed", String(!isHidden));
  if (!picture) tool.remove();
  else if (!tool.isConnected) map.tools.append(tool);
  map.surface.classList.toggle("pictured", !!picture && !isHidden);
  const wanted = picture && !isHidden ? `/api/${address()}?${picture.key}` : "";
  if (wanted !== drawn) map.setPicture(wanted, picture?.matrix);
  drawn = wanted;
}
