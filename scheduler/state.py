"""The state of units, stages and frames. Rule: this file holds the state and computes from it; core.py decides.

A time that is not set is NEVER. Only `TABLE` changes a unit's life. An event that the table refuses is a defect of the
driver.

    down --back-off over--> starting --UnitReady--> ready --too slow--> stopping --UnitDied--> down

A unit has one deadline, and its life says what happens when the deadline passes:
- `down`: the process is started again.
- `starting`: the start took too long, and the process is killed.
- `ready`: the running job or the answer to a ping took too long, and the process is killed.
- `stopping`: there is no deadline, because the process is about to end.

`verdict` says what to do with a unit now, and `next_alarm_ns` says when something is to be done next.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from math import lcm
from typing import Final

from trilane.scheduler.events import NEVER, Graph, Job, JobDone, JobFailed, Pinged, Pong, UnitDied, UnitReady
from trilane.scheduler.ledger import STARVED
from trilane.transport.slots import EdgeSlots, Keeps, edge_rule
from trilane.unexpected_value import UnexpectedValue

DOWN: Final = 0
STARTING: Final = 1
READY: Final = 2
STOPPING: Final = 3
STATES = ("down", "starting", "ready", "stopping")

IGNORED: Final = -1  # the event was under way when the unit's process was killed or died
REFUSED: Final = -2  # the event cannot happen


class DeadlinePassed:
    """The event that a unit's deadline has passed. The core itself finds this out; no driver sends the event."""


class UnitLifeError(Exception):
    """An event that `TABLE` refuses in the unit's life: a defect of the driver, not of the user's input."""


# fmt: off
#: The life that follows each event. JobDone and JobFailed change no life, so core.py need not look them up. Their job
#: counts if it is the first in its unit's queue, even while the unit is stopping. A unit that is down or starting has
#: no jobs.
TABLE: dict[type, tuple[int, int, int, int]] = {
    #                from DOWN  STARTING  READY     STOPPING
    UnitReady:      (REFUSED,   READY,    REFUSED,  IGNORED),
    UnitDied:       (REFUSED,   DOWN,     DOWN,     DOWN),
    Pinged:         (IGNORED,   REFUSED,  READY,    IGNORED),
    Pong:           (IGNORED,   IGNORED,  READY,    IGNORED),
    JobDone:        (IGNORED,   IGNORED,  READY,    STOPPING),
    JobFailed:      (IGNORED,   IGNORED,  READY,    STOPPING),
    DeadlinePassed: (STARTING,  STOPPING, STOPPING, REFUSED),
}
# fmt: on


def state_after(unit: str, state: int, event: type) -> int:
    """Return the life that follows the life `state` after an event, or IGNORED.

    `unit`: name of the unit, for the error message. `event`: class of the event.

    Raises UnitLifeError if the table refuses the event.
    """
    after = TABLE[event][state]
    if after == REFUSED:
        raise UnitLifeError(f"unit {unit} is {STATES[state]}: {event.__name__} cannot happen")
    return after


HELD_JOBS: Final = 2  # the one that runs and the one dispatched ahead
FULL_DUTY: Final = 1000


class UnitState:
    """The state of one unit.

    `life`: DOWN, STARTING, READY or STOPPING, by the table `TABLE`.
    `deadline_ns`: latest time of the event that the unit waits for in this life.
    `queue`: the running job, then the job dispatched ahead.
    `queue_capacity`: number of jobs that the unit may hold now (`update_queue_capacity`).
    `head_since_ns`: time from which the running job could run.
    `hold_until_ns`: end of the pause that the unit's duty asks for; NEVER: no pause.
    `duty`: share of the time for which the unit may work, in thousandths.
    `failures`: number of the unit's deaths since it last ended a job.
    `account`: account of the ledger that gets the unit's time now.
    `account_ns`: time since which this account gets it.
    """

    __slots__ = (
        "account",
        "account_ns",
        "deadline_ns",
        "duty",
        "failures",
        "head_since_ns",
        "hold_until_ns",
        "life",
        "name",
        "queue",
        "queue_capacity",
        "stages",
    )

    def __init__(self, name: str) -> None:
        self.name = name
        self.stages: list[StageState] = []
        self.queue: deque[Job] = deque()
        self.queue_capacity = 0
        self.life: int = STARTING
        self.deadline_ns: int = NEVER
        self.hold_until_ns: int = NEVER
        self.head_since_ns = 0
        self.failures = 0
        self.duty = FULL_DUTY
        self.account = STARVED
        self.account_ns = 0

    @property
    def awaits_nothing(self) -> bool:
        """Whether the unit is ready, has no job and was not pinged, so that only a ping can tell whether it lives."""
        return self.life == READY and not self.queue and self.deadline_ns == NEVER

    def move(self, event: type, deadline_ns: int) -> bool:
        """Change the unit's life by the table's row for `event`, and set its deadline.

        Return False, and change nothing, if the table ignores the event.

        `event`: class of the event.
        `deadline_ns`: deadline after the event in ns, or NEVER.

        Raises UnitLifeError for an event that cannot happen now.
        """
        after = state_after(self.name, self.life, event)
        if after == IGNORED:
            return False
        self.life, self.deadline_ns = after, deadline_ns
        return True

    def update_queue_capacity(self) -> None:
        """Set `queue_capacity` from `life`, `hold_until_ns` and `duty`; call this after a change of any of them."""
        if self.life != READY or self.hold_until_ns != NEVER:
            self.queue_capacity = 0
        else:
            # A capped unit pauses after each job, so it holds none ahead.
            self.queue_capacity = HELD_JOBS if self.duty == FULL_DUTY else 1

    def expected_end_ns(self) -> int:
        """Return the estimated time in ns at which the running job ends. Raises IndexError if no job runs."""
        name = self.queue[0].stage
        for stage in self.stages:
            if stage.name == name:
                return self.head_since_ns + stage.estimate_ns
        raise KeyError(name)


