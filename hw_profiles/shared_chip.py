"""Several pipelines on one chip: avatars and bare networks, each at a rate, on the same units, memory and heat.

`application.py` says what a frame costs, and the cores of `trilane.scheduler.shared_units` decide who waits. This file
adds how much a network slows while others use the memory: it has the bandwidth that they leave (Gables, Hill and Reddi,
2019). Each avatar's camera, display and composition take `application_use_fraction` all the time, and a network of
another pipeline on another unit takes its bytes over its time. Jobs of one unit follow each other and never compete.
A network that nothing slows has the time of `network_time.price`, on a chip that computes as the network does.
The answer has the keys of report.json where they mean the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final, Literal, NamedTuple

from trilane.errors import BadInputError
from trilane.hw_profiles.application import (
    LEAST_FPS,
    MOST_FPS,
    RUNTIMES,
    Plan,
    Variant,
    application_graph,
    stage_times_ms,
)
from trilane.hw_profiles.engine_times import numbers_of, spilled
from trilane.hw_profiles.host_model import UNMEASURED
from trilane.hw_profiles.network_time import AS_IT_SAYS, Computes, interval, price
from trilane.hw_profiles.network_work import Network
from trilane.hw_profiles.over_time import Moment, last_fifth, temperatures_of, unit_power_w, warm_up
from trilane.hw_profiles.pipeline_prediction import holding_back
from trilane.hw_profiles.rates import FrameInterval, holding, without_interval
from trilane.hw_profiles.schema import Corners, Profile, Unit, corners_of
from trilane.hw_profiles.unit_times import time_on
from trilane.scheduler.events import Graph, Settings, Stop, chain
from trilane.scheduler.policy import POLICIES, run_settings
from trilane.scheduler.shared_units import ONE, ROUND_ROBIN, Member, Runs, simulate_beside
from trilane.scheduler.virtual import Service, Simulation, Skips
from trilane.units import BYPASS, HOST, INFER, NS_PER_MS, NS_PER_S, SUSTAINED, UNITS, UnitName

MOST_TENANTS = 8
#: Share of the bandwidth that others can take at most: something is always left.
MOST_USE = 0.95
#: A run lasts at least LEAST_S virtual seconds and LEAST_FRAMES of the slowest tenant, but at most MOST_S.
LEAST_S, LEAST_FRAMES, MOST_S = 10.0, 64, 600.0
#: How frames are taken by default: only the newest counts, as with a camera; an older one is dropped.
NEWEST = Variant("latest", "double")
#: A run of a pipeline that always has a frame ends after MOST_FED frames, about.
MOST_FED: Final = 1000
#: Which time of a network counts: the expected one, or an end of its 80 % interval.
Ends = Literal["expected", "low", "high"]
ENDS: Final[tuple[Ends, ...]] = ("expected", "low", "high")
ENDLESS = 1 << 40
SKIPS = -1


@dataclass(frozen=True)
class Tenant:
    """A pipeline that shares the chip with others.

    `name`: its name in reports. `source`: what was asked for. `networks`: one network for each shape of the tensor and
    number of avatars in view. `frames`: for each frame, the place of its network in `networks`, or `SKIPS`; the list
    starts over after its end. `unit`: unit of the network. `fps`: frames released a second. `variant`: how the stages
    are joined. `is_bare`: whether there is nothing but the network, whose result is due when the next frame comes.
    `avatars`: number of avatars in view for each of `networks`; empty for one each. `computes`: how the networks
    compute. Raises BadInputError for a unit or
    a rate out of range.
    """

    name: str
    source: str
    networks: tuple[Network, ...]
    frames: tuple[int, ...]
    fps: float
    unit: UnitName = "dsp"
    variant: Variant = NEWEST
    is_bare: bool = False
    avatars: tuple[int, ...] = ()
    computes: Computes = AS_IT_SAYS

    def __post_init__(self) -> None:
        if self.unit not in RUNTIMES:
            raise BadInputError(f"{self.name}: unit", repr(self.unit), " or ".join(RUNTIMES))
        if not LEAST_FPS <= self.fps <= MOST_FPS:
            raise BadInputError(f"{self.name}: rate", f"{self.fps:g}", f"{LEAST_FPS:g} to {MOST_FPS:g} frames a second")

    @property
    def graph(self) -> Graph:
        """Its stages, as the scheduler knows them."""
        name, _ = INFER
        if self.is_bare:
            return chain([(name, self.unit)], self.variant.edge, name)
        return replace(application_graph(self.variant.edge, [(name, self.unit)]), bypass=BYPASS)

    @property
    def fed_settings(self) -> Settings:
        """The settings of its scheduler where it always has another frame, and shows all of them."""
        policy = self.variant.policy
        return Settings(ENDLESS, Variant().policy if POLICIES[policy].paced else policy, hang_ns=ENDLESS)

    def settings(self, display_ns: int) -> Settings:
        """Return the settings of its scheduler: frames without end, at its rate.

        `display_ns`: shortest time between two shown frames of an avatar.
        """
        policy = self.variant.policy
        limits: dict[str, Any] = {"in_queue": 0 if POLICIES[policy].newest else 1, "hang_ns": ENDLESS}
        period_ns = round(NS_PER_S / self.fps)
        if self.is_bare:
            return Settings(ENDLESS, policy, period_ns=period_ns, deadline_ns=period_ns, **limits)
        shown_ns = max(period_ns, display_ns)
        return run_settings(policy, ENDLESS, shown_ns, shown_ns, **limits)

    def plan(self, kind: int, stretch: float = 1.0) -> Plan:
        """Return what runs in a frame with the network at place `kind`. `stretch`: factor on the network's time."""
        avatars = self.avatars[kind] if self.avatars else 1
        return Plan(self.networks[kind], self.unit, self.variant, avatars=avatars, stretch=stretch)

    def kind(self, frame: int) -> int:
        """Return the place of the frame's network, or SKIPS."""
        return self.frames[frame % len(self.frames)]


