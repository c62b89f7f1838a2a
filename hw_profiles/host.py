"""This machine: its cores, the units on them, and the numbers of the profile `host` that depend on this machine.

Only cores that this process may use count; a quota of the control group lowers their number. Units share cores only if
there are too few cores. Nothing is measured here: the `source` of every number in `host_tables` says how it was
computed, or on which other machine it was measured. `host_model.py` replaces some numbers by measurements of this
machine, and `trilane.scheduler.placement` places units by measured times.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from trilane import machine
from trilane.errors import BadInputError, MissingPartError, did_you_mean, package_line
from trilane.hw_profiles.schema import Profile
from trilane.pipeline.description import UnitSettings
from trilane.scheduler.placement import FULL, CpuCore, Place, Placement, Ranked, has_own_cores
from trilane.units import NS_PER_MS, UNITS

CORES = "UNIT=LIST, such as dsp=0,1 or dsp=2-5"

#: (INT8, FP32) multiply-accumulates per cycle and core, by CPU flag. The first flag that the machine has is used.
RATES = {
    "avx512_vnni": (128, 32),
    "avx_vnni": (64, 16),
    "avx2": (32, 16),
    "asimddp": (32, 8),
    "": (8, 4),
}
FALLBACK_GHZ = 2.5
ZEN_5 = "ResNet18 of width 64 at 512x512 on four Zen 5 cores"
ZEN_3 = "ResNet18 of width 64 at 512x512 on four Zen 3 cores, docs/networks.md"
#: (speed of each runtime relative to ONNX Runtime in FP32, kind of these numbers, their source), by CPU flag. `cuda`
#: and `qnn` are missing, because they run on a device of their own and were not measured together with the others.
RUNTIMES: dict[str, tuple[dict[str, float], str, str]] = {
    "avx512_vnni": ({"openvino": 3.7, "ort": 2.2}, "measured", ZEN_5),
    "avx_vnni": ({"openvino": 3.7, "ort": 2.2}, "assumed", f"like {ZEN_5}"),
    "avx2": ({"openvino": 1.97, "ort": 1.28}, "measured", ZEN_3),
    "asimddp": ({"openvino": 1.0, "ort": 1.5}, "assumed", "OpenVINO has few INT8 kernels for ARM"),
    "": ({"openvino": 1.0, "ort": 1.0}, "assumed", "nothing is known of such a CPU"),
}

SHOWN = 8  # number of alternative placements in a report


def usable_cores() -> tuple[int, ...]:
    """Return the numbers of the usable cores, ascending: the affinity mask, cut to the control group's quota."""
    cores = machine.here.cores()
    quota = cgroup_quota()
    return cores if quota is None else cores[: max(1, math.ceil(quota))]


def cgroup_quota() -> float | None:
    """Return the number of CPUs whose time the control group allows; None if it sets no limit."""
    root = machine.here.sys / "fs/cgroup"
    try:
        limit, period = (root / "cpu.max").read_text().split()
    except (OSError, ValueError):
        try:
            # Version 1 of control groups; it states -1 for no limit.
            limit = (root / "cpu" / "cpu.cfs_quota_us").read_text().strip()
            period = (root / "cpu" / "cpu.cfs_period_us").read_text().strip()
        except OSError:
            return None
    try:
        value = float(limit) / float(period)  # version 2 states `max`, which is no number
    except (ValueError, ZeroDivisionError):
        return None
    return value if value > 0 else None


