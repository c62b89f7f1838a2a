"""Makes the folder of a run. Until the folder is complete, it has a temporary name in the same parent folder.

Rule: a folder with the run's name is complete; a folder whose name ends in `.partial` is not. If a file cannot be
written, as on a full disk, the written files stay in the partial folder, and the error names this folder.
"""

from __future__ import annotations

import fcntl
import glob
import os
import shutil
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Self

from trilane import machine
from trilane.errors import FREE_SPACE, FULL, BadInputError, TrilaneError, UnwrittenError, reason, remedy
from trilane.writing import WRITABLE

#: Bytes reserved for the report: MOST_MESSAGES of 2000 bytes each, doubled by JSON's escapes, and the figures.
RESERVED_BYTES = 4 << 20


def require_free(target: Path) -> None:
    """Raise BadInputError if `target` exists, or if a live run will rename its folder to `target`."""
    found = "a file or folder" if target.exists() else ""
    for other in _partial(target):
        if is_locked(other):
            found = f"a run that goes on, in {other.name}"
    if found:
        raise BadInputError(target, found, "a name that is free", "choose another --out")


def default_place(scene: str) -> Path:
    """Return the path `runs/<UTC time>-<scene>` in the working directory.

    `scene`: name of the scene; characters that a file name should not have become `-`. If another run has the path, the
    name ends in `-2`, `-3` and so on.
    """
    stamp = machine.here.now().strftime("%Y%m%dT%H%M%SZ")
    safe = "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in scene)
    place, tries = Path("runs") / f"{stamp}-{safe}", 1
    while place.exists() or any(_partial(place)):
        tries += 1
        place = Path("runs") / f"{stamp}-{safe}-{tries}"
    return place


class RunFolder:
    """A context manager that makes a run folder with the temporary path `work`. `complete` renames it to `target`.

    Without `complete`, the exit removes `work` and the parent folders that the entry made. RESERVED_BYTES on the disk
    stay reserved for the report until `release`.
    The entry raises BadInputError if `target` exists or another live run will get that path. It also does if `work`
    cannot be made, or if the disk has no room for a report. The entry raises UnwrittenError if a limit of this process
    forbids a file of RESERVED_BYTES.
    The exit raises TrilaneError if `work` was moved or removed, or if the block ends because a file could not be
    written. In the latter case, `work` stays if it has content.
    """

    def __init__(self, target: Path) -> None:
        self.target = target.absolute()
        names = (self.target.with_name(f"{self.target.name}.{number}.partial") for number in count(os.getpid()))
        taken = {*_partial(self.target)}  # in a container, a killed run often had the number of this process
        self.work = next(name for name in names if name not in taken)
        self._reserve = self.work / ".reserved"
        self._made: list[Path] = []
        self._lock = -1
        self._keep = False

    def __enter__(self) -> Self:
        try:
            require_free(self.target)
            self._make_parents()
            self._claim()
            self._reserve_space()
        except OSError as error:
            self._remove()
            self._unlock()
            if remedy(error, ""):  # a limit of the process, which holds for any other folder too
                raise UnwrittenError(self.target, error) from None
            raise BadInputError.of_os_error(self.target, error, WRITABLE, "choose another --out") from None
        return self

    def _make_parents(self) -> None:
        missing = [folder for folder in self.target.parents if not folder.exists()]
        for folder in reversed(missing):
            folder.mkdir()
            self._made.append(folder)

    def _claim(self) -> None:
        """Make the folder `work`, and lock it for the life of this process.

        While the folder is made, a lock on the parent folder keeps other runs from making theirs.
        """
        parent = os.open(self.target.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(parent, fcntl.LOCK_EX)
            require_free(self.target)
            self.work.mkdir()
            self._lock = os.open(self.work, os.O_RDONLY | os.O_DIRECTORY)
            fcntl.flock(self._lock, fcntl.LOCK_EX)
        finally:
            os.close(parent)

    def _reserve_space(self) -> None:
        with self._reserve.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, RESERVED_BYTES)

    def release(self) -> None:
        """Give back the reserved space on the disk. Call it before the last files are written."""
        self._reserve.unlink(missing_ok=True)

    def named(self, text: str) -> str:
        """Return `text` with the path `target` in place of the path `work`."""
        return text.replace(str(self.work), str(self.target))

    def complete(self) -> Path:
        """Rename the folder `work` to `target`, and return the path `target`.

        Raises BadInputError if the folder cannot be renamed, for example because `target` exists by now; in that case,
        `work` stays.
        """
        self.release()
        self._keep = self._is_there()
        try:
            self.work.rename(self.target)
        except OSError as error:
            remedy = f"the run is in {self.work}"
            raise BadInputError.of_os_error(self.target, error, "a name that is free", remedy) from None
        return self.target

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._end(error)
        finally:
            self._unlock()

    def _end(self, error: BaseException | None) -> None:
        if self._keep:
            return
        is_there = self._is_there()
        self.release()
        if not is_there:
            self._remove()
            if isinstance(error, Exception) or error is None:
                raise TrilaneError(f"{self.work}: it was moved or removed while the run went on") from error
            return
        failed = self._unwritten(error)
        is_kept = failed and any(file.is_file() and file.stat().st_size for file in self.work.rglob("*"))
        if not is_kept:
            self._remove()
        if failed:
            left = f"what was written stays in {self.work}" if is_kept else "nothing was written"
            raise TrilaneError(f"{failed}; {left}") from error

    def _unwritten(self, error: BaseException | None) -> str:
        """Return a text that says which file could not be written, and why; "" if `error` has another cause.

        `error`: exception that ended the `with` block; None without an exception.
        """
        if isinstance(error, UnwrittenError):
            return str(error)
        if isinstance(error, BadInputError) and isinstance(error.__cause__, OSError):
            return f"{error.where}: {error.found}; {remedy(error.__cause__, FREE_SPACE)}"
        if isinstance(error, OSError) and error.errno in FULL:
            return f"{error.filename or self.work}: {reason(error)}; {remedy(error, FREE_SPACE)}"
        return ""

    def _is_there(self) -> bool:
        """Return whether the path `work` still leads to the folder that this object made."""
        try:
            return os.path.samestat(self.work.stat(), os.fstat(self._lock))
        except OSError:
            return False

    def _unlock(self) -> None:
        if self._lock >= 0:
            os.close(self._lock)

    def _remove(self) -> None:
        """Remove the folder `work` if this object made it, and the parent folders that it made."""
        if self._is_there():
            shutil.rmtree(self.work, ignore_errors=True)
        for folder in reversed(self._made):
            try:
                folder.rmdir()
            except OSError:
                return


def _partial(target: Path) -> Iterator[Path]:
    """Yield the `.partial` folders of all runs, live or ended, whose final path is `target`."""
    return target.parent.glob(f"{glob.escape(target.name)}.*.partial")


def is_locked(folder: Path) -> bool:
    """Return whether a live process holds the lock of `folder`. A removed folder has no lock."""
    try:
        fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # a file system without locks: no run of this machine is there
        return False
    finally:
        os.close(fd)
    return False
