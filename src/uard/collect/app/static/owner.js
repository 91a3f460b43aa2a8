// The owner's page: the disputed items, and a link that is easy to copy.

import { showAll } from "./player.js";

showAll("[data-item]");
const link = document.getElementById("link");
link?.addEventListener("focus", () => link.select());
document.getElementById("copy")?.addEventListener("click", async (event) => {
  link.select();
  await navigator.clipboard?.writeText(link.value);
  event.target.textContent = "Copied";
});
for (const form of document.querySelectorAll("form[data-sure]")) {
  form.addEventListener("submit", (event) => { if (!window.confirm(form.dataset.sure)) event.preventDefault(); });
}