def split_cores(cores: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
    """Return the cores of each unit: one for the CPU (and the scheduler), one for the GPU, all others for the DSP.

    With eight cores or more, the GPU has a quarter of them. With two cores, CPU and GPU share one. With one core, all
    units share it.
    """
    if len(cores) == 1:
        return {"cpu": cores, "gpu": cores, "dsp": cores}
    if len(cores) == 2:
        return {"cpu": cores[:1], "gpu": cores[:1], "dsp": cores[1:]}
    end = 1 + max(1, len(cores) // 4 if len(cores) >= 8 else 1)
    return {"cpu": cores[:1], "gpu": cores[1:end], "dsp": cores[end:]}


def rule_placement(cores: tuple[int, ...], asked: Mapping[str, tuple[int, ...]] | None = None) -> Placement:
    """Return the placement by `split_cores`, with a thread for each core. `asked`: cores that the user chose."""
    split = {**split_cores(cores), **(asked or {})}
    return {unit: Place(own, len(own)) for unit, own in split.items()}


def host_units(cores: tuple[int, ...] | None = None) -> dict[str, UnitSettings]:
    """Return the settings of the three units by `split_cores`.

    `cores`: numbers of cores; None for all usable cores.
    """
    return settings_of(rule_placement(cores or usable_cores()))


def settings_of(placement: Placement) -> dict[str, UnitSettings]:
    """Return cores, threads and spinning of each unit of a placement.

    Threads spin between jobs only on cores that no other unit shares.
    """
    return {
        unit: UnitSettings(cores=place.cores, threads=place.threads, spin=has_own_cores(unit, placement))
        for unit, place in placement.items()
    }


def asked_cores(texts: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Return the cores of each unit, ascending, from `UNIT=LIST` texts. Raises BadInputError naming what is wrong."""
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
    """Return the core numbers in `listed`, such as `0,2-5`. `text`: whole text of the option, for messages."""
    cores: list[int] = []
    for part in listed.split(","):
        ends = re.fullmatch(r"(\d{1,5})(?:-(\d{1,5}))?", part.strip())
        if ends is None or int(ends[1]) > int(ends[2] or ends[1]):
            raise BadInputError("--cores", repr(text), CORES)
        cores += range(int(ends[1]), int(ends[2] or ends[1]) + 1)
    if len(set(cores)) < len(cores):
        raise BadInputError("--cores", f"a core twice in {text!r}", "each core once")
    return tuple(sorted(cores))


def host_cores(numbers: Sequence[int]) -> tuple[CpuCore, ...]:
    """Return the cores with these numbers, with their siblings and speeds from the kernel.

    If the kernel does not state siblings and speed, the cores have no siblings and are equally fast.
    """
    root = machine.here.sys / "devices/system/cpu"
    siblings = {number: _number(root / f"cpu{number}/topology/thread_siblings_list", number) for number in numbers}
    # cpu_capacity is 1024 for the fastest type of core; kernels without this file have the highest clock
    for file in ("cpu_capacity", "cpufreq/cpuinfo_max_freq"):
        speed = {number: _number(root / f"cpu{number}/{file}", 0) for number in numbers}
        if len(set(speed.values())) > 1 and min(speed.values()) > 0:
            break
    fastest = max(speed.values())
    return tuple(
        CpuCore(number, siblings[number], round(FULL * speed[number] / fastest) if min(speed.values()) else FULL)
        for number in numbers
    )


def _number(file: Path, otherwise: int) -> int:
    """Return the number at the beginning of a file; `otherwise` without such a file or number."""
    try:
        found = re.match(r"\d+", file.read_text())
    except OSError:
        return otherwise
    return int(found[0]) if found else otherwise


def host_tables() -> dict[str, Any]:
    """Return the tables that replace parts of `host.toml`: title, peak rates of the units, speeds of the runtimes."""
    ghz = machine.here.clock_ghz()
    known_ghz = ghz if ghz > 0 else FALLBACK_GHZ
    flags = machine.here.cpu_flags()
    flag = next(name for name in RATES if name in flags or not name)
    clock = f"{known_ghz:.1f} GHz" + ("" if ghz > 0 else " (not told, assumed)")
    cores = usable_cores()
    core = {unit: f"core {own[0]}" for unit, own in split_cores(cores).items()}
    return {
        "title": f"this machine: {len(cores)} cores, {clock}, {flag or 'no vector products'}",
        "units": {
            "cpu": {**_unit(1, known_ghz, flag, clock), "core": core["cpu"]},
            "gpu": {**_unit(1, known_ghz, flag, clock), "core": core["gpu"]},
            "dsp": {
                **_unit(network_threads(), known_ghz, flag, clock),
                "core": core["dsp"],
                "threads": network_threads(),
                "runtimes": _runtimes(flag),
            },
        },
    }


def network_threads() -> int:
    """Return the number of threads of the DSP unit in the profile `host`: two fewer than the usable cores, at least 1.

    The unit's peak rates in this profile are the rates of as many cores.
    """
    return len(split_cores(usable_cores())["dsp"])


def _runtimes(flag: str) -> dict[str, Any]:
    speeds, kind, source = RUNTIMES[flag]
    return {name: {"value": speed, "kind": kind, "source": source} for name, speed in speeds.items()}


def _unit(cores: int, ghz: float, flag: str, clock: str) -> dict[str, Any]:
    int8, fp32 = RATES[flag]
    source = f"{cores} cores x {clock} x {{}} products a cycle ({flag or 'scalar'})"

    def peak(per_cycle: int) -> dict[str, Any]:
        value = cores * ghz * per_cycle / 1e3
        return {"value": value, "kind": "assumed", "spread": 0.3, "source": source.format(per_cycle)}

    return {"peak_int8_tmac_s": peak(int8), "peak_fp16_tmac_s": peak(fp32), "peak_fp32_tmac_s": peak(fp32)}


def fastest_runtime(profile: Profile, installed: Sequence[str]) -> tuple[str, str]:
    """Return (name of the fastest of the `installed` runtimes by the profile's DSP unit, reason for the choice).

    Raises MissingPartError if the profile has the speed of no installed runtime.
    """
    known = profile.units["dsp"].runtimes
    speeds = {name: known[name] for name in installed if name in known}
    if not speeds:
        raise MissingPartError("no runtime that the host profile knows is installed", package_line("onnxruntime"))
    name = max(speeds, key=lambda runtime: speeds[runtime].or_else(0.0))
    times = ", ".join(f"{runtime} {speed.or_else(0.0):g}" for runtime, speed in speeds.items())
    unknown = ", ".join(runtime for runtime in installed if runtime not in known)
    left_out = f"; installed, but of unknown speed: {unknown}" if unknown else ""
    return name, f"times the speed of FP32, by the host profile: {times}; {speeds[name].source}{left_out}"


def described(placement: Placement) -> str:
    """Return the text of a placement: each unit's cores, such as `cpu 0, gpu 1, dsp 0,1 (2 threads)`."""
    return ", ".join(f"{unit} {_cores(place)}" for unit, place in placement.items())


def _cores(place: Place) -> str:
    listed = ",".join(map(str, place.cores))
    if len(place.cores) == 1:
        return listed
    return f"{listed} ({place.threads} thread{'s' if place.threads > 1 else ''})"


def unit_rows(placement: Placement) -> dict[str, Any]:
    """Return a row with `cores` and `threads` for JSON, by the unit's name."""
    return {unit: {"cores": list(place.cores), "threads": place.threads} for unit, place in placement.items()}


def placement_of(rows: Mapping[str, Any]) -> Placement:
    """Return the placement from `rows`, a result of `unit_rows`."""
    return {unit: Place(tuple(row["cores"]), row["threads"]) for unit, row in rows.items()}


def predictions(best: Ranked, rule: Ranked, found: Sequence[Ranked]) -> dict[str, Any]:
    """Return the keys `predicted_ms`, `rule_ms`, `rule` and `alternatives` of a report's `placement`.

    `best`: placement that was chosen.
    `rule`: placement that suits any run.
    `found`: all placements, the shortest frame time first.
    """
    others = [each for each in found if each.placement != best.placement][:SHOWN]
    return {
        "predicted_ms": best.frame_ns / NS_PER_MS,
        "rule_ms": rule.frame_ns / NS_PER_MS,
        "rule": unit_rows(rule.placement),
        "alternatives": [
            {"units": unit_rows(each.placement), "predicted_ms": each.frame_ns / NS_PER_MS} for each in others
        ],
    }
