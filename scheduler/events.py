"""Defines the events that the core takes in, the actions that it answers with, and the reasons that it gives.

Rule: events and actions are plain tuples of numbers and short strings. All times are integer nanoseconds of the
driver's clock, counted from 0. NEVER stands for a time that does not come or is not set, in every file of the
scheduler. The slot of an input or output that a stage does not have is -1.

A reason says why a run ended, or why a frame was lost or dropped. It consists of a kind and a place, so that no code
parses a string. `str()` of a reason is its key in the report and in messages.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, Final, NamedTuple, get_args

from trilane.unexpected_value import UnexpectedValue


class OutcomeKind(StrEnum):
    """How a run ended.

    - DONE: every frame was presented, dropped or lost.
    - STOPPED: `Stop` was asked for.
    - ABORTED: `Abort` was asked for.
    - GAVE_UP: a unit failed too often.
    """

    DONE = "done"
    STOPPED = "stopped"
    ABORTED = "aborted"
    GAVE_UP = "gave_up"


class Outcome(NamedTuple):
    """How a run ended. `unit`: unit that was given up, only for GAVE_UP."""

    kind: OutcomeKind
    unit: str = ""

    def __str__(self) -> str:
        return _joined(self.kind.value, self.unit)


class LossKind(StrEnum):
    """What ended a frame in flight.

    - DIED, HUNG: the unit that had the frame died, or hung.
    - GAVE_UP: a unit was given up, which ends the run.
    - FAILED: its stage raised an error.
    - ABORTED: the run was aborted.
    """

    DIED = "died"
    HUNG = "hung"
    GAVE_UP = "gave_up"
    FAILED = "failed"
    ABORTED = "aborted"


class Loss(NamedTuple):
    """Why a frame in flight was lost. `where`: name of the unit, or of the stage for FAILED; empty for ABORTED."""

    kind: LossKind
    where: str = ""

    def __str__(self) -> str:
        return _joined(self.kind.value, self.where)


class DropCause(StrEnum):
    """Why a waiting frame was dropped.

    - STALE: a newer frame took its place.
    - LATE: it could not be in time.
    - POOL: a newer frame needed its slot, because no slot of the edge was free.
    - QUEUE_FULL: too many frames waited before the first stage when it was released.
    - TIMEOUT: it waited too long before the first stage.
    - EVERY: every stage without readers leaves this frame out, by its `StageSpec.every`.
    """

    STALE = "stale"
    LATE = "late"
    POOL = "pool"
    QUEUE_FULL = "queue_full"
    TIMEOUT = "timeout"
    EVERY = "every"


class Drop(NamedTuple):
    """Why and where a frame was dropped.

    `edge`: place of the drop, as `producer->consumer`; for EVERY, names of the stages without readers, with commas.
    """

    edge: str
    cause: DropCause

    def __str__(self) -> str:
        return _joined(self.edge, self.cause.value)


def _joined(first: str, second: str) -> str:
    return f"{first}:{second}" if second else first


NEVER: Final = (1 << 62) - 1  # ns, later than any time
HANG_NS: Final = 10_000_000_000  # longest time of a job before its unit counts as hung


class Job(NamedTuple):
    """One stage of one frame on one unit, from an input slot to an output slot.

    `slot_in`: index of the input slot; for several inputs, the result of `packed`. If a bypass ends at the stage, the
    numbers of the bypass's slots begin after the slots of the input edge.
    `slot_out`: index of the output slot.
    `epoch`: epoch of the output edge, or of the input edge if there is no output edge. An edge's epoch grows when a
    unit at the edge dies.
    `fresh`: whether the stage must not rely on what earlier frames brought to the end of the bypass. Only a job of the
    stage at which the bypass begins can be fresh.
    `rung`: rung of the frame's work (policy.py).
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
    """A unit has finished a job.

    `job`: number of the job, `Job.id`.
    `t_begin_ns`, `t_end_ns`: times of the job's begin and end.
    `t_sampled_ns`: time at which the stage sampled the frame; it counts only from a stage without inputs.
    `preempted_ns`: time within the job in which the unit had no core.
    `asleep_ns`: time within the job in which the unit slept and no device of its own worked.
    `preempted_before_ns`: time between the unit's last job and this one in which the unit had no core.
    `skips`: whether the frame takes the bypass; only from the stage at which the bypass begins, else False.
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
    """A stage raised an error; the unit's process goes on. `job`: number of the job, `Job.id`."""

    unit: str
    job: int


