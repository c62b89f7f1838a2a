"""Predicts several tenants on one chip: avatars, networks and pipeline files, each at its rate, with power and heat.

`tenants.py` computes the times of their jobs, and `trilane.scheduler.shared_units` decides whose job waits. This file
computes how much a network slows while other jobs use the memory. The network has the bandwidth that these jobs leave
(Gables, Hill and Reddi, 2019). Each avatar's camera, display and composition take `application_use_fraction` of the
bandwidth all the time. A network on another unit takes the bytes that it moves, spread over its time. Jobs of one unit
follow each other and never compete. A network that nothing slows has the time of `network_time.price`. Keys of the
prediction that mean the same as in report.json have the same names.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

from trilane.hw_profiles.governor import Moment, last_fifth, temperatures_of, unit_power_w, warm_up
from trilane.hw_profiles.host_model import UNMEASURED, is_known
from trilane.hw_profiles.pipeline_prediction import FED_FRAMES, Ends, over_ends, steady_ms
from trilane.hw_profiles.rates import FrameInterval, holding, wanted_drops
from trilane.hw_profiles.schema import Corners, Profile, corners_of
from trilane.hw_profiles.tenants import SharingPipeline
from trilane.scheduler.events import Stop
from trilane.scheduler.shared_units import ONE, ROUND_ROBIN, Member, Runs, simulate_beside
from trilane.scheduler.virtual import Simulation
from trilane.units import HOST, INFER, NS_PER_MS, NS_PER_S, SUSTAINED, UNITS

MOST_TENANTS = 8
#: Largest share of the bandwidth that other jobs can take, so that some is always left.
MOST_USE = 0.95
#: A run lasts at least LEAST_S virtual seconds and LEAST_FRAMES frames of the slowest tenant, but at most MOST_S.
LEAST_S, LEAST_FRAMES, MOST_S = 10.0, 64, 600.0


@dataclass(frozen=True)
class Together:
    """The settled state of several tenants, with each unit at one voltage corner, which fixes its clock.

    `runs`: simulated run of each tenant.
    `stages_ms`: for each tenant, the mean time of a job by stage if no network of another tenant ran.
    `busy`: share of the time in which each unit works for all tenants.
    `by_tenant`: for each tenant, the share of the time in which each unit works for this tenant.
    """

    runs: tuple[Simulation, ...]
    stages_ms: tuple[Mapping[str, float], ...]
    busy: Mapping[str, float]
    by_tenant: tuple[Mapping[str, float], ...]

    @property
    def frame_ms(self) -> float:
        """The mean frame time of the first tenant in ms."""
        mean: float = self.runs[0].report["frame_time_ms"]["mean"]
        return mean


def together(
    profile: Profile,
    tenants: Sequence[SharingPipeline],
    corners: Corners,
    turns: str = ROUND_ROBIN,
    *,
    keep: bool = False,
) -> Together:
    """Return the settled state of `tenants` on the chip `profile`, with its units at `corners`.

    `turns`: name in TURNS, the rule that chooses whose job a unit takes if several wait.
    `keep`: whether the steps and jobs of each run are recorded.
    """
    costs = _Costs(profile, tenants, corners)
    runs = _run(profile, tenants, costs, _seconds(tenants, costs), turns, keep=keep)
    seconds = max(run.report["duration_s"] for run in runs)
    shares: list[dict[str, float]] = [
        {unit: _busy_s(run, tenant, unit) / seconds for unit in UNITS}
        for run, tenant in zip(runs, tenants, strict=True)
    ]
    busy: dict[str, float] = {unit: sum(each[unit] for each in shares) for unit in UNITS}
    return Together(tuple(runs), costs.mean_ms, busy, tuple(shares))


def alone_ms(profile: Profile, tenant: SharingPipeline, corners: Corners) -> Mapping[str, float]:
    """Return the mean time in ms of a job by stage if only `tenant` runs, over its frames with a network."""
    return _Costs(profile, [tenant], corners).mean_ms[0]


def _run(
    profile: Profile,
    tenants: Sequence[SharingPipeline],
    costs: _Costs,
    seconds: float,
    turns: str,
    *,
    fed: int | None = None,
    keep: bool = False,
) -> Sequence[Simulation]:
    """Return the simulated runs of `tenants` for `seconds` of virtual time.

    `fed`: index of the tenant whose source is always ready; None: no such tenant.
    `keep`: whether the steps and jobs of each run are recorded.
    """
    stop = round(NS_PER_S * seconds), Stop()
    cores: dict[str, str] = {name: unit.core for name, unit in profile.units.items() if unit.core}
    display_ns = round(NS_PER_MS * profile.application.display_ms.or_else(0.0))
    members = []
    for number, tenant in enumerate(tenants):
        graph, settings = tenant.fed if number == fed else (tenant.graph, tenant.settings(display_ns))
        seats = {unit: cores.get(hardware, hardware) for unit, hardware in tenant.hardware.items()}
        members.append(Member(graph, settings, costs.jobs[number].service_ns, seats, tenant.skips, inputs=(stop,)))
    return simulate_beside(members, turns=turns, divided=list(cores.values()), speed=costs.speed, keep=keep)


def needed(
    profile: Profile, tenants: Sequence[SharingPipeline], number: int, corners: Corners, turns: str
) -> FrameInterval:
    """Return the least frame time of tenant `number`: its source is always ready, the other tenants have their rates.

    For a single tenant, the result is the same as in its own prediction, because the run has the same length.
    """

    def needs_ms(end: Ends) -> float:
        costs = _Costs(profile, tenants, corners, end)
        bound_ms = costs.jobs[number].bound_ms
        seconds = FED_FRAMES * (bound_ms or max(costs.mean_ms[number].values())) / 1e3
        if len(tenants) > 1:
            seconds = min(seconds, _seconds(tenants, costs))
        run = _run(profile, tenants, costs, seconds, turns, fed=number)[number]
        return max(bound_ms, steady_ms(run, round(NS_PER_S * seconds), tenants[number].repeats))

    return over_ends(needs_ms)


def _busy_s(run: Simulation, tenant: SharingPipeline, unit: str) -> float:
    """Return the busy time in seconds of the chip's unit `unit` in jobs of `tenant`."""
    rows = run.report["units"]
    own = [name for name, hardware in tenant.hardware.items() if hardware == unit and name in rows]
    return float(sum(rows[name]["busy"] for name in own) * run.report["duration_s"])


