"""The output of a run: its messages and its failure while it goes on, and its result.

Rule: the first failure stands; the report also has every message. A result is plain data; a recording is written only
where the caller asks for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from trilane.errors import TrilaneError
from trilane.pipeline.run_metrics import RunMetrics
from trilane.scheduler.events import Drop, Loss
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.recording import Recording
from trilane.transport.messages import Failed


@dataclass(frozen=True)
class Failure:
    """Why a run ended early.

    `message`: one sentence.
    `exit_code`: exit code that the failure asks for.
    """

    message: str
    exit_code: int = 1


@dataclass(frozen=True)
class RunResult:
    """A finished run.

    `report`: what the run measured; the caller adds the machine and the configuration.
    `requested`, `presented`: numbers of frames.
    `lost`, `dropped`: numbers of frames by cause.
    `pids`: process id of each unit.
    `startup_ms`: start-up time of each unit in ms.
    `jobs`, `recording`: jobs and steps of a run without a journal. With a journal both are empty, and the journal has
    them (`trilane.pipeline.journal.Worked`).
    `metrics`: means of what each stage reported, over the jobs that reported it.
    `rungs`: number of presented frames on each rung, for a run with a ladder of work.
    `rung_switches`: how often a frame had another rung than the frame before.
    `messages`: texts of what went wrong on the way, such as a unit that died and was restarted.
    `interrupted`: whether a signal ended the run.
    `failure`: set when a stage failed or a unit could not be kept alive; the other fields hold what was done until
    then.
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
    """The messages and the failure of a run; each function of `hears` is called with every message.

    `messages`: the first MOST_MESSAGES messages, in order.
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
        """Note the failure, unless there was one before; the result shows it."""
        self.failure = self.failure or Failure(text, exit_code)

    def fail_with(self, message: Failed) -> None:
        """Say a stage's error and note it as the failure, unless there was one before."""
        if self.failure is None:
            self.fail(message.message, message.exit_code)
            self.say(message.message)


def after_stderr(tail: str) -> str:
    """Return the last line that a unit wrote to stderr as part of a sentence; empty if it wrote nothing."""
    lines = tail.splitlines()
    return f"it wrote last: {lines[-1]}" if lines else ""
