"""Policies, the release of frames, and how much work a frame gets.

Rule: a policy is a row of the table `POLICIES`; policies differ only in their rows. A policy says which job a unit
takes next, and which frames are dropped. Runs on this machine and runs in virtual time take their settings from here,
so that a policy means the same on both clocks.

The source queues frames within limits. Each released frame is taken once or counted as dropped. Frames that wait when
the run stops never begin.

A frame that would be late gets less work. A ladder has rungs: rung 0 is all the work, and each further rung is less
work at the price of a worse picture. Rule: measured times decide; less work is chosen at once, more work only later.
Some stages take less time for less work (the network); the other stages are assumed to need the same time on all rungs.

The time of a stage on a rung is its isolated time on this rung, times its load. The isolated time is measured
(`set_alone`), or else proportional to the work. The load is the ratio of a job's time to the stage's isolated time. The
median over the stage's last three jobs counts, so that one slow job decides nothing.

The use of a rung is the larger of two ratios:
- the busiest unit's time for a frame, divided by the period;
- the time of all stages for a frame, divided by the time from release to deadline.

`FULL` and `ROOM` are thousandths. The wanted rung is the first whose use is at most `FULL`. Without such a rung, it is
the first rung whose use exceeds the least use by at most a twentieth, because less work would save almost nothing.

The ladder changes at once to a rung of less work. It returns to more work by one rung, after `patience` successive
frames in which that rung's use was at most `ROOM`. If it must leave that rung within `patience` frames, the patience
doubles, up to `MOST_PATIENCE`. Every other change to less work sets the patience to `PATIENCE`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from trilane.scheduler.events import NEVER, DropCause, Settings
from trilane.scheduler.state import StageState
from trilane.unexpected_value import UnexpectedValue
from trilane.units import ALL_WORK, either


class Candidate(NamedTuple):
    """A job that could begin now.

    `frame`: number of its frame.
    `position`: index of its stage in the graph.
    `deadline_ns`: deadline of its frame, or NEVER.
    """

    frame: int
    position: int
    deadline_ns: int


def oldest_frame(candidates: Sequence[Candidate]) -> Candidate:
    """Choose the job of the oldest frame; along a chain this keeps the edges empty and the latency low."""
    return min(candidates)


def furthest_stage(candidates: Sequence[Candidate]) -> Candidate:
    """Choose the job of the last stage; to choose the newest frame would starve the later stages of a shared unit."""
    return max(candidates, key=lambda c: c.position)


def earliest_deadline(candidates: Sequence[Candidate]) -> Candidate:
    """Choose the job whose frame has the earliest deadline; ties go to the older frame."""
    return min(candidates, key=lambda c: (c.deadline_ns, c.frame))


@dataclass(frozen=True)
class Policy:
    """One row of `POLICIES`.

    `choose`: function that returns the job that a unit takes, from the jobs that could begin.
    `meaning`: what the policy does, for help texts.
    `told`: what a comparison says of a run under this policy.
    `in_flight`: limit of frames between admission and presentation; 0: the policy sets no limit.
    `newest`: whether a stage takes the newest waiting frame; all older waiting frames are stale and dropped.
    `drop_late`: whether a frame that cannot meet its deadline is dropped before its next stage.
    `lead_ns`: time before the expected end of a unit's job at which the unit gets its next job; 0: the unit gets the
    next job as soon as there is one.
    `paced`: whether the policy needs a rate: a period, arrivals or frame requests.
    """

    choose: Callable[[Sequence[Candidate]], Candidate]
    meaning: str
    told: str
    in_flight: int = 0
    newest: bool = False
    drop_late: bool = False
    lead_ns: int = 0
    paced: bool = False


POLICIES = {
    "sequential": Policy(oldest_frame, "one frame at a time", "one frame at a time", in_flight=1),
    "pipelined": Policy(oldest_frame, "highest rate", "several frames at a time"),
    "latest": Policy(
        furthest_stage, "newest pose wins", "the newest pose wins", newest=True, lead_ns=1_000_000, paced=True
    ),
    "deadline": Policy(
        earliest_deadline,
        "frames that would be late are dropped",
        "late frames are dropped",
        drop_late=True,
        lead_ns=1_000_000,
        paced=True,
    ),
}
#: The policies in words, for a person.
POLICY_WORDS: Final = either(POLICIES)
#: The policies that need a rate, in words.
PACED_WORDS: Final = " and ".join(name for name, policy in POLICIES.items() if policy.paced)


def policy_named(name: str) -> Policy:
    """Return the row of `POLICIES` with this name. Raises UnexpectedValue for an unknown name."""
    if name not in POLICIES:
        raise UnexpectedValue(f"policy {name!r}", f"one of {', '.join(POLICIES)}")
    return POLICIES[name]


def works_on_one_frame(name: str) -> bool:
    """Return whether a policy lets only one frame be in flight; False for an unknown name, as in an old report."""
    return name in POLICIES and POLICIES[name].in_flight == 1


MOST_FRAMES = 1_000_000  # that a pipeline file may ask for
DEADLINE_PERIODS = 3  # from a frame's release until it must be presented


def run_settings(policy: str, frames: int, scene_period_ns: int, forced_period_ns: int = 0, **others: Any) -> Settings:
    """Return the settings of a run of `frames` frames. With a period, the deadline is DEADLINE_PERIODS periods.

    `scene_period_ns`: period of the scene's rate in ns. Under `latest` and `deadline`, which need a rate, it is the
    period of releases. Under other policies a frame is released as soon as it can be taken.
    `forced_period_ns`: period of releases in ns under every policy; 0: `scene_period_ns` decides.
    `others`: further fields of Settings.

    Raises UnexpectedValue for an unknown policy, if `forced_period_ns` is 0.
    """
    period_ns = forced_period_ns or (scene_period_ns if policy_named(policy).paced else 0)
    return Settings(frames, policy, period_ns=period_ns, deadline_ns=DEADLINE_PERIODS * period_ns, **others)


class Source:
    """The source of frames 0..n-1. A released frame waits in `queue` until it is taken or dropped.

    Without a rate (no period, no arrivals, no requests) a frame counts as released at the moment when it can be taken.
    While frames are held, only `hold` and `request` release them. After the hold the next frame of a rate is due at
    once, and the frames after it follow at their usual distances.

    `drop`: function that is called with each frame that is dropped here, its release time in ns and the cause.
    `queue`: waiting frames as pairs (frame, release time in ns), the oldest first.
    `due_ns`: time at which the next frame is released or the oldest waiting frame runs out of time.
    `is_empty`: whether no frame can be taken now.
    """

    def __init__(self, settings: Settings, drop: Callable[[int, int, DropCause], None]) -> None:
        self._settings = settings
        self._drop = drop
        self._next = 0
        self._end = settings.frames
        self._start_ns = 0
        self._paced = bool(settings.period_ns or settings.arrivals_ns or settings.asked)
        self._held = False
        self._forgotten = 0
        self.queue: deque[tuple[int, int]] = deque()
        self.due_ns = NEVER
        self.is_empty = self._paced or not self._end  # with a rate, no frame is released before `start`

    @property
    def _waits(self) -> bool:
        """Whether a frame must be released before it can be taken."""
        return self._paced or self._held

    def start(self, now_ns: int) -> None:
        """Begin the run: periods and arrivals count from `now_ns`."""
        self._start_ns = now_ns
        self._set_due()

    def stop(self) -> None:
        """Release nothing more, and forget the waiting frames."""
        self._end = self._next
        self._forgotten += len(self.queue)
        self.queue.clear()
        self._set_due()

    @property
    def released(self) -> int:
        """The number of frames that were released so far, including waiting frames and those that `stop` forgot."""
        return self._next

    @property
    def left(self) -> int:
        """The number of frames that were taken from the source, or dropped by it."""
        return self._next - self._forgotten - len(self.queue)

    @property
    def exhausted(self) -> bool:
        return self._next >= self._end and not self.queue

    def advance(self, now_ns: int) -> bool:
        """Release the frames that are due, drop those that waited too long, and return whether something changed."""
        changed = False
        while self._paced and not self._held and self._next < self._end:
            release_ns = self._release_ns(self._next)
            if release_ns > now_ns:
                break
            self._admit(self._next, release_ns)
            self._next += 1
            changed = True
        timeout = self._settings.queue_timeout_ns
        while timeout and self.queue and self.queue[0][1] + timeout <= now_ns:
            self._drop(*self.queue.popleft(), DropCause.TIMEOUT)
            changed = True
        self._set_due()
        return changed

    def request(self, count: int, now_ns: int) -> None:
        """Release `count` frames now, or all frames that are left if they are fewer."""
        for frame in range(self._next, min(self._next + count, self._end)):
            self._admit(frame, now_ns)
            self._next += 1
        self._set_due()

    def hold(self, frames: int, now_ns: int) -> None:
        """Release `frames` frames now, and no others until the next call or `request`; -1 ends the hold."""
        if frames >= 0:
            self._held = True
            self.request(frames, now_ns)
        elif self._held:
            self._held = False
            if self._paced and not self._settings.asked and self._next < self._end:
                # All release times move to later times. Else every frame that came due in the hold would be released
                # when it ends.
                self._start_ns += now_ns - self._release_ns(self._next)
            self._set_due()

    def head(self, now_ns: int) -> tuple[int, int]:
        """Return (number, release time in ns) of the next frame; only valid if `is_empty` is False."""
        return self.queue[0] if self.queue else (self._next, now_ns)

    def keep_newest(self) -> None:
        """Drop all waiting frames but the newest, as stale."""
        while len(self.queue) > 1:
            self._drop(*self.queue.popleft(), DropCause.STALE)
        self._set_due()

    def drop_late_head(self) -> None:
        """Drop the frame that has waited longest, because it cannot be in time."""
        self._drop(*self.queue.popleft(), DropCause.LATE)
        self._set_due()

    def take(self, now_ns: int) -> tuple[int, int]:
        """Remove the next frame, and return its (number, release time in ns)."""
        head = self.head(now_ns)
        if self.queue:
            self.queue.popleft()
        else:
            self._next += 1
        self._set_due()
        return head

    def _admit(self, frame: int, release_ns: int) -> None:
        limit = self._settings.in_queue
        if limit and len(self.queue) >= limit:
            self._drop(frame, release_ns, DropCause.QUEUE_FULL)
        else:
            self.queue.append((frame, release_ns))

    def _set_due(self) -> None:
        self.is_empty = not self.queue and (self._waits or self._next >= self._end)
        is_timed = self._paced and not self._held and self._next < self._end
        self.due_ns = self._release_ns(self._next) if is_timed else NEVER
        if self._settings.queue_timeout_ns and self.queue:
            self.due_ns = min(self.due_ns, self.queue[0][1] + self._settings.queue_timeout_ns)

    def _release_ns(self, frame: int) -> int:
        # Only requests release frames.
        if self._settings.asked:
            return NEVER
        arrivals = self._settings.arrivals_ns
        return self._start_ns + (arrivals[frame] if arrivals else frame * self._settings.period_ns)


FULL: Final = 900  # thousandths of the period or the deadline
ROOM: Final = 750
PATIENCE: Final = 30  # frames
MOST_PATIENCE: Final = 960
SAMPLES: Final = 3
LOAD_ONE: Final = 1 << 20  # a load of 1
TWENTIETH: Final = 20


class WorkLadder:
    """The ladder of a run.

    `rung`: rung of the frames that begin from now on.
    `patience`: number of frames with room in a row, after which the ladder returns to more work.
    `last`: position of the last stage whose time follows the work; -1: none.
    """

    def __init__(
        self,
        stages: Sequence[StageState],
        works: Sequence[int],
        follow: Sequence[str],
        period_ns: int,
        deadline_ns: int,
    ) -> None:
        """Begin at rung 0.

        `stages`: stages of the chain.
        `works`: work of each rung in thousandths of all the work, from ALL_WORK downwards.
        `follow`: names of the stages that take less time for less work.
        `period_ns`: period of frames, more than 0.
        `deadline_ns`: longest time from a frame's release to its presentation; 0: none.
        """
        self.rung = 0
        self.patience = PATIENCE
        self.last = max([stage.position for stage in stages if stage.name in follow], default=-1)
        self._stages = stages
        self._period_ns, self._deadline_ns = period_ns, deadline_ns
        self._rungs = len(works)
        self._alone = [list(works) if stage.name in follow else [ALL_WORK] * len(works) for stage in stages]
        self._loads: list[deque[int]] = [deque(maxlen=SAMPLES) for _ in stages]
        self._waited = 0
        self._since_up = MOST_PATIENCE

    def set_alone(self, position: int, rung: int, service_ns: int) -> None:
        """Set a stage's isolated time on `rung`, in ns. Call this for all rungs of a stage, or for none.

        `position`: position of the stage.

        Raises ValueError for a rung that the ladder does not have.
        """
        if not 0 <= rung < self._rungs:
            raise ValueError(f"rung {rung}, but the ladder has {self._rungs}")
        self._alone[position][rung] = max(service_ns, 1)

    def learn(self, position: int, rung: int, service_ns: int) -> None:
        """Note that the stage at `position` took `service_ns` for a frame that began on `rung`."""
        self._loads[position].append(service_ns * LOAD_ONE // self._alone[position][rung])

    def service_ns(self, position: int, rung: int) -> int:
        """Return the time in ns that the stage at `position` would take now on `rung`; 0 before its first job."""
        loads = sorted(self._loads[position])
        return self._alone[position][rung] * loads[len(loads) // 2] // LOAD_ONE if loads else 0

    def use(self, rung: int) -> int:
        """Return the use of `rung` in thousandths."""
        of_units: dict[str, int] = {}
        for stage in self._stages:
            name = stage.unit.name
            of_units[name] = of_units.get(name, 0) + self.service_ns(stage.position, rung)
        busiest = max(of_units.values()) * ALL_WORK // self._period_ns
        if not self._deadline_ns:
            return busiest
        return max(busiest, sum(of_units.values()) * ALL_WORK // self._deadline_ns)

    def consider(self) -> bool:
        """Choose the rung, and return whether it changed. Call this once for each frame, after its jobs are learnt."""
        uses = [self.use(rung) for rung in range(self._rungs)]
        wanted = _first_that_does(uses)
        self._since_up += 1
        if wanted > self.rung:
            failed = self._since_up <= self.patience
            self.patience = min(2 * self.patience, MOST_PATIENCE) if failed else PATIENCE
            self.rung, self._waited, self._since_up = wanted, 0, MOST_PATIENCE
            return True
        has_room = self.rung > 0 and uses[self.rung - 1] <= ROOM
        self._waited = self._waited + 1 if has_room else 0
        if self._waited < self.patience:
            return False
        self.rung, self._waited, self._since_up = self.rung - 1, 0, 0
        return True


def _first_that_does(uses: Sequence[int]) -> int:
    """Return the first rung whose use is at most `FULL`; without one, the first within a twentieth of the least use."""
    enough = FULL if min(uses) <= FULL else min(uses) + min(uses) // TWENTIETH
    return next(rung for rung, use in enumerate(uses) if use <= enough)
