"""The present stage and what the parent makes of its segments."""

from __future__ import annotations

import hashlib
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from trilane.apps.video import contact_sheet, join_segments, run_checksum
from trilane.pipeline.description import UnitSettings
from trilane.scene.schema import OutputSpec, Scene
from trilane.stages.config import RunConfig
from trilane.stages.cpu.present import SEGMENTS, PresentStage
from trilane.stages.packets import pose_dtype
from trilane.transport.packets import Packet, SlotLayout, view_packet

WIDTH, HEIGHT, FPS = 96, 64, 30.0


def make_config(out_dir: Path, *, record: bool = True) -> RunConfig:
    return RunConfig(
        scene=Scene(output=OutputSpec(width=WIDTH, height=HEIGHT)),
        out_dir=out_dir,
        avatar_dirs=(),
        units={"cpu": UnitSettings(cores=(0,), threads=1)},
        record=record,
    )


def make_slot() -> Packet:
    layout = SlotLayout(pose_dtype(1), payload_bytes=WIDTH * HEIGHT * 3)
    return view_packet(memoryview(bytearray(layout.slot_bytes)), layout)


def grey_of(frame: int) -> int:
    return 40 + 5 * frame


def present(out_dir: Path, frames: range, *, close: bool = True) -> list[dict[str, float]]:
    """Present grey frames whose brightness tells their number."""
    stage, slot = PresentStage(make_config(out_dir)), make_slot()
    stage.bind([slot], [])
    figures = []
    for frame in frames:
        slot.payload[:] = grey_of(frame)
        figures.append(dict(stage.run(frame, 0, None)))
    if close:
        stage.close()
    return figures


def segments(out_dir: Path, ending: str = "mp4") -> list[Path]:
    return sorted((out_dir / SEGMENTS).glob(f"*.{ending}"))


def greys(video: Path) -> list[int]:
    with av.open(str(video)) as container:
        return [int(frame.to_ndarray(format="rgb24").mean()) for frame in container.decode(video=0)]


def test_every_frame_is_in_the_video_in_order(tmp_path: Path) -> None:
    figures = present(tmp_path, range(12))
    joined = join_segments(segments(tmp_path), tmp_path / "video.mp4", FPS)
    assert joined is not None
    assert (joined.frames, joined.seconds) == (12, pytest.approx(12 / 30))
    assert greys(tmp_path / "video.mp4") == pytest.approx([grey_of(k) for k in range(12)], abs=3)
    assert all(set(row) == {"digest_ms", "encode_ms"} for row in figures)


def test_segments_of_a_restarted_stage_are_joined_without_encoding_again(tmp_path: Path) -> None:
    present(tmp_path, range(5))
    present(tmp_path, range(7, 12))
    joined = join_segments(segments(tmp_path), tmp_path / "video.mp4", FPS)
    assert joined is not None
    assert joined.frames == 10
    assert joined.seconds == pytest.approx(12 / 30), "lost frames leave their time in the video"
    assert greys(tmp_path / "video.mp4")[-1] == pytest.approx(grey_of(11), abs=3)


def test_a_segment_that_was_cut_off_keeps_all_but_its_last_frame(tmp_path: Path) -> None:
    present(tmp_path, range(9))
    whole = segments(tmp_path)[0]
    whole.write_bytes(whole.read_bytes()[:-40])
    empty = tmp_path / "empty.mp4"
    empty.touch()
    joined = join_segments([empty, whole], tmp_path / "video.mp4", FPS)
    assert joined is not None
    assert joined.frames >= 8


def test_no_segment_gives_no_video(tmp_path: Path) -> None:
    assert join_segments([], tmp_path / "video.mp4", FPS) is None
    assert not (tmp_path / "video.mp4").exists()


def test_the_checksum_is_of_the_presented_bytes_whatever_the_segments(tmp_path: Path) -> None:
    present(tmp_path / "one", range(6))
    present(tmp_path / "two", range(3))
    present(tmp_path / "two", range(3, 6))
    present(tmp_path / "other", range(1, 7))
    sums = [run_checksum(segments(tmp_path / name, "sha256")) for name in ("one", "two", "other")]
    assert sums[0] == sums[1] != sums[2]
    line = segments(tmp_path / "one", "sha256")[0].read_text().splitlines()[2]
    assert line == f"2 {hashlib.sha256(bytes([grey_of(2)]) * (WIDTH * HEIGHT * 3)).hexdigest()}"
    assert run_checksum([]) is None


def test_the_contact_sheet_shows_first_and_last_frame(tmp_path: Path) -> None:
    present(tmp_path, range(40))
    join_segments(segments(tmp_path), tmp_path / "video.mp4", FPS)
    assert contact_sheet(tmp_path / "video.mp4", tmp_path / "contact.png", FPS) == 20
    with Image.open(tmp_path / "contact.png") as picture:
        sheet = np.asarray(picture)
    cell_height = 320 * HEIGHT // WIDTH
    assert sheet.shape == (5 * cell_height, 4 * 320, 3)
    assert sheet[cell_height - 3, 300].mean() == pytest.approx(grey_of(0), abs=3)
    assert sheet[-3, -3].mean() == pytest.approx(grey_of(39), abs=3)


def test_nothing_is_written_when_the_run_is_not_recorded(tmp_path: Path) -> None:
    stage, slot = PresentStage(make_config(tmp_path, record=False)), make_slot()
    stage.bind([slot], [])
    assert stage.run(0, 0, None) == {}
    stage.close()
    assert list(tmp_path.iterdir()) == []


def test_a_present_stage_has_an_input_and_no_output(tmp_path: Path) -> None:
    stage, slot = PresentStage(make_config(tmp_path, record=False)), make_slot()
    with pytest.raises(ValueError, match="no output"):
        stage.bind([slot], [slot])
    stage.bind([slot], [])
    with pytest.raises(ValueError, match="input slot"):
        stage.run(0, None, None)
