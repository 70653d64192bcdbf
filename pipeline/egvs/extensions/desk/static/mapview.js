// The map from above: draws world coordinates (metres, x east, y north) as SVG; pointer and keyboard move what is on it.
import { h, s, show, debounced } from "./dom.js";

/**
 * @typedef {[number, number]} Point x, y in metres
 * @typedef {Object} Item something with a position that one can choose, and perhaps move
 * @property {string} id
 * @property {Point} at_m
 * @property {string} label
 * @property {string} kind class of its symbol: "pole", "junction", "obstacle", "sensor"
 * @property {string[]} [classes]
 * @property {boolean} [movable]
 * @property {Point[]} [outline_m] corners relative to its position, drawn in metres
 * @property {string} [text] short text inside the symbol
 * @property {string} [title] says what it is when one points at it
 *
 * @typedef {Object} Shapes what lies below the items
 * @property {{points_m: Point[], width_m: number, kind: string}[]} lanes
 * @property {Point[][]} junctions
 * @property {{kind: string, rings_m: Point[][]}[]} solids
 * @property {Point[]|null} [roi_m] corners of the region of interest
 *
 * @typedef {Object} Handlers
 * @property {(id: string|null) => void} onSelect
 * @property {(id: string, at_m: Point, isFine: boolean) => void} onMove at the end of a drag, or when the arrow keys rest; isFine if the last hint was no refusal
 * @property {(at_m: Point) => void} onAdd
 * @property {(id: string) => void} onDelete
 * @property {(id: string, at_m: Point) => void} onDrag while it is dragged
 * @property {(text: string) => void} announce
 */

const STEP_M = 0.5;
const FINE_STEP_M = 0.1;
const DRAG_STARTS_PX = 4;
const KEYS_REST_MS = 600;
const MAX_LABELS = 40;
const MAX_LABELS_NARROW = 8;
const NARROW_PX = 600;
/** @type {Record<string, Point>} */
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/** @param {Point[]} points @param {boolean} closed */
function pathData(points, closed) {
  return `M${points.map(([x, y]) => `${x.toFixed(2)} ${y.toFixed(2)}`).join("L")}${closed ? "Z" : ""}`;
}

/** Return the longest length 1, 2 or 5 times a power of ten that is at most `longest`. @param {number} longest */
export function roundLength(longest) {
  const power = 10 ** Math.floor(Math.log10(longest));
  return Math.max(...[1, 2, 5].map((factor) => factor * power).filter((length) => length <= longest));
}

export class MapView {
  /** @param {HTMLElement} element @param {Handlers} handlers */
  constructor(element, handlers) {
    this.element = element;
    this.handlers = handlers;
    /** @type {Item[]} */ this.items = [];
    /** @type {Map<string, SVGGElement>} */ this.symbols = new Map();
    /** @type {string|null} */ this.selected = null;
    /** @type {{id: string, at_m: Point}|null} */ this.moving = null;
    /** @type {Point|null} */ this.refusal_m = null;
    this.hinted = false;
    this.isFine = false;
    this.isAdding = false;
    this.pictureHref = "";
    /** @type {Point|null} */ this.cross_m = null;
    /** @type {Point} */ this.center_m = [0, 0];
    this.pxPerM = 4;
    this.width = 600;
    this.height = 400;
    /** @type {Map<number, PointerEvent>} */ this.pointers = new Map();
    this.picture = s("g.picture");
    this.ground = s("g.ground");
    this.vehicles = s("g.vehicles");
    this.world = s("g", {}, this.picture, this.ground, this.vehicles);
    this.outlines = s("g.outlines");
    this.marks = s("g.marks");
    this.extra = s("g.extra");
    this.cross = s("path.cross", { d: "M-14 0H14M0 -14V14" });
    this.svg = s("svg", { "aria-hidden": "true" }, this.world, this.outlines, this.marks, this.extra, this.cross);
    this.bubble = h("div.bubble", { hidden: true });
    this.scaleText = h("span");
    this.scaleBar = h("div.scale", { "aria-hidden": "true" }, this.scaleText);
    const button = (/** @type {string} */ text, /** @type {string} */ label, /** @type {() => void} */ action) =>
      h("button", { type: "button", "aria-label": label, title: label, onclick: action }, text);
    this.credit = h("p.credit");
    const north = h("div.north", { "aria-hidden": "true" }, "N");
    this.tools = h("div.maptools", {},
      button("+", "Zoom in", () => this.zoom(1.5)),
      button("−", "Zoom out", () => this.zoom(1 / 1.5)),
      button("⤢", "Show everything", () => this.fit()));
    /** @type {HTMLElement} */
    this.surface = h("div.surface", {
      tabindex: "0", role: "application", "aria-roledescription": "map", "aria-label": "Map from above",
      "aria-describedby": "map-hint",
    }, this.svg);
    element.append(this.surface, this.bubble, this.tools, north, this.scaleBar, this.credit);
    this.keysRest = debounced(KEYS_REST_MS, () => this.endMove());
    /** @type {[number, number, number, number]|null} */ this.box = null;
    /** @type {(() => void)|null} */ this.onPlace = null;
    this.listen();
    new ResizeObserver(() => this.resize()).observe(element);
    this.resize();
  }

