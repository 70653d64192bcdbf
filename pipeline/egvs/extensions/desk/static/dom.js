// Elements of the page. Text only ever becomes text, never markup.

const SVG = "http://www.w3.org/2000/svg";

/**
 * @typedef {Node|string|number|null|undefined|false} Child
 * @typedef {Record<string, unknown>} Attributes "on..." are listeners; true is an empty attribute, false and null none
 */

/**
 * Create an element of HTML.
 * @param {string} name tag, with classes after dots: "p.quiet"
 * @param {Attributes} [attributes]
 * @param {...(Child|Child[])} children
 * @returns {any}
 */
export function h(name, attributes = {}, ...children) {
  const [tag, ...classes] = name.split(".");
  return fill(document.createElement(tag), classes, attributes, children);
}

/**
 * Create an element of SVG.
 * @param {string} name
 * @param {Attributes} [attributes]
 * @param {...(Child|Child[])} children
 * @returns {any}
 */
export function s(name, attributes = {}, ...children) {
  const [tag, ...classes] = name.split(".");
  return fill(document.createElementNS(SVG, tag), classes, attributes, children);
}

/**
 * @param {Element} element
 * @param {string[]} classes
 * @param {Attributes} attributes
 * @param {(Child|Child[])[]} children
 */
function fill(element, classes, attributes, children) {
  if (classes.length) element.classList.add(...classes);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), /** @type {EventListener} */ (value));
    else if (value !== false && value !== null && value !== undefined)
      element.setAttribute(key, value === true ? "" : String(value));
  }
  append(element, children);
  return element;
}

/**
 * @param {Element} element
 * @param {(Child|Child[])[]} children
 */
export function append(element, children) {
  for (const child of children.flat()) {
    if (child === null || child === undefined || child === false) continue;
    element.append(child instanceof Node ? child : String(child));
  }
}

/**
 * Replace what is in an element.
 * @param {Element} element
 * @param {...(Child|Child[])} children
 */
export function show(element, ...children) {
  element.replaceChildren();
  append(element, children);
}

/** @param {string} id @returns {any} */
export function byId(id) {
  const element = document.getElementById(id);
  if (!element) throw new Error(`no element ${id}`);
  return element;
}

/** Move the focus to the heading of a part of the page, so that keyboard and screen reader go on there. @param {Element} element */
export function focusHeading(element) {
  const heading = element.querySelector("h1");
  heading?.setAttribute("tabindex", "-1");
  heading?.focus({ preventScroll: true });
}

/**
 * Rebuild a part of the page, and keep its scroll position, and the focus and what was typed in the field of the same
 * data-key.
 * @param {Element} element
 * @param {() => void} rebuild
 */
export function keepingFocus(element, rebuild) {
  const active = document.activeElement;
  const inside = active instanceof HTMLElement && element.contains(active) ? active : null;
  const key = inside?.dataset.key ?? "";
  const isText = inside instanceof HTMLInputElement && inside.type === "text";
  const typed = isText && inside.value !== inside.defaultValue ? inside.value : null;
  const [start, end] = isText ? [inside.selectionStart, inside.selectionEnd] : [null, null];
  const top = element.scrollTop;
  rebuild();
  element.scrollTop = top;
  const again = key && element.querySelector(`[data-key="${CSS.escape(key)}"]`);
  if (inside && !(again instanceof HTMLElement && !again.matches(":disabled"))) focusHeading(element);
  if (!(again instanceof HTMLElement)) return;
  if (isText && again instanceof HTMLInputElement && typed !== null) again.value = typed;
  again.focus({ preventScroll: true });
  if (isText && again instanceof HTMLInputElement) again.setSelectionRange(start, end);
}

/**
 * Ask in a dialog. Escape is the same as the second button, which has the focus.
 * @param {string} title @param {string} text @param {string} yes @param {string} no
 * @returns {Promise<boolean>}
 */
export function ask(title, text, yes, no) {
  return new Promise((resolve) => {
    const dialog = h("dialog", { "aria-labelledby": "ask-title", "aria-describedby": "ask-text" },
      h("h2", { id: "ask-title" }, title), h("p", { id: "ask-text" }, text),
      h("div.tools", {}, h("button", { type: "button", onclick: () => dialog.close("yes") }, yes), h("button.main", { type: "button", autofocus: true, onclick: () => dialog.close() }, no)));
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "yes");
    });
    document.body.append(dialog);
    dialog.showModal();
  });
}

/**
 * Call a function when nothing was requested for a while; `flush` calls it at once.
 * @param {number} delayMs
 * @param {() => void} action
 */
export function debounced(delayMs, action) {
  let timer = 0;
  const run = () => {
    clearTimeout(timer);
    timer = 0;
    action();
  };
  return {
    request() {
      clearTimeout(timer);
      timer = setTimeout(run, delayMs);
    },
    flush() {
      if (timer) run();
    },
  };
}
