"""Draws the pictures that README and docs show, from real runs: ``python docs/make_images.py [walks regret ...]``.

``regret``, ``robots`` and ``judges`` read published results, ``walks`` and ``paper`` train for some seconds, and
``people`` needs Playwright and a Chromium (``CHROMIUM`` names another one), and MuJoCo. All need Pillow.
"""

import io
import os
import runpy
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

IMAGES = Path(__file__).parent / "images"


INK, SOFT = "#1d2733", "#5b6773"
COLOURS = {"raw": "#cf4f00", "mean": "#b77700", "uard": "#00805f", "true": "#5b6773"}  # after Okabe and Ito
STYLE = {
    "font.family": "sans-serif",
    "font.size": 11.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": SOFT,
    "xtick.color": INK,
    "ytick.color": INK,
}
RULES = {  # of the picture of regrets
    "raw": "the reward itself",
    "mean-of-annotations": "mean of ratings",
    "median": "median of ratings",
    "worst-of-annotations": "lowest rating",
    "min-proxy-median": "reward, at most the median",
    "lcb": "lcb",
    "excess": "excess",
    "uard": "uard",
}


def save(figure: Figure, name: str) -> None:
    """Write a figure on white."""
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=130, facecolor="white", bbox_inches="tight", pad_inches=0.1, metadata={"Software": None})
    small(drawn, name)


def small(png: io.BytesIO, name: str) -> None:
    """Write a picture with a palette of colours, so that it is small."""
    from PIL import Image

    Image.open(png).convert("RGB").quantize(128).save(IMAGES / name, optimize=True)


def numbers() -> dict[str, Any]:
    """Return what ``make_numbers.py`` knows."""
    return runpy.run_path(str(Path(__file__).with_name("make_numbers.py")))


def walks() -> None:
    """Train seed 0 of the scale study and draw the walks."""
    from uard.lab import studies
    from uard.lab.execution import runner
    from uard.lab.execution.store import Store
    from uard.lab.views.study_results import StudyResults

    (study,) = studies.find(("scale",))
    store = Store(":memory:")
    runner.run(study.jobs([0]), store, workers=1)
    results = StudyResults(store, [0], [study])
    titles = {"baseline": "Learns from the reward", "uard-paper": "UARD as printed", "uard": "uard"}
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8.6, 3.4), layout="constrained")
        for axis, (agent, title), colour in zip(
            figure.subplots(1, 3), titles.items(), ("raw", "mean", "uard"), strict=True
        ):
            cell = results.row("scale", agent=agent, size=10, panel="main").cell
            path, grid = results.results(cell)[0].path, cell.environment
            arrives = path[-1] == grid.states - 1
            said = "reaches the goal" if arrives else "never arrives"
            axis.set_title(f"{title}:\n{said}", fontsize=12, color=COLOURS[colour], weight="bold")
            _walk(axis, path, grid, COLOURS[colour])
        save(figure, "walks.png")


def _walk(axis: Axes, path: np.ndarray, grid: Any, colour: str) -> None:
    """Draw a walk over a grid: the way, and how often a cell is visited."""
    size = grid.size
    counts = np.bincount(path, minlength=size * size).reshape(size, size)
    axis.set(xlim=(-0.5, size - 0.5), ylim=(size - 0.5, -0.5), aspect="equal")
    axis.set_xticks(np.arange(-0.5, size), [])
    axis.set_yticks(np.arange(-0.5, size), [])
    axis.grid(color="#d9dfe6", lw=0.7)
    axis.tick_params(length=0)
    for spine in axis.spines.values():
        spine.set(visible=True, color=SOFT)
    for (row, column), word, colour_of in [
        *((trap, "trap", "raw") for trap in grid.traps),
        ((size - 1, size - 1), "goal", "uard"),
    ]:
        axis.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, color=COLOURS[colour_of], alpha=0.18, lw=0))
        beside = [counts[row, column + 1 : column + 3].any(), counts[row, max(column - 2, 0) : column].any()]
        right = word == "trap" and (not beside[0] or beside[1])  # where nobody walks
        place = (column + 0.6, "left") if right else (column - 0.6, "right")
        how: Any = {"va": "center", "fontsize": 9, "color": COLOURS[colour_of], "weight": "bold"}
        axis.text(place[0], row, word, ha=place[1], **how)
    rows, columns = np.divmod(path, size)
    axis.plot(columns, rows, color=colour, lw=2.2, alpha=0.85)
    axis.plot(0, 0, "o", color=INK, ms=6)
    if (most := int(counts.max())) > 2:
        row = int(np.argwhere(counts == most)[0, 0])
        column = int(np.argwhere(counts > 2)[:, 1].max())  # beside all that is visited again and again
        axis.text(column + 0.7, row, f"{most} times", va="center", fontsize=10, weight="bold", color=INK)