  listen() {
    const { surface } = this;
    surface.addEventListener("pointerdown", (event) => this.pointerDown(event));
    surface.addEventListener("pointermove", (event) => this.pointerMove(event));
    surface.addEventListener("pointerup", (event) => this.pointerUp(event));
    surface.addEventListener("pointercancel", (event) => this.cancel(event));
    surface.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), this.pixel(event));
    }, { passive: false });
    surface.addEventListener("keydown", (event) => this.keyDown(event));
    surface.addEventListener("blur", () => this.keysRest.flush());
  }

  resize() {
    const box = this.surface.getBoundingClientRect();
    if (!box.width || !box.height) return;
    const isFirst = this.width === 600 && this.height === 400;
    this.width = box.width;
    this.height = box.height;
    this.svg.setAttribute("viewBox", `0 0 ${box.width} ${box.height}`);
    if (isFirst && this.box) this.fit();
    else this.place();
  }

  // ---------------------------------------------------------------- what is drawn

  /** @param {Shapes} shapes */
  setShapes(shapes) {
    const solids = new Map();
    for (const { kind, rings_m } of shapes.solids)
      solids.set(kind, (solids.get(kind) ?? "") + rings_m.map((ring) => pathData(ring, true)).join(""));
    const lanes = new Map();
    for (const { points_m, width_m, kind } of shapes.lanes) {
      if (points_m.length < 2) continue;
      const key = `${kind} ${width_m.toFixed(1)}`;
      lanes.set(key, (lanes.get(key) ?? "") + pathData(points_m, false));
    }
    const roads = s("path.crossing", { d: shapes.junctions.map((corners) => pathData(corners, true)).join("") });
    const edges = [...lanes].map(([key, d]) => s("path.edge", { d, "stroke-width": Number(key.split(" ")[1]) + 0.6 }));
    const strips = [...lanes].map(([key, d]) => {
      const [kind, width] = key.split(" ");
      return s(`path.lane.${kind}`, { d, "stroke-width": width });
    });
    show(this.ground, edges, roads, strips,
      [...solids].map(([kind, d]) => s(`path.solid.${kind}`, { d })),
      shapes.roi_m && s("path.roi", { d: pathData(shapes.roi_m, true) }));
  }

  /** Show road users. @param {Point[][]} outlines_m corners of each */
  setVehicles(outlines_m) {
    show(this.vehicles, outlines_m.length > 0 && s("path", { d: outlines_m.map((corners) => pathData(corners, true)).join("") }));
  }

  /** Show a picture below the map. @param {string} href empty for none @param {number[]} matrix from its pixels to metres */
  async setPicture(href, matrix) {
    this.pictureHref = href;
    show(this.picture);
    if (!href) return;
    const image = new Image();
    image.src = href;
    await image.decode().catch(() => undefined); // then its width is 0
    const { naturalWidth: width, naturalHeight: height } = image;
    if (this.pictureHref === href) show(this.picture, s("image", { href, width, height, transform: `matrix(${matrix.join(" ")})`, preserveAspectRatio: "none" }));
  }

  /** @param {Item[]} items @param {string|null} [selected] */
  setItems(items, selected = this.selected) {
    this.items = items;
    this.selected = items.some((item) => item.id === selected) ? selected : null;
    const showLabels = items.filter((item) => item.kind !== "junction").length <= (this.width < NARROW_PX ? MAX_LABELS_NARROW : MAX_LABELS);
    this.symbols = new Map(items.map((item) => [item.id, this.symbol(item, showLabels)]));
    show(this.marks, [...this.symbols.values()]);
    show(this.outlines, items.filter((item) => item.outline_m).map((item) =>
      s(`path.${item.kind}`, { "data-id": item.id, d: pathData(item.outline_m ?? [], true) })));
    this.select(this.selected);
    this.place();
  }

  /** @param {Item} item @param {boolean} showLabels */
  symbol(item, showLabels) {
    const shape = item.kind === "pole" && item.classes?.includes("existing")
      ? s("rect.body", { x: -6, y: -6, width: 12, height: 12, rx: 2 })
      : s("circle.body", { r: item.kind === "junction" ? 9 : item.kind === "sensor" ? 12 : 6 });
    const isOut = item.classes?.includes("must_not");
    return s("g", { class: ["item", item.kind, ...(item.classes ?? [])].join(" "), "data-id": item.id },
      item.title && s("title", {}, item.title),
      s("circle.target", { r: 14 }),
      s("circle.halo", { r: 14 }),
      item.outline_m ? null : shape,
      isOut && s("path.out", { d: "M-8 -8L8 8M-8 8L8 -8" }),
      item.text && s("text.inside", { dy: "0.35em" }, item.text),
      s(`text.label${showLabels ? "" : ".quiet"}`, { y: -14 }, item.label));
  }

  /** @param {[number, number, number, number]} [box] x0, y0, x1, y1 in metres; the last one if left out */
  fit(box) {
    this.box = box ?? this.box;
    if (!this.box) return;
    const [x0, y0, x1, y1] = this.box;
    this.center_m = [(x0 + x1) / 2, (y0 + y1) / 2];
    this.pxPerM = 0.94 * Math.min(this.width / Math.max(1, x1 - x0), this.height / Math.max(1, y1 - y0));
    this.place();
  }

  /** Put everything where it belongs in the present view. */
  place() {
    const { pxPerM: k, width, height } = this;
    const [x, y] = this.center_m;
    this.world.setAttribute("transform", `matrix(${k} 0 0 ${-k} ${width / 2 - x * k} ${height / 2 + y * k})`);
    for (const item of this.items) this.placeItem(item.id, item.at_m);
    if (this.moving) this.placeItem(this.moving.id, this.moving.at_m);
    const length = roundLength(Math.min(160, width / 3) / k);
    this.scaleBar.style.width = `${length * k}px`;
    this.scaleText.textContent = length >= 1000 ? `${length / 1000} km` : `${length} m`;
    this.cross.toggleAttribute("hidden", !(this.isAdding && this.cross_m));
    if (this.cross_m) this.cross.setAttribute("transform", `translate(${this.toPixel(this.cross_m).join(" ")})`);
    if (this.refusal_m) this.placeBubble(this.refusal_m);
    this.onPlace?.();
  }

  /** @param {string} id @param {Point} at_m */
  placeItem(id, at_m) {
    const [x, y] = this.toPixel(at_m);
    this.symbols.get(id)?.setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)})`);
    const outline = this.outlines.querySelector(`[data-id="${CSS.escape(id)}"]`);
    outline?.setAttribute("transform", `translate(${x} ${y}) scale(${this.pxPerM} ${-this.pxPerM})`);
  }

  /** @param {Point} at_m @returns {Point} */
  toPixel([x, y]) {
    return [this.width / 2 + (x - this.center_m[0]) * this.pxPerM, this.height / 2 - (y - this.center_m[1]) * this.pxPerM];
  }

  /** @param {Point} pixel @returns {Point} */
  toWorld([x, y]) {
    return [this.center_m[0] + (x - this.width / 2) / this.pxPerM, this.center_m[1] - (y - this.height / 2) / this.pxPerM];
  }

  /** @param {MouseEvent} event @returns {Point} */
  pixel(event) {
    const box = this.surface.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** @param {number} factor @param {Point} [pixel] what stays where it is */
  zoom(factor, pixel = [this.width / 2, this.height / 2]) {
    const before = this.toWorld(pixel);
    this.pxPerM = Math.min(200, Math.max(0.05, this.pxPerM * factor));
    const after = this.toWorld(pixel);
    this.center_m = [this.center_m[0] + before[0] - after[0], this.center_m[1] + before[1] - after[1]];
    this.place();
  }

  // ---------------------------------------------------------------- choosing, adding, refusing

  /** @param {string|null} id */
  select(id) {
    this.selected = id;
    for (const [key, symbol] of this.symbols) symbol.classList.toggle("selected", key === id);
    const symbol = id && this.symbols.get(id);
    if (symbol) this.marks.append(symbol); // above the others
    for (const outline of this.outlines.children) outline.classList.toggle("selected", outline.getAttribute("data-id") === id);
  }

  /** Bring an item into view. @param {string} id */
  reveal(id) {
    const item = this.items.find((other) => other.id === id);
    if (!item) return;
    const [x, y] = this.toPixel(item.at_m);
    if (x < 20 || y < 20 || x > this.width - 20 || y > this.height - 20) {
      this.center_m = item.at_m;
      this.place();
    }
  }

  /** @param {boolean} isAdding */
  setAdding(isAdding) {
    this.isAdding = isAdding;
    this.cross_m = null;
    this.surface.classList.toggle("adding", isAdding);
    this.place();
  }

  /** Show a reason where something was dropped. @param {Point} at_m @param {string} reason */
  refuse(at_m, reason) {
    this.refusal_m = at_m;
    this.bubble.classList.remove("fine");
    this.bubble.textContent = reason;
    this.bubble.hidden = false;
    show(this.extra, s("path.refused", { d: "M-7 -7L7 7M-7 7L7 -7" }));
    this.placeBubble(at_m);
  }

  /** Say something beside the item that is dragged. @param {string} text @param {boolean} isRefused */
  hint(text, isRefused) {
    if (!this.moving) return;
    this.hinted = true;
    this.isFine = !isRefused;
    this.bubble.textContent = text;
    this.bubble.hidden = !text;
    this.bubble.classList.toggle("fine", !isRefused);
    this.symbols.get(this.moving.id)?.classList.toggle("impossible", isRefused);
    if (text) this.placeBubble(this.moving.at_m);
  }

  clearRefusal() {
    this.hinted = this.isFine = false;
    this.refusal_m = null;
    this.bubble.hidden = true;
    show(this.extra);
  }

  /** @param {Point} at_m */
  placeBubble(at_m) {
    const [x, y] = this.toPixel(at_m);
    this.extra.setAttribute("transform", `translate(${x} ${y})`);
    const half = this.bubble.offsetWidth / 2;
    this.bubble.style.left = `${Math.min(Math.max(x - half, 4), Math.max(4, this.width - 2 * half - 4))}px`;
    const above = y - this.bubble.offsetHeight - 14;
    this.bubble.style.top = `${above > 4 ? above : y + 14}px`;
  }

  // ---------------------------------------------------------------- pointer

  /** @param {Event} event */
  itemAt(event) {
    const id = event.target instanceof Element ? event.target.closest("[data-id]")?.getAttribute("data-id") : null;
    return this.items.find((item) => item.id === id) ?? null;
  }

  /** @param {PointerEvent} event */
  pointerDown(event) {
    if (event.button !== 0) return;
    this.keysRest.flush();
    this.surface.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, event);
    this.grabbed = this.isAdding ? null : this.itemAt(event);
    this.start = this.pixel(event);
    this.startCenter_m = this.center_m;
    this.hasMoved = false;
  }

  /** @param {PointerEvent} event */
  pointerMove(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before || !this.start || !this.startCenter_m) return;
    if (this.pointers.size === 2) return this.pinch(event);
    this.pointers.set(event.pointerId, event);
    const [x, y] = this.pixel(event);
    const [dx, dy] = [x - this.start[0], y - this.start[1]];
    if (!this.hasMoved && Math.hypot(dx, dy) < DRAG_STARTS_PX) return;
    if (!this.hasMoved) this.clearRefusal();
    this.hasMoved = true;
    const { grabbed } = this;
    if (grabbed?.movable) {
      if (this.selected !== grabbed.id) this.choose(grabbed.id);
      this.moving = { id: grabbed.id, at_m: [grabbed.at_m[0] + dx / this.pxPerM, grabbed.at_m[1] - dy / this.pxPerM] };
      this.placeItem(this.moving.id, this.moving.at_m);
      if (this.hinted) this.placeBubble(this.moving.at_m);
      this.handlers.onDrag(this.moving.id, this.moving.at_m);
    } else {
      this.center_m = [this.startCenter_m[0] - dx / this.pxPerM, this.startCenter_m[1] + dy / this.pxPerM];
      this.place();
    }
  }

  /** @param {PointerEvent} event */
  pinch(event) {
    const ids = [...this.pointers.keys()];
    const spread = () => {
      const [a, b] = ids.map((id) => this.pixel(/** @type {PointerEvent} */ (this.pointers.get(id))));
      return { length: Math.hypot(a[0] - b[0], a[1] - b[1]), middle: /** @type {Point} */ ([(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]) };
    };
    const before = spread();
    this.pointers.set(event.pointerId, event);
    const after = spread();
    this.hasMoved = true;
    if (before.length > 0) this.zoom(after.length / before.length, after.middle);
  }

  /** @param {PointerEvent} event */
  pointerUp(event) {
    if (!this.pointers.delete(event.pointerId) || this.pointers.size) return;
    if (this.moving) return this.endMove();
    if (this.hasMoved) return;
    this.clearRefusal();
    if (this.isAdding) this.handlers.onAdd(this.toWorld(this.pixel(event)));
    else this.choose(this.grabbed?.id ?? null);
  }

  /** @param {PointerEvent} event */
  cancel(event) {
    this.pointers.delete(event.pointerId);
    this.moving = null;
    this.place();
  }

  /** @param {string|null} id */
  choose(id) {
    this.select(id);
    this.handlers.onSelect(id);
  }

  endMove() {
    const { moving, isFine } = this;
    this.moving = null;
    if (!moving) return;
    this.clearRefusal();
    const item = this.items.find((other) => other.id === moving.id);
    if (item) item.at_m = moving.at_m; // until the server answers
    this.handlers.onMove(moving.id, moving.at_m, isFine);
  }

  // ---------------------------------------------------------------- keyboard

  /** @param {KeyboardEvent} event */
  keyDown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const arrow = ARROWS[event.key];
    const { selected } = this;
    if (arrow) this.arrowKey(arrow, event.shiftKey ? FINE_STEP_M : STEP_M);
    else if (event.key === "+" || event.key === "=") this.zoom(1.25);
    else if (event.key === "-") this.zoom(0.8);
    else if (event.key === "0") this.fit();
    else if (event.key === "PageDown" || event.key === "PageUp") this.step(event.key === "PageDown" ? 1 : -1);
    else if (event.key === "Enter" && this.isAdding) this.handlers.onAdd(this.cross_m ?? this.center_m);
    else if (event.key === "Enter" && selected) this.handlers.onSelect(selected);
    else if (event.key === "Delete" && selected) this.handlers.onDelete(selected);
    else if (event.key === "Escape") this.escape();
    else return;
    event.preventDefault();
  }

  /** @param {Point} direction @param {number} step_m */
  arrowKey([dx, dy], step_m) {
    const item = this.items.find((other) => other.id === this.selected);
    if (this.isAdding) {
      const [x, y] = this.cross_m ?? this.center_m;
      this.cross_m = [x + dx * step_m, y + dy * step_m];
    } else if (item?.movable) {
      this.clearRefusal();
      const [x, y] = this.moving?.at_m ?? item.at_m;
      this.moving = { id: item.id, at_m: [x + dx * step_m, y + dy * step_m] };
      this.keysRest.request();
      this.handlers.onDrag(this.moving.id, this.moving.at_m);
    } else this.center_m = [this.center_m[0] + (dx * 60) / this.pxPerM, this.center_m[1] + (dy * 60) / this.pxPerM];
    this.place();
  }

  /** Choose the next or the previous item. @param {number} direction */
  step(direction) {
    this.keysRest.flush();
    if (!this.items.length) return;
    const at = this.items.findIndex((item) => item.id === this.selected);
    const next = this.items[at < 0 ? 0 : (at + direction + this.items.length) % this.items.length];
    if (next.kind === "suggestion") this.select(next.id); // Enter takes it
    else this.choose(next.id);
    this.reveal(next.id);
    this.handlers.announce(next.title ?? next.label);
  }

  escape() {
    this.clearRefusal();
    if (this.moving) {
      this.moving = null;
      this.place();
    } else this.choose(null);
  }
}
