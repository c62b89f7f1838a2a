"""Several pipelines on one chip: avatars and bare networks, each at a rate, on the same units, memory and heat.

Rule: what a frame costs comes from `application.py`, who waits for whom from the cores of `trilane.scheduler.beside`;
here is only how much slower the memory makes a network while others use it too.

Memory. The bandwidth that a network has is what others leave over (Gables, Hill and Reddi, 2019), as it is in an
application alone. Each avatar's camera, display and composition take `application_use_fraction` all the time; and while
a network of another pipeline runs on another unit, that one's bytes over its time are taken too. What one unit does
never competes with itself: its jobs follow each other.

Heat. Each unit's power follows from how long all pipelines together keep it busy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

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
from trilane.hw_profiles.engine_times import numbers_of
from trilane.hw_profiles.network_work import Network
from trilane.hw_profiles.on_chip import spilled
from trilane.hw_profiles.performance_profiles import Corners
from trilane.hw_profiles.schema import Profile, Unit
from trilane.scheduler.beside import ONE, Member, Runs, simulate_beside
from trilane.scheduler.events import Graph, Settings, Stop, chain
from trilane.scheduler.policy import POLICIES
from trilane.scheduler.release import run_settings
from trilane.scheduler.turns import ROUND_ROBIN
from trilane.scheduler.virtual import Service, Simulation, Skips
from trilane.units import BYPASS, INFER, UNITS, UnitName

MOST_TENANTS = 8
#: Of the bandwidth, what others can take at most: something is always left.
MOST_USE = 0.95
#: Virtual seconds of a run, at least; and so many frames of the slowest tenant.
LEAST_S, LEAST_FRAMES, MOST_S = 10.0, 64, 600.0
#: How frames are taken if nothing else is asked for: the newest counts, as of a camera; a staler one is dropped.
NEWEST = Variant("latest", "double")
NS_PER_MS, NS_PER_S = 1_000_000, 1_000_000_000
ENDLESS = 1 << 40
SKIPS = -1


@dataclass(frozen=True)
class Tenant:
    """A pipeline that shares the chip with others.

    `name`: in reports; `source`: what was asked for. `networks`: one for each shape of its tensor and number of avatars
    in view. `frames`: of each frame, the place of its network in `networks`, or `SKIPS`; they begin anew after the last
    one. `unit`: of the network. `fps`: frames released a second. `variant`: how the stages are joined. `is_bare`:
    nothing but the network, whose result is due when the next frame comes. `avatars`: in view where each of `networks`
    runs; one in each if it is empty. Raises BadInputError for a unit or a rate out of range.
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

    def settings(self, display_ns: int) -> Settings:
        """Of its core: frames without end, at its rate. `display_ns`: an avatar is not shown more often."""
        policy = self.variant.policy
        limits: dict[str, Any] = {"in_queue": 0 if POLICIES[policy].newest else 1, "hang_ns": ENDLESS}
        period_ns = round(NS_PER_S / self.fps)
        if self.is_bare:
            return Settings(ENDLESS, policy, period_ns=period_ns, deadline_ns=period_ns, **limits)
        shown_ns = max(period_ns, display_ns)
        return run_settings(policy, ENDLESS, shown_ns, shown_ns, **limits)

    def plan(self, kind: int) -> Plan:
        """What runs in a frame whose network is the one at place `kind`."""
        return Plan(self.networks[kind], self.unit, self.variant, avatars=self.avatars[kind] if self.avatars else 1)

    def kind(self, frame: int) -> int:
        """The place of the frame's network, or SKIPS."""
        return self.frames[frame % len(self.frames)]


@dataclass(frozen=True)
class Together:
    """The pipelines once they have settled, at constant corners.

    `runs`: what the scheduler says of each. `stages_ms`: of each, mean time of a job by stage if nothing else ran.
    `busy`: share of the time in which each unit works, for all; `by_tenant`: for each.
    """

    runs: tuple[Simulation, ...]
    stages_ms: tuple[Mapping[str, float], ...]
    busy: Mapping[str, float]
    by_tenant: tuple[Mapping[str, float], ...]

    @property
    def frame_ms(self) -> float:
        """Of the first tenant."""
        mean: float = self.runs[0].report["frame_time_ms"]["mean"]
        return mean


def together(
    profile: Profile, tenants: Sequence[Tenant], corners: Corners, turns: str = ROUND_ROBIN, *, keep: bool = False
) -> Together:
    """The `tenants` on the chip `profile`, its units at `corners`.

    `turns`: whose job a unit takes that several wait for.
    `keep`: whether the steps and jobs of each are recorded.
    """
    costs = _Costs(profile, tenants, corners)
    stop = round(NS_PER_S * _seconds(tenants, costs)), Stop()
    seats: dict[str, str] = {unit: profile.units[unit].core or unit for unit in UNITS}
    display_ns = round(NS_PER_MS * profile.application.display_ms.or_else(0.0))
    members = [
        Member(
            tenant.graph, tenant.settings(display_ns), costs.service(number), seats, costs.skips(number), inputs=(stop,)
        )
        for number, tenant in enumerate(tenants)
    ]
    cores = [unit.core for unit in profile.units.values() if unit.core]
    runs = simulate_beside(members, turns=turns, divided=cores, speed=costs.speed, keep=keep)
    seconds = max(run.report["duration_s"] for run in runs)
    shares: list[dict[str, float]] = [{unit: _busy_s(run, unit) / seconds for unit in UNITS} for run in runs]
    busy: dict[str, float] = {unit: sum(each[unit] for each in shares) for unit in UNITS}
    return Together(tuple(runs), costs.mean_ms, busy, tuple(shares))