class SourceLine:
    """The frames that wait for a stage without inputs. It has the methods of `EdgeSlots` that such a stage needs.

    A run has source lines if several stages have no inputs, or if `every` of the only such stage is above 1. An input
    with `latest` does not count here. The number of a frame serves as its slot.
    """

    def __init__(self) -> None:
        self.ready: deque[int] = deque()
        self.lines = (self.ready,)
        self.frame = range(NEVER)  # each slot's frame
        self.free = True  # nobody waits for one of its slots
        self.epoch = 0

    def take(self, slot: int, _line: int = 0) -> None:
        self.ready.remove(slot)

    def release(self, slot: int) -> None:
        """Do nothing, because a frame has no memory here."""

    def pass_by(self, frame: int, _line: int) -> None:
        """Note that the stage no longer waits for `frame`."""
        if frame in self.ready:
            self.ready.remove(frame)

    def give_back(self, slot: int, _line: int = 0, _keeps: Keeps | None = None) -> list[int]:
        """Let the taken frame `slot` wait again in its old place. Return the dropped frames: none."""
        place = sum(frame < slot for frame in self.ready)
        self.ready.insert(place, slot)
        return []


@dataclass(frozen=True)
class Inlet:
    """An input without `latest`: the stage takes one frame after the other.

    `edge`: slots that it reads.
    `line`: index, in `edge.lines`, of the slots that wait for the stage.
    `producer`: stage that fills the slots; None for frames from the source.
    """

    edge: EdgeSlots | SourceLine
    line: int
    producer: StageState | None

    @property
    def waiting(self) -> deque[int]:
        return self.edge.lines[self.line]


@dataclass(frozen=True)
class NewestInlet:
    """An input with `latest`: the stage takes the newest frame.

    `edge`: slots that it reads.
    `reader`: index of this input in `edge.newest`.
    `producer`: stage that fills the slots.
    `max_age_ns`: longest age in ns at which the frame is taken; 0: any age.
    """

    edge: EdgeSlots
    reader: int
    producer: StageState
    max_age_ns: int


