"""Events, which the core takes in, and actions, which it answers with. Rule: plain tuples of numbers and short strings.

All times are integer nanoseconds of the driver's clock, from 0 on. There is one notation for a time that will not come
or is not set, here and in every file of the scheduler: NEVER. Slots are -1 where a stage has no such edge.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

from trilane.scheduler.causes import Outcome
from trilane.unexpected_value import UnexpectedValue

NEVER: Final = (1 << 62) - 1  # ns, later than any time


class Job(NamedTuple):
    """One stage of one frame on one unit, from a slot to a slot.

    `slot_in` counts through the slots of the stage's input edge and, where a bypass ends at it, on through those of the
    bypassed edge. `fresh`: the stage at which the bypass begins must not count on what earlier frames left behind.
    `rung`: of the frame's work (work_ladder.py).
    """

    id: int
    unit: str
    stage: str
    frame: int
    slot_in: int
    slot_out: int
    epoch: int
    fresh: bool = False
    rung: int = 0


class UnitReady(NamedTuple):
    """A unit's process is up and its slots are bound."""

    unit: str


class JobDone(NamedTuple):
    """`t_sampled_ns`: when the frame's pose was sampled, as its header says; 0 but from the first stage.

    `preempted_ns`, `asleep_ns`: parts of the job in which its unit had no core, and in which nothing of it worked.
    `preempted_before_ns`: how long the unit had no core between its job before and this one.
    `skips`: the frame takes the bypass; False but from the stage at which that begins.
    """

    unit: str
    job: int
    t_begin_ns: int
    t_end_ns: int
    t_sampled_ns: int
    preempted_ns: int = 0
    asleep_ns: int = 0
    preempted_before_ns: int = 0
    skips: bool = False


class JobFailed(NamedTuple):
    """A stage raised an error; the unit lives."""

    unit: str
    job: int


class UnitDied(NamedTuple):
    """A unit's process is gone."""

    unit: str


class Pinged(NamedTuple):
    """A unit without a job was sent a ping, and must answer with `Pong`."""

    unit: str


class Pong(NamedTuple):
    """The unit answered the ping: it lives."""

    unit: str


class SchedulerStalled(NamedTuple):
    """The driver did nothing for `ns` since the last step: units have as much longer to answer."""

    ns: int


class SetDuty(NamedTuple):
    """From now on the unit may work `permille` thousandths of the time."""

    unit: str
    permille: int


class StageAlone(NamedTuple):
    """The stage takes `ns` for a frame on `rung` while other units are quiet; said of all rungs, before the start."""

    stage: str
    rung: int
    ns: int


class Stop(NamedTuple):
    """Admit no more frames; end when those in flight are done."""


class FrameRequest(NamedTuple):
    """So many more frames are wanted from outside, now."""

    frames: int


class Hold(NamedTuple):
    """From now on only `frames` more frames are released, and none by its time; -1: all are again.

    Frames that were released before go on. A rate goes on from the moment in which the hold ends.
    """

    frames: int


class Abort(NamedTuple):
    """End at once: every frame in flight is lost."""


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
    """The run is over, and every frame is accounted for."""

    outcome: Outcome


UnitEvent = UnitReady | UnitDied | Pinged | Pong | SetDuty
RunEvent = SchedulerStalled | StageAlone | Stop | FrameRequest | Hold | Abort
Event = JobDone | JobFailed | UnitEvent | RunEvent
Action = Dispatch | Kill | Start | Finish

EVENTS = (
    UnitReady,
    JobDone,
    JobFailed,
    UnitDied,
    Pinged,
    Pong,
    SchedulerStalled,
    SetDuty,
    StageAlone,
    Stop,
    FrameRequest,
    Hold,
    Abort,
)
ACTIONS = (Dispatch, Kill, Start, Finish)


class Decision(NamedTuple):
    """The core's answer: what to do now, and when to ask again at the latest (NEVER: at the next event)."""

    actions: tuple[Action, ...]
    next_deadline_ns: int


