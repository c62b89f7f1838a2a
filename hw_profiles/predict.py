"""Predictions for a chip: one configuration over minutes or at a rate, its alternatives, or a table of configurations.

Every number is on the virtual clock and has an expected relative error. `confidence` is one minus this error, and zero
if the error is as large as the number. A rate limits the application like a display of that rate. Policies that release
frames at a rate use the rate itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from trilane.hw_profiles.application import (
    MOST_FPS,
    NETWORK_UNITS,
    REFERENCE,
    Plan,
    Steady,
    Variant,
    isolated_job_time,
    simulated,
    stage_times_ms,
    steady,
)
from trilane.hw_profiles.governor import ends_of, over_minutes, over_time, settled_corners, unit_power_w
from trilane.hw_profiles.host import described, host_cores, usable_cores
from trilane.hw_profiles.host_model import UNMEASURED, Placed, is_known, on_cores, place_units
from trilane.hw_profiles.network_time import Interval, interval, price, spread_of
from trilane.hw_profiles.network_work import Network
from trilane.hw_profiles.prediction import (
    ApplicationPrediction,
    ChipName,
    MeanTime,
    PredictedConfig,
    PredictedNetwork,
    PredictedStage,
    PredictedTimes,
    PredictedUnit,
)
from trilane.hw_profiles.rates import NOTHING, DevicePower, FrameInterval, FrameLoad, Wanted, answers, device_power
from trilane.hw_profiles.reference_networks import ConfigurationRow, reference_network
from trilane.hw_profiles.schema import Corners, Profile, corners_of
from trilane.hw_profiles.unit_times import relative_error
from trilane.scheduler.placement import Ranked
from trilane.scheduler.policy import POLICIES
from trilane.scheduler.stats import energy_score
from trilane.scheduler.virtual import Simulation
from trilane.transport.slots import EDGES
from trilane.units import HOST, NS_PER_MS, SUSTAINED, UNITS, UnitName

#: Rows of `what_if`: name, variant, share of the network on the GPU. All release frames as often as the display can
#: show them, because they are compared with each other.
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

#: Share by which a rate may be missed and still holds, because the first frames of a simulated run take longer.
MISSING = 0.002


def predict(
    profile: Profile,
    plan: Plan,
    performance_profile: str = SUSTAINED,
    minutes: float = 0.0,
    governor: str | None = None,
    wanted: Wanted = NOTHING,
) -> ApplicationPrediction:
    """Return the prediction of one configuration.

    `profile`: hardware profile of the chip.
    `plan`: application that runs on it.
    `performance_profile`: one of PERFORMANCE_PROFILES.
    `minutes`: virtual time from a cold start; 0 for the settled application at constant temperature.
    `governor`: name in GOVERNORS; None for the profile's governor.
    `wanted`: rate that limits the application, and limit of power.

    Raises BadInputError for an unknown performance profile or edge, or a wanted rate out of range. Unless `minutes` is
    0, it also raises as `over_time` does.
    """
    profile, plan, corners, placed = _settled_on(profile, plan, performance_profile, wanted)
    now = steady(profile, plan, corners)
    moments = over_time(profile, plan, performance_profile, minutes, governor) if minutes else []
    frame = _mean([m.frame_ms for m in moments]) if moments else now.frame_ms
    power = _mean([m.power_w for m in moments]) if moments else _settled_power_w(profile, now, corners)
    work, job = plan.network.work, isolated_job_time(profile, plan.network, plan.unit, corners)
    around, known = interval(profile, work, price(profile, work, plan.unit, corners)), is_known(profile, plan.unit)
    times = unheld_times(profile, plan, corners, around, job.total_ms)
    if not known:
        times = FrameInterval(times.ms)
    per_unit = {u: sum(ms for s, ms in now.stages_ms.items() if now.unit_of[s] == u) for u in UNITS}
    error = relative_error(job, profile.units[plan.unit]) if known else None
    at_all_times = dict.fromkeys(("fps_start", "fps_settled"), 1e3 / now.frame_ms)
    ends: dict[str, Any] = ends_of(moments) if moments else at_all_times
    placement: dict[str, Any] = {} if placed is None else {"placement": placed.facts}
    return ApplicationPrediction(
        schema=1,
        clock="virtual",
        machine=ChipName(profile=profile.name, title=profile.title),
        config=_config(plan, performance_profile, minutes, governor or profile.thermal.governor),
        network=PredictedNetwork(
            parameters_m=work.weights / 1e6,
            gmac=work.macs / 1e9,
            alone_ms=job.total_ms,
            parts_ms=dict(job.parts),
            low_ms=around.low_ms if known else None,
            high_ms=around.high_ms if known else None,
            why=around.why,
        ),
        frame_time_ms=PredictedTimes(
            **_frame_times(profile, frame, [m.frame_ms for m in moments] or [frame]),
            **around_frame(frame, times, least_ms(profile, plan)),
        ),
        latency_ms=MeanTime(mean=now.latency_ms),
        fps=1e3 / frame,
        **ends,
        display_capped=now.capped,
        stages={
            s: PredictedStage(unit=now.unit_of[s], service_ms=MeanTime(mean=ms)) for s, ms in now.stages_ms.items()
        },
        units={u: PredictedUnit(busy=now.busy[u], idle=dict(now.idle[u])) for u in UNITS},
        efficiency=max(per_unit.values()) / plan.variant.batch / now.frame_ms,
        power_w=power,
        base_power_w=profile.thermal.base_power_w.or_else(0),
        base_power_kind=profile.thermal.base_power_w.kind,
        power=power_of(profile, plan, settled_corners(moments) if moments else corners, around),
        energy_mj_per_frame=power * frame,
        xrbench={"energy": energy_score(power * frame)},
        **over_minutes(moments),
        **answers(profile, load_of(profile, plan), corners, wanted, _shown_times(profile, wanted.fps, times)),
        expected_error=error,
        confidence=None if error is None else max(0.0, 1 - error),
        **placement,
        notes=tuple(_notes(profile, plan, placed)),
    )


def _shown_times(profile: Profile, fps: float | None, times: FrameInterval) -> FrameInterval:
    """Return `times`, raised to the display's interval if the display cannot show `fps` frames a second."""
    display = profile.application.display_ms.or_else(0)
    if not fps or display * fps <= 1e3:
        return times
    return FrameInterval(max(times.ms, display), *(None if ms is None else max(ms, display) for ms in times[1:]))


