"""The errors that reach a person: each says what was found, what was expected and how to mend it.

Rule: code raises these for anything a user can cause; the command line turns them into one sentence and an exit code.
The parts of a sentence are fields: nothing reads them out of a text.
"""

from __future__ import annotations

from pathlib import Path

from trilane.install import install_line
from trilane.unexpected_value import UnexpectedValue

#: Letters of what was found that are shown.
LONGEST_FOUND = 500


def reason(error: Exception) -> str:
    """Why it failed, as part of a sentence: an OSError without its number and path, any other error's own text."""
    if not isinstance(error, OSError):
        return str(error)
    text = error.strerror or str(error)
    return text[:1].lower() + text[1:]


class TrilaneError(Exception):
    """A failure with a message for people. Exit code 1: the run failed.

    `details`: lines that follow the message, where it takes more than one to say.
    """

    exit_code = 1
    details: tuple[str, ...] = ()


class BadInputError(TrilaneError):
    """Wrong usage or bad input. Exit code 2.

    `where` is the file, with key or line when known; `found`, `expected` and `remedy` are sentence parts. A long
    `found`, such as a whole line of a file, is shown without its middle.
    """

    exit_code = 2

    def __init__(self, where: str | Path, found: str, expected: str, remedy: str = "") -> None:
        shown = found if len(found) <= LONGEST_FOUND else f"{found[: LONGEST_FOUND - 100]} … {found[-100:]}"
        super().__init__(str(where), shown, expected, remedy)
        self.where, self.found, self.expected, self.remedy = str(where), shown, expected, remedy

    def __str__(self) -> str:
        return f"{self.where}: {UnexpectedValue(self.found, self.expected, self.remedy)}"

    @classmethod
    def at(cls, where: str | Path, unexpected: UnexpectedValue) -> BadInputError:
        """`unexpected`, whose place is `where`."""
        return cls(where, unexpected.found, unexpected.expected, unexpected.remedy)

    @classmethod
    def of_os_error(cls, where: str | Path, error: OSError, expected: str, remedy: str = "") -> BadInputError:
        """What the system said when `where` was opened, read or written.

        `where`: the file or folder.
        `error`: its reason is what was found.
        `expected`, `remedy`: sentence parts.
        """
        return cls(where, reason(error), expected, remedy)


class UnwrittenError(TrilaneError):
    """A file that was being written could not be written on, such as on a full disk. Exit code 1.

    `path`: of the file. `error`: what the system said.
    """

    def __init__(self, path: str | Path, error: OSError) -> None:
        super().__init__(str(path), error)
        self.path, self.error = str(path), error

    def __str__(self) -> str:
        return f"{self.path}: {reason(self.error)}"


class UnitLostError(TrilaneError):
    """A unit cannot go on, but a new process in its place can: it ends, and the scheduler restarts it."""


class MissingPartError(TrilaneError):
    """The environment lacks something. Exit code 3.

    `what` is missing. `install` is the line to type; `extra` in its place names one of Trilane's extras.
    """

    exit_code = 3

    def __init__(self, what: str, install: str = "", *, extra: str = "") -> None:
        self.what, self.install = what, install or install_line(extra)
        super().__init__(self.what, self.install)

    def __str__(self) -> str:
        return f"{self.what}; install it with: {self.install}"
