const film = JSON.parse(document.getElementById("walks").textContent);
const agents = {  // what to see
  "baseline": "Learns from the reward as it is. See where it stays.",
  "uard-paper": "UARD as the paper prints it. See whether it ever arrives.",
  "uard": "Ours. See which way it takes.",
};
const stage = document.getElementById("stage"), time = document.getElementById("time"), play = document.getElementById("play");
const grid = document.getElementById("grid"), seed = document.getElementById("seed");
film[0].walks.uard.forEach((_, i) => seed.add(new Option(i)));
film.forEach((f, i) => grid.add(new Option(f.name, i, false, f.size === 10 && f.name.includes("main"))));
for (const agent in agents) {
  const box = document.createElement("figure");
  box.dataset.agent = agent;
  box.innerHTML = `<figcaption>${agent}<span class="said">${agents[agent]}</span></figcaption><canvas width="800" height="800" data-agent="${agent}" role="img" aria-label="Walk of ${agent}"></canvas><div class="count" data-agent="${agent}"></div>`;
  stage.append(box);
}
function draw() {
  const theme = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const f = film[grid.value], n = f.size, t = +time.value;
  time.max = f.horizon;
  for (const canvas of stage.querySelectorAll("canvas")) {
    const agent = canvas.dataset.agent, path = f.walks[agent][seed.value], c = canvas.getContext("2d"), w = canvas.width / n;
    const at = s => [(s % n) * w, Math.floor(s / n) * w], now = Math.min(t, path.length - 1);
    c.fillStyle = theme("--back"); c.fillRect(0, 0, canvas.width, canvas.height);
    const own = getComputedStyle(canvas).getPropertyValue("--agent").trim();
    const seen = {}; let visits = 0, observed = 0, truth = 0;
    path.slice(0, now + 1).forEach((s, i) => {
      seen[s] = (seen[s] || 0) + 1;
      if (i === 0) return;
      if (f.traps.includes(s)) { visits++; observed += f.rewards.trap; truth += f.rewards.true; }
      else { const r = s === f.goal ? f.rewards.goal : f.rewards.step; observed += r; truth += r; }
    });
    for (const s in seen) { const [x, y] = at(+s); c.fillStyle = own; c.globalAlpha = Math.min(.12 + .05 * seen[s], .65); c.fillRect(x, y, w, w); c.globalAlpha = 1; }
    c.strokeStyle = theme("--line"); c.lineWidth = 2;
    for (let i = 0; i <= n; i++) { c.beginPath(); c.moveTo(i * w, 0); c.lineTo(i * w, n * w); c.moveTo(0, i * w); c.lineTo(n * w, i * w); c.stroke(); }
    c.textAlign = "center"; c.textBaseline = "middle"; c.font = `bold ${w * .4}px sans-serif`;
    for (const s of f.traps) { const [x, y] = at(s); c.fillStyle = theme("--baseline"); c.fillText("+" + f.rewards.trap, x + w / 2, y + w / 2); }
    const [gx, gy] = at(f.goal); c.fillStyle = theme("--ours"); c.font = `bold ${w * .3}px sans-serif`; c.fillText("goal", gx + w / 2, gy + w / 2);
    const [x, y] = at(path[now]); c.beginPath(); c.arc(x + w / 2, y + w / 2, w * .3, 0, 7); c.fillStyle = theme("--ink"); c.fill();
    const end = now < path.length - 1 ? "" : path[now] === f.goal ? " · reached the goal" : " · time is over";
    stage.querySelector(`.count[data-agent="${agent}"]`).textContent = `step ${now}: ${visits} trap visits, observed ${observed.toFixed(1)}, true ${truth.toFixed(1)}${end}`;
  }
}
let timer = null;
function stop() { clearInterval(timer); timer = null; play.textContent = "Play"; play.setAttribute("aria-pressed", "false"); }
play.onclick = () => {
  if (timer) return stop();
  if (+time.value >= +time.max) time.value = 0;
  play.textContent = "Pause"; play.setAttribute("aria-pressed", "true");
  timer = setInterval(() => { time.value = +time.value + 1; draw(); if (+time.value >= +time.max) stop(); }, 160);
};
time.oninput = draw; grid.onchange = () => { time.value = 0; draw(); }; seed.onchange = draw; matchMedia("(prefers-color-scheme: dark)").onchange = draw; draw();
