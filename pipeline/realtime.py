"""The driver on the host's clock. Rule: it waits, tells the core, and does what the core says; it decides nothing.

Before the run it brings the units up, warms them, and measures each stage while the others are quiet.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable
from statistics import fmean, median

from trilane.errors import TrilaneError
from trilane.hw_profiles.governor import Governor
from trilane.pipeline.processes import UnitMessage, UnitProcesses
from trilane.pipeline.requests import FrameRequestQueue
from trilane.pipeline.result import Failure
from trilane.pipeline.signals import Interrupts
from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    Action,
    Dispatch,
    Event,
    Finish,
    Graph,
    Job,
    JobDone,
    JobFailed,
    Kill,
    Pinged,
    Pong,
    SchedulerStalled,
    Settings,
    Start,
    Stop,
    UnitDied,
    UnitReady,
)
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.recording import Recording
from trilane.scheduler.state import NEVER
from trilane.transport import messages
from trilane.transport.job_pipe import PACKETS
from trilane.transport.messages import (
    Close,
    Closed,
    Done,
    Duration,
    Failed,
    Ping,
    Ready,
    RunIsolated,
    RunJob,
)

START_S = 120.0
CLOSE_S = 30.0
ISOLATE_LIMIT_S = 10.0  # frames measured alone: no more are begun after this
REPEATS = 3
PROGRESS_S = 0.1
PING_NS = 500_000_000
LONGEST_TURN_NS = PING_NS + 250_000_000  # between two steps, unless this process was stopped
AT_ONCE = PACKETS - 4  # the others are for what else may be under way


class UnitError(TrilaneError):
    """A unit could not start or be measured; `exit_code` is the one of the error in the unit."""

    def __init__(self, message: str, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class RealtimeDriver:
    """One run over `processes`. Use in order: start, measure_alone, run, close."""

    def __init__(
        self,
        graph: Graph,
        settings: Settings,
        processes: UnitProcesses,
        interrupts: Interrupts,
        on_progress: Callable[[int, int], None] | None = None,
        on_message: Callable[[str], None] | None = None,
        inlet: FrameRequestQueue | None = None,
        governor: Governor | None = None,
    ) -> None:
        self.core = Core(graph, settings)
        self.recording = Recording(graph, settings)
        self.jobs: list[JobRecord] = []
        self.figures: dict[str, Counter[str]] = defaultdict(Counter)
        self.messages: list[str] = []
        self.failure: Failure | None = None
        self.startup_ms: dict[str, float] = {}
        self._graph, self._processes, self._interrupts = graph, processes, interrupts
        self._on_progress, self._on_message = on_progress, on_message
        self._alone: dict[str, list[float]] = defaultdict(list)
        self._open: dict[int, tuple[Job, int]] = {}
        self._started_s: dict[str, float] = {}
        self._unbooked: list[tuple[Job, int, int | None, Done]] = []
        self._progress_s = 0.0
        self._ping_ns = 0
        self._stop_told = False
        self._inlet, self._last = inlet, graph.stages[-1].name
        self._governor = governor
        processes.watch(interrupts.fd)
        if inlet is not None:
            processes.watch(inlet.fd)

    # before the run

    def start(self) -> None:
        """Every unit up and bound. Raises UnitError when one cannot, KeyboardInterrupt when interrupted."""
        waiting = set(self._graph.units)
        for unit in self._graph.units:
            self._start(unit)
        end = time.monotonic() + START_S
        while waiting:
            if time.monotonic() > end:
                raise UnitError(f"unit {', '.join(sorted(waiting))} was not ready after {START_S:.0f} s")
            for unit, message in self._listen_before_run(waiting):
                if isinstance(message, Ready):
                    self._ready(unit)
                    waiting.discard(unit)

    def measure_alone(self, frames: list[int]) -> None:
        """Note the service time of each stage but the last (it writes files), the other units quiet.

        Each of `frames` goes down the chain through the first slot of every edge; then each unit repeats its stages
        in turn and without a pause, as it meets them in a pipelined run; the first turn follows a pause and does not
        count. Raises UnitError when a stage fails.
        """
        end = time.monotonic() + ISOLATE_LIMIT_S
        chain = self._graph.stages[:-1]
        for frame in frames:
            if frame != frames[0] and time.monotonic() > end:
                break
            for position, stage in enumerate(chain):
                self._isolated(stage.unit, [position], frame)
            for unit in self._graph.units:
                own = [position for position, stage in enumerate(chain) if stage.unit == unit]
                times = self._isolated(unit, own * (1 + REPEATS), frame)[len(own) :]
                for index, position in enumerate(own):
                    self._alone[chain[position].name].append(median(times[index :: len(own)]))

    def _isolated(self, unit: str, positions: list[int], frame: int) -> list[int]:
        """The durations in ns of jobs of the unit's stages at `positions`, as many handed to it at once as it takes."""
        found: list[int] = []
        for first in range(0, len(positions), AT_ONCE):
            several = positions[first : first + AT_ONCE]
            for position in several:
                place = self._processes.places[self._graph.stages[position].name]
                self._processes.send(unit, RunIsolated(place, frame, 0 if position else -1, 0))
            found += self._durations(unit, len(several))
        return found

    def measure_again(self, frames: list[int]) -> None:
        """The same after the run, so that a machine that grew slower or faster weighs on both sides; what goes
        wrong here leaves the run's result as it is."""
        if self.failure or not all(unit.alive for unit in self.core.units.values()):
            return
        try:
            self.measure_alone(frames)
        except (UnitError, KeyboardInterrupt) as error:
            self._say(f"the measurement after the run was left out: {error or 'interrupted'}")

    @property
    def alone_ns(self) -> dict[str, float]:
        """Mean service time in ns of each stage measured alone."""
        return {name: fmean(values) for name, values in self._alone.items()}

    def _durations(self, unit: str, count: int) -> list[int]:
        found: list[int] = []
        end = time.monotonic() + START_S
        while len(found) < count:
            if time.monotonic() > end:
                raise UnitError(f"unit {unit} did not end its jobs within {START_S:.0f} s")
            heard = self._listen_before_run({unit})
            found += [message.value for name, message in heard if name == unit and isinstance(message, Duration)]
        return found

    def _listen_before_run(self, _waiting: set[str]) -> list[UnitMessage]:
        heard = self._processes.listen(200)
        if self._interrupts.count:
            raise KeyboardInterrupt
        for unit, message in heard:
            if isinstance(message, Failed):
                raise UnitError(message.message, message.exit_code)
            if message is None:
                raise UnitError(f"unit {unit} ended before the run began{self._last_words(unit)}")
        return heard

    # the run

    def run(self) -> str:
        """Until the core finishes; returns its cause, or `aborted` after a second interrupt."""
        events: list[Event] = [UnitReady(unit) for unit in self._graph.units]
        if self._inlet is not None:
            self._inlet.is_open.set()
        if self._governor is not None:
            events += self._governor.begin(time.monotonic_ns())
        last_ns = time.monotonic_ns()
        while True:
            now_ns = time.monotonic_ns()
            if now_ns - last_ns > LONGEST_TURN_NS:
                events.insert(0, SchedulerStalled(now_ns - last_ns))
            last_ns = now_ns
            decision = self.core.step(now_ns, tuple(events))
            for action in decision.actions:
                self._perform(now_ns, action)
            self._book()
            self.recording.steps.append((now_ns, tuple(events), decision.actions))
            if self.core.finished:
                self._progress(final=True)
                return self._cause(decision.actions)
            if self._interrupts.count > 1:
                return self._abort()
            self._progress()
            events = self._wait(decision.next_deadline_ns)

    def _wait(self, deadline_ns: int | None) -> list[Event]:
        until_ns = min(self._ping_ns, NEVER if deadline_ns is None else deadline_ns)
        if self._governor is not None:
            until_ns = min(until_ns, self._governor.due_ns)
        timeout_ms = max(0, -((time.monotonic_ns() - until_ns) // 1_000_000))
        events = [event for heard in self._processes.listen(timeout_ms) if (event := self._event(heard)) is not None]
        if self._interrupts.count and not self._stop_told:
            self._stop_told = True
            self._say("interrupted: the frames in flight are finished; interrupt again to end at once")
            events.append(Stop())
        if self._inlet is not None:
            events += self._inlet.events()
        now_ns = time.monotonic_ns()
        if self._governor is not None and now_ns >= self._governor.due_ns:
            events += self._governor.tick(now_ns, self.core.ledger.busy_ns)
        if now_ns >= self._ping_ns:
            events += self._ping(now_ns)
        return events

    def _ping(self, now_ns: int) -> list[Event]:
        """FrameRequest the units that do not work whether they live; the others are heard of when their job ends."""
        self._ping_ns = now_ns + PING_NS
        asked = [unit.name for unit in self.core.units.values() if unit.alive and not unit.queue and not unit.pinged_ns]
        for unit in asked:
            self._processes.send(unit, Ping())
        return [Pinged(unit) for unit in asked]

    def _event(self, heard: UnitMessage) -> Event | None:
        unit, message = heard
        if isinstance(message, Done):
            return self._done(unit, message)
        if isinstance(message, Failed):
            return self._failed(unit, message)
        if isinstance(message, Ready):
            self._ready(unit)
            return UnitReady(unit)
        if isinstance(message, messages.Pong):
            return Pong(unit)
        if message is None:
            self._say(f"unit {unit} ended unexpectedly and is started again{self._last_words(unit)}")
            return UnitDied(unit)
        return None

    def _done(self, unit: str, message: Done) -> Event:
        job, dispatch_ns = self._open.pop(message.id)
        state = self.core.frames.get(job.frame)
        self._unbooked.append((job, dispatch_ns, None if state is None else state.ready_ns, message))
        if state is not None and self._inlet is not None and job.stage == self._last:
            self._inlet.answered(job.frame)
        return JobDone(unit, message.id, message.t_begin_ns, message.t_end_ns, message.t_sampled_ns)

    def _book(self) -> None:
        """Note what the ended jobs took, while the units are at the next."""
        for job, dispatch_ns, ready_ns, done in self._unbooked:
            if ready_ns is not None:
                times = (ready_ns, dispatch_ns, done.t_begin_ns, done.t_end_ns)
                self.jobs.append(JobRecord(job.stage, job.unit, job.frame, *times))
            self.figures[job.stage].update(done.metrics)
        self._unbooked.clear()

    def _failed(self, unit: str, message: Failed) -> Event | None:
        if self.failure is None:
            self.failure = Failure(message.message, message.exit_code)
            self._say(message.message)
        if message.id < 0:
            return None  # it could not be built again; the end of its process follows
        self._open.pop(message.id)
        return JobFailed(unit, message.id)

    def _perform(self, now_ns: int, action: Action) -> None:
        if isinstance(action, Dispatch):
            job = action.job
            self._open[job.id] = (job, now_ns)
            message = RunJob(job.id, self._processes.places[job.stage], job.frame, job.slot_in, job.slot_out, job.epoch)
            self._processes.send(job.unit, message)
        elif isinstance(action, Kill):
            self._say(f"unit {action.unit} did not answer in time and is restarted")
            self._processes.kill(action.unit)
        elif isinstance(action, Start):
            self._start(action.unit)

    def _cause(self, actions: tuple[Action, ...]) -> str:
        cause = next(action.cause for action in actions if isinstance(action, Finish))
        if cause in self._graph.units and self.failure is None:
            self.failure = Failure(f"unit {cause} could not be kept alive{self._last_words(cause)}")
        return cause

    def _abort(self) -> str:
        for frame in list(self.core.frames):
            self.core.lose(frame, "aborted")
        self.core.finish("aborted")
        return "aborted"

    # after the run

    def close(self) -> None:
        """Stages complete their files, then the processes leave. A unit that does not is killed by end_all."""
        waiting = set(self._processes.pids)
        for unit in waiting:
            self._processes.send(unit, Close())
        end = time.monotonic() + CLOSE_S
        while waiting and time.monotonic() < end and self._interrupts.count < 2:
            for unit, message in self._processes.listen(200):
                if isinstance(message, Failed):
                    self.failure = self.failure or Failure(message.message, message.exit_code)
                    self._say(message.message)
                if message is None or isinstance(message, Closed):
                    waiting.discard(unit)
        if waiting and self._interrupts.count < 2:
            self.failure = self.failure or Failure(f"unit {', '.join(sorted(waiting))} did not close its files")
        self._processes.wait_for_end(list(self._processes.pids))

    # helpers

    def _start(self, unit: str) -> None:
        self._started_s[unit] = time.monotonic()
        self._processes.start(unit)

    def _ready(self, unit: str) -> None:
        self._processes.connected(unit)
        self.startup_ms.setdefault(unit, (time.monotonic() - self._started_s[unit]) * 1000)

    def _last_words(self, unit: str) -> str:
        words = self._processes.last_words.get(unit, "")
        return f"; its last words: {words.splitlines()[-1]}" if words else ""

    def _say(self, text: str) -> None:
        self.messages.append(text)
        if self._on_message is not None:
            self._on_message(text)

    def _progress(self, *, final: bool = False) -> None:
        now_s = time.monotonic()
        if self._on_progress is not None and (final or now_s - self._progress_s >= PROGRESS_S):
            self._progress_s = now_s
            self._on_progress(len(self.core.ledger.presented_ns), self.core.settings.frames)