class StageState:
    """The state of one stage.

    `estimate_ns`: running mean of its service time in ns (weight 1/8); 0 before the first job.
    `position`: index of the stage in the graph.
    `input`, `output`: edge of the first of `inlets`, and edge that the stage fills; None if there is none.
    `inlets`: inputs without `latest`.
    `waiting`: line of frames that wait at the first of `inlets`.
    `others`: lines of frames that wait at the further `inlets`.
    `slots_of`: inputs whose slots a job names, in the order of `Job.slot_in`.
    `feeder`: unit that fills the input, if every job of the stage reads one slot of the same edge; else None.
    `joins`: whether `Job.slot_in` must be unpacked (`trilane.scheduler.events.unpacked`).
    `bypassed`: for the stage at which a bypass ends, the output edge of the stage at which the bypass begins.
    `readers`: stages that read the output by an input without `latest`, in the order of the output's lines.
    `period`: distance between the frames that the stage does, in frames.
    `bit`: 1 shifted left by `position`.
    `after`: positions of the stages that the stage reads by an input without `latest`.
    `before`: bits of the stages that must have done a frame before this stage can take it.
    `is_main`: whether the stage has no readers, or a stage without readers needs its work. Other stages do side work,
    which is read only by inputs with `latest`.
    """

    __slots__ = (
        "after",
        "before",
        "bit",
        "bypassed",
        "estimate_ns",
        "feeder",
        "inlets",
        "input",
        "is_main",
        "joins",
        "name",
        "others",
        "output",
        "period",
        "position",
        "readers",
        "slots_of",
        "unit",
        "waiting",
    )

    def __init__(self, name: str, unit: UnitState, position: int) -> None:
        self.name, self.unit, self.position = name, unit, position
        self.input: EdgeSlots | SourceLine | None = None
        self.output: EdgeSlots | None = None
        self.bypassed: EdgeSlots | None = None
        self.inlets: tuple[Inlet, ...] = ()
        self.slots_of: tuple[Inlet | NewestInlet, ...] = ()
        self.others: tuple[deque[int], ...] = ()
        self.feeder: UnitState | None = None
        self.waiting: deque[int] = deque()
        self.readers: list[StageState] = []
        self.after: list[int] = []
        self.joins, self.is_main = False, True
        self.estimate_ns = 0
        self.period, self.bit, self.before = 1, 1 << position, 0

    def learn(self, service_ns: int) -> None:
        """Add a measured service time in ns to the running mean."""
        self.estimate_ns += (service_ns - self.estimate_ns) >> 3 if self.estimate_ns else service_ns

    def set_inlets(self, inlets: Sequence[Inlet], slots_of: Sequence[Inlet | NewestInlet]) -> None:
        """Set the inputs.

        `inlets`: inputs without `latest`.
        `slots_of`: all inputs that read another stage, with and without `latest`, in the order of the graph.
        """
        self.inlets, self.slots_of = tuple(inlets), tuple(slots_of)
        if inlets:
            self.input, self.waiting = inlets[0].edge, inlets[0].waiting
            self.others = tuple(inlet.waiting for inlet in inlets[1:])
        self.after = [inlet.producer.position for inlet in inlets if inlet.producer is not None]
        self.joins = tuple(slots_of) != tuple(inlets) or len(slots_of) > 1
        if not self.joins and inlets and inlets[0].producer is not None:
            self.feeder = inlets[0].producer.unit


class FrameState:
    """The state of one frame in flight.

    `position`: in a chain, the position of its next stage.
    `release_ns`, `deadline_ns`: times of its release and of its deadline (or NEVER).
    `ready_ns`: times from which the inputs of each stage were there, by the stage's position.
    `sampled_ns`: time of its sampling, or of its release for `Graph.from_release`; -1 until it is known.
    `latency_ns`: time from `sampled_ns` to the end of the stage at which the latency ends; -1 until it is known.
    `skips`: whether it takes the bypass.
    `rung`: rung of its work.
    `number`: how many frames were put in flight before it.
    `todo`: bits of the stages that have yet to end the frame.
    `begun`: bits of the stages that have begun the frame; always 0 in a chain.
    `jobs`: number of its jobs that units hold; always 0 in a chain.
    `is_presented`: whether all stages without readers have done the frame, so that only side work is left.
    """

    __slots__ = (
        "begun",
        "deadline_ns",
        "is_presented",
        "jobs",
        "latency_ns",
        "number",
        "position",
        "ready_ns",
        "release_ns",
        "rung",
        "sampled_ns",
        "skips",
        "todo",
    )

    def __init__(
        self, release_ns: int, deadline_ns: int, rung: int = 0, number: int = 0, todo: int = 0, stages: int = 1
    ) -> None:
        self.position, self.release_ns, self.ready_ns = 0, release_ns, [release_ns] * stages
        self.deadline_ns, self.rung = deadline_ns, rung
        self.sampled_ns = self.latency_ns = -1
        self.number, self.todo = number, todo
        self.begun = self.jobs = 0
        self.skips = self.is_presented = False

    def end_stage(self, sampled_ns: int | None, end_ns: int, ends_latency: bool) -> None:
        """Note the times of a stage's end.

        `sampled_ns`: time at which a stage without inputs sampled the frame; None from other stages.
        `ends_latency`: whether the latency ends with the stage.
        """
        if sampled_ns is not None:
            self.sampled_ns = sampled_ns if self.sampled_ns < 0 else min(self.sampled_ns, sampled_ns)
        if ends_latency:
            self.latency_ns = end_ns - self.sampled_ns