class UnitDied(NamedTuple):
    """A unit's process is gone."""

    unit: str


class Pinged(NamedTuple):
    """The driver sent a ping to a unit without a job; the unit must answer with `Pong`."""

    unit: str


class Pong(NamedTuple):
    """The unit answered the ping, so its process is alive."""

    unit: str


class SchedulerStalled(NamedTuple):
    """The driver did nothing for `ns` since the last step; units get this much more time to answer."""

    ns: int


class SetDuty(NamedTuple):
    """The unit's duty changes: from now on it may work for `permille` thousandths of the time."""

    unit: str
    permille: int


class StageAlone(NamedTuple):
    """The isolated time of a stage for a frame on `rung` is `ns`; sent for all rungs, before the start."""

    stage: str
    rung: int
    ns: int


class Stop(NamedTuple):
    """Admit no more frames, and end when the frames in flight are done."""


class FrameRequest(NamedTuple):
    """Someone outside wants `frames` more frames now."""

    frames: int


class Hold(NamedTuple):
    """Release `frames` more frames now, and no others until the next `Hold` or `FrameRequest`; -1 ends the hold.

    Frames that were released before go on. A rate goes on from the moment at which the hold ends.
    """

    frames: int


class Abort(NamedTuple):
    """End at once and lose every frame in flight."""


class Dispatch(NamedTuple):
    """Hand the job to its unit."""

    job: Job


class Kill(NamedTuple):
    """End the process of a unit that missed its deadline; `UnitDied` is expected."""

    unit: str


class Start(NamedTuple):
    """Start the unit's process again; `UnitReady` or `UnitDied` is expected."""

    unit: str


class Finish(NamedTuple):
    """The run is over, and every frame is accounted for."""

    outcome: Outcome


Event = (
    UnitReady
    | JobDone
    | JobFailed
    | UnitDied
    | Pinged
    | Pong
    | SchedulerStalled
    | SetDuty
    | StageAlone
    | Stop
    | FrameRequest
    | Hold
    | Abort
)
Action = Dispatch | Kill | Start | Finish
EVENTS, ACTIONS = get_args(Event), get_args(Action)


class Decision(NamedTuple):
    """The core's answer.

    `actions`: actions to carry out now.
    `next_deadline_ns`: latest time of the next step; NEVER: the next step comes with the next event.
    """

    actions: tuple[Action, ...]
    next_deadline_ns: int


@dataclass(frozen=True)
class Input:
    """An input of a stage: the stream that another stage writes.

    `stage`: name of the writing stage.
    `latest`: whether the reading stage takes the stream's newest frame, whatever its number. If not, it takes the same
    frame from all its inputs.
    `max_age_ns`: longest age at which the newest frame is taken; an older frame counts as absent. 0: any age.
    """

    stage: str
    latest: bool = False
    max_age_ns: int = 0


@dataclass(frozen=True)
class StageSpec:
    """A stage and the unit that it runs on.

    `inputs`: inputs of the stage; None for a stage of a chain, which reads the stream of the stage before it.
    `every`: distance between the frames that the stage takes: 3 for the first, the fourth and so on.
    """

    name: str
    unit: str
    inputs: tuple[Input, ...] | None = None
    every: int = 1


MOST_INPUTS: Final = 7  # of one stage, so that the slots of a job fit into one number of a message
NO_SLOT: Final = 255


