// Numbers as people type them, German or English, and as the page shows them.

/**
 * @typedef {Object} Limits
 * @property {number} [min] smallest allowed value
 * @property {number} [max] largest allowed value
 * @property {boolean} [whole] only whole numbers
 * @property {boolean} [optional] an empty field is null
 */

const SPACES = /[\s'’]/gu; // also no-break and thin spaces
const GROUPED = /^\d{1,3}([.,])\d{3}(?:\1\d{3})+$/; // 1.234.567
const ONE_GROUP = /^[1-9]\d{0,2}[.,]\d{3}$/; // 1.234: thousands in one language, thousandths in the other
const BOTH = /^(\d{1,3}(?:\.\d{3})+),(\d+)$|^(\d{1,3}(?:,\d{3})+)\.(\d+)$/; // 1.234,5 or 1,234.5
const PLAIN = /^\d*[.,]?\d+$/;

/**
 * Return the number that a text states; throw an Error with a message for the user.
 * "8,5" and "8.5" are 8.5; "1.234" can be two numbers and is refused.
 * @param {string} text
 * @param {Limits} [limits]
 * @returns {number|null}
 */
export function parseNumber(text, limits = {}) {
  const typed = text.trim();
  if (typed === "") {
    if (limits.optional) return null;
    throw new Error("Type a number.");
  }
  let digits = typed.replace(SPACES, "").replace("−", "-");
  const sign = digits.startsWith("-") ? -1 : 1;
  digits = digits.replace(/^[+-]/, "");
  const both = BOTH.exec(digits);
  if (both) digits = (both[1] ?? both[3]).replace(/[.,]/g, "") + "." + (both[2] ?? both[4]);
  else if (GROUPED.test(digits)) digits = digits.replace(/[.,]/g, "");
  else if (ONE_GROUP.test(digits)) {
    const joined = digits.replace(/[.,]/, "");
    throw new Error(`“${typed}” can be ${joined} or ${digits.replace(",", ".")}. Type ${joined} or ${digits}0.`);
  } else if (!PLAIN.test(digits)) throw new Error(`“${shorten(typed)}” is not a number.`);
  const value = sign * Number(digits.replace(",", "."));
  checkLimits(value, limits);
  return value === 0 ? 0 : value;
}

/** Throws a RangeError, so that a number outside its limits is told from one that cannot be read. @param {number} value @param {Limits} limits */
function checkLimits(value, { min, max, whole }) {
  if (whole && !Number.isInteger(value)) throw new RangeError("Type a whole number.");
  if (min !== undefined && value < min) throw new RangeError(`The smallest value is ${fieldText(min)}.`);
  if (max !== undefined && value > max) throw new RangeError(`The largest value is ${fieldText(max)}.`);
}

/** @param {string} text */
function shorten(text) {
  return text.length > 20 ? `${text.slice(0, 20)}…` : text;
}

const DECIMAL = new Intl.NumberFormat(navigator.language).format(0.5).includes(",") ? "," : ".";

/**
 * Return a number for a text field, with the decimal sign of the browser's language and without groups.
 * At most two decimals, so that what it returns is never ambiguous.
 * @param {number|null|undefined} value
 */
export function fieldText(value) {
  if (value === null || value === undefined) return "";
  return String(Math.round(value * 100) / 100).replace(".", DECIMAL);
}

/**
 * Return a number for reading: spaces between thousands, which no language confuses.
 * @param {number|null|undefined} value
 * @param {number} [decimals]
 */
export function readable(value, decimals = 0) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const [whole, part] = Math.abs(value).toFixed(decimals).split(".");
  const grouped = whole.length > 4 ? whole.replace(/\B(?=(\d{3})+$)/g, "\u202f") : whole;
  const sign = value < 0 && Number(value.toFixed(decimals)) !== 0 ? "−" : "";
  return sign + grouped + (part ? DECIMAL + part : "");
}

/**
 * Return a share as per cent.
 * @param {number|null|undefined} share
 * @param {number} [decimals]
 */
export function percent(share, decimals = 0) {
  return share === null || share === undefined ? "–" : `${readable(100 * share, decimals)} %`;
}

/** @param {string} text */
export const capitalised = (text) => text.charAt(0).toUpperCase() + text.slice(1);

/**
 * Return a duration: "40 s", "3 min", "1 h 20 min".
 * @param {number} seconds
 */
export function duration(seconds) {
  if (seconds < 90) return `${Math.max(1, Math.round(seconds))} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 90 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}
