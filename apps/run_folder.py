"""The folder that a run writes: made under a temporary name beside its place and renamed when it is whole.

Rule: a folder with the run's name is complete; a folder whose name ends in `.partial` is not.
"""

from __future__ import annotations

import os
import shutil
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Self

from trilane.errors import BadInputError
from trilane.writing import WRITABLE


def default_place(scene: str) -> Path:
    """`runs/<UTC time>-<scene>` in the working directory, a name that nothing has at this moment."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    safe = "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in scene)
    place, tries = Path("runs") / f"{stamp}-{safe}", 1
    while place.exists():
        tries += 1
        place = Path("runs") / f"{stamp}-{safe}-{tries}"
    return place


class RunFolder:
    """Context manager: `work` is the temporary folder. Leaving without `complete()` removes it and the parents it made.

    Raises BadInputError on entry when `target` exists already or nothing can be written there.
    """

    def __init__(self, target: Path) -> None:
        self.target = target.absolute()
        self.work = self.target.with_name(f"{self.target.name}.{os.getpid()}.partial")
        self._made: list[Path] = []
        self._keep = False

    def __enter__(self) -> Self:
        try:
            if self.target.exists():
                raise BadInputError(self.target, "a file or folder", "a name that is free", "choose another --out")
            self._make_parents()
            self.work.mkdir()
        except OSError as error:
            self._remove()
            raise BadInputError.of_os_error(self.target, error, WRITABLE, "choose another --out") from None
        return self

    def _make_parents(self) -> None:
        missing = [folder for folder in self.target.parents if not folder.exists()]
        for folder in reversed(missing):
            folder.mkdir()
            self._made.append(folder)

    def complete(self) -> Path:
        """Give the folder its name.

        Raises BadInputError when something else got the name in the meantime; the temporary folder stays then.
        """
        self._keep = True
        try:
            self.work.rename(self.target)
        except OSError as error:
            remedy = f"the run is in {self.work}"
            raise BadInputError.of_os_error(self.target, error, "a name that is free", remedy) from None
        return self.target

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._keep:
            self._remove()

    def _remove(self) -> None:
        shutil.rmtree(self.work, ignore_errors=True)
        for folder in reversed(self._made):
            try:
                folder.rmdir()
            except OSError:
                return
