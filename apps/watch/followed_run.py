"""Follows a run while it goes on or afterwards: finds its journal, reads new records, and tells its state.

Rule: following a run does not change it. A live run writes into the partial folder `NAME.PID.partial` (run_folder.py).
A request for NAME finds the partial folder, and follows the run when the folder is renamed to NAME.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from enum import StrEnum
from pathlib import Path

from trilane.apps.run.report import REPORT_FILE
from trilane.apps.run.run_folder import is_locked
from trilane.errors import BadInputError, did_you_mean
from trilane.pipeline.journal import NAME, JournalReader, Record, journal_in

RUNS = Path("runs")
LOOK_S = 0.2
SILENCE_NS = 1_000_000_000
EXPECTED = "a run folder with a journal"
MOST_NAMED = 4
NO_RECORD = "a journal without a record"
CUT_OFF = "the journal stops here: the run was killed, or the file is cut off; what came after is not known"
PARTIAL = re.compile(r"(?P<name>.+)\.[0-9]{1,9}\.partial")


class RunState(StrEnum):
    """The state of a run.

    GOES_ON: its process holds the folder's lock. FINISHED: its folder has the final name. KILLED: its process died and
    left the partial folder. REMOVED: its folder is gone, because a run that ends before any frame removes its folder.
    """

    GOES_ON = "goes on"
    FINISHED = "finished"
    KILLED = "killed"
    REMOVED = "removed"


def without_journal(folder: Path) -> str:
    """Return a phrase for what was found in place of the journal in `folder`, such as `no such folder`."""
    if (folder / NAME).is_symlink():
        return f"{NAME}, a link to a file that is not there"
    return f"no {NAME}" if folder.is_dir() else "no such folder"


class FollowedRun:
    """Follows a run by reading its journal. `name`: final name of the run folder.

    `folder`: run folder, partial or complete.
    Raises BadInputError if `folder` has no journal.
    """

    def __init__(self, folder: Path) -> None:
        journal = journal_in(folder)
        if journal is None:
            remedy = "an older Trilane wrote it; run the scene again" if (folder / REPORT_FILE).is_file() else ""
            raise BadInputError(folder, without_journal(folder), EXPECTED, remedy)
        self.folder = folder
        self.name = run_name(folder)
        self._reader = JournalReader(journal)
        self._heard_ns = time.monotonic_ns()

    @property
    def state(self) -> RunState:
        """Return the state of the run now."""
        self._find_again()
        if not self.folder.is_dir():
            return RunState.REMOVED
        if PARTIAL.fullmatch(self.folder.name) is None:
            return RunState.FINISHED
        if is_locked(self.folder):
            return RunState.GOES_ON
        # a folder that is gone was moved or removed this very moment
        return RunState.KILLED if self.folder.is_dir() else self.state

    @property
    def silent_ns(self) -> int:
        """Return how long a live run has written nothing, in ns.

        The result is 0 for a silence of up to `SILENCE_NS`, and for a run that has ended.
        """
        silent_ns = time.monotonic_ns() - self._heard_ns
        return silent_ns if silent_ns > SILENCE_NS and self.state is RunState.GOES_ON else 0

    def new(self) -> Iterator[Record]:
        """Yield the records since the last call; none if the run was removed.

        Raises BadInputError for a broken journal.
        """
        self._find_again()
        if not self.folder.is_dir():
            return
        try:
            for record in self._reader.new():
                self._heard_ns = time.monotonic_ns()
                yield record
        except BadInputError:
            if self._reader.path.exists():
                raise  # without a file there, the run was moved this very moment, and the next call finds it

    def whole(self) -> Iterator[Record]:
        """Yield all records of the journal. Call it only if nothing was read before.

        Raises BadInputError for a broken journal or one without records.
        """
        is_empty = True
        for record in self.new():
            is_empty = False
            yield record
        if is_empty:
            raise BadInputError(self.folder, NO_RECORD, EXPECTED)

    def _find_again(self) -> None:
        """Follow the run into the folder with the final name, if the partial folder was renamed."""
        target = self.folder.with_name(self.name)
        if not self.folder.exists() and target.is_dir():
            self.folder = target
            self._reader.path = target / NAME


def follow(given: Path | None, *, wait: bool = False, sleep: Callable[[float], None] = time.sleep) -> FollowedRun:
    """Return the run that `given` means.

    `given`: folder or journal of the run, or its name below runs/; None for the newest run below runs/.
    `wait`: whether to wait until the run has begun; without waiting, a run that has not begun is an error. What a
    killed run left counts as begun only if `given` names its partial folder.
    `sleep`: function that waits for a time in seconds.
    Raises BadInputError if the run is not found or has no journal.
    """
    while True:
        found = _newest(RUNS.glob(f"*/{NAME}")) if given is None else folder_of(given)
        if found is not None:
            run = FollowedRun(found)
            if not wait or run.state is not RunState.KILLED or (given and found.name in given.parts):
                return run
        elif not wait:
            raise _missing(given)
        sleep(LOOK_S)


def folder_of(given: Path) -> Path | None:
    """Return the folder of the run that `given` means (see `follow`), partial or complete; None if no such run exists.

    A journal means the folder around it. Any other existing path is returned as it is, even if it is no run folder.
    """
    if given.name == NAME:
        return folder_of(given.parent)
    places = [given] if given.is_absolute() or len(given.parts) > 1 else [given, RUNS / given]
    for place in places:
        if place.exists():
            return place
        if (found := _newest(place.parent.glob(f"*.partial/{NAME}"), place.name)) is not None:
            return found
    return None


def _newest(journals: Iterator[Path], name: str = "") -> Path | None:
    """Return the run folder whose journal was written to last; None if no journal fits.

    `journals`: paths of journals.
    `name`: final name of the run; only partial folders with this name fit. If empty, all folders fit.
    """
    found = []
    for journal in journals:
        matched = PARTIAL.fullmatch(journal.parent.name)
        if not name or (matched and matched["name"] == name):
            try:
                found.append((journal.stat().st_mtime_ns, journal.parent))
            except OSError:  # the run was moved this very moment
                continue
    return max(found)[1] if found else None


def _missing(given: Path | None) -> BadInputError:
    if given is None:
        return BadInputError(
            RUNS, "no run with a journal", EXPECTED, "start one with `trilane run`, or name its folder"
        )
    prefix = str(given).removesuffix(given.name)
    folders = [*(given.parent if prefix else RUNS).glob("*/")]
    folders += [] if prefix else [journal.parent for journal in Path().glob(f"*/{NAME}")]
    names = sorted({run_name(folder) for folder in folders})
    others = f"{prefix} has {', '.join(names[-MOST_NAMED:])}" if prefix and names else ""
    return BadInputError(given, "no such run", EXPECTED, did_you_mean(given.name, names, prefix) or others)


def run_name(folder: Path) -> str:
    """Return the final name of the run in `folder`: the folder's name, without the end that marks a partial folder."""
    matched = PARTIAL.fullmatch(folder.name)
    return matched["name"] if matched else folder.name
