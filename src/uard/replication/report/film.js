const film = JSON.parse(document.getElementById("walks").textContent);
const colours = { "baseline": "#c1272d", "uard-paper": "#2c6fbb", "uard": "#1b8a4b" };
const stage = document.getElementById("stage"), time = document.getElementById("time"), play = document.getElementById("play");
const grid = document.getElementById("grid"), seed = document.getElementById("seed");
film[0].walks.uard.forEach((_, i) => seed.add(new Option(i)));
film.forEach((f, i) => grid.add(new Option(f.name, i, false, f.size === 10 && f.name.includes("main"))));
for (const agent in colours) {
  const box = document.createElement("figure");
  box.innerHTML = `<figcaption>${agent}</figcaption><canvas width="660" height="660" data-agent="${agent}" role="img" aria-label="Walk of ${agent}"></canvas><div class="count" data-agent="${agent}"></div>`;
  box.firstChild.style.color = colours[agent];
  stage.append(box);
}
function draw() {
  const f = film[grid.value], n = f.size, t = +time.value;
  time.max = f.horizon;
  for (const canvas of stage.querySelectorAll("canvas")) {
    const agent = canvas.dataset.agent, path = f.walks[agent][seed.value], c = canvas.getContext("2d"), w = canvas.width / n;
    const at = s => [(s % n) * w, Math.floor(s / n) * w], now = Math.min(t, path.length - 1);
    c.fillStyle = "#fff"; c.fillRect(0, 0, canvas.width, canvas.height);
    const seen = {}; let visits = 0, observed = 0, truth = 0;
    path.slice(0, now + 1).forEach((s, i) => {
      seen[s] = (seen[s] || 0) + 1;
      if (i === 0) return;
      if (f.traps.includes(s)) { visits++; observed += f.rewards.trap; truth += f.rewards.true; }
      else { const r = s === f.goal ? f.rewards.goal : f.rewards.step; observed += r; truth += r; }
    });
    for (const s in seen) { const [x, y] = at(+s); c.fillStyle = colours[agent]; c.globalAlpha = Math.min(.12 + .05 * seen[s], .65); c.fillRect(x, y, w, w); c.globalAlpha = 1; }
    c.strokeStyle = "#dde3ea"; c.lineWidth = 2;
    for (let i = 0; i <= n; i++) { c.beginPath(); c.moveTo(i * w, 0); c.lineTo(i * w, n * w); c.moveTo(0, i * w); c.lineTo(n * w, i * w); c.stroke(); }
    c.textAlign = "center"; c.textBaseline = "middle"; c.font = `bold ${w * .4}px sans-serif`;
    for (const s of f.traps) { const [x, y] = at(s); c.fillStyle = "#c1272d"; c.fillText("+" + f.rewards.trap, x + w / 2, y + w / 2); }
    const [gx, gy] = at(f.goal); c.fillStyle = "#1b8a4b"; c.font = `bold ${w * .3}px sans-serif`; c.fillText("goal", gx + w / 2, gy + w / 2);
    const [x, y] = at(path[now]); c.beginPath(); c.arc(x + w / 2, y + w / 2, w * .3, 0, 7); c.fillStyle = "#1d2733"; c.fill();
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
time.oninput = draw; grid.onchange = () => { time.value = 0; draw(); }; seed.onchange = draw; draw();
