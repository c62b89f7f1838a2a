"""The errors that reach a person: each says what was found, what was expected and how to mend it.

Rule: code raises these for anything a user can cause; the command line turns them into one sentence and an exit code.
"""

from __future__ import annotations

from pathlib import Path


class TrilaneError(Exception):
    """A failure with a message for people. Exit code 1: the run failed."""

    exit_code = 1


class BadInputError(TrilaneError):
    """Wrong usage or bad input. Exit code 2.

    `where` is the file, with key or line when known; `found`, `expected` and `fix` are sentence parts.
    """

    exit_code = 2

    def __init__(self, where: str | Path, found: str, expected: str, fix: str = "") -> None:
        self.where, self.found, self.expected, self.fix = str(where), found, expected, fix
        super().__init__(f"{where}: found {found}, expected {expected}" + (f"; {fix}" if fix else ""))

    @classmethod
    def about(cls, where: str | Path, error: ValueError) -> BadInputError:
        """Of an `error` whose text is `found A, expected B`."""
        found, _, expected = str(error).removeprefix("found ").partition(", expected ")
        return cls(where, found, expected)


class UnitLostError(TrilaneError):
    """A unit cannot go on, but a new process in its place can: it ends, and the scheduler restarts it."""


class MissingPartError(TrilaneError):
    """The environment lacks something. Exit code 3. `install` is the line to type."""

    exit_code = 3

    def __init__(self, what: str, install: str) -> None:
        self.what, self.install = what, install
        super().__init__(f"{what}; install it with: {install}")