@dataclass(frozen=True)
class Together:
    """The pipelines once they have settled, at constant corners.

    `runs`: what the scheduler says of each pipeline. `stages_ms`: for each, mean milliseconds of a job by stage if
    nothing else ran. `busy`: share of the time in which each unit works for all of them; `by_tenant`: the same for
    each.
    """

    runs: tuple[Simulation, ...]
    stages_ms: tuple[Mapping[str, float], ...]
    busy: Mapping[str, float]
    by_tenant: tuple[Mapping[str, float], ...]

    @property
    def frame_ms(self) -> float:
        """Mean frame time of the first tenant."""
        mean: float = self.runs[0].report["frame_time_ms"]["mean"]
        return mean


def together(
    profile: Profile, tenants: Sequence[Tenant], corners: Corners, turns: str = ROUND_ROBIN, *, keep: bool = False
) -> Together:
    """Run the `tenants` on the chip `profile`, with its units at `corners`, until they have settled.

    `turns`: rule that chooses whose job a unit takes when several wait.
    `keep`: whether the steps and jobs of each are recorded.
    """
    costs = _Costs(profile, tenants, corners)
    runs = _run(profile, tenants, costs, _seconds(tenants, costs), turns, keep=keep)
    seconds = max(run.report["duration_s"] for run in runs)
    shares: list[dict[str, float]] = [{unit: _busy_s(run, unit) / seconds for unit in UNITS} for run in runs]
    busy: dict[str, float] = {unit: sum(each[unit] for each in shares) for unit in UNITS}
    return Together(tuple(runs), costs.mean_ms, busy, tuple(shares))


def alone_ms(profile: Profile, tenant: Tenant, corners: Corners) -> Mapping[str, float]:
    """Return the mean milliseconds of a job by stage, of a pipeline that is alone, over its frames with a network."""
    return _Costs(profile, [tenant], corners).mean_ms[0]


