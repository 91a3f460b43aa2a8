const heat = document.getElementById("heat"), said = document.getElementById("said"), first = said.textContent;
const rows = [...heat.tBodies[0].rows].map(row => [...row.cells].slice(1));
let at = [0, 0];
function move(r, c) {
  rows[at[0]][at[1]].tabIndex = -1;
  at = [Math.max(0, Math.min(r, rows.length - 1)), Math.max(0, Math.min(c, rows[0].length - 1))];
  rows[at[0]][at[1]].tabIndex = 0;
}
for (const row of rows) for (const cell of row) { cell.tabIndex = -1; cell.dataset.said = cell.title; cell.removeAttribute("title"); cell.setAttribute("aria-label", cell.dataset.said); }
move(0, 0);
const show = event => { const cell = event.target.closest("td[data-said]"); if (cell) said.textContent = cell.dataset.said; };
heat.addEventListener("mouseover", show);
heat.addEventListener("focusin", event => { const cell = event.target, r = rows.findIndex(row => row.includes(cell)); if (r >= 0) { move(r, rows[r].indexOf(cell)); show(event); } });
heat.addEventListener("mouseleave", () => { if (!heat.contains(document.activeElement)) said.textContent = first; });
heat.addEventListener("keydown", event => {
  const step = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1], Home: [0, -99], End: [0, 99] }[event.key];
  if (!step) return;
  event.preventDefault();
  move(at[0] + step[0], at[1] + step[1]);
  rows[at[0]][at[1]].focus();
});
