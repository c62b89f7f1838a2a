"""What `trilane predict --beside` answers: each pipeline among the others, beside itself alone, and the chip's units.

Rule: plain data with the keys of report.json where they mean the same; every number is computed, on the virtual clock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

from trilane.hw_profiles.beside import Tenant, Together, together
from trilane.hw_profiles.load import HOST
from trilane.hw_profiles.measured_host import UNMEASURED
from trilane.hw_profiles.over_time import Moment, unit_power_w, warm_up
from trilane.hw_profiles.performance_profiles import Corners, corners_of
from trilane.hw_profiles.schema import Profile
from trilane.scheduler.turns import ROUND_ROBIN
from trilane.units import INFER, SUSTAINED, UNITS

LAST = 5  # of the time: the last fifth is what it settles to


def predict_beside(
    profile: Profile,
    tenants: Sequence[Tenant],
    performance_profile: str = SUSTAINED,
    minutes: float = 0.0,
    governor: str | None = None,
    turns: str = ROUND_ROBIN,
) -> dict[str, Any]:
    """Everything about the `tenants` on one chip.

    `profile`: of the chip.
    `performance_profile`: by name.
    `minutes`: of virtual time from a cold start; 0 for constant temperature.
    `governor`: of GOVERNORS; None for the profile's own.
    `turns`: of TURNS, whose job a unit takes that several wait for.
    Raises BadInputError for an unknown name or a time out of range.
    """
    corners = corners_of(profile, performance_profile)
    at = cache(lambda where: together(profile, tenants, where, turns))
    now = together(profile, tenants, corners, turns)
    moments = warm_up(profile, at, performance_profile, minutes, governor) if minutes else []
    last = at(moments[-1].corners) if moments else now
    powers = unit_power_w(profile, now, corners)
    return {
        "schema": 1,
        "clock": "virtual",
        "machine": {"profile": profile.name, "title": profile.title},
        "config": {
            "performance_profile": performance_profile,
            "minutes": minutes,
            "governor": governor or profile.thermal.governor,
            "turns": turns,
        },
        "pipelines": [
            _row(profile, tenant, number, now, corners, _settled_ms(moments, at, number))
            for number, tenant in enumerate(tenants)
        ],
        "units": {unit: _unit(unit, now, tenants) for unit in UNITS},
        "units_settled": {unit: _unit(unit, last, tenants) for unit in UNITS},
        "power_w": _mean([moment.power_w for moment in moments]) or sum(powers.values()) + _base_w(profile),
        "base_power_w": _base_w(profile),
        "base_power_kind": profile.thermal.base_power_w.kind,
        "unit_power_w": dict(powers),
        "temperature_c": _temperatures(moments),
        "caps": {"throttled_share": _mean([float(moment.throttled) for moment in moments])},
        "notes": _notes(profile, tenants, turns),
    }


def _base_w(profile: Profile) -> float:
    return profile.thermal.base_power_w.or_else(0.0)


def _row(
    profile: Profile, tenant: Tenant, number: int, now: Together, corners: Corners, settled_ms: float | None
) -> dict[str, Any]:
    report = now.runs[number].report
    alone = together(profile, [tenant], corners).runs[0].report
    return {
        "name": tenant.name,
        "source": tenant.source,
        "kind": "network" if tenant.is_bare else "avatar",
        "unit": tenant.unit,
        "rate_fps": tenant.fps,
        "policy": tenant.variant.policy,
        "edge": tenant.variant.edge,
        **_kept(report),
        "frame_ms_settled": settled_ms or report["frame_time_ms"]["mean"],
        "alone": _kept(alone),
        "stages": {stage: {**report["stages"][stage], "alone_ms": ms} for stage, ms in now.stages_ms[number].items()},
        "units": {
            unit: {"busy": row["busy"], "idle": row["idle"], "jobs": row["jobs"]}
            for unit, row in report["units"].items()
        },
    }


def _kept(report: Mapping[str, Any]) -> dict[str, Any]:
    """What is said of a run among others and of one alone. `in_time`: share of the released frames."""
    frames, misses = report["frames"], report["deadline_misses"]
    return {
        "frames": {key: frames[key] for key in ("requested", "presented", "dropped")},
        "frame_time_ms": report["frame_time_ms"],
        "latency_ms": report["latency_ms"],
        "response_ms": report["response_ms"],
        "fps": report["fps"],
        "deadline_misses": misses,
        "in_time": (frames["presented"] - misses) / max(frames["requested"], 1),
    }


def _settled_ms(moments: Sequence[Moment], at: Callable[[Corners], Together], number: int) -> float | None:
    """Mean frame time of a pipeline in the last fifth of the time; None where there is no time."""
    last = moments[-max(1, len(moments) // LAST) :]
    return _mean([at(each.corners).runs[number].report["frame_time_ms"]["mean"] for each in last]) or None


def _unit(unit: str, now: Together, tenants: Sequence[Tenant]) -> dict[str, Any]:
    by_name = {tenant.name: row[unit] for tenant, row in zip(tenants, now.by_tenant, strict=True)}
    return {"busy": now.busy[unit], "idle": 1 - now.busy[unit], "by_pipeline": by_name}


def _temperatures(moments: Sequence[Moment]) -> dict[str, float]:
    if not moments:
        return {}
    return {
        "device_end": moments[-1].device_c,
        "device_max": max(moment.device_c for moment in moments),
        "junction_max": max(moment.junction_c for moment in moments),
    }


def _notes(profile: Profile, tenants: Sequence[Tenant], turns: str) -> list[str]:
    notes = [
        "frames are released from one instant on, each pipeline's at its own rate; response: from release to shown; "
        "a network's result is due when its next frame comes, an avatar's frame three of its periods after its release"
    ]
    if profile.name == HOST:
        measured = profile.units[INFER[1]].measured
        notes += [
            "units on one core of this machine divide it in equal shares; cores are given by the rule for any run",
            f"{UNMEASURED}: `trilane bench pipeline --beside` measures"
            if measured is None
            else f"the first pipeline was {measured.said}; others have the same ratios of measured to modelled times",
        ]
    elif len(tenants) > 1:
        notes.append(f"a unit that several pipelines have handed a job takes them by {turns}, each job to its end")
    return notes


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else 0.0
