"""A finished run, at any of its moments: a run in virtual time whose every slice is known, with a video beside it."""

from __future__ import annotations

import asyncio
import io
import json
import struct
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

pytest.importorskip("prometheus_client", reason="the extra dashboard is not installed")

from support.run_report import make_report
from trilane.apps.dashboard.finished_view import (
    CUT_OFF,
    MOST_JOBS,
    NO_VIDEO,
    PIECE_ROWS,
    FinishedView,
    TimeTable,
    _RunPictures,
)
from trilane.apps.dashboard.run_facts import facts_of_report
from trilane.apps.dashboard.view import Client, ControlSaid, Seek
from trilane.apps.run.report import Report
from trilane.errors import BadInputError
from trilane.pipeline.journal import NAME, Ended, JournalWriter, journal_of
from trilane.scheduler.events import Settings, chain
from trilane.scheduler.virtual import simulate
from trilane.stages.cpu.present import Segment

MS = 1_000_000
FRAMES, FPS = 40, 30.0
#: With these times infer bounds: frame n is inferred from 10 + 20 n to 30 + 20 n and presented from there for 5 ms.
TIMES = {"pose": 4 * MS, "raster": 6 * MS, "infer": 20 * MS, "present": 5 * MS}
GRAPH = chain([("pose", "cpu"), ("raster", "gpu"), ("infer", "dsp"), ("present", "out")], "double", "infer")


def grey(frame: int) -> int:
    return 40 + 4 * frame


@pytest.fixture(scope="module")
def view(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FinishedView]:
    folder = tmp_path_factory.mktemp("runs") / "walk"
    folder.mkdir()
    run = simulate(GRAPH, Settings(FRAMES), lambda stage, *_: TIMES[stage], keep=True)
    assert run.recording is not None
    with JournalWriter(folder / NAME) as writer:
        for record in journal_of(run.recording, run.jobs, {"clock": "virtual"}, run.report):
            writer.add(record)
    segment = Segment(folder / "video.mp4", FPS, 64, 64)
    for frame in range(FRAMES):
        segment.add(frame, np.full((64, 64, 3), grey(frame), np.uint8))
    segment.close()
    view = FinishedView(folder)
    yield view
    view.close()


def seek(view: FinishedView, client: Client, t_ms: float, span_ms: float) -> dict[str, Any]:
    messages = asyncio.run(view.seek(client, Seek(type="seek", t_ms=t_ms, span_ms=span_ms)))
    return {message["type"]: message for message in messages}


def picture(view: FinishedView, client: Client) -> tuple[int, float, int] | None:
    """Frame, time in the scene and grey of the picture."""
    data = asyncio.run(view.picture(client))
    if data is None:
        return None
    kind, frame, media_ms, _ = struct.unpack("<BIdd", data[:21])
    assert kind == 2
    return frame, media_ms, round(float(np.asarray(Image.open(io.BytesIO(data[21:]))).mean()))


def test_it_says_what_it_is(view: FinishedView) -> None:
    hello, state, *_ = view.greeting()
    assert (hello["is_live"], hello["controls"], hello["run"]["name"]) == (False, [], "walk")
    assert hello["run"]["stages"][2] == {"name": "infer", "unit": "dsp"}
    assert hello["run"]["units"] == ["cpu", "gpu", "dsp", "out"]
    assert hello["span_ms"] == [0.0, 10.0 + 20 * FRAMES + 5.0]
    assert state["is"] == "ended"
    assert json.dumps(list(view.greeting()))


def test_what_bounded_it_is_that_of_its_report(view: FinishedView) -> None:
    """Without a report, as of a run that was killed, nothing is said of it."""
    assert [*view.greeting()][1]["bound"] is None
    document = make_report(notes=[])
    document["config"]["edge"] = "double"
    document["config"]["scene"] |= {"fps": 30.0, "avatars": [{"bundle": "someone"}]}
    said = facts_of_report("n", Report.model_validate(document)).state("ended")["bound"]
    assert said == {
        key: document[key] for key in ("bottleneck", "bound", "efficiency", "core_efficiency", "machine_efficiency")
    }


