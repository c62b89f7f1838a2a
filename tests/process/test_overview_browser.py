"""The overview in a browser: it opens alone, sorts, filters, and lays two pictures over each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from trilane import machine
from trilane.apps.compare import pages as page_module
from trilane.apps.compare.overview import Entry, frontier

playwright = pytest.importorskip("playwright.sync_api")
pytestmark = pytest.mark.slow
CHROMIUM = next(filter(None, map(machine.here.program, ("chromium", "chromium-browser", "google-chrome"))), None)


def entries(video: Path) -> list[Entry]:
    speeds = {"slow and near": (90.0, 33.0), "quick": (9.0, 30.0), "beaten": (95.0, 29.0), "middle": (20.0, 31.0)}
    return [
        Entry(name, "host", "a machine", {"size": name}, frame_ms=ms, psnr_db=db, error_source="told", video=video)
        for name, (ms, db) in speeds.items()
    ]


@pytest.fixture
def written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    pictures = iter([b"\xff\xd8a", b"\xff\xd8b", b"\xff\xd8c", b"\xff\xd8d"])
    monkeypatch.setattr(page_module, "still", lambda _: next(pictures))
    file = tmp_path / "page.html"
    file.write_text(page_module.overview_page("Told", entries(file)), encoding="utf-8")
    return file


def names(page: Any) -> list[str]:
    cells = page.locator("table.entries tbody tr:not([hidden]) td:first-child")
    return [str(name) for name in cells.all_inner_texts()]


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: scripts/setup.sh all installs it")
def test_the_page_works_by_itself(written: Path) -> None:
    asked: list[str] = []
    said: list[str] = []
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 360, "height": 740})
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda message: said.append(message.text))
        page.goto(written.as_uri())
        assert names(page) == ["slow and near", "quick", "beaten", "middle"]
        marked = page.locator("table.entries tbody tr.on td:first-child").all_inner_texts()
        told = entries(written)
        assert marked == [entry.name for entry, on in zip(told, frontier(told), strict=True) if on]
        assert marked == ["slow and near", "quick", "middle"]
        page.get_by_role("button", name="frame, ms").click()
        assert names(page) == ["quick", "middle", "slow and near", "beaten"]
        page.get_by_role("button", name="frame, ms").click()
        assert names(page) == ["beaten", "slow and near", "middle", "quick"]
        page.get_by_label("frontier only").check()
        page.get_by_label("Filter").fill("a machine NEAR")
        assert names(page) == ["slow and near"]
        assert page.locator("#count").inner_text() == "1 of 4"
        right = page.locator(".pair img").nth(1)
        page.locator("#divide").fill("25")
        assert right.evaluate("image => image.style.clipPath") == "inset(0px 0px 0px 25%)"
        assert right.get_attribute("src").endswith("/9hi")
        assert page.evaluate("document.documentElement.scrollWidth") == 360
        browser.close()
    assert [url for url in asked if not url.startswith("data:")] == [written.as_uri()]
    assert [text for text in said if "Failed to load" not in text] == []
