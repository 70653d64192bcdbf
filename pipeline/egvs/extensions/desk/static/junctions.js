// Names of junctions.

/** The streets of a junction; its signals are in a column of their own. @param {string} title */
export function shortTitle(title) {
  return title.replace(/^(signalised )?junction (without signals )?(of|in) /, "");
}
