"""The present stage and what the parent makes of its segments."""

from __future__ import annotations

import errno
import hashlib
import shutil
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from support.small_pipeline import without_bytes
from trilane.apps.run import run_files
from trilane.apps.run.run_files import contact_sheet, join_folder, join_segments, run_checksum
from trilane.errors import UnwrittenError
from trilane.pipeline.description import UnitSettings
from trilane.scene.schema import OutputSpec, Scene
from trilane.stages.config import RunConfig, pose_dtype
from trilane.stages.cpu.present import SEGMENTS, PresentStage, full_disk_told
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
    assert all(set(without_bytes(row)) == {"digest_ms", "encode_ms"} for row in figures)


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


@pytest.mark.parametrize("removed", ["folder", "digests"])
def test_a_segment_that_is_removed_is_told_at_the_next_frame(tmp_path: Path, removed: str) -> None:
    stage, slot = PresentStage(make_config(tmp_path)), make_slot()
    stage.bind([slot], [])
    stage.run(0, 0, None)
    (segment,) = segments(tmp_path)
    shutil.rmtree(segment.parent) if removed == "folder" else segment.with_suffix(".sha256").unlink()
    with pytest.raises(UnwrittenError) as raised:
        stage.run(1, 0, None)
    assert str(raised.value) == f"{segment}: it was removed while it was written"
    stage.close()


def test_a_segment_whose_folder_is_removed_while_its_files_are_made_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage, opened = PresentStage(make_config(tmp_path)), av.open

    def open_and_remove(file: str, *words: Any, **options: Any) -> Any:
        container = opened(file, *words, **options)
        shutil.rmtree(tmp_path / SEGMENTS)
        return container

    monkeypatch.setattr(av, "open", open_and_remove)
    with pytest.raises(UnwrittenError, match=r"\.mp4: it was removed while it was written$"):
        stage.bind([make_slot()], [])


@pytest.mark.parametrize(
    ("removed", "shown", "is_told"),
    [
        ("", 12, False),
        ("*", 0, True),
        ("1.*", 5, True),
        ("1.mp4", 5, True),
        ("1.sha256", 5, True),
    ],
)
def test_segments_that_are_removed_after_the_last_frame_are_told(
    tmp_path: Path, removed: str, shown: int, is_told: bool
) -> None:
    """Of two processes, the second with seven frames; the first has five."""
    present(tmp_path, range(5))
    present(tmp_path, range(5, 12))
    for number, path in enumerate(segments(tmp_path)):
        for file in (path, path.with_suffix(".sha256")):
            file.rename(file.with_name(f"{number}{file.suffix}"))
    for file in list((tmp_path / SEGMENTS).glob(removed)) if removed else ():
        file.unlink()
    joined, error = join_folder(tmp_path / SEGMENTS, tmp_path / "video.mp4", FPS, 12)
    assert (joined.frames if joined else 0) == shown
    assert (str(error) if error else "") == (
        f"{tmp_path / SEGMENTS}: files were removed from it during the run" if is_told else ""
    )


def test_a_killed_writer_and_one_that_had_no_frame_removed_nothing(tmp_path: Path) -> None:
    """The first has a digest of a frame that is not in its segment; the second died before its first picture."""
    present(tmp_path, range(9))
    whole = segments(tmp_path)[0]
    with whole.with_suffix(".sha256").open("a") as digests:
        digests.write("9 aa\n")
    (whole.parent / "z.sha256").write_text("10 bb\n")
    joined, error = join_folder(tmp_path / SEGMENTS, tmp_path / "video.mp4", FPS, 9)
    assert joined is not None and (joined.frames, error) == (9, None)
    assert join_folder(tmp_path / "none", tmp_path / "other.mp4", FPS, 0) == (None, None)


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "x"), av.error.err_check])
def test_a_full_disk_is_told_with_its_file(error: Any) -> None:
    """As the system says it, and as FFmpeg does; another error stays itself."""
    with pytest.raises(UnwrittenError) as raised, full_disk_told(Path("/a/b")):
        if isinstance(error, OSError):
            raise error
        error(-errno.ENOSPC)
    assert str(raised.value) == "/a/b: no space left on device; free space there or choose another --out"
    with pytest.raises(FileNotFoundError), full_disk_told(Path("/a/b")):
        raise FileNotFoundError(errno.ENOENT, "x")


def test_a_disk_that_is_full_at_the_start_is_told_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        av.error.err_check(-errno.ENOSPC)

    monkeypatch.setattr(av, "open", full)
    with pytest.raises(UnwrittenError, match=r"\.mp4: no space left on device; free space there"):
        PresentStage(make_config(tmp_path)).bind([make_slot()], [])


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


