"""Bytes that a stage moves for a frame, counted by the stage where it copies them, beside the least that would do.

Rule: a byte counts at each memory that it is read from or written to. A copy from a slot to the GPU is read there and
uploaded here; a copy back is read back here and written there. So the four figures add up to what passed through the
memories, and a stage that copies nothing between its input and its output comes to its least.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

#: Key in report.json to the name under which a stage reports it with a job.
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
    """Of one frame.

    `read`: from slots, shared assets and what the stage samples.
    `written`: into the output slot, or the file.
    `uploaded`: from the CPU's memory into the GPU's.
    `read_back`: from the GPU's memory into the CPU's.
    `least`: what the frame needs: of the input what it depends on, read once, and the output, written once.
    """

    read: int = 0
    written: int = 0
    uploaded: int = 0
    read_back: int = 0
    least: int = 0

    def start(self, passed_on: int = 0) -> None:
        """A frame begins. `passed_on`: bytes of the header, copied from the input slot to the output slot."""
        self.read = self.written = passed_on
        self.uploaded = self.read_back = self.least = 0

    def copied(self, count: int) -> None:
        """`count` bytes were read in one slot and written to another."""
        self.read += count
        self.written += count

    def figures(self) -> dict[str, float]:
        """What the stage reports of its job."""
        return {
            "bytes_read": self.read,
            "bytes_written": self.written,
            "bytes_uploaded": self.uploaded,
            "bytes_read_back": self.read_back,
            "bytes_least": self.least,
        }


def add_bytes(report: dict[str, Any], sums: Mapping[str, Mapping[str, float]]) -> None:
    """Add to `report`, the keys of report.json, what each stage moved for a presented frame, and the total.

    `sums`: of each stage, the sums of what its jobs reported. A stage that had no job moved nothing; one that does not
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
    """Means, and `ratio`: of all that was moved to the least; null where that is 0."""
    least = sums[NAMES[LEAST]]
    means = {key: sums[name] / frames for key, name in NAMES.items()}
    return {**means, "ratio": _moved(sums) / least if least else None}


def _moved(sums: Mapping[str, float]) -> float:
    return sum(sums[name] for key, name in NAMES.items() if key != LEAST)