def predicted_run(
    profile: Profile, plan: Plan, performance_profile: str = SUSTAINED, wanted: Wanted = NOTHING
) -> Simulation:
    """Return the run in virtual time, at constant temperature, by which `predict` divides time into busy and idle.

    The parameters and the errors are as in `predict` without minutes.
    """
    profile, plan, corners, _ = _settled_on(profile, plan, performance_profile, wanted)
    return simulated(profile, plan, corners)


def what_if(
    profile: Profile, network: Network, unit: UnitName, performance_profile: str, fps: float | None = None
) -> list[dict[str, Any]]:
    """Return a row for the network under each of `ALTERNATIVES` that the unit allows.

    A row has `name`, `policy`, `edge`, `frame_ms`, `fps` and `latency_ms`. With `fps`, return a row of `at_rate` for
    every policy with every edge instead.

    `profile`: hardware profile of the chip.
    `network`: network that runs.
    `unit`: unit that runs it, gpu or dsp.
    `performance_profile`: one of PERFORMANCE_PROFILES.
    `fps`: rate in frames a second; None for no rate.

    Raises BadInputError for an unknown performance profile or a rate out of range.
    """
    corners = corners_of(profile, performance_profile)
    if fps is not None:
        return [at_rate(profile, Plan(network, unit, variant), corners, fps) for variant in every_variant()]
    rows = []
    for name, variant, share in ALTERNATIVES:
        if not share or unit == "dsp":
            now = steady(profile, Plan(network, unit, variant, share), corners)
            means = {"name": name, "policy": variant.policy, "edge": variant.edge}
            rows.append({**means, "frame_ms": now.frame_ms, "fps": 1e3 / now.frame_ms, "latency_ms": now.latency_ms})
    return rows


def predict_table(
    profile: Profile,
    rows: Sequence[ConfigurationRow],
    performance_profile: str = SUSTAINED,
    variant: Variant = REFERENCE,
    on_row: Callable[[int], None] = lambda _count: None,
) -> Iterator[dict[str, Any]]:
    """Yield for each row its cells and predictions.

    Predictions are `bench_*_ms`, `app_*_ms` with their ranges, `expected_error_*` and `confidence`.

    `profile`: hardware profile of the chip.
    `rows`: rows of a table of configurations.
    `performance_profile`: one of PERFORMANCE_PROFILES.
    `variant`: how the stages are connected and scheduled.
    `on_row`: function that is called after each row with the number of rows so far.

    Raises BadInputError for an unknown performance profile.
    """
    corners = corners_of(profile, performance_profile)
    for count, row in enumerate(rows, 1):
        yield {**_cells(row), **_row_predictions(profile, reference_network(row.spec), corners, variant)}
        on_row(count)