def paper() -> None:
    """Train ten seeds of the paper's grid and draw what its headline says beside what it does not say."""
    known = numbers()
    results = known["paper_results"]()
    agents = {
        "Q-learning": ("Q-learning on the raw reward", "raw"),
        "a random walk": ("a random walk", "true"),
        "UARD as printed": ("`uard-paper`, as printed", "mean"),
        "uard": ("`uard`", "uard"),
    }
    found = {label: known["paper_row"](results, name, "main") for label, (name, _) in agents.items()}
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.6, 2.7), layout="constrained")
        for axis, metric, title in zip(
            figure.subplots(1, 2, sharey=True), (0, 1), ("trap visits", "goal rate"), strict=True
        ):
            for i, (label, (_, colour)) in enumerate(agents.items()):
                mean = found[label][metric].mean
                axis.barh(i, mean, 0.62, color=COLOURS[colour])
                axis.annotate(f"{mean:.2f}", (mean, i), (4, 0), textcoords="offset points", va="center", fontsize=10.5)
            axis.set_title(title, loc="left", fontsize=11.5, weight="bold")
            axis.margins(x=0.2)
        axis.set_yticks(range(len(agents)), list(agents))
        axis.invert_yaxis()
        figure.supxlabel("per episode, mean of ten seeds, 10x10", fontsize=10.5, color=SOFT)
        save(figure, "paper.png")


def regret() -> None:
    """Draw mean regret of every rule by kind of panel, as a table of colours, from published results."""
    from uard.lab.views import choice

    known = numbers()
    with matplotlib.rc_context(STYLE | {"font.size": 10.5}):
        figure = Figure(figsize=(9.4, 4.6), layout="constrained")
        axes = figure.subplots(1, 2, sharey=True)
        for axis, these in zip(axes, known["regrets"](), strict=True):
            groups = choice.by_kind(these)
            kinds = [kind for kind in known["WORDS"] if kind in groups]
            means = np.array([[these.regret[rule][groups[kind]].mean() for kind in kinds] for rule in RULES])
            _colours(axis, means, [known["WORDS"][kind] for kind in kinds])
            axis.set_title(f"random {known['TASKS'][these.tasks]} ({len(these.scenarios)})", weight="bold", pad=8)
        axes[0].set_yticks(range(len(RULES)), list(RULES.values()))
        axes[0].get_yticklabels()[-1].set_weight("bold")
        figure.supxlabel("mean regret: 0 as good as the true reward, 1 a random walk", fontsize=10.5, color=SOFT)
        save(figure, "regret.png")


def _colours(axis: Axes, means: np.ndarray, kinds: list[str]) -> None:
    """Draw a table: the darker, the more regret."""
    axis.imshow(np.sqrt(means.clip(0, 2)), cmap="Oranges", vmin=0, vmax=np.sqrt(2.0), aspect="auto")
    for (i, j), x in np.ndenumerate(means):
        axis.text(j, i, f"{x:.2f}", ha="center", va="center", color="white" if x > 0.9 else INK, fontsize=10)
    words = [kind.replace("are tempted by the same lie", "are tempted").replace(" ", "\n", 1) for kind in kinds]
    axis.set_xticks(
        range(len(kinds)), [word.replace(" at ", "\nat ").replace(" the ", "\nthe ") for word in words], fontsize=9
    )
    axis.tick_params(length=0)
    for spine in axis.spines.values():
        spine.set_visible(False)


def robots() -> None:
    """Draw the true return of a Hopper whose reward lies, by what it learns from, from published results."""
    from uard.lab.views import robots as published

    p = published.published()
    (setting,) = (s for s in published.settings(p) if (s.robot, s.region, s.panel) == ("hopper", "posture", "random"))
    bars = {
        "the reward itself": ("raw", "raw"),
        "mean of the ratings": ("mean-of-annotations", "mean"),
        "uard": ("uard", "uard"),
        "the true reward": ("true reward", "true"),
    }
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.2, 2.9), layout="constrained")
        axis = figure.subplots()
        for i, (name, colour) in enumerate(bars.values()):
            row = setting.one(name)
            found, hacks = (p.of(row, metric) for metric in ("true_return", "hacks"))
            low, high = found.ci95
            axis.barh(i, found.mean, 0.62, color=COLOURS[colour])
            axis.errorbar(found.mean, i, xerr=[[found.mean - low], [high - found.mean]], color=INK, lw=1.2, capsize=3)
            times = f"{hacks.mean:.0f}" if hacks.mean >= 10 else f"{hacks.mean:.1f}"
            axis.text(high + 40, i, f"{times} hacks", va="center", fontsize=10.5)
        axis.set_yticks(range(len(bars)), list(bars))
        axis.invert_yaxis()
        axis.set(xlabel="true return per episode, eight seeds [95 %]", xlim=(-550, 2050))
        axis.axvline(0, color=SOFT, lw=0.8)
        axis.set_title("Hopper, paid for leaning: learns from ...", loc="left", fontsize=11.5, weight="bold")
        save(figure, "robots.png")