def _seconds(tenants: Sequence[SharingPipeline], costs: _Costs) -> float:
    """Return the length of the simulated runs in virtual seconds."""
    slowest = max(
        max(1 / tenant.fps, sum(means.values()) / 1e3) for tenant, means in zip(tenants, costs.mean_ms, strict=True)
    )
    return min(max(LEAST_S, LEAST_FRAMES * slowest), MOST_S)


class _Job(NamedTuple):
    """A job with a network: the index of its tenant, and the tenant's name for the network."""

    tenant: int
    network: Any


class _Costs:
    """The times of the tenants' jobs on the chip, and the speed of jobs beside each other."""

    def __init__(
        self, profile: Profile, tenants: Sequence[SharingPipeline], corners: Corners, end: Ends = "expected"
    ) -> None:
        own = profile.memory.application_use_fraction.or_else(0.0)
        self._always = min(MOST_USE, own * sum(tenant.takes_memory for tenant in tenants))
        self._bytes_s = profile.memory.bandwidth_gb_s.or_else(10.0) * 1e9
        self.jobs = tuple(tenant.on(profile, corners, end, self._always) for tenant in tenants)
        self._speeds: dict[tuple[_Job, tuple[_Job, ...]], int] = {}
        self.mean_ms = tuple(each.mean_ms for each in self.jobs)

    def speed(self, job: Runs, others: Sequence[Runs]) -> int:
        """Return the speed of a job beside `others`, in units of 1 / ONE; a job without a network is never slowed."""
        own = self._job(job)
        if own is None:
            return ONE
        beside = [found for other in others if other.seat != job.seat and (found := self._job(other)) is not None]
        if not beside:
            return ONE
        key = own, tuple(sorted(beside, key=str))
        if key not in self._speeds:
            taken = self._always + sum(map(self._demand, key[1]))
            slow_ms = self._ms(own, min(MOST_USE, taken))
            self._speeds[key] = round(ONE * self._ms(own, self._always) / slow_ms)
        return self._speeds[key]

    def _job(self, runs: Runs) -> _Job | None:
        network = self.jobs[runs.member].network(runs.stage, runs.frame)
        return None if network is None else _Job(runs.member, network)

    def _ms(self, job: _Job, use: float) -> float:
        return self.jobs[job.tenant].network_ms(job.network, use)

    def _demand(self, job: _Job) -> float:
        """Return the share of the bandwidth that the network of `job` takes while it runs, 0 to 1."""
        moved = self.jobs[job.tenant].moved_bytes(job.network)
        return moved / (self._ms(job, self._always) / 1e3) / self._bytes_s


