"""What the core is told (events) and what it answers (actions). Rule: plain tuples of numbers and short strings.

All times are integer nanoseconds of the driver's clock. Slots are -1 where a stage has no such edge.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from trilane.unexpected import UnexpectedValue


class Job(NamedTuple):
    """One stage of one frame on one unit, from a slot to a slot."""

    id: int
    unit: str
    stage: str
    frame: int
    slot_in: int
    slot_out: int
    epoch: int


class UnitReady(NamedTuple):
    """A unit's process is up and its slots are bound."""

    unit: str


class JobDone(NamedTuple):
    """`t_sampled_ns`: when the frame's pose was sampled, as its header says; 0 but from the first stage."""

    unit: str
    job: int
    t_begin_ns: int
    t_end_ns: int
    t_sampled_ns: int


class JobFailed(NamedTuple):
    """A stage raised; the unit lives."""

    unit: str
    job: int


class UnitDied(NamedTuple):
    """A unit's process is gone."""

    unit: str


class Pinged(NamedTuple):
    """A unit without work was asked whether it lives."""

    unit: str


class Pong(NamedTuple):
    """The unit's answer."""

    unit: str


class SchedulerStalled(NamedTuple):
    """Whoever runs the core did nothing for `ns` since the last step: units have as much longer to answer."""

    ns: int


class SetDuty(NamedTuple):
    """From now on the unit may work `permille` thousandths of the time."""

    unit: str
    permille: int


class Stop(NamedTuple):
    """Admit no more frames; end when those in flight are done."""


class FrameRequest(NamedTuple):
    """Somebody outside wants so many more frames, now."""

    frames: int


class Dispatch(NamedTuple):
    """Hand the job to its unit."""

    job: Job


class Kill(NamedTuple):
    """The unit missed its deadline: end its process; `UnitDied` is expected."""

    unit: str


class Start(NamedTuple):
    """Start the unit's process again; `UnitReady` or `UnitDied` is expected."""

    unit: str


class Finish(NamedTuple):
    """Every frame is accounted for. `cause`: `done`, `stopped`, or the unit that could not be kept alive."""

    cause: str


Event = UnitReady | JobDone | JobFailed | UnitDied | Pinged | Pong | SchedulerStalled | SetDuty | Stop | FrameRequest
Action = Dispatch | Kill | Start | Finish

EVENTS = (UnitReady, JobDone, JobFailed, UnitDied, Pinged, Pong, SchedulerStalled, SetDuty, Stop, FrameRequest)
ACTIONS = (Dispatch, Kill, Start, Finish)


class Decision(NamedTuple):
    """The core's answer: what to do now, and when to ask again at the latest (None: at the next event)."""

    actions: tuple[Action, ...]
    next_deadline_ns: int | None


@dataclass(frozen=True)
class StageSpec:
    """A stage and the unit that it runs on."""

    name: str
    unit: str


@dataclass(frozen=True)
class Graph:
    """A chain of stages. `edges[i]`: the rule between stages i and i + 1. Latency ends with stage `latency_to`."""

    stages: tuple[StageSpec, ...]
    edges: tuple[str, ...]
    latency_to: str

    def __post_init__(self) -> None:
        names = [stage.name for stage in self.stages]
        if len(set(names)) != len(names) or not names:
            raise UnexpectedValue(f"stages {names}", "different names")
        if len(self.edges) != len(names) - 1 or self.latency_to not in names:
            found = f"{len(self.edges)} edges and latency to {self.latency_to!r} for stages {names}"
            raise UnexpectedValue(found, "one edge fewer than stages, and latency to one of them")

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys([stage.unit for stage in self.stages]))

    def edge_name(self, index: int) -> str:
        return f"{self.stages[index].name}->{self.stages[index + 1].name}"


def avatar_graph(edge: str = "double", infer: Iterable[tuple[str, str]] = (("infer", "dsp"),)) -> Graph:
    """The pipeline of DESIGN's data flow, every edge with the same rule. `infer`: stages and units of the network."""
    names = (("pose", "cpu"), ("raster", "gpu"), *infer, ("composite", "gpu"), ("present", "cpu"))
    return Graph(tuple(StageSpec(*name) for name in names), (edge,) * (len(names) - 1), "composite")


@dataclass(frozen=True)
class Settings:
    """What a run asks of the core. A time or a limit of 0 means none.

    `period_ns`: a frame is released every so often; 0: as soon as it can be taken.
    `arrivals_ns`: release times from the start, instead of a period.
    `asked`: frames are released by `FrameRequest` alone.
    `latch_ns`: the first stage of a frame begins so late that it is expected to end this long before the second can
    take it: the pose is newer, and waits less.
    `deadline_ns`: a frame's time from release to presented.
    `in_flight`: frames between pose and presented.
    `in_queue`: released frames that may wait; more are turned away.
    `queue_timeout_ns`: the longest wait there.
    `hang_ns`: the longest that a job may take, or that an idle unit may leave a question unanswered.
    `start_ns`: the longest that a unit may take to start.
    `max_failures`: in a row, without a finished job between them, after which a unit is given up.
    """

    frames: int
    policy: str = "pipelined"
    period_ns: int = 0
    arrivals_ns: tuple[int, ...] = ()
    asked: bool = False
    latch_ns: int = 0
    deadline_ns: int = 0
    in_flight: int = 0
    in_queue: int = 0
    queue_timeout_ns: int = 0
    hang_ns: int = 10_000_000_000
    start_ns: int = 120_000_000_000
    max_failures: int = 5
