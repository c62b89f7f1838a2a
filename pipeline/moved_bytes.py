"""Counts the bytes that a stage moves for a frame, where the stage copies them, beside the least that would do.

Rule: a byte counts at each memory that it is read from or written to. A copy from a slot to the GPU counts as read and
as uploaded; a copy back counts as read back and as written. So the four figures add up to what passed through the
memories. A stage that copies nothing between its input and its output moves its least.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

#: Keys in report.json, with the name under which a stage reports each with a job.
NAMES = {
    "read": "bytes_read",
    "written": "bytes_written",
    "uploaded": "bytes_uploaded",
    "read_back": "bytes_read_back",
    "least": "bytes_least",
}
BYTES = frozenset(NAMES.values())
LEAST = "least"


@dataclass(slots=True)
class ByteCounter:
    """The bytes that a stage moves for one frame.

    `read`: bytes read from slots, shared assets and what the stage samples.
    `written`: bytes written into the output slot or the file.
    `uploaded`: bytes moved from the CPU's memory into the GPU's.
    `read_back`: bytes moved from the GPU's memory into the CPU's.
    `least`: bytes that the frame needs: the part of the input that it depends on, read once, and the output, written
    once.
    """

    read: int = 0
    written: int = 0
    uploaded: int = 0
    read_back: int = 0
    least: int = 0

    def start(self, passed_on: int = 0) -> None:
        """Begin a frame. `passed_on`: bytes of the header, copied from the input slot to the output slot."""
        self.read = self.written = passed_on
        self.uploaded = self.read_back = self.least = 0

    def copied(self, count: int) -> None:
        """Count `count` bytes that were read in one slot and written to another."""
        self.read += count
        self.written += count

    def figures(self) -> dict[str, float]:
        """Return what the stage reports of its job."""
        return {
            "bytes_read": self.read,
            "bytes_written": self.written,
            "bytes_uploaded": self.uploaded,
            "bytes_read_back": self.read_back,
            "bytes_least": self.least,
        }


def add_bytes(report: dict[str, Any], sums: Mapping[str, Mapping[str, float]]) -> None:
    """Add what each stage moved for a presented frame, and the total, to `report`, the keys of report.json.

    `sums`: sums of what the jobs of each stage reported. A stage without a job moved nothing; a stage that does not
    count has no row. Nothing is added where no frame was presented or no stage counts.
    """
    frames = report["frames"]["presented"]
    counted = {stage: row for stage, row in sums.items() if row.keys() >= BYTES}
    if not frames or not counted:
        return
    nothing = dict.fromkeys(BYTES, 0.0)
    for stage, row in report["stages"].items():
        if stage in counted or not row["jobs"]:
            row["bytes"] = _per_frame(counted.get(stage, nothing), frames)
    total = {name: sum(row[name] for row in counted.values()) for name in BYTES}
    seconds = report["duration_s"]
    report["bytes"] = {**_per_frame(total, frames), "gb_per_second": _moved(total) / 1e9 / seconds if seconds else None}


def _per_frame(sums: Mapping[str, float], frames: int) -> dict[str, float | None]:
    """Return the means per frame, and `ratio`, all that was moved over the least; null where the least is 0."""
    least = sums[NAMES[LEAST]]
    means = {key: sums[name] / frames for key, name in NAMES.items()}
    return {**means, "ratio": _moved(sums) / least if least else None}


def _moved(sums: Mapping[str, float]) -> float:
    return sum(sums[name] for key, name in NAMES.items() if key != LEAST)
