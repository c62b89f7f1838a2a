"""Predictions for a chip: one configuration over minutes, or a table of many.

Rule: every number is on the virtual clock and comes with the relative error that is to be expected of it. `confidence`
is one minus that error, and zero when the error is as large as the number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from trilane.hw_profiles.application import (
    MOST_FPS,
    REFERENCE,
    RUNTIMES,
    Plan,
    Steady,
    Variant,
    isolated_job_time,
    relative_error,
    steady,
)
from trilane.hw_profiles.configuration_table import Row
from trilane.hw_profiles.host import host_cores, usable_cores
from trilane.hw_profiles.load import HOST
from trilane.hw_profiles.network_work import Network
from trilane.hw_profiles.operator_times import JobTime
from trilane.hw_profiles.over_time import Moment, over_time, unit_power_w
from trilane.hw_profiles.performance_profiles import Corners, corners_of
from trilane.hw_profiles.placed_host import Placed, on_cores, place_units
from trilane.hw_profiles.placement_facts import NS_PER_MS, described
from trilane.hw_profiles.reference_networks import reference_network
from trilane.hw_profiles.schema import Profile
from trilane.scheduler.placement import Ranked
from trilane.scheduler.policy import POLICIES
from trilane.scheduler.stats import energy_score
from trilane.units import SUSTAINED, UNITS, UnitName

#: Rows of `what_if`: name, how the stages are joined, share of the network on the GPU. All have frames as often as the
#: display can show them, for they are compared with each other.
ALTERNATIVES: tuple[tuple[str, Variant, float], ...] = (
    ("reference application", REFERENCE, 0.0),
    ("one frame at a time", Variant("sequential", "single"), 0.0),
    ("pipelined, two buffers", Variant("pipelined", "double"), 0.0),
    ("pipelined, newest of three buffers", Variant("pipelined", "triple"), 0.0),
    ("newest pose wins", Variant("latest", "double", fps=MOST_FPS), 0.0),
    ("newest pose wins, newest of three buffers", Variant("latest", "triple", fps=MOST_FPS), 0.0),
    ("pipelined, batches of 2", Variant("pipelined", "double", 2), 0.0),
    ("pipelined, 5 % of the network on the GPU", Variant("pipelined", "double"), 0.05),
)


def predict(
    profile: Profile,
    plan: Plan,
    performance_profile: str = SUSTAINED,
    minutes: float = 0.0,
    governor: str | None = None,
) -> dict[str, Any]:
    """Everything about one configuration, as plain data with the keys of report.json and more.

    `profile`: of the chip.
    `plan`: what runs on it.
    `performance_profile`: by name.
    `minutes`: of virtual time from a cold start; 0 for the settled application at constant temperature.
    `governor`: of GOVERNORS; None for the profile's own.
    Raises BadInputError for an unknown name or a time out of range.
    """
    corners = corners_of(profile, performance_profile)
    placed = place_units(profile, plan, corners, host_cores(usable_cores())) if profile.name == HOST else None
    if placed is not None:
        profile = on_cores(profile, placed.best.placement)
    now = steady(profile, plan, corners, twice=True)
    moments = over_time(profile, plan, performance_profile, minutes, governor) if minutes else []
    frame = _mean([m.frame_ms for m in moments]) if moments else now.frame_ms
    power = _mean([m.power_w for m in moments]) if moments else _settled_power(profile, now, corners)
    job = isolated_job_time(profile, plan.network, plan.runtime, corners)
    return {
        "schema": 1,
        "clock": "virtual",
        "machine": {"profile": profile.name, "title": profile.title},
        "config": _config(plan, performance_profile, minutes, governor or profile.thermal.governor),
        "network": _network(plan, job),
        "frame_time_ms": _frame_times(profile, frame, [m.frame_ms for m in moments] or [frame]),
        "latency_ms": {"mean": now.latency_ms},
        "fps": 1e3 / frame,
        **_ends(moments, now),
        **_settled(plan, now),
        "power_w": power,
        "base_power_w": profile.thermal.base_power_w.or_else(0),
        "base_power_kind": profile.thermal.base_power_w.kind,
        "energy_mj_per_frame": power * frame,
        "xrbench": {"energy": energy_score(power * frame)},
        "temperature_c": _temperatures(moments),
        "caps": _caps(moments),
        "timeline": [_shown(m) for m in _thinned(moments)],
        **_expected_error(profile, plan, job),
        **({} if placed is None else {"placement": placed.facts}),
        "notes": _notes(profile, plan.variant, placed),
    }


def _ends(moments: Sequence[Moment], now: Steady) -> dict[str, float]:
    """Frames a second at the start, and those to which it settles: the mean of the last fifth of the time."""
    if not moments:
        return {"fps_start": 1e3 / now.frame_ms, "fps_settled": 1e3 / now.frame_ms}
    last = moments[-max(1, len(moments) // 5) :]
    return {"fps_start": 1e3 / moments[0].frame_ms, "fps_settled": 1e3 / _mean([m.frame_ms for m in last])}


def _notes(profile: Profile, variant: Variant, placed: Placed | None) -> list[str]:
    """What a reader of the figures has to know of the profile, of the policy and of the placement."""
    notes = []
    if POLICIES[variant.policy].paced:
        notes.append(
            f"under {variant.policy}, {variant.fps:g} frames are released a second, whether there is room or not"
        )
    if profile.name == HOST:
        notes.append(
            "of this machine are cores, clock and instructions; its speeds are assumed: `trilane run` measures"
        )
    if placed is not None:
        beside = f"; {_predicted(placed.rule)}" if placed.rule.placement != placed.best.placement else ""
        notes.append(f"placement: {_predicted(placed.best)} ms, the least by the placement's model{beside}")
    sharing = [unit for unit in UNITS if any(_on_one_core(profile, unit, other) for other in UNITS if other != unit)]
    if sharing:
        notes.append(f"{' and '.join(sharing)} share a core and work in turns")
    return notes


def _predicted(ranked: Ranked) -> str:
    return f"{described(ranked.placement)}: {ranked.frame_ns / NS_PER_MS:.1f}"


def _on_one_core(profile: Profile, one: UnitName, other: UnitName) -> bool:
    return bool(profile.units[one].core) and profile.units[one].core == profile.units[other].core


def _expected_error(profile: Profile, plan: Plan, job: JobTime) -> dict[str, float]:
    error = relative_error(job, profile.units[plan.runtime])
    return {"expected_error": error, "confidence": max(0.0, 1 - error)}


def _network(plan: Plan, job: JobTime) -> dict[str, Any]:
    work = plan.network.work
    return {
        "parameters_m": work.weights / 1e6,
        "gmac": work.macs / 1e9,
        "alone_ms": job.total_ms,
        "parts_ms": dict(job.parts),
    }


def _settled(plan: Plan, now: Steady) -> dict[str, Any]:
    per_unit = {u: sum(ms for s, ms in now.stages_ms.items() if now.unit_of[s] == u) for u in UNITS}
    return {
        "display_capped": now.capped,
        "stages": {s: {"unit": now.unit_of[s], "service_ms": {"mean": ms}} for s, ms in now.stages_ms.items()},
        "units": {u: {"busy": now.busy[u], "idle": dict(now.idle[u])} for u in UNITS},
        "accounts": {key: now.accounts[key] for key in ("largest_difference", "agree")},
        "efficiency": max(per_unit.values()) / plan.variant.batch / now.frame_ms,
    }


def _config(plan: Plan, performance_profile: str, minutes: float, governor: str) -> dict[str, Any]:
    network, variant = plan.network, plan.variant
    return {
        **network.facts,
        "size": f"{network.height}x{network.width}",
        "channels": network.channels,
        "layout": network.layout,
        "runtime": plan.runtime,
        "policy": variant.policy,
        "edge": variant.edge,
        "batch": variant.batch,
        "fps": variant.fps,
        "gpu_share": plan.gpu_share,
        "performance_profile": performance_profile,
        "minutes": minutes,
        "governor": governor,
    }


def _settled_power(profile: Profile, now: Steady, corners: Corners) -> float:
    return sum(unit_power_w(profile, now, corners).values()) + profile.thermal.base_power_w.or_else(0)


def _frame_times(profile: Profile, mean_ms: float, frames: Sequence[float]) -> dict[str, float]:
    ordered = sorted(frames)
    shown = {f"p{p}": ordered[min(len(ordered) - 1, len(ordered) * p // 100)] for p in (50, 90, 95, 99)}
    low, high = ema_range_ms(profile, mean_ms)
    return {"mean": mean_ms, **shown, "max": ordered[-1], "ema20_min": low, "ema20_max": high}


def ema_range_ms(profile: Profile, mean_ms: float) -> tuple[float, float]:
    """Least and greatest exponential average over 20 frames, in ms; never below the display's interval."""
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
    throttled_s = [m.t_s for m in moments if m.throttled]
    return {
        "throttled_share": len(throttled_s) / len(moments) if moments else 0.0,
        "first_throttled_s": throttled_s[0] if throttled_s else None,
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
    """The same network under every row of `ALTERNATIVES` that the runtime allows.

    `profile`: of the chip.
    `network`: that runs.
    `runtime`: the unit that runs it.
    `performance_profile`: by name; raises BadInputError for an unknown one.
    """
    corners = corners_of(profile, performance_profile)
    rows = []
    for name, variant, share in ALTERNATIVES:
        if not share or runtime == "dsp":
            now = steady(profile, Plan(network, runtime, variant, share), corners)
            means = {"name": name, "policy": variant.policy, "edge": variant.edge}
            rows.append({**means, "frame_ms": now.frame_ms, "fps": 1e3 / now.frame_ms, "latency_ms": now.latency_ms})
    return rows


def predict_table(
    profile: Profile,
    rows: Sequence[Row],
    performance_profile: str = SUSTAINED,
    variant: Variant = REFERENCE,
    on_row: Callable[[int], None] = lambda _count: None,
) -> Iterator[dict[str, Any]]:
    """For each row: its cells, then `bench_*_ms`, `app_*_ms` with their ranges, and `confidence`.

    `profile`: of the chip.
    `rows`: of a table of configurations.
    `performance_profile`: by name; raises BadInputError for an unknown one.
    `variant`: how the stages are joined.
    `on_row`: called after each row with the count of rows so far.
    """
    corners = corners_of(profile, performance_profile)
    for count, row in enumerate(rows, 1):
        yield {**_cells(row), **_row_predictions(profile, reference_network(row.spec), corners, variant)}
        on_row(count)


def _row_predictions(profile: Profile, network: Network, corners: Corners, variant: Variant) -> dict[str, Any]:
    predictions: dict[str, Any] = {}
    errors = []
    for runtime in RUNTIMES:
        alone = isolated_job_time(profile, network, runtime, corners)
        frame = steady(profile, Plan(network, runtime, variant), corners, quick=True).frame_ms
        low, high = ema_range_ms(profile, frame)
        errors.append(relative_error(alone, profile.units[runtime]))
        predictions |= {f"bench_{runtime}_ms": alone.total_ms, f"app_{runtime}_ms": frame}
        predictions |= {f"app_{runtime}_ms_min": low, f"app_{runtime}_ms_max": high}
        predictions[f"expected_error_{runtime}"] = errors[-1]
    return {**predictions, "confidence": max(0.0, 1 - _mean(errors))}


def _cells(row: Row) -> dict[str, Any]:
    """The cells of the row as text, those that are whole numbers as integers."""
    return {key: int(text) if text.isdecimal() else text for key, text in row.cells.items()}
