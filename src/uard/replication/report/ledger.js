document.getElementById("filter").onclick = event => {
  if (event.target.tagName !== "BUTTON") return;
  for (const b of event.currentTarget.children) b.setAttribute("aria-pressed", b === event.target);
  for (const r of document.querySelectorAll("#ledger-table tbody tr")) r.hidden = event.target.dataset.v && r.dataset.v !== event.target.dataset.v;
};
