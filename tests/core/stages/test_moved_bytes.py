"""Bytes moved: counted by the stages of CPU and DSP, and their means in the report, all by hand."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane import machine
from trilane.body.body import ShapedBody
from trilane.body.skinning import FrameSkinner
from trilane.machine import Machine, last_level_bytes, moved_of_kept
from trilane.pipeline.memory import BYTES, ByteCounter, add_bytes
from trilane.pipeline.run_metrics import MovedInAll
from trilane.stages.cpu.present import Segment
from trilane.stages.dsp.infer import BoundPart

KEYS = ("read", "written", "uploaded", "read_back", "least")


def said(*figures: float) -> dict[str, float]:
    """As a stage reports them."""
    return {f"bytes_{key}": value for key, value in zip(KEYS, figures, strict=True)}


def report(presented: int = 4, **jobs: int) -> dict[str, Any]:
    stages = {name: {"jobs": count} for name, count in jobs.items()}
    return {"frames": {"presented": presented}, "duration_s": 2.0, "stages": stages}


def test_a_counter_begins_every_frame_with_the_header() -> None:
    counter = ByteCounter()
    counter.copied(7)
    counter.uploaded, counter.read_back, counter.least = 1, 2, 3
    assert counter.figures() == said(7, 7, 1, 2, 3)
    counter.start(5)
    assert counter.figures() == said(5, 5, 0, 0, 0) and counter.figures().keys() == BYTES
    counter.start()
    assert counter.figures() == said(0, 0, 0, 0, 0)


def test_a_mean_is_of_presented_frames() -> None:
    """Two of four frames skipped b, all skipped c; d does not count."""
    made = report(a=4, b=2, c=0, d=4)
    add_bytes(made, {"a": said(40, 20, 0, 0, 30) | {"x": 1.0}, "b": said(0, 8, 16, 24, 16), "d": {"x": 9.0}})
    rows = {name: row.get("bytes") for name, row in made["stages"].items()}
    assert rows["a"] == {"read": 10, "written": 5, "uploaded": 0, "read_back": 0, "least": 7.5, "ratio": 2}
    assert rows["b"] == {"read": 0, "written": 2, "uploaded": 4, "read_back": 6, "least": 4, "ratio": 3}
    assert rows["c"] == {"read": 0, "written": 0, "uploaded": 0, "read_back": 0, "least": 0, "ratio": None}
    assert rows["d"] is None
    total = {"read": 10, "written": 7, "uploaded": 4, "read_back": 6, "least": 11.5, "ratio": 108 / 46}
    assert made["bytes"] == total | {"gb_per_second": 54e-9}
    assert MovedInAll.model_validate(made["bytes"]).all == 27


@pytest.mark.parametrize(("presented", "sums"), [(0, {"a": said(1, 1, 1, 1, 1)}), (4, {"a": {"bytes_read": 1.0}})])
def test_without_frames_or_counts_nothing_is_said(presented: int, sums: Any) -> None:
    made = report(presented, a=1, b=0)
    add_bytes(made, sums)
    assert "bytes" not in made and not any("bytes" in row for row in made["stages"].values())


def caches(folder: Path, *sizes: tuple[int, int, str]) -> None:
    """The kernel's files: core, level and size of each cache."""
    for number, (core, level, size) in enumerate(sizes):
        index = folder / f"cpu{core}" / "cache" / f"index{number}"
        index.mkdir(parents=True)
        (index / "level").write_text(f"{level}\n")
        (index / "size").write_text(f"{size}\n")


def test_the_last_level_decides_what_comes_from_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "here", Machine(tmp_path))
    cores = tmp_path / "sys/devices/system/cpu"
    caches(cores, (0, 1, "48K"), (0, 3, "2M"), (0, 2, "512K"), (1, 2, "4096K"), (2, 2, "junk"), (3, 1, "100"))
    assert [last_level_bytes([core]) for core in (0, 1, 2, 3, 9)] == [2 << 20, 4 << 20, 0, 100, 0]
    assert (last_level_bytes([0, 1]), last_level_bytes([])) == (4 << 20, 0)
    monkeypatch.setattr(machine.here, "cores", lambda: (0,))
    assert (moved_of_kept(2 << 20), moved_of_kept((2 << 20) + 1)) == (0, (2 << 20) + 1)


def test_a_new_frame_is_read_by_digest_and_encoder_and_a_repeated_one_by_neither(tmp_path: Path) -> None:
    """48 x 32 pixels are 4608 bytes; what is written is in the files."""
    path = tmp_path / "a.mp4"
    segment = Segment(path, 30.0, 32, 48)
    pixels = np.full((32, 48, 3), 90, np.uint8)
    seen = []
    for frame, repeats in ((0, False), (1, True)):
        segment.moved.start()
        segment.digest(frame, pixels, repeats)
        segment.add(frame, pixels, repeats)
        seen.append(segment.moved.figures())
    segment.close()
    line = len("0 ") + 64 + 1
    encoded = [figures["bytes_written"] - line for figures in seen]
    assert seen == [
        said(9216, line + encoded[0], 0, 0, 4608 + encoded[0]),
        said(0, line + encoded[1], 0, 0, encoded[1]),
    ]
    assert path.with_suffix(".sha256").stat().st_size == 2 * line
    assert 0 < sum(encoded) < path.stat().st_size


def test_what_skinning_keeps_is_all_that_it_reads_again(shaped: ShapedBody) -> None:
    """Rest positions of a block of 256 vertices, the weights and numbers of its joints, 90 vertices' blend shapes."""
    used = int((shaped.body.weights > 0).any(axis=0).sum())
    assert shaped.body.posedirs is not None and shaped.body.posedirs.dtype == np.float32
    assert FrameSkinner(shaped).constant_bytes == 256 * 12 + used * 256 * 4 + used * 8 + 90 * 3 * 486 * 4


def test_a_part_of_the_network_counts_its_tensors_weights_and_what_it_hands_on() -> None:
    """A tensor that only a later part needs is copied, which the least does not hold."""
    given, passed = np.zeros(12, np.uint8), np.arange(5, dtype=np.uint8)
    ran: list[int] = []
    binding, counter = SimpleNamespace(run=lambda: ran.append(1)), ByteCounter()
    bound = BoundPart(binding, [(passed, given[:5])], in_bytes=100, out_bytes=30)
    bound.run(counter)
    assert counter.figures() == said(105, 35, 0, 0, 130)
    assert ran == [1] and given[:5].tolist() == [0, 1, 2, 3, 4]
