"""The whole application on a chip: a service time per stage, run through the real scheduler in virtual time.

Rule: what a frame costs is computed here, who waits for whom is the scheduler's business alone.

`REFERENCE` is the reference application's way of working: one buffer between stages, so that a frame is not drawn
before the network has let go of the buffer that it reads. Read-back holds the GPU; the hand-over holds the network's
unit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

from trilane.errors import BadInputError
from trilane.hw_profiles.network_work import CLASSES, Network, Work
from trilane.hw_profiles.operator_times import JobTime, job_time, machine_of
from trilane.hw_profiles.performance_profiles import Corners
from trilane.hw_profiles.reference_networks import CHANNELS_PER_PASS
from trilane.hw_profiles.schema import Profile, Unit
from trilane.scheduler.events import Graph, Settings, StageSpec
from trilane.scheduler.policy import POLICIES
from trilane.scheduler.virtual import simulate
from trilane.unexpected import UnexpectedValue
from trilane.units import UNITS, UnitName

RUNTIMES: tuple[UnitName, ...] = ("gpu", "dsp")
PACKED_BYTES_PER_PIXEL = 16
#: Frames of a simulated run: for shares of time, for a frame time alone, and where drops make intervals vary.
FRAMES, QUICK_FRAMES, FRAMES_WITH_DROPS = 192, 12, 480
NS_PER_MS = 1_000_000


class Way(NamedTuple):
    """How the stages are joined: scheduling policy, rule of every edge, frames per network job."""

    policy: str = "pipelined"
    edge: str = "single"
    batch: int = 1


REFERENCE = Way()


@dataclass(frozen=True)
class Plan:
    """One application on one chip. `gpu_share`: the part of the network's products that the GPU does for the DSP."""

    network: Network
    runtime: UnitName
    way: Way = REFERENCE
    gpu_share: float = 0.0

    def __post_init__(self) -> None:
        if self.runtime not in RUNTIMES:
            raise BadInputError("runtime", repr(self.runtime), "gpu or dsp")
        if self.way.policy not in POLICIES:
            raise BadInputError("policy", repr(self.way.policy), "one of " + ", ".join(POLICIES))
        if not 1 <= self.way.batch <= 64:
            raise BadInputError("batch", str(self.way.batch), "1 to 64")
        if not 0 <= self.gpu_share < 1 or (self.gpu_share and self.runtime == "gpu"):
            raise BadInputError("gpu-share", f"{self.gpu_share:g} on {self.runtime}", "0 to below 1, on the dsp")


def network_alone(profile: Profile, network: Network, runtime: UnitName, corners: Corners) -> JobTime:
    """The network run continuously with nothing beside it, as a benchmark does."""
    return _job(profile, network.work, runtime, corners, contended=False)


def _job(
    profile: Profile, work: Work, unit: UnitName, corners: Corners, *, contended: bool = True, batch: int = 1
) -> JobTime:
    clock = profile.units[unit].clock(corners[UNITS.index(unit)])
    return job_time(work, machine_of(profile.units[unit], profile.memory, clock, contended), batch)


