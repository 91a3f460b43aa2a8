const value = cell => { const v = cell.dataset.v ?? cell.textContent.trim(); return v === "" || isNaN(v) ? v : +v; };
function order(a, b) {
  if (a === "" || b === "") return (a === "") - (b === "");
  return typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true });
}
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
  heads.forEach((head, column) => {
    if (head.classList.contains("plain")) return;
    const button = document.createElement("button");
    button.type = "button"; button.className = "sort"; button.textContent = head.textContent;
    head.replaceChildren(button);
    button.onclick = () => {
      const down = head.classList.contains("l") ? head.ariaSort === "ascending" : head.ariaSort !== "descending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const keyed = [...body.rows].map(row => [value(row.cells[column]), row]);
      keyed.sort(([a], [b]) => a === "" || b === "" ? order(a, b) : down ? order(b, a) : order(a, b));
      body.append(...keyed.map(([, row]) => row));
      body.dispatchEvent(new Event("sorted"));
    };
  });
}
const closed = () => [...document.querySelectorAll("details:not([open])")];
let opened = [];
addEventListener("beforeprint", () => { opened = closed(); for (const d of opened) d.open = true; });
addEventListener("afterprint", () => { for (const d of opened) d.open = false; });
for (const filters of document.querySelectorAll(".filters")) {
  const bodies = [...document.querySelectorAll(filters.dataset.for)].map(table => table.tBodies[0]);
  const count = filters.querySelector(".count"), all = filters.querySelector("button.all");
  const first = +(filters.dataset.first ?? Infinity), noun = filters.dataset.noun ?? "lines";
  const filter = () => {
    const wanted = [...filters.querySelectorAll("select")].filter(s => s.value);
    const most = all?.getAttribute("aria-pressed") === "true" ? Infinity : first;
    let shown = 0, found = 0, every = 0;
    for (const body of bodies) { let here = 0; for (const row of body.rows) {
      const fits = wanted.every(s => row.dataset[s.dataset.key] === s.value);
      every += 1; found += fits; here += fits;
      row.hidden = !fits || here > most;
      shown += !row.hidden;
    } }
    count.textContent = `${shown} of ${every} ${noun}` + (shown < found ? `, ${found - shown} more` : "");
  };
  if (all) all.onclick = () => { all.setAttribute("aria-pressed", all.getAttribute("aria-pressed") !== "true"); filter(); };
  filters.hidden = false; filters.onchange = filter; filter();
  for (const body of bodies) body.addEventListener("sorted", filter);
  addEventListener("beforeprint", () => { for (const body of bodies) for (const row of body.rows) row.hidden = false; });
  addEventListener("afterprint", filter);
}
