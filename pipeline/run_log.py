"""What a person is told while a run goes on. Rule: the first failure stands; the report also has every message."""

from __future__ import annotations

from collections.abc import Callable

from trilane.errors import TrilaneError
from trilane.pipeline.result import Failure
from trilane.transport.messages import Failed

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