def _busy_s(run: Simulation, unit: str) -> float:
    seconds: float = run.report["units"].get(unit, {"busy": 0.0})["busy"] * run.report["duration_s"]
    return seconds


def _seconds(tenants: Sequence[Tenant], costs: _Costs) -> float:
    """How long the run lasts."""
    slowest = max(
        max(1 / tenant.fps, sum(means.values()) / 1e3) for tenant, means in zip(tenants, costs.mean_ms, strict=True)
    )
    return min(max(LEAST_S, LEAST_FRAMES * slowest), MOST_S)


class _Job(NamedTuple):
    """A network: number of its tenant, place among the networks of that one."""

    tenant: int
    kind: int


class _Costs:
    """What the jobs of the pipelines take on the chip, and how they slow each other."""

    def __init__(self, profile: Profile, tenants: Sequence[Tenant], corners: Corners) -> None:
        self._profile, self._tenants, self._corners = profile, tenants, corners
        own = profile.memory.application_use_fraction.or_else(0.0)
        self._always = min(MOST_USE, own * sum(not tenant.is_bare for tenant in tenants))
        self._times = cache(self._stage_ns)
        self._infer_ms = cache(self._network_ms)
        self._speeds: dict[tuple[_Job, tuple[_Job, ...]], int] = {}
        self.mean_ms = tuple(self._means(number) for number in range(len(tenants)))

    def skips(self, number: int) -> Skips:
        """Which frames of a tenant take the bypass."""
        tenant = self._tenants[number]
        return lambda frame, _fresh: tenant.kind(frame) == SKIPS

    def service(self, number: int) -> Service:
        """The service times of a tenant, beside nobody."""
        tenant = self._tenants[number]

        def service(stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
            return self._times(_Job(number, max(tenant.kind(frame), 0)))[stage]

        return service

    def speed(self, job: Runs, others: Sequence[Runs]) -> int:
        """Of a network's job beside `others`, by what they leave of the memory's bandwidth; of any other job, `ONE`."""
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
        """The share of the bandwidth that a network takes while it runs."""
        tenant = self._tenants[job.tenant]
        bytes_s = moved_bytes(tenant.networks[job.kind], self._profile.units[tenant.unit])
        bytes_s /= self._infer_ms(job, self._always) / 1e3
        return bytes_s / (self._profile.memory.bandwidth_gb_s.or_else(10.0) * 1e9)

    def _network_ms(self, job: _Job, use: float) -> float:
        """Of a network while the share `use` of the bandwidth is taken."""
        return self._stages_ms(job, use)[INFER[0]]

    def _stages_ms(self, job: _Job, use: float) -> dict[str, float]:
        tenant = self._tenants[job.tenant]
        used, plan = _used(self._profile, use), tenant.plan(job.kind)
        times = {stage: ms for (stage, _), ms in stage_times_ms(used, plan, self._corners).items()}
        if not tenant.is_bare:
            return times
        return {INFER[0]: times[INFER[0]] - self._profile.application.handover_ms.or_else(0.0)}

    def _stage_ns(self, job: _Job) -> dict[str, int]:
        return {stage: round(ms * NS_PER_MS) for stage, ms in self._stages_ms(job, self._always).items()}

    def _means(self, number: int) -> dict[str, float]:
        """Mean over the frames that have a network, by stage; of the first network where none has one."""
        kinds = [kind for kind in self._tenants[number].frames if kind != SKIPS] or [0]
        each = [self._times(_Job(number, kind)) for kind in kinds]
        return {stage: sum(times[stage] for times in each) / len(each) / NS_PER_MS for stage in each[0]}


def _used(profile: Profile, use: float) -> Profile:
    """The chip while others take the share `use` of its memory's bandwidth."""
    fraction = profile.memory.application_use_fraction.model_copy(update={"value": use})
    memory = profile.memory.model_copy(update={"application_use_fraction": fraction})
    return profile.model_copy(update={"memory": memory})


def moved_bytes(network: Network, unit: Unit) -> float:
    """Bytes that a network reads and writes in a job on `unit`: every operator's elements, and the weights once.

    On a tensor engine only what does not stay on the chip.
    """
    work = network.work
    if unit.engine is not None:
        return float(sum(spilled(work.layers, numbers_of(unit.engine).room)) + work.weights) * unit.element_bytes
    return float(work.table[:, 1].sum() + work.weights) * unit.element_bytes
