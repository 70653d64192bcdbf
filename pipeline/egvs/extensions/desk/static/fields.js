// Fields, choices and tables of the panels.
import { ApiError } from "./api.js";
import { h } from "./dom.js";
import { fieldText, parseNumber } from "./numbers.js";

/** Texts that were refused, by the key of their field: they stay until they are corrected. @type {Map<string, {text: string, reason: string}>} */
const refused = new Map();

/** Forget them. @returns {string[]} the reasons */
export function takeRefused() {
  const reasons = [...refused.values()].map(({ reason }) => reason);
  refused.clear();
  return reasons;
}

let lastId = 0;
const newId = () => `f${++lastId}`;

/** @typedef {(error: ApiError) => void} Refuse */

/**
 * A field for a number, German or English. It is sent when it is left or Enter is pressed, if it changed.
 * @param {Object} options
 * @param {string} options.key
 * @param {string} options.label
 * @param {string} [options.labelMore] end of the label that only screen readers need
 * @param {boolean} [options.hasUnseenLabel]
 * @param {number|null|undefined} options.value
 * @param {import("./numbers.js").Limits} [options.limits]
 * @param {string} [options.unit]
 * @param {string} [options.placeholder] what an empty field means
 * @param {boolean} [options.isDisabled]
 * @param {(value: number|null, refuse: Refuse) => void} options.send
 * @param {(value: number|null) => void} [options.onInput] called with every valid number while it is typed
 * @returns {HTMLElement}
 */
export function numberField(options) {
  const { key, label, value, limits = {}, unit, send, onInput } = options;
  return textInput({
    ...options, text: fieldText(value), mode: "decimal", unit, label, key,
    send(text, refuse) {
      try {
        send(parseNumber(text, limits), refuse);
      } catch (error) {
        refuse(new ApiError(422, /** @type {Error} */ (error).message));
      }
    },
    onInput: onInput && ((text) => {
      try {
        onInput(parseNumber(text, limits));
      } catch (error) {
        return error instanceof RangeError ? error.message : ""; // other texts may not be complete yet
      }
    }),
  });
}

/**
 * A field for text; see numberField.
 * @param {Object} options
 * @param {string} options.key
 * @param {string} options.label
 * @param {string} [options.labelMore]
 * @param {boolean} [options.hasUnseenLabel]
 * @param {string} options.text
 * @param {string} [options.mode]
 * @param {string} [options.unit]
 * @param {string} [options.placeholder]
 * @param {boolean} [options.isDisabled]
 * @param {(text: string, refuse: Refuse) => void} options.send
 * @param {(text: string) => string|void} [options.onInput] returns what is wrong while it is typed
 * @returns {HTMLElement}
 */
export function textInput({ key, label, labelMore, hasUnseenLabel, text, mode, unit, placeholder, isDisabled, send, onInput }) {
  const id = newId();
  const before = refused.get(key);
  const reason = h("p.reason", { id: `${id}-reason`, hidden: !before }, before?.reason);
  const input = h("input", {
    id, type: "text", inputmode: mode, value: text, "data-key": key, placeholder, disabled: isDisabled,
    autocomplete: "off", spellcheck: "false", "aria-describedby": `${id}-reason`,
  });
  let sent = text;
  const mark = (/** @type {string} */ message) => {
    reason.textContent = message;
    reason.hidden = !message;
    if (message) input.setAttribute("aria-invalid", "true");
    else input.removeAttribute("aria-invalid");
  };
  if (before) {
    input.value = before.text;
    mark(before.reason);
  }
  const commit = () => {
    const typed = input.value;
    if (typed === sent) return;
    sent = input.defaultValue = typed;
    refused.delete(key);
    mark("");
    if (typed.trim() === text) {
      input.value = text;
      return;
    }
    send(typed, (error) => {
      refused.set(key, { text: typed, reason: error.message });
      mark(error.message);
      const shown = document.querySelector(`[data-key="${CSS.escape(key)}"]`);
      if (shown && shown !== input) shown.dispatchEvent(new CustomEvent("refused", { detail: error.message }));
    });
  };
  input.addEventListener("refused", (/** @type {CustomEvent} */ event) => mark(event.detail));
  input.addEventListener("change", commit);
  input.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
    if (event.key === "Enter") commit();
    if (event.key === "Escape") {
      refused.delete(key);
      input.value = sent = text;
      mark("");
    }
  });
  if (onInput) input.addEventListener("input", () => mark(onInput(input.value) ?? ""));
  return h("div.field", {},
    h(`label${hasUnseenLabel ? ".unseen" : ""}`, { for: id }, label, labelMore && h("span.unseen", {}, labelMore)),
    h("span.entry", {}, input, unit && h("span.unit", { "aria-hidden": "true" }, unit)),
    reason);
}

/**
 * A list of choices.
 * @param {Object} options
 * @param {string} options.key
 * @param {string} options.label
 * @param {boolean} [options.hasUnseenLabel]
 * @param {string} options.value
 * @param {[string, string][]} options.choices value and text
 * @param {boolean} [options.isDisabled]
 * @param {(value: string) => void} options.send
 */
export function choiceField({ key, label, hasUnseenLabel, value, choices, isDisabled, send }) {
  const id = newId();
  const select = h("select", { id, "data-key": key, disabled: isDisabled, onchange: () => send(select.value) },
    choices.map(([choice, text]) => h("option", { value: choice, selected: choice === value }, text)));
  return h("div.field", {}, h(`label${hasUnseenLabel ? ".unseen" : ""}`, { for: id }, label), select);
}

