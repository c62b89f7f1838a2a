"""The host clock, for the scheduler's loop, and the CPU time of units in the report of a run on this machine.

Rule: the clock waits and carries out the core's actions; it decides nothing. `wait` turns messages of the units,
signals and the governor's duties into events; `perform` turns actions into messages. The shares of the units include
the time for which a viewer held the run; a message states how long this was (`HeldTime`).

Rule: CPU time counts only within the run. If figures contradict each other, or were not measured, a message says so. A
unit's CPU time covers all threads of its process, including threads that a runtime lets spin between jobs. Units that
may run only on a set of cores cannot have more CPU time than these cores had time. If they seem to have more, a thread
has run elsewhere or a clock is wrong.
"""

from __future__ import annotations

import contextlib
import signal
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from trilane.errors import TrilaneError
from trilane.pipeline.controls import FrameRequestQueue, Interrupts, RunControls
from trilane.pipeline.description import Pipeline
from trilane.pipeline.job_times import counts_run_delay
from trilane.pipeline.journal import Stopped, Worked
from trilane.pipeline.result import RunLog
from trilane.pipeline.unit_processes import UnitMessage, UnitProcesses
from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    NEVER,
    Abort,
    Action,
    Dispatch,
    Event,
    Hold,
    Job,
    JobDone,
    JobFailed,
    Kill,
    Pinged,
    Pong,
    SchedulerStalled,
    SetDuty,
    Start,
    Stop,
    UnitDied,
    UnitReady,
)
from trilane.scheduler.ledger import PREEMPTED, JobRecord
from trilane.scheduler.stats import Samples, Sketch
from trilane.transport import messages
from trilane.transport.messages import Done, Failed, Ping, Ready, RunJob
from trilane.units import NS_PER_S

CLOCKS_DIFFER = 0.001  # CLOCK_MONOTONIC is slewed by up to 500 ppm; the clock of CPU times is not


class CoreUse(NamedTuple):
    """The use of a set of cores by the units that run only on these cores.

    `cores`: numbers of the cores.
    `units`: names of the units.
    `cpu`: sum of the units' CPU time, as a share of the time that the cores had.
    `busy`: sum of the units' busy time, as a share of the time that the cores had.
    """

    cores: tuple[int, ...]
    units: tuple[str, ...]
    cpu: float
    busy: float

    @property
    def is_possible(self) -> bool:
        """Whether the CPU time is at most the time that the cores had."""
        return self.cpu <= 1 + CLOCKS_DIFFER


class CpuTimes:
    """The CPU time of each unit and of each stage's jobs, in ns.

    `cores`: number of cores of each unit.
    `sketch`: function that makes a sketch, as for `trilane.scheduler.stats.Samples`.
    `in_jobs_ns`, `between_ns`: CPU time of each unit in its jobs, and before or between them.
    `stage_ns`: CPU time of each job of a stage, by the stage's name.
    """

    def __init__(self, cores: Mapping[str, int], sketch: Callable[[], Sketch] | None = None) -> None:
        self._cores = cores
        self.in_jobs_ns: Counter[str] = Counter()
        self.between_ns: Counter[str] = Counter()
        self.stage_ns: defaultdict[str, Samples] = defaultdict(lambda: Samples(sketch))
        self._begun: set[str] = set()

    def add(self, unit: str, stage: str, done: Done, run_begin_ns: int) -> None:
        """Book a job.

        CPU time before a unit's first job counts only up to the time that the unit's cores had since the run began. CPU
        time between two jobs has no such limit, because an impossible figure must stay visible (`is_possible`).

        `done`: the unit's answer to the job.
        `run_begin_ns`: time in ns at which the run began.
        """
        self.in_jobs_ns[unit] += done.cpu_ns
        self.stage_ns[stage].add(done.cpu_ns)
        before_ns = done.cpu_before_ns
        if unit not in self._begun:
            self._begun.add(unit)
            before_ns = min(before_ns, max(done.t_begin_ns - run_begin_ns, 0) * self._cores[unit])
        self.between_ns[unit] += before_ns

    def of_unit_s(self, unit: str) -> float:
        """Return the unit's CPU time in seconds, from the begin of the run to the end of the unit's last job."""
        return (self.in_jobs_ns[unit] + self.between_ns[unit]) / NS_PER_S


