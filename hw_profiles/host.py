"""This machine as three units. Rule: cores are shared only when there are too few, and then `spin` is off.

Cores are those that this process may use; a quota of the control group lowers their number.
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
    """Core numbers, ascending: the affinity mask, cut to what the control group's quota pays for (at least one)."""
    cores = sorted(os.sched_getaffinity(0))
    quota = cgroup_quota()
    return tuple(cores if quota is None else cores[: max(1, math.ceil(quota))])


def cgroup_quota(root: Path = CGROUP) -> float | None:
    """CPUs' worth of time that the control group allows; None when it does not limit them."""
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

    From eight cores on the GPU has a quarter. With two cores CPU and GPU share one; with one all share it.
    """
    if len(cores) == 1:
        return {"cpu": cores, "gpu": cores, "dsp": cores}
    if len(cores) == 2:
        return {"cpu": cores[:1], "gpu": cores[:1], "dsp": cores[1:]}
    end = 1 + max(1, len(cores) // 4 if len(cores) >= 8 else 1)
    return {"cpu": cores[:1], "gpu": cores[1:end], "dsp": cores[end:]}


def host_units(cores: tuple[int, ...] | None = None) -> dict[str, UnitSettings]:
    """Settings of the three units on this machine, or on the given cores of it."""
    split = split_cores(cores or usable_cores())
    return {unit: UnitSettings(cores=own, threads=len(own), spin=_alone(unit, split)) for unit, own in split.items()}


def _alone(unit: str, split: dict[str, tuple[int, ...]]) -> bool:
    return all(not set(split[unit]) & set(cores) for other, cores in split.items() if other != unit)


def sensor_c() -> float | None:
    """Degrees Celsius of the hottest sensor, where the system shows any."""
    read: dict[str, list[Any]] = getattr(psutil, "sensors_temperatures", dict)()
    values = [sensor.current for sensors in read.values() for sensor in sensors]
    return max(values) if values else None
