"""The processor's last-level cache. Rule: what a stage keeps from frame to frame, such as a network's weights, is moved
in every frame when it is larger than that cache, else in none.

It is the kernel's figure for the cores; on a virtual machine it may be the whole host's. Where the kernel tells none,
nothing is taken to fit.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from trilane import machine

UNITS = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30}


def last_level_bytes(cores: Iterable[int]) -> int:
    """Size of the largest last-level cache of `cores`; 0 where the kernel tells none."""
    folder = machine.here.sys / "devices/system/cpu"
    return max((_of_core(folder / f"cpu{core}" / "cache") for core in cores), default=0)


def moved_of_kept(kept_bytes: int) -> int:
    """Of `kept_bytes` that each frame needs again on this process's cores, those that come from memory: all or none."""
    return 0 if kept_bytes <= last_level_bytes(machine.here.cores()) else kept_bytes


def _of_core(caches: Path) -> int:
    try:
        levels = {int((index / "level").read_text()): index for index in caches.glob("index[0-9]*")}
        return _bytes((levels[max(levels)] / "size").read_text().strip()) if levels else 0
    except (OSError, ValueError):
        return 0


def _bytes(text: str) -> int:
    """Of a size as the kernel writes it: 307200K."""
    return int(text[:-1]) * UNITS[text[-1]] if text[-1:] in UNITS else int(text)