def _settled_on(
    profile: Profile, plan: Plan, performance_profile: str, wanted: Wanted
) -> tuple[Profile, Plan, Corners, Placed | None]:
    """Return (profile, plan at the wanted rate, corner of each unit, placement of the units).

    For this machine the profile has its units on cores. For a chip the placement is None.
    """
    corners = corners_of(profile, performance_profile)
    placed = place_units(profile, plan, corners, host_cores(usable_cores())) if profile.name == HOST else None
    if placed is not None:
        profile = on_cores(profile, placed.best.placement)
    return profile, held_to(plan, wanted.fps), corners, placed


def _notes(profile: Profile, plan: Plan, placed: Placed | None) -> list[str]:
    """Return sentences about the profile, the policy and the placement, for the reader of the figures."""
    notes, variant, measured = [], plan.variant, profile.units[plan.unit].measured
    if POLICIES[variant.policy].paced:
        notes.append(
            f"under {variant.policy}, {variant.fps:g} frames are released a second, whether there is room or not"
        )
    if profile.name == HOST:
        notes.append(UNMEASURED if measured is None else f"{measured.said}; of powers nothing is measured")
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


def _config(plan: Plan, performance_profile: str, minutes: float, governor: str) -> PredictedConfig:
    network, variant, facts = plan.network, plan.variant, dict[str, Any](plan.network.facts)
    return PredictedConfig(
        **facts,
        size=f"{network.height}x{network.width}",
        channels=network.channels,
        layout=network.layout,
        unit=plan.unit,
        policy=variant.policy,
        edge=variant.edge,
        batch=variant.batch,
        fps=plan.most_fps or variant.fps,
        gpu_share=plan.gpu_share,
        performance_profile=performance_profile,
        minutes=minutes,
        governor=governor,
    )


