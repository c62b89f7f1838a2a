"""What the server of live runs tells the pages while runs end, begin and move their folders, at the worst moments."""

from __future__ import annotations

import asyncio
import contextlib
import io
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("prometheus_client", reason="the extra dashboard is not installed")

from trilane.apps.dashboard import live_server
from trilane.apps.dashboard.app import DashboardApp
from trilane.apps.dashboard.channel import RunBegins, StateIs
from trilane.apps.dashboard.live_server import RECORDS_AT_ONCE, LiveView
from trilane.apps.dashboard.run_facts import RunFacts
from trilane.apps.dashboard.view import Client
from trilane.pipeline.journal import NAME, JournalWriter, journal_of
from trilane.scheduler.events import Settings, chain
from trilane.scheduler.virtual import simulate
from trilane.transport.live_window import LiveWindow, create_window

GRAPH = chain([("pose", "cpu"), ("raster", "gpu")], "double", "raster")


@pytest.fixture
def window() -> LiveWindow:
    fd = create_window(8, 8)
    window = LiveWindow(fd, 8, 8)
    os.close(fd)
    return window


@pytest.fixture
def view(window: LiveWindow) -> LiveView:
    return LiveView(window, lambda _asked: True)


def begin(folder: Path, frames: int = 3) -> RunBegins:
    """Write the journal of a run of that many frames into `folder`; returns what its process says of it."""
    folder.mkdir()
    run = simulate(GRAPH, Settings(frames), lambda *_: 1_000_000, keep=True)
    assert run.recording is not None
    with JournalWriter(folder / NAME) as writer:
        for record in journal_of(run.recording, run.jobs, {"clock": "virtual"}, run.report):
            writer.add(record)
    facts = RunFacts(folder.name, "default", "virtual", "", 30.0, (8, 8), {}, {}, None, {})
    return RunBegins(str(folder), asdict(facts), [])


def names(messages: Any) -> list[str]:
    """The names of the runs that begin in these messages."""
    return [message["run"]["name"] for message in messages if message["type"] == "hello"]


def test_a_run_that_begins_while_the_last_ones_journal_is_read_is_shown(
    view: LiveView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_server, "READ_S", 60.0)  # on a busy machine, the first records may take longer than 50 ms

    async def watched() -> list[list[str]]:
        view.hear(begin(tmp_path / "first.1.partial", frames=RECORDS_AT_ONCE))
        await view.news(is_watched=True)  # has found the journal, reads nothing yet
        reading = asyncio.create_task(view.news(is_watched=True))
        await asyncio.sleep(0)  # `reading` has read the first records, and let others go first
        assert not reading.done()
        view.hear(StateIs("restarting", ""))
        view.hear(begin(tmp_path / "second.1.partial"))
        return [names(await reading), *[names(await view.news(is_watched=True)) for _ in range(2)]]

    assert asyncio.run(watched()) == [["first.1.partial"], [], ["second.1.partial"]]


def test_a_run_that_was_over_before_anybody_looked_is_shown(view: LiveView, tmp_path: Path) -> None:
    async def watched() -> list[str]:
        view.hear(begin(tmp_path / "short.1.partial"))
        (tmp_path / "short.1.partial").rename(tmp_path / "short")
        return names([message for _ in range(2) for message in await view.news(is_watched=True)])

    assert asyncio.run(watched()) == ["short.1.partial"]


def test_a_frame_of_a_new_run_is_not_the_old_runs_picture(view: LiveView, window: LiveWindow) -> None:
    def shade(of: int, sampled_ns: int) -> float:
        window.show(0, 0.0, sampled_ns, np.full((8, 8, 3), of, np.uint8))
        view._picture_s = 0.0
        data = asyncio.run(view.picture(Client(None, lambda: None)))  # type: ignore[arg-type]
        assert data is not None
        return float(np.asarray(Image.open(io.BytesIO(data[21:]))).mean())

    assert shade(40, 1) == pytest.approx(40, abs=1)
    assert shade(200, 2) == pytest.approx(200, abs=1)


def test_a_server_that_cannot_tell_the_news_ends_and_says_why(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, view: LiveView
) -> None:
    async def unreadable(**_: object) -> list[Any]:
        raise OSError("the disk is gone")

    async def served() -> None:
        stopped = asyncio.Event()
        monkeypatch.setattr(view, "news", unreadable)
        app = DashboardApp(view, 1, "token")
        app.stop = stopped.set
        inbox: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        await inbox.put({"type": "lifespan.startup"})
        sent: asyncio.Queue[Any] = asyncio.Queue()
        life = asyncio.create_task(app.asgi({"type": "lifespan", "asgi": {"version": "3.0"}}, inbox.get, sent.put))
        await asyncio.wait_for(stopped.wait(), 30)
        life.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await life

    asyncio.run(served())
    assert "OSError: the disk is gone" in capsys.readouterr().err
