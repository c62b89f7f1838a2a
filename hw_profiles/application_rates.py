"""The application at a rate: whether the rate holds, what is left of a frame's time, and at which power.

Rule: a rate holds the application as a display of that rate would; policies that release frames have it themselves.
What a frame needs when nothing holds it says whether the rate can be kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from trilane.hw_profiles.application import MOST_FPS, REFERENCE, Plan, Steady, Variant, stage_times_ms, steady
from trilane.hw_profiles.device_power import device_power
from trilane.hw_profiles.network_time import Interval, spread_of
from trilane.hw_profiles.over_time import unit_power_w
from trilane.hw_profiles.performance_profiles import Corners
from trilane.hw_profiles.rates import FrameTimes, Load
from trilane.hw_profiles.schema import Profile
from trilane.scheduler.policy import POLICIES
from trilane.units import UNITS, UnitName

#: Edges that are compared at a rate.
EDGES = ("single", "double", "triple", "fifo:4", "orphan")
#: Part of a rate that may be missing where it is said to hold: the first frames of a simulated run take longer.
MISSING = 0.002


def held_to(plan: Plan, fps: float | None) -> Plan:
    """The plan at a rate: a policy that releases frames releases so many, any other one is held to it."""
    if fps is None:
        return plan
    if POLICIES[plan.variant.policy].paced:
        return replace(plan, variant=plan.variant._replace(fps=fps))
    return replace(plan, most_fps=fps)


def _unheld(plan: Plan) -> Plan:
    return replace(plan, most_fps=None, variant=plan.variant._replace(fps=MOST_FPS))


def unheld_times(profile: Profile, plan: Plan, corners: Corners, around: Interval, network_ms: float) -> FrameTimes:
    """Times of a frame when neither the display nor a rate holds the application.

    `profile`: of the chip.
    `plan`: what runs on it.
    `corners`: of all units.
    `around`, `network_ms`: the network's time with its interval. A frame's follow from it; where the other stages were
    measured with it, they have its relative error.
    """
    display = profile.application.display_ms.model_copy(update={"value": 1e3 / MOST_FPS})
    free = profile.model_copy(update={"application": profile.application.model_copy(update={"display_ms": display})})
    stretches = (1.0, around.low_ms / network_ms, around.high_ms / network_ms)
    if profile.units[plan.runtime].measured is not None:
        frame_ms = steady(free, _unheld(plan), corners, quick=True).frame_ms
        return FrameTimes(*(stretch * frame_ms for stretch in stretches))
    plans = (replace(_unheld(plan), stretch=stretch) for stretch in stretches)
    return FrameTimes(*(steady(free, each, corners, quick=True).frame_ms for each in plans))


def least_ms(profile: Profile, plan: Plan) -> float:
    """Milliseconds between frames that the display, or the rate, allows."""
    fps = plan.variant.fps if POLICIES[plan.variant.policy].paced else plan.most_fps
    return max(profile.application.display_ms.or_else(0), 1e3 / fps if fps else 0.0)


def around_frame(frame_ms: float, times: FrameTimes, least: float) -> dict[str, float]:
    """The 80 % interval of a mean frame time, from that of the network.

    `frame_ms`: the mean.
    `times`: when nothing holds the application.
    `least`: of `least_ms`.
    """
    low, high = (frame_ms * max(ms, least) / max(times.ms, least) for ms in times[1:])
    return {"low": low, "high": high}


def load_of(profile: Profile, plan: Plan) -> Load:
    """The application as fast as it can be, but no faster than the display."""

    def work_ms(corners: Corners) -> dict[UnitName, float]:
        times = stage_times_ms(profile, plan, corners)
        return {u: sum(ms for (_, unit), ms in times.items() if unit == u) / plan.variant.batch for u in UNITS}

    return Load(work_ms, lambda corners: steady(profile, _unheld(plan), corners, quick=True).frame_ms)


def power_of(profile: Profile, plan: Plan, corners: Corners, around: Interval) -> dict[str, Any]:
    """Power of the settled application, as `device_power` has it.

    `profile`: of the chip.
    `plan`: what runs on it.
    `corners`: of all units.
    `around`: the network's time, which the busy share of its unit follows.
    """
    busy = steady(profile, plan, corners).busy
    return device_power(profile, busy, corners, {plan.runtime: spread_of(around)})


def settled_power_w(profile: Profile, now: Steady, corners: Corners) -> float:
    """Mean power of the whole device, its base included."""
    return sum(unit_power_w(profile, now, corners).values()) + profile.thermal.base_power_w.or_else(0)


def every_variant() -> Iterator[Variant]:
    """The reference application, then every policy with every edge that is compared."""
    yield REFERENCE
    yield from (Variant(policy, edge) for policy in POLICIES for edge in EDGES if (policy, edge) != REFERENCE[:2])


def at_rate(profile: Profile, plan: Plan, corners: Corners, fps: float) -> dict[str, Any]:
    """One row of the comparison at a rate: whether it holds, the share of frames that are dropped, and the power.

    `profile`: of the chip.
    `plan`: what runs on it.
    `corners`: of all units.
    `fps`: the rate.
    """
    now, variant = steady(profile, held_to(plan, fps), corners), plan.variant
    return {
        "name": "reference application" if variant == REFERENCE else f"{variant.policy}, {variant.edge}",
        "policy": variant.policy,
        "edge": variant.edge,
        "frame_ms": now.frame_ms,
        "fps": 1e3 / now.frame_ms,
        "latency_ms": now.latency_ms,
        "holds": 1e3 / now.frame_ms >= fps * (1 - MISSING),
        "dropped": now.dropped,
        "power_w": settled_power_w(profile, now, corners),
    }