def _run(
    profile: Profile,
    tenants: Sequence[Tenant],
    costs: _Costs,
    seconds: float,
    turns: str,
    *,
    fed: int | None = None,
    keep: bool = False,
) -> Sequence[Simulation]:
    """Run the `tenants` for `seconds` of virtual time. `fed`: number of the one that always has another frame."""
    stop = round(NS_PER_S * seconds), Stop()
    seats: dict[str, str] = {unit: profile.units[unit].core or unit for unit in UNITS}
    display_ns = round(NS_PER_MS * profile.application.display_ms.or_else(0.0))
    members = []
    for number, tenant in enumerate(tenants):
        graph, settings = tenant.graph, tenant.settings(display_ns)
        if number == fed:
            graph = replace(graph, edges=tuple(map(holding_back, graph.edges)))
            settings = tenant.fed_settings
        members.append(
            Member(graph, settings, costs.service(number), seats, costs.skips(number), inputs=(stop,)),
        )
    cores = [unit.core for unit in profile.units.values() if unit.core]
    return simulate_beside(members, turns=turns, divided=cores, speed=costs.speed, keep=keep)


def needed(profile: Profile, tenants: Sequence[Tenant], number: int, corners: Corners, turns: str) -> FrameInterval:
    """Return the time of a frame of tenant `number` if it always had another one, beside the others at their rates.

    The ends are those where all networks take as little, or as long, as their 80 % intervals say: their errors are
    taken as one, as they are on one chip.
    """
    found = []
    for end in ENDS:
        costs = _Costs(profile, tenants, corners, end)
        seconds = min(_seconds(tenants, costs), MOST_FED * max(costs.mean_ms[number].values()) / 1e3)
        run = _run(profile, tenants, costs, seconds, turns, fed=number)[number]
        found.append(float(run.report["frame_time_ms"]["mean"]))
    return FrameInterval(*found)


def _busy_s(run: Simulation, unit: str) -> float:
    seconds: float = run.report["units"].get(unit, {"busy": 0.0})["busy"] * run.report["duration_s"]
    return seconds


def _seconds(tenants: Sequence[Tenant], costs: _Costs) -> float:
    """Return the virtual seconds that the run lasts."""
    slowest = max(
        max(1 / tenant.fps, sum(means.values()) / 1e3) for tenant, means in zip(tenants, costs.mean_ms, strict=True)
    )
    return min(max(LEAST_S, LEAST_FRAMES * slowest), MOST_S)


class _Job(NamedTuple):
    """The network of a job, by the number of its tenant and its place among the tenant's networks."""

    tenant: int
    kind: int


