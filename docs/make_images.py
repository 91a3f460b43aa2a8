"""Draws the pictures that README and docs show, from real runs: ``python docs/make_images.py [walks people]``.

``people`` needs Playwright and a Chromium (``CHROMIUM`` names another one), and MuJoCo.
"""

import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

IMAGES = Path(__file__).parent / "images"


def walks() -> None:
    """Train seed 0 of the scale study and draw the walks."""
    from uard.lab import studies
    from uard.lab.execution import runner
    from uard.lab.execution.store import Store
    from uard.lab.views.study_results import StudyResults
    from uard.replication import figures

    (study,) = studies.find(("scale",))
    store = Store(":memory:")
    runner.run(study.jobs([0]), store, workers=1)
    figure = figures.walks(StudyResults(store, [0], [study]))
    figure.savefig(IMAGES / "walks.png", dpi=80, bbox_inches="tight")


def people() -> None:
    """Record a Hopper, let a simulated panel rate it, and look at the rater's and the owner's page."""
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
        panel = Panel((Rater(noise=0.1), Rater(noise=0.2, bias=0.3), Rater(noise=0.4)))
        with project.store() as store:
            links = {name: store.invite(name) for name in ("ann", "bob", "dan")}
        Simulation(url, links, project, law_by_reward(panel), idle=1.0, pause=0.05).run(threading.Event())
        with sync_playwright() as play:
            browser = play.chromium.launch(
                executable_path=os.environ.get("CHROMIUM", "/usr/bin/chromium"), args=["--no-sandbox"]
            )
            rater = browser.new_page(viewport={"width": 1000, "height": 860})
            rater.goto(told["cyd"])
            rater.get_by_role("button").first.click()
            rater.wait_for_url("**/rate")
            rater.get_by_role("button", name="Begin").or_(rater.get_by_role("button", name="Start")).first.click()
            for key in ("6", ".", ".", "."):
                rater.keyboard.press(key)
                rater.wait_for_timeout(200)
            rater.screenshot(path=IMAGES / "people-rate.png")
            owner = browser.new_page(viewport={"width": 1200, "height": 1000})
            owner.goto(f"{url}/owner")
            owner.locator("input[type=password]").fill("pictures")
            owner.keyboard.press("Enter")
            owner.wait_for_load_state("networkidle")
            owner.wait_for_timeout(500)
            owner.screenshot(path=IMAGES / "people-owner.png")
            browser.close()
        page.terminate()
        page.wait()


if __name__ == "__main__":
    known = {"walks": walks, "people": people}
    for name in sys.argv[1:] or known:
        known[name]()