def judges() -> None:
    """Draw gold against distance for the mean of judges and for ours, from published results."""
    from uard.lab.views import grpo

    p = grpo.published()
    rules = {r.row["rule"]: r.row for r in dict(grpo.conditions(p))["shared bias"]}
    shown = {"one model": ("one model", "raw"), "mean": ("mean of five", "mean"), "uard": ("uard, of five", "uard")}
    grid = np.linspace(0.0, 5.0, 41)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.2, 3.4), layout="constrained")
        axis = figure.subplots()
        for name, (label, colour) in (shown | {"true reward": ("true reward", "true")}).items():
            divergence, gold = p.derived(rules[name], "divergence"), p.derived(rules[name], "gold")
            runs = [[grpo.at_distance(d, g, x) for x in grid] for d, g in zip(divergence, gold, strict=True)]
            curves = np.array(runs)
            every = ~np.isnan(curves).any(0)  # where all seeds come so far
            mean, error = curves[:, every].mean(0), curves[:, every].std(0, ddof=1) / np.sqrt(len(curves))
            axis.plot(grid[every], mean, color=COLOURS[colour], lw=2.6 if name == "uard" else 1.8)
            reach = 2.365 * error  # Student's t of eight seeds
            axis.fill_between(grid[every], mean - reach, mean + reach, color=COLOURS[colour], alpha=0.13, lw=0)
            end = (grid[every][-1], mean[-1])
            how: Any = {"va": "center", "color": COLOURS[colour], "weight": "bold"}
            axis.annotate(label, end, (5, 0), textcoords="offset points", **how)
        axis.set(xlabel="KL from the start, nats per answer", ylabel="gold: what an answer is worth", xlim=(0, 4.4))
        axis.set_title("GRPO; two of five annotators like flattery", loc="left", fontsize=11.5, weight="bold")
        save(figure, "judges.png")


def shoot(page: Any, name: str) -> None:
    """Write what a browser shows."""
    small(io.BytesIO(page.screenshot()), name)


def people() -> None:
    """Record a Hopper, let two simulated raters rate it, and look at a third's page and at the owner's."""
    from playwright.sync_api import sync_playwright

    from uard.collect import Project
    from uard.collect.simulate import Simulation, law_by_reward
    from uard.ratings.panels import Panel, Rater

    with tempfile.TemporaryDirectory() as parent:
        folder = f"{parent}/hopper"
        run = [sys.executable, "-m", "uard", "collect"]
        subprocess.run([*run, "record", "Hopper-v5", folder, "--segments", "40"], check=True)
        project = Project.open(folder)
        serve = [*run, "serve", folder, "--port", "0", "--raters", "cyd"]
        page = subprocess.Popen(
            serve, stdout=subprocess.PIPE, text=True, env=os.environ | {"UARD_OWNER_PASSWORD": "pictures"}
        )
        told = dict(line.strip().split(": ", 1) for line in (next(page.stdout), next(page.stdout)))
        url = told["owner"].removesuffix("/owner")
        panel = Panel((Rater(noise=0.1), Rater(noise=0.3, bias=0.3)))
        with project.store() as store:
            links = {name: store.invite(name) for name in ("ann", "bob")}
        Simulation(url, links, project, law_by_reward(panel), idle=1.0, pause=0.05).run(threading.Event())
        with sync_playwright() as play:
            browser = play.chromium.launch(
                executable_path=os.environ.get("CHROMIUM", "/usr/bin/chromium"), args=["--no-sandbox"]
            )
            rater = browser.new_page(viewport={"width": 1000, "height": 740})
            rater.goto(told["cyd"])
            rater.get_by_role("button").first.click()
            rater.wait_for_url("**/rate")
            rater.get_by_role("button", name="Begin").or_(rater.get_by_role("button", name="Start")).first.click()
            for key in ("6", ".", ".", "."):
                rater.keyboard.press(key)
                rater.wait_for_timeout(200)
            shoot(rater, "people-rate.png")
            owner = browser.new_page(viewport={"width": 1200, "height": 1000})
            owner.goto(f"{url}/owner")
            owner.locator("input[type=password]").fill("pictures")
            owner.keyboard.press("Enter")
            owner.wait_for_load_state("networkidle")
            owner.wait_for_timeout(500)
            shoot(owner, "people-owner.png")
            browser.close()
        page.terminate()
        page.wait()


if __name__ == "__main__":
    known = {"walks": walks, "paper": paper, "regret": regret, "robots": robots, "judges": judges, "people": people}
    for name in sys.argv[1:] or known:
        known[name]()
