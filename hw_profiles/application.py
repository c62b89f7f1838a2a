"""Predicts the whole application on a chip: service times of its stages, run by the real scheduler in virtual time.

This file computes the time of each stage for a frame; only the scheduler decides which stage waits for which.
`REFERENCE` describes the reference application. It has one slot between stages, so a frame is drawn only after the
network has released that slot. The GPU is busy during read-back, and the network's unit during the hand-over.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

from trilane.errors import BadInputError
from trilane.hw_profiles.network_work import Network, Work
from trilane.hw_profiles.reference_networks import CHANNELS_PER_PASS
from trilane.hw_profiles.schema import Corners, Profile
from trilane.hw_profiles.unit_times import JobTime, time_on
from trilane.scheduler.events import Graph, Settings, chain
from trilane.scheduler.ledger import NAMES, PREEMPTED, STARVED
from trilane.scheduler.policy import POLICIES, run_settings
from trilane.scheduler.virtual import Simulation, simulate
from trilane.transport.slots import DEFAULT_EDGE
from trilane.unexpected_value import UnexpectedValue
from trilane.units import AFTER_INFER, BEFORE_INFER, INFER, LATENCY_TO, NS_PER_MS, TARGET_FPS, UNITS, UnitName

NETWORK_UNITS: tuple[UnitName, ...] = ("gpu", "dsp")
PACKED_BYTES_PER_PIXEL = 16
#: Frames of a simulated run: for shares of time, for only a frame time, and for runs that drop frames or have long
#: queues, which take many frames to fill.
FRAMES, QUICK_FRAMES, MOST_FRAMES = 192, 12, 480
#: (stage, unit, time of a job in ns) for each stage, in data-flow order.
StageTimes = tuple[tuple[str, UnitName, int], ...]
LEAST_FPS, MOST_FPS = 1e-3, 1000.0  # a scene has the same limits


class Variant(NamedTuple):
    """How the stages are connected and scheduled.

    `policy`: policy of the scheduler.
    `edge`: rule of every edge between stages.
    `batch`: frames per job, 1 to 64.
    `fps`: rate of the scene in frames a second; `latest` and `deadline` release frames at this rate, but no faster than
    the display shows them.
    """

    policy: str = "pipelined"
    edge: str = "single"
    batch: int = 1
    fps: float = TARGET_FPS


REFERENCE = Variant()


@dataclass(frozen=True)
class Plan:
    """One application on one chip.

    `network`: network that runs.
    `unit`: unit that runs it, gpu or dsp.
    `variant`: how the stages are connected and scheduled.
    `gpu_share`: share of the network's products that the GPU does while the DSP does the rest, 0 to below 1.
    `most_fps`: largest rate of shown frames, as if a display had this rate; None for the display of the profile.
    `stretch`: factor on the network's expected time.
    `avatars`: number of avatars in view; they share one tensor.
    `meshes`: vertices of all avatars in view, counted in whole meshes; None if every avatar has its whole mesh.

    Raises BadInputError for a value outside its range.
    """

    network: Network
    unit: UnitName
    variant: Variant = REFERENCE
    gpu_share: float = 0.0
    most_fps: float | None = None
    stretch: float = 1.0
    avatars: int = 1
    meshes: float | None = None

    def __post_init__(self) -> None:
        if self.unit not in NETWORK_UNITS:
            raise BadInputError("unit", repr(self.unit), "gpu or dsp")
        if self.variant.policy not in POLICIES:
            raise BadInputError("policy", repr(self.variant.policy), "one of " + ", ".join(POLICIES))
        if not 1 <= self.variant.batch <= 64:
            raise BadInputError("batch", str(self.variant.batch), "1 to 64")
        if not LEAST_FPS <= self.variant.fps <= MOST_FPS:
            raise BadInputError("fps", f"{self.variant.fps:g}", f"{LEAST_FPS:g} to {MOST_FPS:g}")
        if self.most_fps is not None and not LEAST_FPS <= self.most_fps <= MOST_FPS:
            raise BadInputError("fps", f"{self.most_fps:g}", f"{LEAST_FPS:g} to {MOST_FPS:g}")
        if self.avatars < 1:
            raise BadInputError("avatars", str(self.avatars), "at least 1")
        if not 0 <= self.gpu_share < 1 or (self.gpu_share and self.unit == "gpu"):
            raise BadInputError("gpu-share", f"{self.gpu_share:g} on {self.unit}", "0 to below 1, on the dsp")


def isolated_job_time(profile: Profile, network: Network, unit: UnitName, corners: Corners) -> JobTime:
    """Return the time of a job of one frame when only the network runs, without a pause, as in a benchmark.

    `profile`: hardware profile of the chip.
    `network`: network that runs.
    `unit`: unit that runs it.
    `corners`: corner of each unit.
    """
    return _job(profile, network.work, unit, corners, contended=False)


def _job(
    profile: Profile, work: Work, unit: UnitName, corners: Corners, *, contended: bool = True, batch: int = 1
) -> JobTime:
    """Return the time of a job; `contended`: the rest of the application uses the memory at the same time."""
    clock = profile.units[unit].clock(corners[UNITS.index(unit)])
    return time_on(profile.units[unit], profile.memory, work, clock, contended=contended, batch=batch)


def stage_times_ms(profile: Profile, plan: Plan, corners: Corners) -> dict[tuple[str, UnitName], float]:
    """Return the time of one job in ms, by (stage, unit), in data-flow order.

    A job has `plan.variant.batch` frames. The pose time is proportional to the avatars in view. The raster time depends
    on the vertices that are drawn, and on the pixels of the tensor that all avatars share. Unknown values in the
    profile's `application` table count as 0.

    `corners`: corner of each unit, in the order of `UNITS`.
    """
    app, network, batch = profile.application, plan.network, plan.variant.batch
    cpu, gpu = (profile.units[u].clock(corners[UNITS.index(u)]) for u in ("cpu", "gpu"))
    passes = 1 if network.layout == "packed" else -(-network.channels // CHANNELS_PER_PASS)
    moved_bytes = network.pixels * (
        PACKED_BYTES_PER_PIXEL if network.layout == "packed" else CHANNELS_PER_PASS * passes
    )
    meshes = plan.avatars if plan.meshes is None else plan.meshes
    draw_ns = meshes * app.vertices.or_else(0) * app.raster_ns_per_vertex.or_else(0) * passes
    draw_ns += network.pixels * app.raster_ns_per_pixel.or_else(0) * -(-network.channels // CHANNELS_PER_PASS)
    raster_ns = draw_ns / gpu + moved_bytes * app.readback_ns_per_byte.or_else(0)
    times: dict[tuple[str, UnitName], float] = {
        ("pose", "cpu"): batch * plan.avatars * app.pose_ms.or_else(0) / cpu,
        ("raster", "gpu"): batch * raster_ns / 1e6,
    }
    times |= _network_ms(profile, plan, corners)
    times["composite", "gpu"] = batch * app.composite_ms.or_else(0) / gpu
    times["present", "cpu"] = batch * app.present_ms.or_else(0) / cpu
    return times


def _network_ms(profile: Profile, plan: Plan, corners: Corners) -> dict[tuple[str, UnitName], float]:
    handover = profile.application.handover_ms.or_else(0)
    work, batch = plan.network.work, plan.variant.batch
    if not plan.gpu_share:
        job = _job(profile, work, plan.unit, corners, batch=batch)
        return {("infer", plan.unit): handover + plan.stretch * job.total_ms}
    head, tail = split_work(work, plan.gpu_share)
    return {
        ("infer_head", "gpu"): handover + plan.stretch * _job(profile, head, "gpu", corners, batch=batch).total_ms,
        ("infer", "dsp"): handover + plan.stretch * _job(profile, tail, "dsp", corners, batch=batch).total_ms,
    }


def split_work(work: Work, share: float) -> tuple[Work, Work]:
    """Return (fewest first operators of `work` that do at least `share` of its products, the other operators)."""
    macs, cut = 0, 0
    for cut, operator in enumerate(work.operators, 1):  # noqa: B007
        macs += operator.macs
        if macs >= share * work.macs:
            break
    crossing = work.operators[cut - 1].live  # what later operators still need goes to the second part
    head = Work(work.operators[:cut], work.input_elements, work.input_tensors, crossing)
    rest = work.operators[cut:]
    layers = work.layers.since(rest[0].name if rest else "", crossing)
    return head, Work(rest, crossing, 1, work.output_elements, layers)


@dataclass(frozen=True)
class Steady:
    """The application in its settled state.

    `busy` and the causes of `idle` add up to 1 for each unit. If units share a core, `preempted` is the share of time
    in which another unit works on this core.

    `frame_ms`: mean frame time.
    `latency_ms`: mean latency; None if no frame is presented.
    `capped`: whether the display, or its rate in the plan, limits the rate.
    `unit_of`: unit of each stage.
    `stages_ms`: time of a job of each stage in ms.
    `busy`: share of the time in which each unit works.
    `idle`: share of the time in which each unit is idle, by unit and cause.
    `dropped`: share of the frames that are not shown.
    """

    frame_ms: float
    latency_ms: float | None
    capped: bool
    unit_of: Mapping[str, UnitName]
    stages_ms: Mapping[str, float]
    busy: Mapping[str, float]
    idle: Mapping[str, Mapping[str, float]]
    dropped: float


def application_graph(edge: str = DEFAULT_EDGE, infer: Iterable[tuple[str, str]] = (INFER,)) -> Graph:
    """Return the avatar's pipeline with the same rule on every edge. `infer`: the network's stages and their units."""
    return chain((*BEFORE_INFER, *infer, *AFTER_INFER), edge, LATENCY_TO)


@lru_cache(maxsize=4096)
def _settled(times: StageTimes, variant: Variant, display_ns: int, quick: bool) -> tuple[Any, bool]:
    """Return (report of a run, whether the display limits its rate).

    `display_ns`: shortest time between two shown jobs.
    `quick`: whether to run only QUICK_FRAMES with one slot between stages. With more slots, frames come faster until
    the slots are full, so more frames are needed.
    """
    frames = _frames_of(variant, quick)
    report = _simulated(times, variant, settings_of(variant, frames, display_ns)).report
    # The display does not limit a run that is slower than the display, or that has its own rate.
    if POLICIES[variant.policy].paced or report["frame_time_ms"]["mean"] * NS_PER_MS >= display_ns:
        return report, False
    return _simulated(times, variant, settings_of(variant, frames, display_ns, held=True)).report, True


def _frames_of(variant: Variant, quick: bool) -> int:
    """Return how many frames are simulated. `quick`: as in `_settled`."""
    if variant.edge not in ("single", "double") or POLICIES[variant.policy].paced:
        return MOST_FRAMES
    return QUICK_FRAMES if quick and variant.edge == "single" else FRAMES


def settings_of(variant: Variant, frames: int, display_ns: int, *, held: bool = False) -> Settings:
    """Return the scheduler's settings of a simulated run.

    `variant`: policy and rate of the scene.
    `frames`: number of jobs of each stage.
    `display_ns`: shortest time between two shown jobs.
    `held`: whether jobs are released at the display's rate under every policy.
    """
    scene_period_ns = max(display_ns, round(variant.batch * 1e9 / variant.fps))
    return run_settings(variant.policy, frames, scene_period_ns, display_ns if held else 0)


def _simulated(times: StageTimes, variant: Variant, settings: Settings, *, keep: bool = False) -> Simulation:
    """Return a simulated run whose jobs take `times`. Raises BadInputError for an unknown edge."""
    service = {name: ns for name, _, ns in times}
    try:
        graph = chain(((name, unit) for name, unit, _ in times), variant.edge, LATENCY_TO)
        return simulate(graph, settings, lambda stage, _unit, _frame, _begin: service[stage], keep=keep)
    except ValueError as error:
        expected = error.expected if isinstance(error, UnexpectedValue) else str(error)
        raise BadInputError("edge", repr(variant.edge), expected) from None


def simulated(profile: Profile, plan: Plan, corners: Corners) -> Simulation:
    """Return the run in virtual time from which `steady` takes its figures, with its recording and its jobs.

    The parameters and the errors are as in `steady`.
    """
    times, display_ns = _rounded(profile, plan, corners), _display_ns(profile, plan)
    _, held = _settled(times, plan.variant, display_ns, quick=False)
    settings = settings_of(plan.variant, _frames_of(plan.variant, quick=False), display_ns, held=held)
    return _simulated(times, plan.variant, settings, keep=True)


def _rounded(profile: Profile, plan: Plan, corners: Corners) -> StageTimes:
    """Return the time of a job of each stage in whole ns, with the unit that `workers_of` gives."""
    worker = workers_of(profile)
    times = stage_times_ms(profile, plan, corners)
    return tuple((name, worker[unit], round(ms * NS_PER_MS)) for (name, unit), ms in times.items())


def _display_ms(profile: Profile, plan: Plan) -> float:
    """Return the shortest time between two shown frames in ms."""
    return max(profile.application.display_ms.or_else(0), 1e3 / (plan.most_fps or math.inf))


def _display_ns(profile: Profile, plan: Plan) -> int:
    """Return the shortest time between two shown jobs in ns."""
    return round(plan.variant.batch * _display_ms(profile, plan) * NS_PER_MS)


def steady(profile: Profile, plan: Plan, corners: Corners, *, quick: bool = False) -> Steady:
    """Return frame time, latency and shares of time, from a run of the scheduler in virtual time.

    `profile`: hardware profile of the chip.
    `plan`: application that runs on it.
    `corners`: constant corner of each unit.
    `quick`: whether to simulate a short run if that is possible. The frame time of a short run is right to a hundredth;
    its shares of time include the filling and emptying of the pipeline.

    Raises BadInputError for an unknown edge.
    """
    times, worker = stage_times_ms(profile, plan, corners), workers_of(profile)
    batch, display = plan.variant.batch, _display_ms(profile, plan)
    rounded = _rounded(profile, plan, corners)
    report, capped = _settled(rounded, plan.variant, _display_ns(profile, plan), quick)
    shares = {unit: _shares(unit, worker, times, report["units"]) for unit in UNITS}
    frame = max(report["frame_time_ms"]["mean"], *times.values()) / batch
    return Steady(
        frame_ms=max(frame, display) if capped else frame,
        latency_ms=report["latency_ms"]["mean"] if report["frames"]["presented"] else None,
        capped=capped,
        unit_of=dict(times.keys()),
        stages_ms={name: ms for (name, _), ms in times.items()},
        busy={unit: busy for unit, (busy, _) in shares.items()},
        idle={unit: idle for unit, (_, idle) in shares.items()},
        dropped=1 - report["frames"]["presented"] / report["frames"]["requested"],
    )


def workers_of(profile: Profile) -> dict[UnitName, UnitName]:
    """Return, for each unit, the unit that stands for it in the scheduler.

    Units on one core work in turns, so the first unit of a core stands for all of its units.
    """
    first: dict[str, UnitName] = {}
    return {unit: first.setdefault(profile.units[unit].core or unit, unit) for unit in UNITS}


def _shares(
    unit: UnitName,
    worker: Mapping[UnitName, UnitName],
    times: Mapping[tuple[str, UnitName], float],
    units: Mapping[str, Any],
) -> tuple[float, dict[str, float]]:
    """Return (busy share of `unit`, shares of its idle time by cause).

    Units with the same worker divide its busy time in proportion to the times of their jobs in ms, `times`.
    """
    own, together = (
        sum(ms for (_, other), ms in times.items() if other in group)
        for group in ({unit}, {each for each in UNITS if worker[each] == worker[unit]})
    )
    if not own:
        return 0.0, {NAMES[STARVED]: 1.0}
    share = units[worker[unit]]
    busy = share["busy"] * own / together
    preempted = {PREEMPTED: share["busy"] - busy} if own < together else {}
    return busy, {**share["idle"], **preempted}


def reference_frame_ms(profile: Profile, plan: Plan, corners: Corners) -> float:
    """Return the mean frame time in ms of the variant `REFERENCE`, computed without the scheduler, for fits.

    With one slot between stages, raster, network and composite follow each other. Therefore the frame time is the sum
    of their times, but at least the display's interval. A test compares the result with the scheduler in virtual time.
    """
    times = stage_times_ms(profile, plan, corners)
    chain = sum(ms for (name, _), ms in times.items() if name not in ("pose", "present"))
    return max(profile.application.display_ms.or_else(0), chain)
