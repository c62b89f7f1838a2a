"""The output of a run: its messages, its failure, its record of steps and jobs, and its result.

Rule: only the first failure counts; the result also has the messages. A result is plain data; a recording is written
only if the caller asks for it.

Steps and jobs of a run are kept either in memory or in the run's journal, never in both. Memory is for a caller that
runs a few frames and needs all steps and jobs. With a journal, memory does not grow with the number of frames. Steps
are written many at a time, after the actions of the last step were sent to the units. To write each step alone would
take three times as long, because the code that writes would never be in the caches.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from trilane import machine
from trilane.errors import BadInputError, TrilaneError, UnwrittenError
from trilane.pipeline.journal import (
    SCHEMA,
    Accounted,
    Begun,
    Counted,
    Ended,
    JournalWriter,
    Said,
    Sampled,
    Stepped,
    Stopped,
    Worked,
    read_journal,
    records_of,
)
from trilane.pipeline.reckoning import Reckoned, reckoned
from trilane.pipeline.run_metrics import RunMetrics
from trilane.scheduler.core import Core
from trilane.scheduler.events import Action, Drop, Event, Graph, Loss, Settings
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.placement import Placement
from trilane.scheduler.recording import Recording
from trilane.scheduler.state import FULL_DUTY
from trilane.transport.messages import Failed
from trilane.writing import WRITABLE


@dataclass(frozen=True)
class Failure:
    """The reason why a run ended early.

    `message`: reason as one sentence.
    `exit_code`: exit code of the program after this failure.
    """

    message: str
    exit_code: int = 1


@dataclass(frozen=True)
class RunResult:
    """A finished run.

    `report`: figures of the run, without machine and configuration, which the caller adds.
    `requested`, `presented`: numbers of requested and of presented frames.
    `lost`, `dropped`: numbers of lost and of dropped frames, by cause.
    `pids`: process id of each unit.
    `startup_ms`: start-up time of each unit in ms.
    `jobs`, `recording`: jobs and steps of a run without a journal. With a journal both are empty, because the journal
    has the jobs and steps.
    `metrics`: mean of each metric of each stage, over the jobs that reported it; counts of bytes are left out.
    `rungs`: number of presented frames on each rung, for a run with a ladder of work.
    `rung_switches`: how often a frame had another rung than the frame before.
    `messages`: messages about problems during the run, such as a unit that died and was restarted.
    `interrupted`: whether a signal ended the run.
    `failure`: failure that ended the run; None without one. The other fields then cover the time until the failure.
    """

    report: RunMetrics
    requested: int
    presented: int
    lost: Mapping[Loss, int]
    dropped: Mapping[Drop, int]
    pids: Mapping[str, int]
    startup_ms: Mapping[str, float]
    jobs: tuple[JobRecord, ...]
    recording: Recording
    metrics: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    rungs: Mapping[int, int] = field(default_factory=dict)
    rung_switches: int = 0
    messages: tuple[str, ...] = ()
    interrupted: bool = False
    failure: Failure | None = None


# The memory of a run must not grow with its length; the journal has all messages.
MOST_MESSAGES = 1000


class UnitError(TrilaneError):
    """A unit could not start or be measured. `exit_code`: exit code of the error in the unit."""

    def __init__(self, message: str, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class RunLog:
    """The messages and the failure of a run.

    `hears`: functions that are called with the text of every message.
    `messages`: the first MOST_MESSAGES messages, in order, and a note about the number of further messages.
    `failure`: the run's first failure.
    """

    def __init__(self, *hears: Callable[[str], None]) -> None:
        self.failure: Failure | None = None
        self._hears = hears
        self._first: list[str] = []
        self._more = 0

    @property
    def messages(self) -> list[str]:
        more = f"{self._more} more messages are in the journal of the run alone"
        return [*self._first, more] if self._more else [*self._first]

    def say(self, text: str) -> None:
        if len(self._first) < MOST_MESSAGES:
            self._first.append(text)
        else:
            self._more += 1
        for hear in self._hears:
            hear(text)

    def fail(self, text: str, exit_code: int = 1) -> None:
        """Note the first failure of the run; do nothing for later failures.

        `text`: reason as one sentence. `exit_code`: exit code of the program after this failure.
        """
        self.failure = self.failure or Failure(text, exit_code)

    def fail_with(self, message: Failed) -> None:
        """Note a stage's error as failure and as message; do nothing if the run has failed before."""
        if self.failure is None:
            self.fail(message.message, message.exit_code)
            self.say(message.message)


