"""Answers for a chip: one configuration over minutes, or a table of many.

Rule: every figure here is on the virtual clock and comes with the relative error that is to be expected of it.
`confidence` is one minus that error, and zero when the error is as large as the figure.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from trilane.errors import BadInputError
from trilane.hw_profiles.application import (
    REFERENCE,
    RUNTIMES,
    Plan,
    Steady,
    Way,
    network_alone,
    relative_error,
    steady,
)
from trilane.hw_profiles.configuration_table import Row
from trilane.hw_profiles.network_work import Network
from trilane.hw_profiles.performance_profiles import Corners, corners_of
from trilane.hw_profiles.reference_networks import reference_network
from trilane.hw_profiles.schema import CORNERS, Profile
from trilane.hw_profiles.throttling import GOVERNORS, Heat, Throttle
from trilane.scheduler.stats import energy_score
from trilane.units import SUSTAINED, UNITS, UnitName

MAX_MINUTES = 24 * 60

#: What-if: name, way of working, share of the network on the GPU.
ALTERNATIVES: tuple[tuple[str, Way, float], ...] = (
    ("reference application", REFERENCE, 0.0),
    ("one frame at a time", Way("sequential", "single"), 0.0),
    ("pipelined, two buffers", Way("pipelined", "double"), 0.0),
    ("pipelined, newest of three buffers", Way("pipelined", "triple"), 0.0),
    ("newest pose wins", Way("latest", "triple"), 0.0),
    ("pipelined, batches of 2", Way("pipelined", "double", 2), 0.0),
    ("pipelined, 5 % of the network on the GPU", Way("pipelined", "double"), 0.05),
)


@dataclass(frozen=True)
class Moment:
    """One poll of the governor. Temperatures in degrees Celsius, of the device and of the hottest junction."""

    t_s: float
    frame_ms: float
    device_c: float
    junction_c: float
    power_w: float
    throttled: bool
    corners: Corners


def over_time(
    profile: Profile, plan: Plan, performance_profile: str, minutes: float, governor: str | None = None
) -> list[Moment]:
    """The application from a cold start for `minutes`, held by the governor (the profile's when None).

    Raises BadInputError for an unknown name or a time out of range.
    """
    name = governor or profile.thermal.governor
    if name not in GOVERNORS:
        raise BadInputError("governor", repr(name), " or ".join(GOVERNORS))
    if not 0 < minutes <= MAX_MINUTES:
        raise BadInputError("minutes", f"{minutes:g}", f"above 0, at most {MAX_MINUTES}")
    asked = dict(zip(UNITS, map(CORNERS.index, corners_of(profile, performance_profile)), strict=True))
    heat, throttle, moments = Heat.at_rest(profile), Throttle(), []
    poll, known = profile.thermal.poll_s.or_else(1.0), dict[Corners, Steady]()
    for tick in range(max(1, round(60 * minutes / poll))):
        cpu, gpu, dsp = (CORNERS[throttle.corner_index(unit, asked[unit])] for unit in UNITS)
        corners = (cpu, gpu, dsp)
        if corners not in known:
            known[corners] = steady(profile, plan, corners)
        now = known[corners]
        power = _power_w(profile, now, corners)
        heat.advance(profile, power, poll)
        total = sum(power.values()) + profile.thermal.base_power_w.or_else(0)
        held = any(throttle.steps.values())
        hottest = max(heat.junction_c.values())
        moments.append(Moment((tick + 1) * poll, now.frame_ms, heat.device_c, hottest, total, held, corners))
        GOVERNORS[name](profile, heat, throttle, asked, power)
    return moments


def _power_w(profile: Profile, now: Steady, corners: Corners) -> dict[UnitName, float]:
    return {
        name: profile.units[name].power_w(corner, now.busy[name]) for name, corner in zip(UNITS, corners, strict=True)
    }


def predict(
    profile: Profile,
    plan: Plan,
    performance_profile: str = SUSTAINED,
    minutes: float = 0.0,
    governor: str | None = None,
) -> dict[str, Any]:
    """Everything about one configuration, as plain data with the keys of report.json and more.

    `minutes` 0: the settled application alone, without heat. Raises BadInputError.
    """
    corners = corners_of(profile, performance_profile)
    network, unit = plan.network, profile.units[plan.runtime]
    alone, now = network_alone(profile, network, plan.runtime, corners), steady(profile, plan, corners)
    moments = over_time(profile, plan, performance_profile, minutes, governor) if minutes else []
    error, work = relative_error(alone, unit), network.work
    per_unit = {u: sum(ms for s, ms in now.stages_ms.items() if now.unit_of[s] == u) for u in UNITS}
    frame = _mean([m.frame_ms for m in moments]) if moments else now.frame_ms
    power = _mean([m.power_w for m in moments]) if moments else _settled_power(profile, now, corners)
    return {
        "schema": 1,
        "clock": "virtual",
        "machine": {"profile": profile.name, "title": profile.title},
        "config": _config(plan, performance_profile, minutes, governor or profile.thermal.governor),
        "network": {
            "parameters_m": work.weights / 1e6,
            "gmac": work.macs / 1e9,
            "alone_ms": alone.total_ms,
            "parts_ms": dict(alone.parts),
        },
        "frame_time_ms": _frame_times(profile, frame, [m.frame_ms for m in moments] or [frame]),
        "latency_ms": {"mean": now.latency_ms},
        "fps": 1e3 / frame,
        "display_capped": now.capped,
        "stages": {s: {"unit": now.unit_of[s], "service_ms": {"mean": ms}} for s, ms in now.stages_ms.items()},
        "units": {u: {"busy": now.busy[u], "idle": dict(now.idle[u])} for u in UNITS},
        "efficiency": max(per_unit.values()) / plan.way.batch / now.frame_ms,
        "power_w": power,
        "energy_mj_per_frame": power * frame,
        "xrbench": {"energy": energy_score(power * frame)},
        "temperature_c": _temperatures(moments),
        "caps": _caps(moments),
        "timeline": [_shown(m) for m in _thinned(moments)],
        "expected_error": error,
        "confidence": max(0.0, 1 - error),
    }


def _config(plan: Plan, performance_profile: str, minutes: float, governor: str) -> dict[str, Any]:
    network, way = plan.network, plan.way
    return {
        **network.facts,
        "size": f"{network.height}x{network.width}",
        "channels": network.channels,
        "layout": network.layout,
        "runtime": plan.runtime,
        "policy": way.policy,
        "edge": way.edge,
        "batch": way.batch,
        "gpu_share": plan.gpu_share,
        "performance_profile": performance_profile,
        "minutes": minutes,
        "governor": governor,
    }


def _settled_power(profile: Profile, now: Steady, corners: Corners) -> float:
    return sum(_power_w(profile, now, corners).values()) + profile.thermal.base_power_w.or_else(0)


def _frame_times(profile: Profile, mean_ms: float, frames: Sequence[float]) -> dict[str, float]:
    ordered = sorted(frames)
    shown = {f"p{p}": ordered[min(len(ordered) - 1, len(ordered) * p // 100)] for p in (50, 90, 95, 99)}
    low, high = ema_range_ms(profile, mean_ms)
    return {"mean": mean_ms, **shown, "max": ordered[-1], "ema20_min": low, "ema20_max": high}


def ema_range_ms(profile: Profile, mean_ms: float) -> tuple[float, float]:
    """Least and greatest exponential average over 20 frames; never below what the display shows."""
    half = profile.application.ema20_half_range_fraction.or_else(0) * mean_ms
    return max(profile.application.display_ms.or_else(0), mean_ms - half), mean_ms + half


def _temperatures(moments: Sequence[Moment]) -> dict[str, float]:
    if not moments:
        return {}
    return {
        "device_end": moments[-1].device_c,
        "device_max": max(m.device_c for m in moments),
        "junction_max": max(m.junction_c for m in moments),
    }


def _caps(moments: Sequence[Moment]) -> dict[str, Any]:
    held = [m.t_s for m in moments if m.throttled]
    return {
        "throttled_share": len(held) / len(moments) if moments else 0.0,
        "first_throttled_s": held[0] if held else None,
    }


def _thinned(moments: Sequence[Moment], most: int = 360) -> Sequence[Moment]:
    return moments[:: max(1, len(moments) // most)]


def _shown(moment: Moment) -> dict[str, Any]:
    return {
        "t_s": moment.t_s,
        "fps": 1e3 / moment.frame_ms,
        "device_c": moment.device_c,
        "junction_c": moment.junction_c,
        "power_w": moment.power_w,
        "corners": dict(zip(UNITS, moment.corners, strict=True)),
    }


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def what_if(profile: Profile, network: Network, runtime: UnitName, performance_profile: str) -> list[dict[str, Any]]:
    """The same network under every row of `ALTERNATIVES` that the runtime allows."""
    corners = corners_of(profile, performance_profile)
    rows = []
    for name, way, share in ALTERNATIVES:
        if not share or runtime == "dsp":
            now = steady(profile, Plan(network, runtime, way, share), corners)
            rows.append(
                {"name": name, "frame_ms": now.frame_ms, "fps": 1e3 / now.frame_ms, "latency_ms": now.latency_ms}
            )
    return rows


def predict_table(
    profile: Profile,
    rows: Sequence[Row],
    performance_profile: str = SUSTAINED,
    way: Way = REFERENCE,
    on_row: Callable[[int], None] = lambda _done: None,
) -> Iterator[dict[str, Any]]:
    """One answer per row: its cells, then `bench_*_ms`, `app_*_ms` with their ranges, and `confidence`."""
    corners = corners_of(profile, performance_profile)
    for done, row in enumerate(rows, 1):
        yield {**_cells(row), **_row_figures(profile, reference_network(row.spec), corners, way)}
        on_row(done)


def _row_figures(profile: Profile, network: Network, corners: Corners, way: Way) -> dict[str, Any]:
    figures: dict[str, Any] = {}
    errors = []
    for runtime in RUNTIMES:
        alone = network_alone(profile, network, runtime, corners)
        frame = steady(profile, Plan(network, runtime, way), corners, quick=True).frame_ms
        low, high = ema_range_ms(profile, frame)
        errors.append(relative_error(alone, profile.units[runtime]))
        figures |= {f"bench_{runtime}_ms": alone.total_ms, f"app_{runtime}_ms": frame}
        figures |= {f"app_{runtime}_ms_min": low, f"app_{runtime}_ms_max": high}
        figures[f"expected_error_{runtime}"] = errors[-1]
    return {**figures, "confidence": max(0.0, 1 - _mean(errors))}


def _cells(row: Row) -> dict[str, Any]:
    """The cells as they were given, whole numbers as numbers."""
    return {key: int(text) if text.isdecimal() else text for key, text in row.cells.items()}