def stage_times_ms(profile: Profile, plan: Plan, corners: Corners) -> dict[tuple[str, UnitName], float]:
    """(stage, unit) -> milliseconds for one job of each stage, in data-flow order. A job is `batch` frames."""
    app, drawn_on, batch = profile.application, plan.network, plan.way.batch
    cpu, gpu = (profile.units[u].clock(corners[UNITS.index(u)]) for u in ("cpu", "gpu"))
    passes = 1 if drawn_on.layout == "packed" else -(-drawn_on.channels // CHANNELS_PER_PASS)
    moved = drawn_on.pixels * (PACKED_BYTES_PER_PIXEL if drawn_on.layout == "packed" else CHANNELS_PER_PASS * passes)
    drawn = app.vertices.or_else(0) * app.raster_ns_per_vertex.or_else(0) * passes
    drawn += drawn_on.pixels * app.raster_ns_per_pixel.or_else(0) * -(-drawn_on.channels // CHANNELS_PER_PASS)
    raster = drawn / gpu + moved * app.readback_ns_per_byte.or_else(0)
    times: dict[tuple[str, UnitName], float] = {
        ("pose", "cpu"): batch * app.pose_ms.or_else(0) / cpu,
        ("raster", "gpu"): batch * raster / 1e6,
    }
    times |= _network_ms(profile, plan, corners)
    times["composite", "gpu"] = batch * app.composite_ms.or_else(0) / gpu
    times["present", "cpu"] = batch * app.present_ms.or_else(0) / cpu
    return times


def _network_ms(profile: Profile, plan: Plan, corners: Corners) -> dict[tuple[str, UnitName], float]:
    handover = profile.application.handover_ms.or_else(0)
    work, batch = plan.network.work, plan.way.batch
    if not plan.gpu_share:
        job = _job(profile, work, plan.runtime, corners, batch=batch)
        return {("infer", plan.runtime): handover + job.total_ms}
    head, tail = split_work(work, plan.gpu_share)
    return {
        ("infer_head", "gpu"): handover + _job(profile, head, "gpu", corners, batch=batch).total_ms,
        ("infer", "dsp"): handover + _job(profile, tail, "dsp", corners, batch=batch).total_ms,
    }


def split_work(work: Work, share: float) -> tuple[Work, Work]:
    """Cut after the first operators that do `share` of the products; what is alive there goes from one to the other."""
    done, cut = 0, 0
    for cut, operator in enumerate(work.operators, 1):  # noqa: B007
        done += operator.macs
        if done >= share * work.macs:
            break
    crossing = work.operators[cut - 1].live
    head = Work(work.operators[:cut], work.input_elements, work.input_tensors, crossing)
    return head, Work(work.operators[cut:], crossing, 1, work.output_elements)


@dataclass(frozen=True)
class Steady:
    """The application once it has settled. Shares of time sum to 1 per unit."""

    frame_ms: float
    latency_ms: float
    capped: bool
    unit_of: Mapping[str, UnitName]
    stages_ms: Mapping[str, float]
    busy: Mapping[str, float]
    idle: Mapping[str, Mapping[str, float]]


@lru_cache(maxsize=4096)
def _settled(times: tuple[tuple[str, UnitName, int], ...], way: Way, display_ns: int, quick: bool) -> tuple[Any, bool]:
    """Report of a run of `times`, and whether the display held it back."""
    stages = tuple(StageSpec(name, unit) for name, unit, _ in times)
    graph = Graph(stages, (way.edge,) * (len(stages) - 1), "composite")
    service = {name: ns for name, _, ns in times}
    paced = POLICIES[way.policy].paced
    regular = way.edge in ("single", "double") and not paced
    frames = (QUICK_FRAMES if quick else FRAMES) if regular else FRAMES_WITH_DROPS
    settings = Settings(frames, way.policy, period_ns=display_ns if paced else 0)
    report = _run(graph, settings, service)
    if paced or report["frame_time_ms"]["mean"] * NS_PER_MS >= display_ns:
        return report, False
    return _run(graph, Settings(frames, way.policy, period_ns=display_ns), service), True


def _run(graph: Graph, settings: Settings, service: Mapping[str, int]) -> Any:
    try:
        return simulate(graph, settings, lambda stage, _unit, _frame, _begin: service[stage]).report
    except ValueError as error:
        expected = error.expected if isinstance(error, UnexpectedValue) else str(error)
        raise BadInputError("edge", repr(graph.edges[0]), expected) from None


def steady(profile: Profile, plan: Plan, corners: Corners, *, quick: bool = False) -> Steady:
    """Frame time, latency and idleness with the units held at `corners`, by the scheduler in virtual time.

    `quick`: a short run, good for the frame time alone; the shares of time then count filling and draining.
    """
    times = stage_times_ms(profile, plan, corners)
    rounded = tuple((name, unit, round(ms * NS_PER_MS)) for (name, unit), ms in times.items())
    batch, display = plan.way.batch, profile.application.display_ms.or_else(0)
    report, capped = _settled(rounded, plan.way, round(batch * display * NS_PER_MS), quick)
    units = report["units"]
    frame = max(report["frame_time_ms"]["mean"], *times.values()) / batch
    return Steady(
        frame_ms=max(frame, display) if capped else frame,
        latency_ms=report["latency_ms"]["mean"],
        capped=capped,
        unit_of=dict(times.keys()),
        stages_ms={name: ms for (name, _), ms in times.items()},
        busy={unit: units[unit]["busy"] if unit in units else 0.0 for unit in UNITS},
        idle={unit: units[unit]["idle"] if unit in units else {"starved": 1.0} for unit in UNITS},
    )


def reference_frame_ms(profile: Profile, plan: Plan, corners: Corners) -> float:
    """Mean frame time of `REFERENCE` in closed form, for fitting: one buffer makes its three stages follow each other.

    A test holds it against the scheduler in virtual time.
    """
    times = stage_times_ms(profile, plan, corners)
    chain = sum(ms for (name, _), ms in times.items() if name not in ("pose", "present"))
    return max(profile.application.display_ms.or_else(0), chain)


def relative_error(job: JobTime, unit: Unit) -> float:
    """Expected relative error of `job`: each part by the number that it rests on, and the model's own beside them."""
    rests_on = {
        "fixed": unit.job_fixed_ms,
        "input": unit.input_ns_per_element,
        "weights": unit.efficiency.convolution_traffic,
        "fallback": unit.fallback_ns_per_element,
        "depthwise": unit.efficiency.depthwise_traffic,
        "pointwise": unit.efficiency.pointwise_traffic,
    }
    rests_on |= {kind: getattr(unit.efficiency, kind) for kind in CLASSES if kind not in rests_on}
    shares = {part: ms / job.total_ms for part, ms in job.parts.items()}
    variance = sum((shares[part] * quantity.relative_error) ** 2 for part, quantity in rests_on.items())
    return float((variance + unit.model_error_fraction.or_else(0.5) ** 2) ** 0.5)