def after_stderr(tail: str) -> str:
    """Return the last line of a unit's stderr as part of a sentence; empty if the unit wrote nothing.

    `tail`: stderr tail of the unit.
    """
    lines = tail.splitlines()
    return f"it wrote last: {lines[-1]}" if lines else ""


FLUSH_NS = 250_000_000
SAMPLE_NS = 5_000_000_000
STEPS_AT_ONCE = 64  # of about twelve frames
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class JournalFile:
    """The path of a run's journal, and content for the journal that the run itself does not know.

    `path`: path of a file that does not exist yet.
    `facts`: facts of the journal's first record, `Begun`.
    `sensors`: function that returns measured values by dotted name (`Sampled`); it is called every `SAMPLE_NS`.
    """

    path: Path
    facts: Mapping[str, Any]
    sensors: Callable[[], Mapping[str, float]] = dict


class JobSource(Protocol):
    """The methods of `trilane.pipeline.realtime_clock.RealtimeClock` with which a record of the run reads jobs."""

    @property
    def waiting(self) -> int:
        """The number of jobs that have ended since the last call of `ended`."""

    def ended(self) -> list[Worked | None]:
        """Return the jobs that ended since the last call; None stands for a job whose frame is gone."""

    def stopped(self) -> list[Stopped]:
        """Return a record for each unit that a signal was seen to have stopped since the last call."""


class CapReadings(Protocol):
    """The property of a run's governor that the journal records."""

    @property
    def temperatures_c(self) -> Mapping[str, float]:
        """The temperatures on which the governor's decisions depend, in degrees Celsius, by name."""


class _KeptRun:
    """The record of a run in memory, which the scheduler's loop fills through `add`. `failure` stays None."""

    def __init__(self, graph: Graph, settings: Settings) -> None:
        self.recording = Recording(graph, settings)
        self.jobs: list[JobRecord] = []
        self.failure: UnwrittenError | None = None
        self._source: JobSource | None = None

    def begin(self, source: JobSource, pids: Callable[[], Mapping[str, int]]) -> None:  # noqa: ARG002 - a journal has them
        """Note that the scheduler's loop begins. The jobs of `source` are read after the run.

        To read them during the run would slow units on the scheduler's core. `pids`: not used.
        """
        self._source = source

    def add(self, now_ns: int, events: tuple[Event, ...], actions: tuple[Action, ...], core: Core) -> None:
        """Record a step of `core`, after its actions were carried out."""
        self.recording.add(now_ns, events, actions, core)

    def say(self, text: str) -> None:
        """Do nothing, because the log of the run keeps the messages."""

    def reckoned(self, places: Placement) -> Reckoned:
        """Return what bounded the whole run; called after the loop. `places`: cores and threads of the run's units."""
        if self._source is not None:
            self.jobs += [worked.job for worked in self._source.ended() if worked is not None]
        recording = self.recording
        return reckoned(recording.graph, recording.settings, places, records_of(recording, self.jobs))

    def end(self, report: Mapping[str, Any]) -> None:
        """Do nothing, because everything is in memory."""


#: A step, the records that result from it, and the number of jobs that ended from the last writing to this step.
_Step = tuple[Stepped, list[Accounted | Counted], int]