def packed(slots: Sequence[int]) -> int:
    """Return the slots of a job's inputs as one number, with the first input in the lowest byte; -1 without inputs.

    `slots`: slot of each input; -1 for an input with `latest` that has no frame yet.
    """
    if len(slots) == 1:
        return slots[0] if slots[0] >= 0 else NO_SLOT
    code = 0
    for slot in reversed(slots):
        code = code << 8 | (slot if slot >= 0 else NO_SLOT)
    return code if slots else -1


def unpacked(code: int, count: int) -> list[int]:
    """Return the slot of each of `count` inputs from `code`, a result of `packed`; -1 for an input without a frame."""
    slots = [code >> 8 * place & NO_SLOT for place in range(count)]
    return [slot if slot != NO_SLOT else -1 for slot in slots]


@dataclass(frozen=True)
class Graph:
    """The stages of a run, and how frames go through them. Each stage comes after the stages that it reads.

    `edges`: rule of each edge, such as `fifo:3`. In a chain `edges[i]` lies between stages i and i + 1. Any other graph
    has one rule for each stage that has a reader, in the order of the stages.
    `latency_to`: stage at whose end the latency ends.
    `bypass`: names of two stages of a chain. A frame skips the stages between them if the first stage says so
    (flow.py).
    `from_release`: whether the latency begins with the frame's release. If not, it begins when the first stage samples
    the frame.

    Raises UnexpectedValue for stages, edges, `latency_to` or a bypass that do not fit together.
    """

    stages: tuple[StageSpec, ...]
    edges: tuple[str, ...]
    latency_to: str
    bypass: tuple[str, str] | None = None
    from_release: bool = False

    def __post_init__(self) -> None:
        names = [stage.name for stage in self.stages]
        if len(set(names)) != len(names) or not names:
            raise UnexpectedValue(f"stages {names}", "different names")
        if not self.is_chain:
            self._check_inputs()
        if len(self.edges) != len(self.streams) or self.latency_to not in names:
            found = f"{len(self.edges)} edges and latency to {self.latency_to!r} for stages {names}"
            raise UnexpectedValue(found, f"{len(self.streams)} edges, and latency to one of the stages")
        if self.bypass is not None:
            if not self.is_chain:
                raise UnexpectedValue(f"bypass {self.bypass}", "none, as the stages are no chain")
            self._check_bypass(names, self.bypass)

    def _check_inputs(self) -> None:
        """Raise UnexpectedValue for missing, unknown, later, repeated or too many inputs, and an `every` below 1."""
        known: set[str] = set()
        for stage in self.stages:
            if stage.inputs is None:
                raise UnexpectedValue(f"stage {stage.name} without a list of inputs", "one, as other stages have it")
            read = [each.stage for each in stage.inputs]
            if not set(read) <= known or len(set(read)) != len(read) or len(read) > MOST_INPUTS:
                expected = f"at most {MOST_INPUTS} different stages that come before it"
                raise UnexpectedValue(f"stage {stage.name} with inputs {', '.join(read)}", expected)
            if stage.every < 1:
                raise UnexpectedValue(f"stage {stage.name} with every {stage.every}", "1 or more")
            known.add(stage.name)

    def _check_bypass(self, names: list[str], bypass: tuple[str, str]) -> None:
        """Raise UnexpectedValue for a bypass that skips no stage, or the stage at which the latency ends."""
        if not set(bypass) <= set(names) or names.index(bypass[0]) + 1 >= names.index(bypass[1]):
            raise UnexpectedValue(f"bypass {bypass} of stages {names}", "a stage, and one at least two places after it")
        if self.latency_to in self.bypassed:
            found = f"latency to {self.latency_to!r}, which bypass {bypass} skips"
            raise UnexpectedValue(found, "latency to a stage that every frame meets")

    @property
    def is_chain(self) -> bool:
        """Whether each stage takes every frame from the stage before it, and has no other input."""
        return all(stage.inputs is None and stage.every == 1 for stage in self.stages)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys([stage.unit for stage in self.stages]))

    @property
    def bypassed(self) -> tuple[str, ...]:
        """The names of the stages that a frame on the bypass skips; empty without a bypass."""
        if self.bypass is None:
            return ()
        names = [stage.name for stage in self.stages]
        return tuple(names[names.index(self.bypass[0]) + 1 : names.index(self.bypass[1])])

    def inputs_of(self, index: int) -> tuple[Input, ...]:
        """Return the inputs of the stage at `index`; in a chain, only the stage before it, and none for the first."""
        given = self.stages[index].inputs
        if given is not None:
            return given
        return (Input(self.stages[index - 1].name),) if index else ()

    @property
    def streams(self) -> dict[str, tuple[str, ...]]:
        """The readers of each stage, by the stage's name; stages without readers are left out."""
        readers: dict[str, list[str]] = {stage.name: [] for stage in self.stages}
        for index, stage in enumerate(self.stages):
            for each in self.inputs_of(index):
                readers[each.stage].append(stage.name)
        return {name: tuple(found) for name, found in readers.items() if found}

    def edge_name(self, index: int) -> str:
        """Return the name `WRITER->READER` of the edge with rule `edges[index]`; commas separate several readers."""
        name, readers = list(self.streams.items())[index]
        return f"{name}->{','.join(readers)}"

    def written(self) -> dict[str, Any]:
        """Return the graph as a JSON object for `recording.graph_of`. A chain leaves out keys with default values."""
        if self.is_chain and not self.from_release:
            stages = [{"name": stage.name, "unit": stage.unit} for stage in self.stages]
            return {"stages": stages, "edges": self.edges, "latency_to": self.latency_to, "bypass": self.bypass}
        return asdict(self)


