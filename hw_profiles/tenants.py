"""Tenants, the pipelines that share a chip: scenes, networks and pipeline files, with the times of their jobs.

    jobs = tenant.on(profile, corners, "expected", 0.1)
    jobs.service_ns("infer", "dsp", 7, 0), jobs.mean_ms

Rule: a tenant knows only its own stages and times. `shared_chip.py` computes how tenants slow each other. It asks which
network each job computes, and how long a network takes with less bandwidth.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

from trilane.errors import BadInputError
from trilane.hw_profiles.application import (
    LEAST_FPS,
    MOST_FPS,
    NETWORK_UNITS,
    Plan,
    Variant,
    application_graph,
    stage_times_ms,
)
from trilane.hw_profiles.graph_file import GraphFile
from trilane.hw_profiles.network_time import AS_IT_SAYS, Computes, interval, price
from trilane.hw_profiles.network_work import Network, Work
from trilane.hw_profiles.pipeline_prediction import (
    NEVER_HANGS_NS,
    Drawn,
    Ends,
    always_fed,
    factors_at,
    fed_bound_ms,
    holding_back,
    prices_of,
    repeats_after,
)
from trilane.hw_profiles.schema import Corners, Profile, Unit
from trilane.hw_profiles.unit_times import numbers_of, spilled, time_on
from trilane.pipeline.file_graph import edge_rules, graph_of, settings_of
from trilane.pipeline.file_keys import OnnxStage
from trilane.pipeline.pipeline_file import PipelineFile
from trilane.scheduler.events import Graph, Settings, chain
from trilane.scheduler.policy import POLICIES, run_settings
from trilane.transport.slots import DEFAULT_EDGE
from trilane.units import BYPASS, INFER, NS_PER_MS, NS_PER_S, UNITS, UnitName

#: The default: only the newest frame counts, as with a camera; an older frame is dropped.
NEWEST = Variant("latest", DEFAULT_EDGE)
ENDLESS = 1 << 40
SKIPS = -1


def check_rate(name: str, fps: float) -> None:
    """Raise BadInputError if `fps`, frames a second, is out of range. `name`: name of the tenant, for the message."""
    if not LEAST_FPS <= fps <= MOST_FPS:
        raise BadInputError(f"{name}: rate", f"{fps:g}", f"{LEAST_FPS:g} to {MOST_FPS:g} frames a second")


@dataclass(frozen=True)
class Tenant:
    """An avatar, or a network by itself, as a `SharingPipeline`.

    `name`: name in reports.
    `source`: text of the user's request.
    `networks`: one network for each combination of tensor shape, number of avatars in view and levels of their meshes.
    `frames`: for each frame, the index of its network in `networks`, or `SKIPS`; after its end the list starts over.
    `fps`: frames that are released a second.
    `unit`: unit of the network.
    `variant`: how the stages are connected and scheduled.
    `is_bare`: whether it consists only of the network, whose result is due when the next frame comes.
    `avatars`: number of avatars in view for each of `networks`; empty for one avatar each.
    `meshes`: for each of `networks`, the vertices in view, counted in whole meshes; empty if all meshes are whole.
    `computes`: precision and runtime of the networks.

    Raises BadInputError for a unit or a rate out of range.
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
    meshes: tuple[float, ...] = ()
    computes: Computes = AS_IT_SAYS

    def __post_init__(self) -> None:
        if self.unit not in NETWORK_UNITS:
            raise BadInputError(f"{self.name}: unit", repr(self.unit), " or ".join(NETWORK_UNITS))
        check_rate(self.name, self.fps)

    @property
    def kind(self) -> str:
        """The kind in reports: avatar, network or pipeline."""
        return "network" if self.is_bare else "avatar"

    @property
    def takes_memory(self) -> bool:
        """Whether its camera, display and composition use the memory all the time."""
        return not self.is_bare

    @property
    def repeats(self) -> int:
        """The number of frames after which its jobs are the same again."""
        return len(self.frames)

    @property
    def hardware(self) -> Mapping[str, str]:
        """The chip's unit for each unit of the pipeline; its own name for a unit that is not on the chip."""
        return {unit: unit for unit in UNITS}

    @property
    def graph(self) -> Graph:
        """The graph for the scheduler."""
        name, _ = INFER
        if self.is_bare:
            return chain([(name, self.unit)], self.variant.edge, name)
        return replace(application_graph(self.variant.edge, [(name, self.unit)]), bypass=BYPASS)

    @property
    def fed(self) -> tuple[Graph, Settings]:
        """(Graph, settings) for a run whose source is always ready and in which no frame is dropped."""
        policy = self.variant.policy
        settings = Settings(ENDLESS, Variant().policy if POLICIES[policy].paced else policy, hang_ns=ENDLESS)
        return holding_back(self.graph), settings

    def settings(self, display_ns: int) -> Settings:
        """Return the settings of its scheduler for endless frames at its rate.

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
        """Return the application with the network `networks[kind]`. `stretch`: factor on the network's time."""
        avatars = self.avatars[kind] if self.avatars else 1
        meshes = self.meshes[kind] if self.meshes else None
        return Plan(self.networks[kind], self.unit, self.variant, avatars=avatars, meshes=meshes, stretch=stretch)

    def place(self, frame: int) -> int:
        """Return the index into `networks` of the network of `frame`; SKIPS if the frame takes the bypass."""
        return self.frames[frame % len(self.frames)]

    def skips(self, frame: int, is_fresh: bool) -> bool:  # noqa: ARG002 an older result is never shown again here
        """Return whether a frame takes the bypass of the graph. `is_fresh`: whether its job is fresh."""
        return self.place(frame) == SKIPS

    def on(self, profile: Profile, corners: Corners, end: Ends, always: float) -> _AvatarJobs:
        """Return the times of its jobs on the chip `profile`.

        `corners`: corner of each unit of the chip.
        `end`: expected times, or one end of their intervals.
        `always`: share of the memory's bandwidth that is taken all the time, 0 to 1.

        Raises BadInputError if the chip has no tensor engine for the requested precision and runtime.
        """
        return _AvatarJobs(self, self.computes.on(profile, self.unit), corners, end, always)

    def facts(self, profile: Profile) -> dict[str, Any]:
        """Return a prediction's keys `unit`, `numbers`, `precision`, `policy` and `edge` for this pipeline."""
        return {
            "unit": self.unit,
            "numbers": self.computes.numbers,
            "precision": self.computes.on(profile, self.unit).units[self.unit].precision,
            "policy": self.variant.policy,
            "edge": self.variant.edge,
        }


