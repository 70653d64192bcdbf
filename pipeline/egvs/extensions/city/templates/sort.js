// Sorts the table by the column whose head is chosen, and shows the map that is chosen.
(() => {
  const table = document.querySelector("table.sortable"), body = table.tBodies[0];
  const value = (row, at) => {
    const cell = row.cells[at], number = Number(cell.dataset.value);
    return cell.dataset.value === undefined ? cell.textContent.trim() : number;
  };
  const compare = (a, b) => typeof a === "number" ? a - b : a.localeCompare(b, undefined, { numeric: true });
  table.querySelectorAll("thead button").forEach(button => button.addEventListener("click", () => {
    const head = button.closest("th"), at = head.cellIndex, up = head.getAttribute("aria-sort") === "descending";
    const first = head.hasAttribute("aria-sort") ? up : head.dataset.first === "up";
    table.querySelectorAll("th[aria-sort]").forEach(other => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", first ? "ascending" : "descending");
    const rows = [...body.rows].sort((a, b) => (first ? 1 : -1) * compare(value(a, at), value(b, at)));
    body.replaceChildren(...rows);
  }));
  const show = key => document.querySelectorAll("[data-map]").forEach(map => { map.hidden = map.dataset.map !== key; });
  const choices = document.querySelectorAll("input[name=map]");
  choices.forEach(choice => choice.addEventListener("change", () => show(choice.value)));
  document.querySelector(".maps").classList.add("choosing-map");
  show(choices[0].value);
  addEventListener("beforeprint", () => document.querySelectorAll("[data-map]").forEach(map => { map.hidden = false; }));
})();