def sheet_of(tmp_path: Path, frames: range, fps: float = FPS) -> tuple[int, np.ndarray]:
    """How many frames a sheet of these has, and the grey of each of its places, read at the lower right."""
    present(tmp_path, frames)
    join_segments(segments(tmp_path), tmp_path / "video.mp4", fps)
    count = contact_sheet(tmp_path / "video.mp4", tmp_path / "contact.png", fps)
    with Image.open(tmp_path / "contact.png") as picture:
        sheet = np.asarray(picture)
    high = 320 * HEIGHT // WIDTH
    assert sheet.shape[1] % 320 == 0 and sheet.shape[0] % high == 0
    return count, sheet[high - 3 :: high, 317::320].mean(axis=2)


@pytest.mark.parametrize(
    ("frames", "count", "shape"), [(1, 1, (1, 1)), (3, 3, (1, 3)), (6, 6, (2, 4)), (20, 20, (5, 4)), (39, 20, (5, 4))]
)
def test_a_sheet_has_as_many_rows_as_it_needs(tmp_path: Path, frames: int, count: int, shape: tuple[int, int]) -> None:
    """Of 39 frames every second one; places without a frame are black."""
    found, greys_of = sheet_of(tmp_path, range(frames))
    shown = [grey_of(round(k * (frames - 1) / max(1, count - 1))) for k in range(count)]
    assert (found, greys_of.shape) == (count, shape)
    assert greys_of.ravel() == pytest.approx([*shown, *[0] * (shape[0] * shape[1] - count)], abs=4)


@pytest.mark.parametrize("decode", ["_decode_all", "_decode_each"])
def test_both_ways_to_decode_give_the_frames_that_are_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, decode: str
) -> None:
    """Seeking to each is used where more than 30 frames lie between them: here it is said to be fewer or more."""
    used = []
    chosen = getattr(run_files, decode)
    monkeypatch.setattr(run_files, decode, lambda *given: used.append(len(given[1])) or chosen(*given))
    monkeypatch.setattr(run_files, "KEYFRAME_EVERY", 2 if decode == "_decode_all" else 1.9)
    _, greys_of = sheet_of(tmp_path, range(40))
    assert used == [20]
    assert greys_of.ravel() == pytest.approx([grey_of(round(k * 39 / 19)) for k in range(20)], abs=4)


def test_labels_are_at_the_upper_left_of_their_pictures(tmp_path: Path) -> None:
    """White with black round it on grey: the darkest and the brightest of each place are in its upper left corner."""
    present(tmp_path, range(10, 15))
    join_segments(segments(tmp_path), tmp_path / "video.mp4", FPS)
    contact_sheet(tmp_path / "video.mp4", tmp_path / "contact.png", FPS)
    with Image.open(tmp_path / "contact.png") as picture:
        grey = np.asarray(picture.convert("L")).astype(int)
    high = 320 * HEIGHT // WIDTH
    for row, column in ((0, 0), (0, 3), (1, 0)):
        place = grey[row * high : (row + 1) * high, column * 320 : (column + 1) * 320]
        label = np.s_[2:24, 4:80]
        assert place[label].max() == 255 and place[label].min() == 0
        place = place.copy()
        place[label] = grey_of(10)
        assert place.min() > 80 and place.max() < 130


def test_a_frame_that_comes_too_soon_is_shown_after_the_one_before(tmp_path: Path) -> None:
    """A second segment that begins with an earlier number goes on where the first one ended."""
    present(tmp_path, range(4, 6))
    present(tmp_path, range(1, 3))
    joined = join_segments(segments(tmp_path), tmp_path / "video.mp4", FPS)
    assert joined is not None and (joined.frames, joined.seconds) == (4, pytest.approx(8 / 30))
    with av.open(str(tmp_path / "video.mp4")) as container:
        stream = container.streams.video[0]
        packets = [packet for packet in container.demux(stream) if packet.size]
        times = [float(packet.pts * stream.time_base * 30) for packet in packets]
        assert times == pytest.approx([4, 5, 6, 7], abs=0.02)
        lengths = [float(packet.duration * stream.time_base * 30) for packet in packets]
        assert lengths == pytest.approx([1, 1, 1, 1], abs=0.02)
    text = (tmp_path / "video.mp4").read_bytes()
    assert text.index(b"moov") < text.index(b"mdat")  # can be shown while it is still loaded


def test_what_a_digest_file_says(tmp_path: Path) -> None:
    """Lines in the order of their frames, whichever file they are in; a last line without an end is none."""
    (tmp_path / "a.sha256").write_text("10 aa\n2 bb\n11 c")
    (tmp_path / "b.sha256").write_text("1 dd\n")
    files = [tmp_path / "a.sha256", tmp_path / "b.sha256"]
    assert run_checksum(files) == hashlib.sha256(b"1 dd\n2 bb\n10 aa\n").hexdigest()
    (tmp_path / "b.sha256").write_text("1 d")
    assert run_checksum(files[1:]) is None
