"""A run of a pipeline file under its dashboard, as the page meets it. One run for all of it, in order."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("starlette", reason="the extra dashboard is not installed")
pytest.importorskip("uvicorn", reason="the extra dashboard is not installed")
pytest.importorskip("prometheus_client", reason="the extra dashboard is not installed")
pytest.importorskip("websockets.sync.client", reason="the extra dashboard is not installed")

import numpy as np
from PIL import Image

from support.dashboard_client import PATIENCE_S, Page, Served, serving
from trilane.apps.run.report import read_report

pytestmark = pytest.mark.slow

FILE = """
[run]
fps = 20
[stages]
camera = { block = "video", unit = "reader", path = "pictures", size = "33x24" }
shown  = { block = "encode", unit = "writer", in = "camera", path = "out.mp4" }
"""


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Served, Path]]:
    """A run of two pictures in turn, without a number of frames."""
    folder = tmp_path_factory.mktemp("file")
    (folder / "pictures").mkdir()
    for number in range(2):
        Image.fromarray(np.full((24, 33, 3), 200 * number, np.uint8)).save(folder / f"pictures/{number}.png")
    (folder / "two.toml").write_text(FILE)
    command = [sys.executable, "-m", "trilane", "run", "two.toml", "--dashboard", "--json", "--out", "run"]
    with serving(command, folder) as served:
        yield served, folder


@pytest.fixture(scope="module")
def page(served: tuple[Served, Path]) -> Iterator[Page]:
    with served[0].connect(max_queue=None) as socket:
        page = Page(socket)
        page.until(lambda: page.presented > 5, "frames")
        yield page


def test_the_page_has_the_units_of_the_file_and_no_camera(page: Page) -> None:
    run = page.told["hello"]["run"]
    assert (run["scene"], run["units"], run["output"], run["fps"]) == ("two", ["reader", "writer"], [33, 24], 20)
    rows = {row["name"]: row for row in page.told["hello"]["controls"]}
    assert list(rows) == ["play", "pause", "step", "kill"]
    assert rows["kill"]["choices"] == ["reader", "writer"]
    assert page.told["state"]["config"]["policy"] == "pipelined"


def test_the_newest_picture_is_shown(page: Page) -> None:
    """The two pictures take turns, so both are seen."""
    seen: set[str] = set()

    def both() -> bool:
        seen.add(page.picture())
        return len(seen) == 2

    page.until(both, "the other picture")


def test_the_run_is_held_stepped_and_let_go(page: Page) -> None:
    page.control("pause")
    page.until(lambda: page.state == "paused", "the pause")
    held = page.settle()
    page.control("step")
    page.until(lambda: page.presented == held + 1, "one frame")
    assert page.settle() == held + 1
    page.control("play")
    page.until(lambda: page.presented > held + 5, "frames")


def test_a_unit_is_killed_and_comes_back(page: Page) -> None:
    page.control("kill", "writer")
    page.until(lambda: page.told["figures"]["units"]["writer"].get("restarts") == 1, "the restart")
    before = page.presented
    page.until(lambda: page.presented > before + 5, "frames after it")


def test_an_interrupt_ends_it_with_its_folder(served: tuple[Served, Path], page: Page) -> None:
    """All frames that were released are accounted for, though their number was not said."""
    server, folder = served
    server.parent.send_signal(signal.SIGINT)
    assert server.parent.wait(PATIENCE_S) == 130
    report = read_report(folder / "run")
    frames = report.frames
    assert frames.presented >= page.presented and frames.requested < 1_000_000
    assert frames.presented + frames.lost + frames.not_begun == frames.requested
    assert (folder / "out.mp4").stat().st_size > 0