def test_a_moment_has_the_slices_that_are_known(view: FinishedView) -> None:
    told = seek(view, Client(None, lambda: None), 400.0, 30.0)  # type: ignore[arg-type]
    infers = [(job[2], job[3], job[4]) for job in told["slices"]["jobs"] if job[:2] == (2, 2)]
    assert infers == [(n, 10.0 + 20 * n, 30.0 + 20 * n) for n in range(17, 22)]  # those that touch 370 to 430 ms
    presents = [(job[2], job[3], job[4]) for job in told["slices"]["jobs"] if job[1] == 3]
    assert presents[0] == (17, 370.0, 375.0)
    rows = [job[3:5] for job in told["slices"]["jobs"] if job[0] == 1]
    rows += [piece[2:4] for piece in told["slices"]["idle"] if piece[0] == 1]
    gpu = sorted(tuple(row) for row in rows)
    assert gpu[0][0] <= 370.0 and gpu[-1][1] >= 430.0
    assert all(before[1] == after[0] for before, after in pairwise(gpu))  # jobs and idle time without a gap
    assert told["figures"]["t_ms"] <= 400.0


def test_the_picture_is_of_the_frame_that_was_presented_last(view: FinishedView) -> None:
    client = Client(None, lambda: None)  # type: ignore[arg-type]
    last = picture(view, client)
    assert last is not None and last[0] == FRAMES - 1
    assert picture(view, client) is None  # it has it
    for t_ms, frame in ((375.0, 17), (374.9, 16), (400.0, 18), (35.0, 0), (1e9, FRAMES - 1)):
        seek(view, client, t_ms, 1.0)
        client.had_frame = -1
        shown = picture(view, client)
        assert shown is not None
        assert shown[:2] == (frame, pytest.approx(1000 * frame / FPS))
        assert abs(shown[2] - grey(frame)) <= 1  # the codec's and JPEG's rounding; frames are 4 apart
    seek(view, client, 34.0, 1.0)
    assert picture(view, client) is None  # none was presented yet


def test_nothing_of_it_can_be_changed(view: FinishedView) -> None:
    assert view.control(ControlSaid(type="control", name="pause")) == "the run is over"
    assert "trilane_" in view.metrics()


@pytest.mark.parametrize("video", [None, b"no video"], ids=["missing", "damaged"])
def test_a_run_that_is_not_whole_says_so(tmp_path: Path, view: FinishedView, video: bytes | None) -> None:
    run = simulate(GRAPH, Settings(3), lambda stage, *_: TIMES[stage], keep=True)
    assert run.recording is not None
    with JournalWriter(tmp_path / NAME) as writer:
        for record in journal_of(run.recording, run.jobs, {"clock": "virtual"}, run.report):
            if not isinstance(record, Ended):
                writer.add(record)
    if video is not None:
        (tmp_path / "video.mp4").write_bytes(video)
    cut = FinishedView(tmp_path)
    said = [(message["t_ms"], message["text"]) for message in cut.greeting() if message["type"] == "note"]
    cut.close()
    assert said == [(75.0, CUT_OFF), (0.0, NO_VIDEO)]
    assert not [message for message in view.greeting() if message["type"] == "note"]


def test_a_folder_without_a_journal_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=NAME):
        FinishedView(tmp_path)


def test_rows_of_a_time_are_found_among_many() -> None:
    table = TimeTable(np.dtype([("number", "<u4"), ("begin", "<f8"), ("end", "<f8")]))
    count = 3 * PIECE_ROWS + 17
    for number in range(count):
        table.add((number, float(number), number + 0.5))
    table.complete()
    assert table.near(5000.0, 2.0, 100)["number"].tolist() == [4998, 4999, 5000, 5001, 5002]
    assert table.near(5000.2, 1e9, 3)["number"].tolist() == [4999, 5000, 5001]
    assert len(table.near(0.0, 1e9, 10 * count)) == count
    assert len(table.near(-10.0, 2.0, 5)) == 0
    last, early = table.last_before(8191.5), table.last_before(0.4)
    assert last is not None and int(last["number"]) == 8191 and early is None
    table.close()
    assert MOST_JOBS > PIECE_ROWS


def test_a_damaged_or_silent_video_has_no_pictures(tmp_path: Path) -> None:
    segment = Segment(tmp_path / "whole.mp4", FPS, 64, 64)
    noise = np.random.default_rng(1)
    for frame in range(FRAMES):
        segment.add(frame, noise.integers(0, 255, (64, 64, 3), np.uint8))
    segment.close()
    content = (tmp_path / "whole.mp4").read_bytes()
    (tmp_path / "damaged.mp4").write_bytes(content[: len(content) // 2])
    damaged = _RunPictures(tmp_path / "damaged.mp4", FPS)
    assert damaged.jpeg(0) is not None
    assert damaged.jpeg(FRAMES - 1) is None
    damaged.close()
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=48000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        sound.rate = 48000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    assert _RunPictures(tmp_path / "sound.mp4", FPS).is_missing
