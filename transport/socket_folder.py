"""The folder of a unit's ZeroMQ socket. Rule: it is private, and there only until the unit has connected.

A connection lives on without the name of its socket, so the folder is removed as soon as the unit is connected. A
parent that is killed before that leaves its folder behind: the next run finds that nobody holds the folder's lock, and
removes it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from pathlib import Path
from typing import Self

PREFIX = "trilane-"
LOCK = "lock"
MAX_PATH = 80  # bytes of the folder's path; the path of a Unix socket inside it may have 108


class SocketFolder:
    """A folder with mode 0700 for the names of sockets, held by a lock on a file inside it."""

    def __init__(self) -> None:
        base = tempfile.gettempdir()
        base = base if len(base) < MAX_PATH else "/tmp"  # noqa: S108 - mkdtemp below makes a private folder in it
        remove_abandoned(Path(base))
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=base))
        self._lock = os.open(self.path / LOCK, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)

    def endpoint(self, name: str) -> str:
        """The ZeroMQ address of the socket `name` in this folder."""
        return f"ipc://{self.path / name}"

    def remove(self) -> None:
        """Remove the folder and let go of its lock."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exc: object) -> None:
        self.remove()


def remove_abandoned(base: Path) -> None:
    """Remove this user's socket folders in `base` whose owner has ended, which are those whose lock is free."""
    for folder in base.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            lock = os.open(folder / LOCK, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)
