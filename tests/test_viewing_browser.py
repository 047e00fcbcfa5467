"""The page of a run in a real browser: what it shows, and that it asks nobody else for anything."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import LONGEST_S

pytest.importorskip("viser")
pytest.importorskip("playwright")

from page_client import viewed
from playwright.sync_api import sync_playwright

from mixpose.pictures.overlay import BODY_COLOURS

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SESSION = Path(__file__).parents[1] / "data" / "synthetic" / "several_bodies" / "session.toml"
SIZE = (1400, 900)
OPTIONS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture
def page() -> Iterator[Any]:
    """A page of a browser, without the graphics card that tests may not have."""
    with sync_playwright() as engine:
        browser = engine.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.set_default_timeout(1e3 * LONGEST_S)
        yield page
        browser.close()


def coloured(page: Any, element: Any) -> list[int]:
    """How many pixels of an element have about the colour of each body."""
    box = element.bounding_box()
    picture = cv2.imdecode(np.frombuffer(page.screenshot(clip=box), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return [
        int((np.abs(picture.astype(int) - colour).max(axis=2) < 60).sum())
        for colour in BODY_COLOURS[:4]
    ]


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed")
def test_a_browser_shows_sensors_scene_and_plots_and_steps_the_run(page: Any) -> None:
    asked: list[str] = []
    wrong: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: wrong.append(str(error)))
    with viewed(SESSION, "--pause", "--stop", "4") as (process, address):
        page.goto(address)
        page.get_by_text("frame 0", exact=True).wait_for()
        page.get_by_role("button", name="Step").click()
        page.get_by_text("frame 1", exact=True).wait_for()
        assert process.poll() is None
        for words in (
            "tool",
            "reference",
            "rod-0",
            "rod-1",
            "bodies by status",
            "residual RMS, px",
        ):
            page.get_by_text(words, exact=True).first.wait_for()
        # the overlays: each camera's picture, as wide as it was drawn, has all four bodies
        pictures = page.locator("img[src^='blob:'], img[src^='data:image/jpeg']")
        page.wait_for_function(
            "[...document.images].filter(i => i.naturalWidth == 640).length == 2"
        )
        for k in range(2):
            assert min(coloured(page, pictures.nth(k))) >= 20
        # the scene: bodies have their colours there, too; lines of two pixels
        scene = page.locator("canvas[data-engine]").first
        assert any(min(coloured(page, scene)) >= 5 for _ in range(50))  # it may be some frames late
        # two plots with the frames so far
        frames = "Object.values(window.__viserTestpoints.uplots).map(p => [...p.chart.data[0]])"
        assert page.evaluate(frames) == [[0, 1], [0, 1]]
        page.get_by_role("button", name="Go on").click()
        page.get_by_text("frame 3", exact=True).wait_for()
        page.get_by_text("done, ").wait_for()
    assert wrong == []
    outside = {url for url in asked if not url.startswith((address, "data:", "blob:"))}
    assert outside == set()
