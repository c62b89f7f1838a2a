"""This machine as three units: which cores each has. Rule: units share cores only when there are too few.

The cores are those that this process may use; a quota of the control group lowers their number. The threads of a unit
spin between jobs only when no other unit shares its cores.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import psutil

from trilane.pipeline.description import UnitSettings

CGROUP = Path("/sys/fs/cgroup")


def usable_cores() -> tuple[int, ...]:
    """Numbers of the cores in the affinity mask, ascending, at most as many as the control group's quota allows."""
    cores = sorted(os.sched_getaffinity(0))
    quota = cgroup_quota()
    return tuple(cores if quota is None else cores[: max(1, math.ceil(quota))])


def cgroup_quota(root: Path = CGROUP) -> float | None:
    """How many CPUs' time the control group allows; None when it sets no limit. `root`: where its files are."""
    try:
        limit, period = (root / "cpu.max").read_text().split()
    except (OSError, ValueError):
        try:
            limit = (root / "cpu" / "cpu.cfs_quota_us").read_text().strip()
            period = (root / "cpu" / "cpu.cfs_period_us").read_text().strip()
        except OSError:
            return None
    try:
        value = float(limit) / float(period)
    except (ValueError, ZeroDivisionError):
        return None
    return value if value > 0 else None


def split_cores(cores: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
    """Cores of each unit: one for the CPU (and the scheduler), one for the GPU, the rest for the DSP.

    With eight cores or more, the GPU has a quarter of them. With two, CPU and GPU share one; with one, all share it.
    """
    if len(cores) == 1:
        return {"cpu": cores, "gpu": cores, "dsp": cores}
    if len(cores) == 2:
        return {"cpu": cores[:1], "gpu": cores[:1], "dsp": cores[1:]}
    end = 1 + max(1, len(cores) // 4 if len(cores) >= 8 else 1)
    return {"cpu": cores[:1], "gpu": cores[1:end], "dsp": cores[end:]}


def host_units(cores: tuple[int, ...] | None = None) -> dict[str, UnitSettings]:
    """Settings of the three units on `cores` of this machine, None for all usable ones."""
    split = split_cores(cores or usable_cores())
    return {
        unit: UnitSettings(cores=own, threads=len(own), spin=_has_own_cores(unit, split)) for unit, own in split.items()
    }


def _has_own_cores(unit: str, split: dict[str, tuple[int, ...]]) -> bool:
    return all(not set(split[unit]) & set(cores) for other, cores in split.items() if other != unit)


def sensor_c() -> float | None:
    """Temperature of the hottest sensor in degrees Celsius; None on a system that shows none."""
    by_chip: dict[str, list[Any]] = getattr(psutil, "sensors_temperatures", dict)()
    values = [sensor.current for sensors in by_chip.values() for sensor in sensors]
    return max(values) if values else None