def chain(stages: Iterable[tuple[str, str]], edge: str, latency_to: str) -> Graph:
    """Return the graph of a chain of stages.

    `stages`: pairs (name of the stage, name of its unit).
    `edge`: rule of every edge.
    `latency_to`: stage at whose end the latency ends.

    Raises ValueError if two stages have the same name, or if `latency_to` is none of them.
    """
    specs = tuple(StageSpec(name, unit) for name, unit in stages)
    return Graph(specs, (edge,) * (len(specs) - 1), latency_to)


@dataclass(frozen=True)
class Settings:
    """The settings of a run. All times are in ns. For a time or limit whose default is 0, 0 means that there is none.

    `frames`: number of frames of the run.
    `policy`: name of the scheduling policy.
    `period_ns`: time between releases of frames; 0: a frame is released as soon as it can be taken.
    `arrivals_ns`: release time of each frame, from the start of the run, instead of a period.
    `asked`: whether only `FrameRequest` releases frames.
    `latch_ns`: margin of late latching: time from the expected end of a frame's first stage until the second stage can
    take the frame.
    `deadline_ns`: longest time from a frame's release to its presentation.
    `works`: work of each rung of the ladder (policy.py) in thousandths of all the work, from 1000 downwards; empty: no
    ladder.
    `follow`: names of the stages whose time follows the work.
    `in_flight`: limit of frames between admission and presentation.
    `in_queue`: limit of released frames that wait before the first stage; further frames are dropped.
    `queue_timeout_ns`: longest wait of a released frame before the first stage; then it is dropped.
    `hang_ns`: longest time of a job, and longest time for which an idle unit may leave a ping unanswered.
    `start_ns`: longest time of a unit's start.
    `max_failures`: most failures in a row that a unit may have, with no finished job between them. After one more, the
    unit is given up.
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
    hang_ns: int = HANG_NS
    start_ns: int = 120_000_000_000
    max_failures: int = 5

    def due_from_ns(self, release_ns: int) -> int:
        """Return the deadline in ns of a frame that was released at `release_ns`; NEVER if frames have none."""
        return release_ns + self.deadline_ns if self.deadline_ns else NEVER