def use_of_cores(
    cores: Mapping[str, Sequence[int]], cpu_s: Mapping[str, float], busy: Mapping[str, float], duration_s: float
) -> list[CoreUse]:
    """Return the use of each unit's set of cores, and of all cores together, the smallest set first.

    `cores`: numbers of the cores of each unit.
    `cpu_s`: CPU time of each unit in seconds.
    `busy`: busy time of each unit, as a share of the run's time (0 to 1).
    `duration_s`: time of the run in seconds.
    """
    sets = {frozenset(own) for own in cores.values()} | {frozenset().union(*cores.values())}
    rows = []
    for these in sorted(sets, key=lambda these: (len(these), sorted(these))):
        units = tuple(unit for unit, own in cores.items() if these.issuperset(own))
        had_s = len(these) * duration_s
        cpu = sum(cpu_s[unit] for unit in units) / had_s if had_s else 0.0
        rows.append(CoreUse(tuple(sorted(these)), units, cpu, sum(busy[unit] for unit in units) / len(these)))
    return rows


NO_RUN_DELAY = (
    "this kernel does not count how long threads wait for a core (CONFIG_SCHED_INFO): the time in which a unit had a "
    "job but not its core is not known, and counts as overhead"
)


def add_accounts(report: dict[str, Any], pipeline: Pipeline, cpu: CpuTimes, log: RunLog) -> None:
    """Add CPU times to a ledger's report: `cpu_s` and `cpu_in_jobs_s` of units, `cpu_ms` of stages, and `core_shares`.

    If the kernel counts no run delay, the idle share `preempted` of each unit becomes None.

    `report`: report of a ledger, which is changed in place.
    `pipeline`: pipeline that ran.
    `cpu`: CPU time of the pipeline's units and stages.
    `log`: log that gets messages about missing or contradictory figures.
    """
    for unit, row in report["units"].items():
        row.update(cpu_s=cpu.of_unit_s(unit), cpu_in_jobs_s=cpu.in_jobs_ns[unit] / NS_PER_S)
    for stage, row in report["stages"].items():
        row["cpu_ms"] = cpu.stage_ns[stage].summary_ms()
    cores = {unit: pipeline.units[unit].cores for unit in report["units"]}
    cpu_s = {unit: cpu.of_unit_s(unit) for unit in cores}
    uses = use_of_cores(cores, cpu_s, {unit: report["units"][unit]["busy"] for unit in cores}, report["duration_s"])
    report["core_shares"] = [use._asdict() for use in uses]
    for use in uses:
        if not use.is_possible:
            log.say(f"{', '.join(use.units)} had {use.cpu:.1%} of the time of cores {use.cores}: please report this")
    if not counts_run_delay():
        for row in report["units"].values():
            row["idle"][PREEMPTED] = None
        log.say(NO_RUN_DELAY)


PROGRESS_S = 0.1
PING_NS = 500_000_000
LONGEST_STEP_NS = PING_NS + 250_000_000  # between two steps, unless this process was stopped


class ClockGovernor(Protocol):
    """A governor: limits each unit to a share of the time. `due_ns`: time at which the clock next calls `tick`."""

    due_ns: int

    def begin(self, now_ns: int) -> list[SetDuty]:
        """Return an event for the duty of each unit at the start of the run."""

    def tick(self, now_ns: int, busy_ns: dict[str, int]) -> list[SetDuty]:
        """Return an event for each duty that changes now. `busy_ns`: busy time of each unit in ns since the start."""


