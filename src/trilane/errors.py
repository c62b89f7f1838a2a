"""The errors that reach a person: each says what was found, what was expected and how to fix it.

Code raises these errors for anything that a user can cause; the command line turns each into one sentence and an exit
code. The parts of the sentence are fields of the error, so that no code parses a text. A remedy may be the word that a
person most likely meant, or a command that installs a missing package. The command can be typed as it is, and fits the
way in which this Trilane was installed. It never fetches Trilane from a package index, because no index has Trilane.
"""

from __future__ import annotations

import errno
import importlib.metadata
import re
import resource
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator
from difflib import get_close_matches
from pathlib import Path

from trilane.unexpected_value import UnexpectedValue


def did_you_mean(word: str, known: Iterable[str], prefix: str = "") -> str:
    """Return the remedy `did you mean 'x'?`, where x is the word of `known` most like `word`; empty if no word is near.

    If exactly one word of `known` begins with `word`, it is near too.

    `prefix`: text that the remedy puts before the suggested word, such as a folder.
    """
    words = list(known)
    longer = [each for each in words if word and each.startswith(word)]
    near = get_close_matches(word, words, n=1) or (longer if len(longer) == 1 else [])
    return f"did you mean {prefix + near[0]!r}?" if near else ""


PACKAGE = Path(__file__).resolve().parent
#: Text in place of the packages' names if no installed distribution lists them. This happens if the source tree was
#: copied without its pyproject.toml.
UNKNOWN = "(the packages that Trilane's pyproject.toml lists)"
#: EGL and a software OpenGL driver, on Debian and Ubuntu.
EGL_LINE = "apt-get install libegl1 libgl1-mesa-dri"


def clone() -> Path | None:
    """Return the root of the source tree that this Trilane runs from; None if a wheel was installed.

    An editable install runs from a source tree too.
    """
    root = PACKAGE.parents[1]
    return root if PACKAGE.parent.name == "src" and (root / "pyproject.toml").is_file() else None


def pip() -> str:
    """Return the command that runs this Python's pip.

    The path in it is relative if this Python is in the .venv of the source tree, and the working directory is its root.
    """
    root = clone()
    if root is None or Path(sys.prefix).resolve() != root / ".venv":
        return f"{shlex.quote(sys.executable)} -m pip"
    return ".venv/bin/pip" if _stands_in(root) else shlex.quote(str(root / ".venv/bin/pip"))


def package_line(name: str) -> str:
    """Return the command that installs the package `name` from a package index."""
    return f"{pip()} install {name}"


def install_line(extra: str = "") -> str:
    """Return the command that installs the packages of `extra`.

    `extra`: one of Trilane's extras, or several joined by commas. Empty: the packages that every run needs.
    """
    root = clone()
    if root is not None:
        source = ("." if _stands_in(root) else str(root)) + (f"[{extra}]" if extra else "")
        return f"{pip()} install -e {shlex.quote(source)}"
    packages = [shlex.quote(each) for name in extra.split(",") for each in _requirements(name)] or [UNKNOWN]
    return f"{pip()} install {' '.join(packages)}"


def _stands_in(root: Path) -> bool:
    try:
        return Path.cwd() == root
    except FileNotFoundError:  # the working directory was removed
        return False


def _requirements(extra: str) -> Iterator[str]:
    """Yield the installed distribution's requirements for `extra`, or for every run if it is ""; without markers."""
    try:
        lines = importlib.metadata.requires("trilane") or []
    except importlib.metadata.PackageNotFoundError:
        return
    for line in lines:
        requirement, _, marker = line.partition(";")
        named = re.search(r"""extra\s*==\s*["']([\w.-]+)["']""", marker)
        if (named[1] if named else "") == extra:
            yield requirement.strip()


#: Error numbers after which a file takes no more data, and the remedy for them.
FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS})
FREE_SPACE = "free space there or choose another --out"
#: Most characters of `found` that a message shows.
LONGEST_FOUND = 500