def predict_beside(
    profile: Profile,
    tenants: Sequence[SharingPipeline],
    performance_profile: str = SUSTAINED,
    minutes: float = 0.0,
    governor: str | None = None,
    turns: str = ROUND_ROBIN,
) -> dict[str, Any]:
    """Return the prediction of `tenants` on one chip: each beside the others and by itself, and the chip's units.

    `profile`: hardware profile of the chip.
    `performance_profile`: one of PERFORMANCE_PROFILES.
    `minutes`: virtual time from a cold start; 0 for constant temperature.
    `governor`: name in GOVERNORS; None for the profile's governor.
    `turns`: name in TURNS, the rule that chooses whose job a unit takes if several wait.

    Raises BadInputError for an unknown performance profile, and, unless `minutes` is 0, as `warm_up` does.
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
        "temperature_c": temperatures_of(moments).as_json(),
        "caps": {"throttled_share": _mean([float(moment.throttled) for moment in moments])},
        "notes": _notes(profile, tenants, turns),
    }


def _base_w(profile: Profile) -> float:
    return profile.thermal.base_power_w.or_else(0.0)


def _rate(
    profile: Profile,
    tenants: Sequence[SharingPipeline],
    number: int,
    corners: Corners,
    turns: str,
    frames: Mapping[str, Any],
) -> dict[str, dict[str, Any]]:
    """Return the keys `needs_ms` and `rate` of tenant `number`; without an interval if the error is not known."""
    needs = needed(profile, tenants, number, corners, turns)
    if not (is_known(profile, INFER[1]) and tenants[number].on(profile, corners, "expected", 0.0).is_known):
        needs = FrameInterval(needs.ms)
    rate = holding(tenants[number].fps, needs, wanted_drops(frames["dropped"]), frames=frames["requested"])
    return {"needs_ms": {"mean": needs.ms, "low": needs.low_ms, "high": needs.high_ms}, "rate": rate.as_json()}


def _row(
    profile: Profile,
    tenants: Sequence[SharingPipeline],
    number: int,
    now: Together,
    corners: Corners,
    turns: str,
    settled_ms: float | None,
) -> dict[str, Any]:
    tenant = tenants[number]
    report = now.runs[number].report
    alone = together(profile, [tenant], corners).runs[0].report
    return {
        "name": tenant.name,
        "source": tenant.source,
        "kind": tenant.kind,
        "rate_fps": tenant.fps,
        **tenant.facts(profile),
        **_kept(report),
        **_rate(profile, tenants, number, corners, turns, report["frames"]),
        "frame_ms_settled": settled_ms or report["frame_time_ms"]["mean"],
        "alone": {**_kept(alone), **_rate(profile, [tenant], 0, corners, turns, alone["frames"])},
        "stages": {stage: {**report["stages"][stage], "alone_ms": ms} for stage, ms in now.stages_ms[number].items()},
        "units": {
            unit: {"hardware": tenant.hardware[unit], **{key: row[key] for key in ("busy", "idle", "jobs")}}
            for unit, row in report["units"].items()
        },
    }


def _kept(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a report that a prediction has for a tenant beside the others, and for the tenant by itself.

    The key `in_time` is the share of released frames that were presented in time, without the frames that `every`
    leaves out.
    """
    frames = report["frames"]
    wanted = frames["requested"] - sum(frames["dropped"].values()) + wanted_drops(frames["dropped"])
    return {
        "frames": {key: frames[key] for key in ("requested", "presented", "dropped")},
        **{key: report[key] for key in ("frame_time_ms", "latency_ms", "response_ms", "fps", "deadline_misses")},
        "in_time": (frames["presented"] - report["deadline_misses"]) / max(wanted, 1),
    }


def _settled_ms(moments: Sequence[Moment], at: Callable[[Corners], Together], number: int) -> float | None:
    """Return the mean frame time of tenant `number` in ms in the last fifth of the moments; None without moments."""
    last = last_fifth(moments)
    return _mean([at(each.corners).runs[number].report["frame_time_ms"]["mean"] for each in last]) or None


def _unit(unit: str, now: Together, tenants: Sequence[SharingPipeline]) -> dict[str, Any]:
    by_name = {tenant.name: row[unit] for tenant, row in zip(tenants, now.by_tenant, strict=True)}
    return {"busy": now.busy[unit], "idle": 1 - now.busy[unit], "by_pipeline": by_name}


def _notes(profile: Profile, tenants: Sequence[SharingPipeline], turns: str) -> list[str]:
    notes = [
        "frames are released from one instant on, each pipeline's at its own rate; response: from release to shown; "
        "a network's result is due when its next frame comes, any other frame three of its periods after its release"
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