class RealtimeClock:
    """The host clock of one run: a `trilane.scheduler.core.Clock` for `core`, with the units in `processes`.

    `on_progress`: function that is called with (number of presented frames, number of frames of the run), or None.
    `sketch`: function that makes a sketch, as for `trilane.scheduler.stats.Samples`.
    `requests`, `controls`: frame requests, and other requests to the run; None: none.
    `metrics`: sums of each stage's metrics over the jobs that `ended` has returned, by stage and metric.
    `reported`: number of these jobs that reported each metric, by stage and metric.
    `cpu`: CPU time of units and stages in these jobs.
    `first`: events that the core gets before all other events.
    """

    def __init__(
        self,
        core: Core,
        processes: UnitProcesses,
        interrupts: Interrupts,
        log: RunLog,
        requests: FrameRequestQueue | None,
        governor: ClockGovernor | None,
        on_progress: Callable[[int, int], None] | None,
        sketch: Callable[[], Sketch] | None = None,
        controls: RunControls | None = None,
    ) -> None:
        self.metrics: dict[str, dict[str, float]] = defaultdict(dict)
        self.reported: dict[str, Counter[str]] = defaultdict(Counter)
        self.cpu = CpuTimes(processes.core_counts, sketch)
        self.first: list[Event] = []
        self._core, self._processes, self._interrupts, self._log = core, processes, interrupts, log
        self._requests, self._governor, self._on_progress = requests, governor, on_progress
        self._controls = controls
        self._last_stage = core.graph.stages[-1].name
        self._open: dict[int, tuple[Job, int]] = {}
        self._unbooked: list[tuple[Job, int, int | None, Done]] = []
        self._held = HeldTime()
        self._to_end: set[str] = set()
        self._stopped_ns: dict[str, int] = {}
        self._unnoted: list[Stopped] = []
        self._begun = self._stopping = self._is_lost = False
        self._step_ns = self._ping_ns = self._continued = 0
        self._progress_s = 0.0
        for watched in (interrupts, requests, controls):
            if watched is not None:
                processes.watch(watched.fd)

    def wait(self, deadline_ns: int) -> tuple[int, tuple[Event, ...]]:
        """Wait for an event, until `deadline_ns` at the latest, and return (time in ns, events)."""
        self._show_progress()
        self._tell_unanswered()
        events = self._listen(deadline_ns) if self._begun else self._begin()
        now_ns = time.monotonic_ns()
        # This process was stopped. Without this event, the core would restart healthy units.
        if now_ns - self._step_ns > LONGEST_STEP_NS:
            events.insert(0, SchedulerStalled(now_ns - self._step_ns))
            self._tell_stalled(now_ns - self._step_ns)
        self._step_ns = now_ns
        self._continued = self._interrupts.continued
        return now_ns, tuple(events)

    def perform(self, now_ns: int, actions: tuple[Action, ...]) -> None:
        """Carry out the actions: send jobs to units, and kill or start the processes of units."""
        for action in actions:
            if isinstance(action, Dispatch):
                self._dispatch(now_ns, action.job)
            elif isinstance(action, Kill):
                why = ", because a signal has stopped it," if action.unit in self._processes.stopped else ""
                self._log.say(f"unit {action.unit} did not answer in time{why} and is restarted")
                self._to_end.add(action.unit)
                self._processes.kill(action.unit)
            elif isinstance(action, Start):
                try:
                    self._processes.start(action.unit)
                except (TrilaneError, OSError) as error:  # the next step aborts the run
                    self._log.fail(str(error))
                    self._is_lost = True

    @property
    def waiting(self) -> int:
        """The number of jobs that have ended since the last call of `ended`."""
        return len(self._unbooked)

    def ended(self) -> list[Worked | None]:
        """Book and return the jobs that have ended since the last call.

        None stands for a job whose frame was dropped or lost meanwhile.
        """
        found: list[Worked | None] = []
        for job, dispatch_ns, ready_ns, done in self._unbooked:
            if ready_ns is None:
                found.append(None)
            else:
                record = JobRecord(
                    stage=job.stage,
                    unit=job.unit,
                    frame=job.frame,
                    ready_ns=ready_ns,
                    dispatch_ns=dispatch_ns,
                    begin_ns=done.t_begin_ns,
                    end_ns=done.t_end_ns,
                    preempted_ns=done.preempted_ns,
                    asleep_ns=done.asleep_ns,
                    preempted_before_ns=done.preempted_before_ns,
                    cpu_ns=done.cpu_ns,
                )
                found.append(Worked(record, done.metrics))
            self.cpu.add(job.unit, job.stage, done, self._core.ledger.start_ns)
            sums, counts = self.metrics[job.stage], self.reported[job.stage]
            for name, value in done.metrics.items():
                sums[name] = sums.get(name, 0.0) + value
                counts[name] += 1
        self._unbooked.clear()
        return found

    def stopped(self) -> list[Stopped]:
        """Return a record for each unit that a signal was seen to have stopped since the last call."""
        unnoted, self._unnoted = self._unnoted, []
        return unnoted

    def finish(self) -> None:
        """Show the final progress, and log how long the run was held."""
        if held := self._held.sentence(time.monotonic_ns()):
            self._log.say(held)
        self._show_progress(final=True)

    def _begin(self) -> list[Event]:
        self._begun = True
        self._step_ns = time.monotonic_ns()
        events: list[Event] = [*self.first, *(UnitReady(unit) for unit in self._core.graph.units)]
        if self._requests is not None:
            self._requests.is_open.set()
        if self._governor is not None:
            events += self._governor.begin(self._step_ns)
        return events

    def _listen(self, deadline_ns: int) -> list[Event]:
        if self._is_lost:
            return [Abort()]
        until_ns = min(self._ping_ns, deadline_ns, NEVER if self._governor is None else self._governor.due_ns)
        timeout_ms = max(0, -((time.monotonic_ns() - until_ns) // 1_000_000))
        messages = self._processes.listen(timeout_ms)
        events = [event for message in messages if (event := self._event(message)) is not None]
        events += self._interrupted()
        if self._controls is not None:
            events += self._asked(self._controls)
        if self._requests is not None:
            events += self._requests.events()
        now_ns = time.monotonic_ns()
        if self._governor is not None and now_ns >= self._governor.due_ns:
            events += self._governor.tick(now_ns, self._core.ledger.busy_ns)
        if now_ns >= self._ping_ns:
            events += self._ping(now_ns)
        return events

    def _interrupted(self) -> list[Event]:
        """Return the events that follow from signals: the first signal stops the run, the second aborts it."""
        if self._interrupts.count > 1:
            return [Abort()]
        if self._interrupts.count and not self._stopping:
            self._stopping = True
            by = "" if self._interrupts.last == signal.SIGINT else f" by {self._interrupts.last.name}"
            self._log.say(f"interrupted{by}: the frames in flight are finished; interrupt again to end at once")
            return [Stop()]
        return []

    def _asked(self, controls: RunControls) -> list[Event]:
        events, kills = controls.taken()
        self._held.hear(time.monotonic_ns(), events)
        for unit in kills:
            self._log.say(f"unit {unit} is killed, as was asked")
            self._to_end.add(unit)
            self._processes.kill(unit)
        return events

    def _ping(self, now_ns: int) -> list[Event]:
        """Ping the units without a job, and return an event for each. A busy unit needs none: its job has a deadline.

        Units that a signal has stopped, and a fork server that does not answer, are noticed here too.
        """
        self._ping_ns = now_ns + PING_NS
        with contextlib.suppress(OSError):  # starting the next unit tries again
            if why := self._processes.renew_starter():
                self._log.say(f"{why} and is replaced")
        self._tell_stopped(now_ns)
        units = [unit.name for unit in self._core.units.values() if unit.awaits_nothing]
        for unit in units:
            self._processes.send(unit, Ping())
        return [Pinged(unit) for unit in units]

    def _tell_stopped(self, now_ns: int) -> None:
        """Note units that a signal has stopped. If a stopped unit runs again, log how long it was stopped."""
        stopped = self._processes.stopped
        for unit in stopped - self._stopped_ns.keys():
            self._stopped_ns[unit] = now_ns
            self._unnoted.append(Stopped(now_ns, unit))
        for unit in self._stopped_ns.keys() - stopped:
            seconds = (now_ns - self._stopped_ns.pop(unit)) / NS_PER_S
            self._log.say(f"unit {unit} was stopped by a signal for about {seconds:.1f} s")

    def _tell_stalled(self, ns: int) -> None:
        """If a signal had stopped this process, log for how long; do nothing if the process only had no core."""
        if self._interrupts.continued > self._continued:
            frame = min(self._core.frames, default=self._core.ledger.presented_count)
            seconds = ns / NS_PER_S
            self._log.say(f"the scheduler itself was stopped by a signal for about {seconds:.1f} s, at frame {frame}")

    def _event(self, unit_message: UnitMessage) -> Event | None:
        unit, message = unit_message
        if isinstance(message, Done):
            return self._done(unit, message)
        if isinstance(message, Failed):
            return self._failed(unit, message)
        if isinstance(message, Ready):
            self._processes.connected(unit)
            return UnitReady(unit)
        if isinstance(message, messages.PongMessage):
            return Pong(unit)
        if message is None:
            self._open = {number: held for number, held in self._open.items() if held[0].unit != unit}
            how = "has ended" if unit in self._to_end else "ended unexpectedly"
            self._to_end.discard(unit)
            self._log.say(f"unit {unit} {how} and is started again{self._processes.why_ended(unit)}")
            return UnitDied(unit)
        return None

    def _done(self, unit: str, message: Done) -> Event:
        job, dispatch_ns = self._open.pop(message.id)
        # `ended` books the job later, so that the unit's next job is sent first.
        self._unbooked.append((job, dispatch_ns, self._core.ready_ns(job), message))
        if job.frame in self._core.frames and self._requests is not None and job.stage == self._last_stage:
            self._requests.answered(job.frame)
        return JobDone(
            unit=unit,
            job=message.id,
            t_begin_ns=message.t_begin_ns,
            t_end_ns=message.t_end_ns,
            t_sampled_ns=message.t_sampled_ns,
            preempted_ns=message.preempted_ns,
            asleep_ns=message.asleep_ns,
            preempted_before_ns=message.preempted_before_ns,
            skips=message.skips > 0,
        )

    def _failed(self, unit: str, message: Failed) -> Event | None:
        self._log.fail_with(message)
        if message.id < 0:
            return None  # its stages could not be built again; the end of the process follows
        self._open.pop(message.id)
        return JobFailed(unit, message.id)

    def _dispatch(self, now_ns: int, job: Job) -> None:
        self._open[job.id] = (job, now_ns)
        place = self._processes.places[job.stage]
        fields = (job.id, place, job.frame, job.slot_in, job.slot_out, job.epoch, now_ns, int(job.fresh), job.rung)
        self._processes.send(job.unit, RunJob(*fields))

    def _tell_unanswered(self) -> None:
        """Tell the queue of frame requests the number of dropped and lost frames by cause."""
        if self._requests is None:
            return
        ledger = self._core.ledger
        if ledger.dropped or ledger.lost:
            self._requests.tell_unanswered({**ledger.dropped_by_cause, **ledger.lost_by_cause})

    def _show_progress(self, *, final: bool = False) -> None:
        now_s = time.monotonic()
        if self._on_progress is not None and (final or now_s - self._progress_s >= PROGRESS_S):
            self._progress_s = now_s
            self._on_progress(self._core.ledger.presented_count, self._core.settings.frames)


class HeldTime:
    """Measures how long the run was held. A hold lasts until it is ended, even if it releases single frames."""

    def __init__(self) -> None:
        self._total_ns = 0
        self._since_ns: int | None = None

    def hear(self, now_ns: int, events: Iterable[Event]) -> None:
        """Take the events that were requested at `now_ns`; all events but `Hold` are ignored."""
        for event in events:
            if not isinstance(event, Hold):
                continue
            if event.frames < 0:
                self._total_ns, self._since_ns = self.until(now_ns), None
            elif self._since_ns is None:
                self._since_ns = now_ns

    def until(self, now_ns: int) -> int:
        """Return the time in ns for which the run was held up to `now_ns`."""
        return self._total_ns + (0 if self._since_ns is None else now_ns - self._since_ns)

    def sentence(self, now_ns: int) -> str:
        """Return the message that states how long the run was held; empty if the run was never held."""
        held_s = self.until(now_ns) / NS_PER_S
        if not held_s:
            return ""
        return f"held for {held_s:.1f} s by who watched it: shares of units have that in them, frame times do not"