class _Costs:
    """The times of the pipelines' jobs on the chip, and how these jobs slow each other."""

    def __init__(self, profile: Profile, tenants: Sequence[Tenant], corners: Corners, end: Ends = "expected") -> None:
        self._memory, self._tenants, self._corners = profile.memory, tenants, corners
        self._chips = [tenant.computes.on(profile, tenant.unit) for tenant in tenants]
        self._end: Ends = end
        self._stretches = cache(self._stretch)
        own = profile.memory.application_use_fraction.or_else(0.0)
        self._always = min(MOST_USE, own * sum(not tenant.is_bare for tenant in tenants))
        self._times = cache(self._stage_ns)
        self._infer_ms = cache(self._network_ms)
        self._speeds: dict[tuple[_Job, tuple[_Job, ...]], int] = {}
        self.mean_ms = tuple(self._means(number) for number in range(len(tenants)))

    def skips(self, number: int) -> Skips:
        """Return the rule by which frames of a tenant take the bypass."""
        tenant = self._tenants[number]
        return lambda frame, _fresh: tenant.kind(frame) == SKIPS

    def service(self, number: int) -> Service:
        """Return service times of a tenant when no other one runs."""
        tenant = self._tenants[number]

        def service(stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
            return self._times(_Job(number, max(tenant.kind(frame), 0)))[stage]

        return service

    def speed(self, job: Runs, others: Sequence[Runs]) -> int:
        """Return the speed of a job beside `others`: a network's by the bandwidth that they leave, `ONE` for others."""
        if job.stage != INFER[0]:
            return ONE
        beside = [other for other in others if self._competes(job, other)]
        if not beside:
            return ONE
        key = self._job(job), tuple(sorted(self._job(other) for other in beside))
        if key not in self._speeds:
            taken = self._always + sum(self._demand(other) for other in key[1])
            slow_ms = self._infer_ms(key[0], min(MOST_USE, taken))
            self._speeds[key] = round(ONE * self._infer_ms(key[0], self._always) / slow_ms)
        return self._speeds[key]

    @staticmethod
    def _competes(job: Runs, other: Runs) -> bool:
        return other.stage == INFER[0] and other.seat != job.seat

    def _job(self, runs: Runs) -> _Job:
        return _Job(runs.member, max(self._tenants[runs.member].kind(runs.frame), 0))

    def _demand(self, job: _Job) -> float:
        """Return the share of the bandwidth that a network takes while it runs."""
        tenant = self._tenants[job.tenant]
        bytes_s = moved_bytes(tenant.networks[job.kind], self._chips[job.tenant].units[tenant.unit])
        bytes_s /= self._infer_ms(job, self._always) / 1e3
        return bytes_s / (self._memory.bandwidth_gb_s.or_else(10.0) * 1e9)

    def _network_ms(self, job: _Job, use: float) -> float:
        """Return the milliseconds of a network while the share `use` of the bandwidth is taken."""
        return self._stages_ms(job, use)[INFER[0]]

    def _stages_ms(self, job: _Job, use: float) -> dict[str, float]:
        tenant, used = self._tenants[job.tenant], _used(self._chips[job.tenant], use)
        stretch, unit = self._stretches(job), used.units[tenant.unit]
        if tenant.is_bare:
            clock = unit.clock(self._corners[UNITS.index(tenant.unit)])
            time = time_on(unit, used.memory, tenant.networks[job.kind].work, clock, contended=True)
            return {INFER[0]: stretch * time.total_ms}
        whole, of_network = (stretch, 1.0) if unit.measured is not None else (1.0, stretch)
        times = stage_times_ms(used, tenant.plan(job.kind, of_network), self._corners)
        return {stage: whole * ms for (stage, _), ms in times.items()}

    def _stretch(self, job: _Job) -> float:
        """Return the factor on a network's time. Where the unit was measured, the other stages have it too."""
        if self._end == "expected":
            return 1.0
        tenant, chip = self._tenants[job.tenant], self._chips[job.tenant]
        work = tenant.networks[job.kind].work
        time = price(chip, work, tenant.unit, self._corners)
        around = interval(chip, work, time)
        return (around.low_ms if self._end == "low" else around.high_ms) / time.total_ms

    def _stage_ns(self, job: _Job) -> dict[str, int]:
        return {stage: round(ms * NS_PER_MS) for stage, ms in self._stages_ms(job, self._always).items()}

    def _means(self, number: int) -> dict[str, float]:
        """Return the mean milliseconds by stage over the frames with a network; the first network's if none has one."""
        kinds = [kind for kind in self._tenants[number].frames if kind != SKIPS] or [0]
        each = [self._times(_Job(number, kind)) for kind in kinds]
        return {stage: sum(times[stage] for times in each) / len(each) / NS_PER_MS for stage in each[0]}


def _used(profile: Profile, use: float) -> Profile:
    """Return the chip while others take the share `use` of its memory's bandwidth."""
    fraction = profile.memory.application_use_fraction.model_copy(update={"value": use})
    memory = profile.memory.model_copy(update={"application_use_fraction": fraction})
    return profile.model_copy(update={"memory": memory})


def moved_bytes(network: Network, unit: Unit) -> float:
    """Return the bytes that a network moves in a job on `unit`: the elements of every operator, and the weights once.

    A tensor engine moves only what does not stay on the chip.
    """
    work = network.work
    if unit.engine is not None:
        return float(sum(spilled(work.layers, numbers_of(unit.engine).room)) + work.weights) * unit.element_bytes
    return float(work.table[:, 1].sum() + work.weights) * unit.element_bytes


def predict_beside(
    profile: Profile,
    tenants: Sequence[Tenant],
    performance_profile: str = SUSTAINED,
    minutes: float = 0.0,
    governor: str | None = None,
    turns: str = ROUND_ROBIN,
) -> dict[str, Any]:
    """Return everything about the `tenants` on one chip: each one beside the others and alone, and the chip's units.

    `profile`: hardware profile of the chip.
    `performance_profile`: its name, one of PERFORMANCE_PROFILES.
    `minutes`: virtual time from a cold start; 0 for constant temperature.
    `governor`: name in GOVERNORS; None for the profile's own.
    `turns`: name in TURNS, the rule that chooses whose job a unit takes when several wait.
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
            _row(profile, tenants, number, now, corners, turns, _settled_ms(moments, at, number))
            for number in range(len(tenants))
        ],
        "units": {unit: _unit(unit, now, tenants) for unit in UNITS},
        "units_settled": {unit: _unit(unit, last, tenants) for unit in UNITS},
        "power_w": _mean([moment.power_w for moment in moments]) or sum(powers.values()) + _base_w(profile),
        "base_power_w": _base_w(profile),
        "base_power_kind": profile.thermal.base_power_w.kind,
        "unit_power_w": dict(powers),
        "temperature_c": temperatures_of(moments),
        "caps": {"throttled_share": _mean([float(moment.throttled) for moment in moments])},
        "notes": _notes(profile, tenants, turns),
    }


def _base_w(profile: Profile) -> float:
    return profile.thermal.base_power_w.or_else(0.0)


def _rate(
    profile: Profile, tenants: Sequence[Tenant], number: int, corners: Corners, turns: str
) -> dict[str, dict[str, Any]]:
    """Return `needs_ms` and `rate` of a pipeline; without an interval where this machine was not measured."""
    needs = needed(profile, tenants, number, corners, turns)
    rate = holding(tenants[number].fps, needs)
    if profile.name == HOST and profile.units[INFER[1]].measured is None:
        return {"needs_ms": {"mean": needs.ms, "low": None, "high": None}, "rate": without_interval(rate)}
    return {"needs_ms": {"mean": needs.ms, "low": needs.low_ms, "high": needs.high_ms}, "rate": rate}


def _row(
    profile: Profile,
    tenants: Sequence[Tenant],
    number: int,
    now: Together,
    corners: Corners,
    turns: str,
    settled_ms: float | None,
) -> dict[str, Any]:
    tenant = tenants[number]
    report, chip = now.runs[number].report, tenant.computes.on(profile, tenant.unit)
    alone = together(profile, [tenant], corners).runs[0].report
    return {
        "name": tenant.name,
        "source": tenant.source,
        "kind": "network" if tenant.is_bare else "avatar",
        "unit": tenant.unit,
        "numbers": tenant.computes.numbers,
        "precision": chip.units[tenant.unit].precision,
        "rate_fps": tenant.fps,
        "policy": tenant.variant.policy,
        "edge": tenant.variant.edge,
        **_kept(report),
        **_rate(profile, tenants, number, corners, turns),
        "frame_ms_settled": settled_ms or report["frame_time_ms"]["mean"],
        "alone": {**_kept(alone), **_rate(profile, [tenant], 0, corners, turns)},
        "stages": {stage: {**report["stages"][stage], "alone_ms": ms} for stage, ms in now.stages_ms[number].items()},
        "units": {
            unit: {"busy": row["busy"], "idle": row["idle"], "jobs": row["jobs"]}
            for unit, row in report["units"].items()
        },
    }


def _kept(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a run's report that is shown both for a run beside others and for a run alone.

    `in_time`: share of the released frames that were presented in time.
    """
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
    """Return the mean frame time of a pipeline in the last fifth of the time; None where no time passes."""
    last = last_fifth(moments)
    return _mean([at(each.corners).runs[number].report["frame_time_ms"]["mean"] for each in last]) or None


def _unit(unit: str, now: Together, tenants: Sequence[Tenant]) -> dict[str, Any]:
    by_name = {tenant.name: row[unit] for tenant, row in zip(tenants, now.by_tenant, strict=True)}
    return {"busy": now.busy[unit], "idle": 1 - now.busy[unit], "by_pipeline": by_name}


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