def _frame_times(profile: Profile, mean_ms: float, frames: Sequence[float]) -> dict[str, Any]:
    ordered = sorted(frames)
    shown = {f"p{p}": ordered[min(len(ordered) - 1, len(ordered) * p // 100)] for p in (50, 90, 95, 99)}
    low, high = ema_range_ms(profile, mean_ms)
    return {"mean": mean_ms, **shown, "max": ordered[-1], "ema20_min": low, "ema20_max": high}


def ema_range_ms(profile: Profile, mean_ms: float) -> tuple[float, float]:
    """Return (least, largest) 20-frame exponential average in ms; the first is not below the display's interval."""
    half = profile.application.ema20_half_range_fraction.or_else(0) * mean_ms
    return max(profile.application.display_ms.or_else(0), mean_ms - half), mean_ms + half


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _row_predictions(profile: Profile, network: Network, corners: Corners, variant: Variant) -> dict[str, Any]:
    predictions, errors, known = dict[str, Any](), [], is_known(profile, NETWORK_UNITS[-1])
    for unit in NETWORK_UNITS:
        alone = isolated_job_time(profile, network, unit, corners)
        frame = steady(profile, Plan(network, unit, variant), corners, quick=True).frame_ms
        low, high = ema_range_ms(profile, frame)
        errors.append(relative_error(alone, profile.units[unit]))
        predictions |= {f"bench_{unit}_ms": alone.total_ms, f"app_{unit}_ms": frame}
        predictions |= {f"app_{unit}_ms_min": low, f"app_{unit}_ms_max": high}
        predictions[f"expected_error_{unit}"] = errors[-1] if known else None
    return {**predictions, "confidence": max(0.0, 1 - _mean(errors)) if known else None}


def _cells(row: ConfigurationRow) -> dict[str, Any]:
    """Return the cells of the row by column: whole numbers as integers, other cells as text."""
    return {key: int(text) if text.isdecimal() else text for key, text in row.cells.items()}


def held_to(plan: Plan, fps: float | None) -> Plan:
    """Return `plan` at the rate `fps`, or unchanged if `fps` is None. Raises BadInputError for a rate out of range.

    A policy that releases frames at a rate uses `fps`. For any other policy, `fps` limits the rate of shown frames.
    """
    if fps is None:
        return plan
    if POLICIES[plan.variant.policy].paced:
        return replace(plan, variant=plan.variant._replace(fps=fps))
    return replace(plan, most_fps=fps)


def _unheld(plan: Plan) -> Plan:
    return replace(plan, most_fps=None, variant=plan.variant._replace(fps=MOST_FPS))


def unheld_times(profile: Profile, plan: Plan, corners: Corners, around: Interval, network_ms: float) -> FrameInterval:
    """Return the times of a frame if neither the display nor a rate limits the application.

    The interval follows from the interval of the network's time. Stages that were measured together with the network
    have the same relative error.

    `profile`: hardware profile of the chip.
    `plan`: application that runs on it.
    `corners`: corner of each unit.
    `around`: interval of the network's time.
    `network_ms`: mean of the network's time.
    """
    display = profile.application.display_ms.model_copy(update={"value": 1e3 / MOST_FPS})
    free = profile.model_copy(update={"application": profile.application.model_copy(update={"display_ms": display})})
    stretches = (1.0, around.low_ms / network_ms, around.high_ms / network_ms)
    if profile.units[plan.unit].measured is not None:
        frame_ms = steady(free, _unheld(plan), corners, quick=True).frame_ms
        return FrameInterval(*(stretch * frame_ms for stretch in stretches))
    plans = (replace(_unheld(plan), stretch=stretch) for stretch in stretches)
    return FrameInterval(*(steady(free, each, corners, quick=True).frame_ms for each in plans))


def least_ms(profile: Profile, plan: Plan) -> float:
    """Return the least time between frames in ms that the display and the rate allow."""
    fps = plan.variant.fps if POLICIES[plan.variant.policy].paced else plan.most_fps
    return max(profile.application.display_ms.or_else(0), 1e3 / fps if fps else 0.0)


def around_frame(frame_ms: float, times: FrameInterval, least: float) -> dict[str, Any]:
    """Return the 80 % interval of a mean frame time, as `low` and `high`; None if unknown.

    `frame_ms`: mean frame time.
    `times`: times of a frame if nothing limits the application.
    `least`: result of `least_ms`.
    """
    low, high = (None if ms is None else frame_ms * max(ms, least) / max(times.ms, least) for ms in times[1:])
    return {"low": low, "high": high}


def load_of(profile: Profile, plan: Plan) -> FrameLoad:
    """Return the load of the application if only the display limits its rate."""

    def work_ms(corners: Corners) -> dict[UnitName, float]:
        times = stage_times_ms(profile, plan, corners)
        return {u: sum(ms for (_, unit), ms in times.items() if unit == u) / plan.variant.batch for u in UNITS}

    return FrameLoad(work_ms, lambda corners: steady(profile, _unheld(plan), corners, quick=True).frame_ms)


def power_of(profile: Profile, plan: Plan, corners: Corners, around: Interval) -> DevicePower:
    """Return the power of the settled application, as `device_power` returns it.

    `profile`: hardware profile of the chip.
    `plan`: application that runs on it.
    `corners`: corner of each unit.
    `around`: interval of the network's time; the busy share of the network's unit has the same relative error.
    """
    busy = steady(profile, plan, corners).busy
    return device_power(profile, busy, corners, {plan.unit: spread_of(around)})


def _settled_power_w(profile: Profile, now: Steady, corners: Corners) -> float:
    """Return the mean power of the whole device in watts, including its base power."""
    return sum(unit_power_w(profile, now, corners).values()) + profile.thermal.base_power_w.or_else(0)


def every_variant() -> Iterator[Variant]:
    """Yield the variant `REFERENCE`, then every other combination of a policy and an edge of EDGES."""
    yield REFERENCE
    yield from (Variant(policy, edge) for policy in POLICIES for edge in EDGES if (policy, edge) != REFERENCE[:2])


def at_rate(profile: Profile, plan: Plan, corners: Corners, fps: float) -> dict[str, Any]:
    """Return one row of the comparison at a rate.

    Besides the keys of `what_if`, the row has `holds`, `dropped` (share of frames) and `power_w` of the device.

    `profile`: hardware profile of the chip.
    `plan`: application that runs on it.
    `corners`: corner of each unit.
    `fps`: rate in frames a second.
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
        "power_w": _settled_power_w(profile, now, corners),
    }