class _AvatarJobs:
    """The times of a tenant's jobs on a chip, with its units at given corners, if no other tenant runs.

    The name of a network is its index in `Tenant.networks`.

    `chip`: hardware profile in the precision and under the runtime of the networks.
    `mean_ms`: mean time of a job by stage.
    `bound_ms`: lower bound on the frame time if the source is always ready; 0 if none is known.
    `is_known`: whether the error of every time is known.
    """

    is_known = True
    bound_ms = 0.0

    def __init__(self, tenant: Tenant, chip: Profile, corners: Corners, end: Ends, always: float) -> None:
        self._tenant, self._chip, self._corners, self._end = tenant, chip, corners, end
        self._always, self._stages_ms = always, cache(self._made_ms)
        kinds = [kind for kind in tenant.frames if kind != SKIPS] or [0]
        each = [self._stages_ms(kind, always) for kind in kinds]
        # The mean over the frames with a network; if no frame has one, the times of the first network.
        self.mean_ms = {stage: sum(times[stage] for times in each) / len(each) for stage in each[0]}

    def service_ns(self, stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
        """Return the time in ns of the job of `stage` for `frame`."""
        return round(self._stages_ms(self._kind(frame), self._always)[stage] * NS_PER_MS)

    def network(self, stage: str, frame: int) -> Hashable | None:
        """Return a name for the network that the job of `stage` for `frame` computes; None if it computes none."""
        return self._kind(frame) if stage == INFER[0] else None

    def network_ms(self, network: int, use: float) -> float:
        """Return the time of a job with `network` in ms, while other jobs take the share `use` of the bandwidth."""
        return self._stages_ms(network, use)[INFER[0]]

    def moved_bytes(self, network: int) -> float:
        """Return the bytes that `network` moves in a job."""
        tenant = self._tenant
        return moved_bytes(tenant.networks[network].work, self._chip.units[tenant.unit])

    def _kind(self, frame: int) -> int:
        return max(self._tenant.place(frame), 0)

    def _made_ms(self, kind: int, use: float) -> dict[str, float]:
        tenant, used = self._tenant, _used(self._chip, use)
        stretch, unit = self._stretch(tenant.networks[kind].work), used.units[tenant.unit]
        if tenant.is_bare:
            clock = unit.clock(self._corners[UNITS.index(tenant.unit)])
            time = time_on(unit, used.memory, tenant.networks[kind].work, clock, contended=True)
            return {INFER[0]: stretch * time.total_ms}
        # If the unit was measured, the other stages were measured together with it, so they have the same error.
        whole, of_network = (stretch, 1.0) if unit.measured is not None else (1.0, stretch)
        times = stage_times_ms(used, tenant.plan(kind, of_network), self._corners)
        return {stage: whole * ms for (stage, _), ms in times.items()}

    def _stretch(self, work: Work) -> float:
        """Return the factor that turns a network's expected time into the time at the chosen end of its interval."""
        if self._end == "expected":
            return 1.0
        time = price(self._chip, work, self._tenant.unit, self._corners)
        around = interval(self._chip, work, time)
        return (around.low_ms if self._end == "low" else around.high_ms) / time.total_ms


@dataclass(frozen=True)
class FileTenant:
    """A pipeline file, as a `SharingPipeline`.

    `graphs`: graphs of its networks, by the stage's name.
    `precision`: int8, fp16 or fp32 for networks whose stage states none; None: the network and its unit decide.

    Raises BadInputError for a file without a rate, or with a rate out of range.
    """

    name: str
    source: str
    file: PipelineFile
    graphs: Mapping[str, GraphFile]
    precision: str | None = None

    kind: str = "pipeline"
    takes_memory: bool = False

    def __post_init__(self) -> None:
        if self.file.run.fps is None:
            found = "random arrivals" if self.file.run.arrivals else "no rate"
            raise BadInputError(f"{self.file.path}: run.fps", found, "frames a second", f"such as {self.file.path}@30")
        check_rate(self.name, self.fps)

    @property
    def fps(self) -> float:
        return float(self.file.run.fps or 0.0)

    @cached_property
    def hardware(self) -> Mapping[str, str]:
        return {unit: self.file.hardware(unit) or unit for unit in self.file.units}

    @property
    def repeats(self) -> int:
        return repeats_after(self.file)

    @cached_property
    def graph(self) -> Graph:
        return graph_of(self.file, edge_rules(self.file))

    @property
    def fed(self) -> tuple[Graph, Settings]:
        return always_fed(self.file)

    def settings(self, display_ns: int) -> Settings:  # noqa: ARG002 the file states how its frames are shown
        return settings_of(self.file, ENDLESS, hang_ns=NEVER_HANGS_NS)

    def skips(self, frame: int, is_fresh: bool) -> bool:  # noqa: ARG002 as in every prediction of a file
        return self.file.bypass is not None and self.file.bypass[1].takes(frame)

    def on(self, profile: Profile, corners: Corners, end: Ends, always: float) -> _FileJobs:
        return _FileJobs(self, profile, corners, end, always)

    def chip(self, stage: str, profile: Profile, unit: UnitName) -> Profile:
        """Return `profile` with `unit` in the precision of the network of `stage`."""
        keys = self.file.stages[stage]
        asked = (keys.precision if isinstance(keys, OnnxStage) else None) or self.precision
        return Computes(self.graphs[stage].numbers, asked).on(profile, unit)

    def facts(self, profile: Profile) -> dict[str, Any]:  # noqa: ARG002 each stage has its own precision
        run = self.file.run
        units = dict.fromkeys(self.hardware.values())
        return {"unit": ", ".join(units), "numbers": None, "precision": None, "policy": run.policy, "edge": run.edge}


#: A pipeline that shares a chip with others; its members are described at `Tenant`.
SharingPipeline = Tenant | FileTenant


class _Priced(NamedTuple):
    """A network that the chip's model prices. `factor`: time at the chosen end of its interval / expected time."""

    work: Work
    chip: Profile
    unit: UnitName
    factor: float


class _FileJobs:
    """The jobs of a `FileTenant`, as `_AvatarJobs`. The name of a network is the name of its stage.

    A network takes bandwidth only if the chip's model gives its time, not if the file states it.
    """

    def __init__(self, tenant: FileTenant, profile: Profile, corners: Corners, end: Ends, always: float) -> None:
        self._corners = corners
        prices = prices_of(
            tenant.file, tenant.graphs, lambda name, _, unit: tenant.chip(name, profile, unit), lambda _: corners
        )
        self.is_known = all(each.low_ms is not None for each in prices.values())
        factors = factors_at(prices, end)
        self._networks: dict[str, _Priced] = {}
        for name, graph in tenant.graphs.items():
            unit = next((each for each in UNITS if each == tenant.hardware[tenant.file.stages[name].unit]), None)
            if prices[name].is_modelled and unit is not None:
                self._networks[name] = _Priced(graph.work, tenant.chip(name, profile, unit), unit, factors[name])
        used = {name: self.network_ms(name, always) / prices[name].time.mean_ms for name in self._networks}
        self._drawn = Drawn(prices, 0, {**factors, **used})
        self.mean_ms = {name: each.time.mean_ms * {**factors, **used}[name] for name, each in prices.items()}
        self.bound_ms = fed_bound_ms(tenant.file, self.mean_ms)

    def service_ns(self, stage: str, unit: str, frame: int, begin_ns: int) -> int:
        return self._drawn(stage, unit, frame, begin_ns)

    def network(self, stage: str, _frame: int) -> Hashable | None:
        return stage if stage in self._networks else None

    def network_ms(self, network: str, use: float) -> float:
        work, chip, unit, factor = self._networks[network]
        used = _used(chip, use)
        clock = used.units[unit].clock(self._corners[UNITS.index(unit)])
        return factor * time_on(used.units[unit], used.memory, work, clock, contended=True).total_ms

    def moved_bytes(self, network: str) -> float:
        work, chip, unit, _ = self._networks[network]
        return moved_bytes(work, chip.units[unit])


def _used(profile: Profile, use: float) -> Profile:
    """Return the profile of the chip while other jobs take the share `use` of its memory's bandwidth."""
    fraction = profile.memory.application_use_fraction.model_copy(update={"value": use})
    memory = profile.memory.model_copy(update={"application_use_fraction": fraction})
    return profile.model_copy(update={"memory": memory})


def moved_bytes(work: Work, unit: Unit) -> float:
    """Return the bytes that a network moves in a job on `unit`: the elements of every operator, and all weights once.

    On a tensor engine only elements that do not fit on the chip count.
    """
    if unit.engine is not None:
        return float(sum(spilled(work.layers, numbers_of(unit.engine).room)) + work.weights) * unit.element_bytes
    return float(work.table[:, 1].sum() + work.weights) * unit.element_bytes