@dataclass(frozen=True)
class StageSpec:
    """A stage and the unit that it runs on."""

    name: str
    unit: str


@dataclass(frozen=True)
class Graph:
    """A chain of stages. `edges[i]`: the rule between stages i and i + 1. Latency ends with stage `latency_to`.

    `bypass`: names of two stages; a frame for which the first says so skips those between them (bypass.py).
    """

    stages: tuple[StageSpec, ...]
    edges: tuple[str, ...]
    latency_to: str
    bypass: tuple[str, str] | None = None

    def __post_init__(self) -> None:
        names = [stage.name for stage in self.stages]
        if len(set(names)) != len(names) or not names:
            raise UnexpectedValue(f"stages {names}", "different names")
        if len(self.edges) != len(names) - 1 or self.latency_to not in names:
            found = f"{len(self.edges)} edges and latency to {self.latency_to!r} for stages {names}"
            raise UnexpectedValue(found, "one edge fewer than stages, and latency to one of them")
        if self.bypass is not None:
            self._check_bypass(names, self.bypass)

    def _check_bypass(self, names: list[str], bypass: tuple[str, str]) -> None:
        """Raises UnexpectedValue for one that skips nothing, or skips the end of the latency."""
        if not set(bypass) <= set(names) or names.index(bypass[0]) + 1 >= names.index(bypass[1]):
            raise UnexpectedValue(f"bypass {bypass} of stages {names}", "a stage, and one at least two places after it")
        if self.latency_to in self.bypassed:
            found = f"latency to {self.latency_to!r}, which bypass {bypass} skips"
            raise UnexpectedValue(found, "latency to a stage that every frame meets")

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys([stage.unit for stage in self.stages]))

    @property
    def bypassed(self) -> tuple[str, ...]:
        """The stages that a frame on the bypass skips."""
        if self.bypass is None:
            return ()
        names = [stage.name for stage in self.stages]
        return tuple(names[names.index(self.bypass[0]) + 1 : names.index(self.bypass[1])])

    def edge_name(self, index: int) -> str:
        return f"{self.stages[index].name}->{self.stages[index + 1].name}"


def chain(stages: Iterable[tuple[str, str]], edge: str, latency_to: str) -> Graph:
    """A graph of `stages`, each a name and its unit, all of whose edges have the same rule.

    Raises ValueError for stages of one name, and when `latency_to` is none of them.
    """
    specs = tuple(StageSpec(name, unit) for name, unit in stages)
    return Graph(specs, (edge,) * (len(specs) - 1), latency_to)


@dataclass(frozen=True)
class Settings:
    """What a run asks of the core. All `_ns` are lengths of time; a length or a limit of 0 means that there is none.

    `period_ns`: a frame is released every so often; 0: as soon as it can be taken.
    `arrivals_ns`: release times from the start, instead of a period.
    `asked`: frames are released by `FrameRequest` alone.
    `latch_ns`: the first stage of a frame begins so late that it is expected to end this long before the second can
    take it: the pose is newer, and waits less.
    `deadline_ns`: a frame's time from release to presented.
    `works`: of each rung of the ladder on which a frame's work is stepped down when it would be late (work_ladder.py),
    in thousandths, 1000 first, falling; empty: there is none. `follow`: the stages whose time follows the work.
    `in_flight`: frames between pose and presented.
    `in_queue`: released frames that may wait; more are turned away.
    `queue_timeout_ns`: the longest wait there.
    `hang_ns`: the longest that a job may take, or that an idle unit may leave a ping unanswered.
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
    works: tuple[int, ...] = ()
    follow: tuple[str, ...] = ()
    in_flight: int = 0
    in_queue: int = 0
    queue_timeout_ns: int = 0
    hang_ns: int = 10_000_000_000
    start_ns: int = 120_000_000_000
    max_failures: int = 5
