"""A real browser, for the pages that are tested in it."""

from __future__ import annotations

import shutil

import pytest


@pytest.fixture(scope="session")
def browser():
    found = [p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p]
    if not found:
        pytest.skip("no browser: chromium, chromium-browser or google-chrome is not on the PATH")
    from playwright.sync_api import sync_playwright

    flags = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=found[0], args=flags)
        yield started
        started.close()
