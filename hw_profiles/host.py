"""This machine's cores, and the units on them where nothing was measured. Rule: they share only when there are too few.

The cores are those that this process may use; a quota of the control group lowers their number. The threads of a unit
spin between jobs only when no other unit shares its cores. `trilane.scheduler.placement` places what was measured.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from trilane import machine
from trilane.errors import BadInputError, did_you_mean
from trilane.pipeline.description import UnitSettings
from trilane.scheduler.places import FULL, Core, Place, Placement, has_own_cores
from trilane.units import UNITS

CORES = "UNIT=LIST, such as dsp=0,1 or dsp=2-5"


def usable_cores() -> tuple[int, ...]:
    """Numbers of the cores in the affinity mask, ascending, at most as many as the control group's quota allows."""
    cores = machine.here.cores()
    quota = cgroup_quota()
    return cores if quota is None else cores[: max(1, math.ceil(quota))]


def cgroup_quota() -> float | None:
    """How many CPUs' time the control group allows; None when it sets no limit."""
    root = machine.here.sys / "fs/cgroup"
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


def rule_placement(cores: tuple[int, ...], asked: Mapping[str, tuple[int, ...]] | None = None) -> Placement:
    """`split_cores` with a thread for each core of a unit; `asked`: units whose cores were asked for."""
    split = {**split_cores(cores), **(asked or {})}
    return {unit: Place(own, len(own)) for unit, own in split.items()}


def host_units(cores: tuple[int, ...] | None = None) -> dict[str, UnitSettings]:
    """Settings of the three units on `cores` of this machine, None for all usable ones, by `split_cores`."""
    return settings_of(rule_placement(cores or usable_cores()))


def settings_of(placement: Placement) -> dict[str, UnitSettings]:
    """The settings of units that are placed so."""
    return {
        unit: UnitSettings(cores=place.cores, threads=place.threads, spin=has_own_cores(unit, placement))
        for unit, place in placement.items()
    }


def asked_cores(texts: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """`UNIT=LIST` texts as the cores of each unit, ascending. Raises BadInputError naming what is wrong."""
    asked: dict[str, tuple[int, ...]] = {}
    usable = machine.here.cores()
    for text in texts:
        unit, equals, listed = text.partition("=")
        if not equals:
            raise BadInputError("--cores", repr(text), CORES)
        if unit not in UNITS:
            expected = f"one of {', '.join(UNITS)}"
            raise BadInputError("--cores", f"unknown unit {unit!r}", expected, did_you_mean(unit.lower(), UNITS))
        if unit in asked:
            raise BadInputError("--cores", f"unit {unit} twice", "each unit once", f"such as {unit}=0,1 for two cores")
        asked[unit] = _listed(text, listed)
        if absent := set(asked[unit]) - set(usable):
            found = f"core {', '.join(map(str, sorted(absent)))} for unit {unit}"
            raise BadInputError("--cores", found, f"cores that this process may use: {', '.join(map(str, usable))}")
    return asked


def _listed(text: str, listed: str) -> tuple[int, ...]:
    """The numbers of a list such as `0,2-5`."""
    cores: list[int] = []
    for part in listed.split(","):
        ends = re.fullmatch(r"(\d{1,5})(?:-(\d{1,5}))?", part.strip())
        if ends is None or int(ends[1]) > int(ends[2] or ends[1]):
            raise BadInputError("--cores", repr(text), CORES)
        cores += range(int(ends[1]), int(ends[2] or ends[1]) + 1)
    if len(set(cores)) < len(cores):
        raise BadInputError("--cores", f"a core twice in {text!r}", "each core once")
    return tuple(sorted(cores))


def host_cores(numbers: Sequence[int]) -> tuple[Core, ...]:
    """What the kernel says of the cores with these numbers: which are siblings, and how fast each type is.

    Where it says nothing, a core is a physical one, and as fast as the others.
    """
    root = machine.here.sys / "devices/system/cpu"
    siblings = {number: _number(root / f"cpu{number}/topology/thread_siblings_list", number) for number in numbers}
    # cpu_capacity is 1024 for the fastest type of core; kernels without it have the highest clock
    for file in ("cpu_capacity", "cpufreq/cpuinfo_max_freq"):
        speed = {number: _number(root / f"cpu{number}/{file}", 0) for number in numbers}
        if len(set(speed.values())) > 1 and min(speed.values()) > 0:
            break
    fastest = max(speed.values())
    return tuple(
        Core(number, siblings[number], round(FULL * speed[number] / fastest) if min(speed.values()) else FULL)
        for number in numbers
    )


def _number(file: Path, otherwise: int) -> int:
    """The first number in a file."""
    try:
        found = re.match(r"\d+", file.read_text())
    except OSError:
        return otherwise
    return int(found[0]) if found else otherwise