class _JournaledRun:
    """The record of a run in the journal `file`. Its `recording` has no steps, and its `jobs` stay empty.

    `writer`: writer of the journal.
    `caps`: governor that sets the units' duties; duties and temperatures are sampled.
    """

    def __init__(
        self,
        file: JournalFile,
        writer: JournalWriter,
        graph: Graph,
        settings: Settings,
        caps: CapReadings | None,
        target_ns: int,
    ) -> None:
        self.recording = Recording(graph, settings)
        self.jobs: list[JobRecord] = []
        self._file, self._writer, self._caps = file, writer, caps
        self._source: JobSource | None = None
        self._pids: Callable[[], Mapping[str, int]] = dict
        self._accounts = dict.fromkeys(graph.units, -1)
        self._steps: list[_Step] = []
        self._left_out = self._flush_ns = self._sample_ns = 0
        began = {"clock": "host", "began_at": machine.here.now().isoformat(timespec="seconds")}
        self._writer.add(Begun(SCHEMA, graph, settings, {**began, "target_period_ns": target_ns, **file.facts}))
        self._writer.flush()

    def begin(self, source: JobSource, pids: Callable[[], Mapping[str, int]]) -> None:
        self._source, self._pids = source, pids

    @property
    def failure(self) -> UnwrittenError | None:
        return self._writer.failure

    def add(self, now_ns: int, events: tuple[Event, ...], actions: tuple[Action, ...], core: Core) -> None:
        """Record a step of `core`, after its actions were carried out. If there is a `failure`, raise it."""
        if self._writer.failure is not None:
            raise self._writer.failure
        follows: list[Accounted | Counted] = []
        accounts = self._accounts
        for unit in core.units.values():
            if accounts[unit.name] != unit.account:
                accounts[unit.name] = unit.account
                follows.append(Accounted(unit.account_ns, unit.name, unit.account))
        ledger = core.ledger
        if ledger.left_out != self._left_out:
            self._left_out = ledger.left_out
            follows.append(Counted(now_ns, ledger.lost_by_cause, ledger.dropped_by_cause))
        ended = self._source.waiting if self._source is not None else 0
        self._steps.append((Stepped(now_ns, events, actions), follows, ended))
        if len(self._steps) == STEPS_AT_ONCE or now_ns >= self._flush_ns:
            self._write()
        if now_ns >= self._flush_ns:
            self._sample(now_ns, core)

    def _write(self) -> None:
        """Add the steps and jobs since the last call to the journal. Raises UnwrittenError if this fails."""
        add, told = self._writer.add, 0
        jobs = self._source.ended() if self._source is not None else []
        for stopped in self._source.stopped() if self._source is not None else []:
            add(stopped)  # before the record of the job that the stop made longer
        for step, follows, ended in self._steps:
            add(step)
            for record in (*follows, *jobs[told:ended]):
                if record is not None:
                    add(record)
            told = ended
        self._steps.clear()

    def say(self, text: str) -> None:
        with suppress(UnwrittenError):  # the next `add` raises it
            self._writer.add(Said(time.monotonic_ns(), text))
            self._writer.flush()

    def reckoned(self, places: Placement) -> Reckoned:
        """Return what bounded the whole run. Raises `failure` if the recorded steps and jobs are gone."""
        with suppress(UnwrittenError):  # it stays as `failure`
            self.flush()
        records = read_journal(self._file.path)
        try:
            next(records)  # the header
        except BadInputError:
            if self.failure is not None:  # it was removed
                raise self.failure from None
            raise
        return reckoned(self.recording.graph, self.recording.settings, places, records)

    def end(self, report: Mapping[str, Any]) -> None:
        with suppress(UnwrittenError):  # it stays as `failure`
            self._writer.add(Ended(time.monotonic_ns(), report))
            self._writer.flush()

    def flush(self) -> None:
        """Write everything that was recorded to the file. Raises UnwrittenError if this fails."""
        self._write()
        self._writer.flush()

    def _sample(self, now_ns: int, core: Core) -> None:
        """Write the measured values that are due, and flush, so that readers of the journal see them."""
        self._flush_ns = now_ns + FLUSH_NS
        values: dict[str, float] = {}
        if self._caps is not None:
            values = {f"duty.{unit.name}": unit.duty / FULL_DUTY for unit in core.units.values()}
            values |= {f"temperature_c.{name}": celsius for name, celsius in self._caps.temperatures_c.items()}
        if now_ns >= self._sample_ns:
            self._sample_ns = now_ns + SAMPLE_NS
            values |= self._file.sensors()
            pids = {"scheduler": os.getpid(), **self._pids()}
            values |= {f"memory_bytes.{name}": memory_bytes(pid) for name, pid in pids.items()}
        if values:
            self._writer.add(Sampled(now_ns, values))
        self._writer.flush()


RunRecord = _KeptRun | _JournaledRun


@contextmanager
def recorded(
    file: JournalFile | None, graph: Graph, settings: Settings, caps: CapReadings | None, target_period_ns: int
) -> Iterator[RunRecord]:
    """Yield the record of one run. At the end of the context the file is complete, however the run ended.

    `file`: journal of the run; None: the record is in memory.
    `caps`: governor that sets the units' duties, or None.
    `target_period_ns`: as for `trilane.scheduler.stats.due_ns`, for the journal.

    Raises BadInputError if the file cannot be made.
    """
    if file is None:
        yield _KeptRun(graph, settings)
        return
    try:
        writer = JournalWriter(file.path)
    except OSError as error:
        raise BadInputError.of_os_error(file.path, error, WRITABLE) from None
    with writer:
        run = _JournaledRun(file, writer, graph, settings, caps, target_period_ns)
        try:
            yield run
        finally:
            with suppress(UnwrittenError):  # the run raised this error already when it tried to write
                run.flush()


def memory_bytes(pid: int) -> int:
    """Return the memory in use (RSS) of a process in bytes, including shared memory; 0 for a process that has ended."""
    try:
        return int((machine.here.proc / f"{pid}/statm").read_text(encoding="ascii").split()[1]) * PAGE_BYTES
    except (OSError, IndexError):
        return 0