def build(graph: Graph) -> tuple[list[StageState], dict[str, UnitState], list[EdgeSlots]]:
    """Return the connected states of a graph: (stages in the graph's order, units by name, edges as in `graph.edges`).

    Raises ValueError for an unknown rule of an edge, or for one slot behind a stage that an input with `latest` reads.
    """
    units = {name: UnitState(name) for name in graph.units}
    stages = [StageState(spec.name, units[spec.unit], position) for position, spec in enumerate(graph.stages)]
    named = {stage.name: stage for stage in stages}
    read = {stage.name: graph.inputs_of(stage.position) for stage in stages}
    edges = []
    for (name, readers), text in zip(graph.streams.items(), graph.edges, strict=True):
        producer = named[name]
        by_frame = [reader for reader in readers if not any(each.latest for each in read[reader] if each.stage == name)]
        producer.readers = [named[reader] for reader in by_frame]
        lines = len(by_frame) + (graph.bypass is not None and graph.bypass[0] == name)
        producer.output = EdgeSlots(edge_rule(text), lines, len(readers) - len(by_frame))
        if producer.output.newest and producer.output.rule.slots < 2:
            raise UnexpectedValue(f"edge {text!r} behind {name}", "two slots or more", "one holds the newest frame")
        edges.append(producer.output)
    roots = [stage for stage in stages if all(each.latest for each in read[stage.name])]
    held = dict.fromkeys(named, 0)
    for stage, spec in zip(stages, graph.stages, strict=True):
        stage.unit.stages.append(stage)
        # The only stage without inputs takes its frames from the source itself.
        is_fed = stage in roots and (len(roots) > 1 or spec.every > 1)
        inlets: list[Inlet] = [Inlet(SourceLine(), 0, None)] if is_fed else []
        slots_of: list[Inlet | NewestInlet] = []
        stage.period = spec.every
        for each in read[spec.name]:
            producer = named[each.stage]
            assert producer.output is not None
            if each.latest:
                slots_of.append(NewestInlet(producer.output, held[each.stage], producer, each.max_age_ns))
                held[each.stage] += 1
                continue
            inlets.append(Inlet(producer.output, producer.readers.index(stage), producer))
            slots_of.append(inlets[-1])
            stage.before |= producer.before | producer.bit
            stage.period = lcm(stage.period, producer.period)
        stage.set_inlets(inlets, slots_of)
    # From the end, because a stage is main if one of its readers is.
    for stage in reversed(stages):
        stage.is_main = stage.output is None or any(reader.is_main for reader in stage.readers)
    return stages, units, edges


#: Verdicts on a unit: leave it alone, kill its process, start its process, end its pause, see if it takes a job.
NOTHING: Final = 0
KILL: Final = 1
START: Final = 2
RESUME: Final = 3
LOOK: Final = 4

#: Waits before a restart in ns: the first after one failure, the next after two in a row, and so on; the last repeats.
BACK_OFF_NS = (0, 100_000_000, 400_000_000, 1_600_000_000)


def verdict(unit: UnitState, now_ns: int, lead_ns: int) -> int:
    """Return the verdict on the unit now: NOTHING, KILL, START, RESUME or LOOK.

    `lead_ns`: lead of the policy in ns; LOOK comes only with a lead.
    """
    if unit.deadline_ns <= now_ns:
        return START if unit.life == DOWN else KILL
    if unit.hold_until_ns <= now_ns:
        return RESUME
    return LOOK if lead_ns and len(unit.queue) == 1 else NOTHING


def next_alarm_ns(units: Iterable[UnitState], now_ns: int, lead_ns: int) -> int:
    """Return the time in ns at which the first verdict other than NOTHING is due, or NEVER.

    Only a newly set deadline or pause can make a verdict due earlier: a job's end and a Pong move deadlines to later.

    `lead_ns`: lead of the policy in ns.
    """
    alarm_ns = NEVER
    for unit in units:
        alarm_ns = min(alarm_ns, unit.deadline_ns, unit.hold_until_ns)
        if lead_ns and len(unit.queue) == 1:
            lead_from_ns = unit.expected_end_ns() - lead_ns
            if now_ns < lead_from_ns < alarm_ns:
                alarm_ns = lead_from_ns
    return alarm_ns


def fates(jobs: Iterable[Job], sources: Container[str]) -> list[tuple[Job, bool]]:
    """Return pairs (job of a dead unit, whether the job's frame is lost), in the order of `jobs`.

    The frame of the running job is lost. A frame at a stage without an input slot is lost too, because no slot keeps
    its input. All other frames wait for their stage again.

    `jobs`: jobs of the unit, the running one first.
    `sources`: names of the stages without an input slot.
    """
    return [(job, place == 0 or job.stage in sources) for place, job in enumerate(jobs)]


def back_off_ns(failures: int) -> int:
    """Return the time in ns for which a unit stays down. `failures`: number of failures in a row, at least 1."""
    return BACK_OFF_NS[min(failures, len(BACK_OFF_NS)) - 1]