def reason(error: Exception) -> str:
    """Return the reason of `error` as part of a sentence.

    For an OSError it is the system's text without number and path. If the limit on file sizes was reached, the limit is
    added. For any other error it is the error's own text.
    """
    if not isinstance(error, OSError):
        return str(error)
    text = error.strerror or str(error)
    limit = f": no file may have more than {_file_limit()} bytes (ulimit -f)" if _is_of_limit(error) else ""
    return text[:1].lower() + text[1:] + limit


def remedy(error: OSError, otherwise: str) -> str:
    """Return the command that lifts the limit on file sizes if `error` comes from that limit, else `otherwise`."""
    return "ulimit -f unlimited" if _is_of_limit(error) else otherwise


def _is_of_limit(error: OSError) -> bool:
    return error.errno == errno.EFBIG and _file_limit() != resource.RLIM_INFINITY


def _file_limit() -> int:
    return resource.getrlimit(resource.RLIMIT_FSIZE)[0]


class TrilaneError(Exception):
    """Base class of failures with a message for people. The exit code is 1, unless a subclass has another.

    `details`: further lines to print after the message.
    """

    exit_code = 1
    details: tuple[str, ...] = ()


class BadInputError(TrilaneError):
    """Wrong usage or bad input. Exit code 2.

    `where`: file, option or setting; for a file, with key or line if known.
    `found`, `expected`, `remedy`: sentence parts. A long `found` is shown without its middle.
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
        """Return `unexpected` as an error about the place `where`."""
        return cls(where, unexpected.found, unexpected.expected, unexpected.remedy)

    @classmethod
    def of_os_error(cls, where: str | Path, error: OSError, expected: str, remedy: str = "") -> BadInputError:
        """Return the error to raise after the system refused to open, read or write `where`.

        `where`: file or folder.
        `error`: error of the system; its reason becomes `found`.
        `expected`, `remedy`: sentence parts.
        """
        return cls(where, reason(error), expected, remedy)


class UnwrittenError(TrilaneError):
    """A file could not be written any further, for example on a full disk, or was removed. Exit code 1.

    `path`: path of the file. `error`: error of the system.
    """

    def __init__(self, path: str | Path, error: OSError) -> None:
        super().__init__(str(path), error)
        self.path, self.error = str(path), error

    def __str__(self) -> str:
        helps = f"; {remedy(self.error, FREE_SPACE)}" if self.error.errno in FULL else ""
        return f"{self.path}: {reason(self.error)}{helps}"


class UnitLostError(TrilaneError):
    """A unit's process cannot go on, but a new process can. The process ends, and the scheduler restarts the unit."""


class MissingPartError(TrilaneError):
    """A part that the program needs is not installed. Exit code 3.

    `what`: sentence part that names the missing part.
    `install`: command that installs this part; empty: the command that installs `extra`.
    `extra`: Trilane's extra that contains this part, or several extras joined by commas.
    """

    exit_code = 3

    def __init__(self, what: str, install: str = "", *, extra: str = "") -> None:
        self.what, self.extra, self.install = what, extra, install or install_line(extra)
        super().__init__(self.what, self.install)

    def __str__(self) -> str:
        return f"{self.what}; install it with: {self.install}"


def require(checks: Iterable[Callable[[], object]]) -> None:
    """Call all `checks`. If parts are missing, raise one MissingPartError, with one command that installs all of them.

    `checks`: functions that raise a MissingPartError with an `extra` if their part is missing.
    """
    missing: list[MissingPartError] = []
    for check in checks:
        try:
            check()
        except MissingPartError as error:
            missing.append(error)
    if missing:
        whats = dict.fromkeys(error.what for error in missing)
        extras = dict.fromkeys(error.extra for error in missing)
        raise MissingPartError(", and ".join(whats), extra=",".join(extras))
