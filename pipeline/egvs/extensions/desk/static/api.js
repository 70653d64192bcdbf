// Requests to the desk's server and its events.

/**
 * @typedef {Object} Job
 * @property {number} id
 * @property {string} kind
 * @property {string} title
 * @property {"runs"|"done"|"failed"|"stopped"} state
 * @property {string} stage
 * @property {string} what
 * @property {number} done
 * @property {number} total
 * @property {number|null} share
 * @property {number} elapsed_s
 * @property {number|null} remaining_s
 * @property {string} message
 * @property {string} hint
 * @property {string[]} [log]
 * @property {any} [result]
 */

/** The server refused a request, or did not answer; the message is for the user. */
export class ApiError extends Error {
  /** @param {number} status 0 without an answer @param {string} message @param {string} [hint] @param {string} [field] */
  constructor(status, message, hint = "", field = "") {
    super(hint ? `${message} ${hint}` : message);
    this.status = status;
    this.reason = message;
    this.field = field;
  }
}

const LOST = "The desk does not answer. Is the command “egvs desk” still running?";

/**
 * @param {"GET"|"POST"|"PUT"|"PATCH"|"DELETE"} method
 * @param {string} path after /api/
 * @param {unknown} [body] sent as JSON; a File or Blob as it is
 * @returns {Promise<any>}
 */
export async function request(method, path, body) {
  const isFile = body instanceof Blob;
  /** @type {RequestInit} */
  const options = { method, credentials: "same-origin" };
  if (body !== undefined) {
    options.body = isFile ? body : JSON.stringify(body);
    options.headers = { "Content-Type": isFile ? "application/octet-stream" : "application/json" };
  }
  let response;
  try {
    response = await fetch(`/api/${path}`, options);
  } catch {
    throw new ApiError(0, LOST);
  }
  const isJson = (response.headers.get("Content-Type") ?? "").startsWith("application/json");
  const answer = isJson ? await response.json() : { message: await response.text() };
  if (!response.ok) throw new ApiError(response.status, answer.message || response.statusText, answer.hint, answer.field);
  return answer;
}

/** @param {string} path */
export const get = (path) => request("GET", path);
/** @param {string} path @param {unknown} [body] */
export const post = (path, body = {}) => request("POST", path, body);

/**
 * Answers of a path, or null where there is none (404).
 * @param {string} path
 */
export async function getIfAny(path) {
  try {
    return await get(path);
  } catch (error) {
    if (error instanceof ApiError && error.status === 404) return null;
    throw error;
  }
}

/**
 * Send requests one at a time; of those that wait, only the latest.
 * @template T
 * @param {(value: T) => Promise<void>} send
 * @returns {(value: T) => void}
 */
export function latestWins(send) {
  let isBusy = false;
  /** @type {{value: T}|null} */
  let next = null;
  return async function offer(value) {
    next = { value };
    if (isBusy) return;
    isBusy = true;
    try {
      while (next) {
        const current = next;
        next = null;
        await send(current.value);
      }
    } finally {
      isBusy = false;
    }
  };
}

/**
 * Listen to the server.
 * @param {Record<"state"|"job"|"log"|"score", (data: any) => void>} handlers
 * @param {(isConnected: boolean) => void} onConnection
 */
export function listen(handlers, onConnection) {
  const source = new EventSource("/api/events");
  for (const [name, handler] of Object.entries(handlers))
    source.addEventListener(name, (event) => handler(JSON.parse(/** @type {MessageEvent} */ (event).data)));
  source.addEventListener("open", () => onConnection(true));
  source.addEventListener("error", () => onConnection(false));
  addEventListener("pagehide", () => source.close());
}