/**
 * @param {string} key @param {string} label @param {boolean} isChecked @param {(isChecked: boolean) => void} send
 * @param {boolean} [isDisabled]
 */
export function checkField(key, label, isChecked, send, isDisabled = false) {
  const id = newId();
  const input = h("input", { id, type: "checkbox", checked: isChecked, disabled: isDisabled, "data-key": key, onchange: () => send(input.checked) });
  return h("div.check", {}, input, h("label", { for: id }, label));
}

/**
 * Choices that exclude each other.
 * @param {Object} options
 * @param {string} options.name
 * @param {string} options.label
 * @param {string} options.value
 * @param {[string, string, string?][]} options.choices value, text and explanation
 * @param {(value: string) => void} options.send
 */
export function radioField({ name, label, value, choices, send }) {
  return h("fieldset.radios", {}, h("legend", {}, label), choices.map(([choice, text, more]) => {
    const id = newId();
    return h("div.check", {},
      h("input", { id, type: "radio", name, value: choice, checked: choice === value, "data-key": `${name}.${choice}`, onchange: () => send(choice) }),
      h("label", { for: id }, text, more && h("small", {}, more)));
  }));
}

/**
 * @param {string} text @param {() => void} onclick @param {{key?: string, isMain?: boolean, isDisabled?: boolean, title?: string, pressed?: boolean}} [options]
 * @returns {HTMLButtonElement}
 */
export function button(text, onclick, { key, isMain, isDisabled, title, pressed } = {}) {
  return h(`button${isMain ? ".main" : ""}`, {
    type: "button", onclick, title, disabled: isDisabled, "data-key": key ?? text,
    "aria-pressed": pressed === undefined ? null : String(pressed),
  }, text);
}

/** Let files be dropped on an element. @param {HTMLElement} element @param {(files: File[]) => void} send */
export function acceptDrop(element, send) {
  element.addEventListener("dragover", (event) => {
    event.preventDefault();
    element.classList.add("over");
  });
  element.addEventListener("dragleave", () => element.classList.remove("over"));
  element.addEventListener("drop", (event) => {
    event.preventDefault();
    element.classList.remove("over");
    if (event.dataTransfer?.files.length) send([...event.dataTransfer.files]);
  });
}

/**
 * A place for files: choose them, or drop them there.
 * @param {Object} options
 * @param {string} options.id
 * @param {string} options.label
 * @param {string[]} options.kinds endings of their names
 * @param {boolean} [options.multiple]
 * @param {boolean} [options.isDisabled]
 * @param {(files: File[]) => void} options.send
 */
export function dropZone({ id, label, kinds, multiple, isDisabled, send }) {
  const input = h("input", {
    id, type: "file", "data-key": id, accept: kinds.join(","), multiple, disabled: isDisabled,
    onchange: () => input.files.length && send([...input.files]),
  });
  const zone = h("div.drop", {}, h("label", { for: id }, h("b", {}, label), " or drop it here"), input);
  acceptDrop(zone, send);
  return zone;
}

export const PAGE_ROWS = 25;
/** Page that each table shows. @type {Map<string, number>} */
const pages = new Map();

/**
 * A table of 25 rows a page.
 * @template Row
 * @param {Object} options
 * @param {string} options.key
 * @param {string} options.caption
 * @param {{title: string, isNumber?: boolean, isHead?: boolean, cell: (row: Row) => import("./dom.js").Child}[]} options.columns
 * @param {Row[]} options.rows
 * @param {(row: Row) => boolean} [options.isSelected]
 * @param {() => void} options.redraw called when another page is chosen
 */
export function pagedTable({ key, caption, columns, rows, isSelected, redraw }) {
  const last = Math.max(0, Math.ceil(rows.length / PAGE_ROWS) - 1);
  const page = Math.min(pages.get(key) ?? 0, last);
  const body = rows.slice(page * PAGE_ROWS, (page + 1) * PAGE_ROWS).map((row) =>
    h("tr", { class: isSelected?.(row) ? "chosen" : null }, columns.map(({ isNumber, isHead, cell }) =>
      h(`${isHead ? "th" : "td"}${isNumber ? ".n" : ""}`, { scope: isHead ? "row" : null }, cell(row)))));
  const turn = (/** @type {number} */ to) => () => {
    pages.set(key, to);
    redraw();
  };
  return h("div.table", {},
    h("table", {}, h("caption.unseen", {}, caption),
      h("thead", {}, h("tr", {}, columns.map(({ title, isNumber }) => h(`th${isNumber ? ".n" : ""}`, { scope: "col" }, title)))),
      h("tbody", {}, body)),
    last > 0 && h("div.pager", {},
      button("‹ Previous", turn(page - 1), { key: `${key}.previous`, isDisabled: page === 0 }),
      h("span", {}, `${page * PAGE_ROWS + 1} to ${Math.min(rows.length, (page + 1) * PAGE_ROWS)} of ${rows.length}`),
      button("Next ›", turn(page + 1), { key: `${key}.next`, isDisabled: page === last })));
}

/** Turn a table to the page of a row. @param {string} key @param {number} index */
export function turnTo(key, index) {
  if (index >= 0) pages.set(key, Math.floor(index / PAGE_ROWS));
}
