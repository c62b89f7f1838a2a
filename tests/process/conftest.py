"""What runs of real processes leave behind, which is nothing, and how a test finds a unit's process."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

SHM = Path("/dev/shm")  # noqa: S108 - looked at, not written to
OPEN_FILES = Path("/proc/self/fd")


def bus_folders(base: Path) -> set[str]:
    return {folder.name for folder in base.glob("trilane-*")}


def _open_files() -> list[str]:
    return [str((OPEN_FILES / name).readlink()) for name in _names(OPEN_FILES) if (OPEN_FILES / name).is_symlink()]


@pytest.fixture
def nothing_left(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """After the test: no new child, no name in /dev/shm, no bus folder; yields the folder that those would be in."""
    base = tmp_path_factory.mktemp("t")
    monkeypatch.setattr("tempfile.tempdir", str(base))
    monkeypatch.setenv("TMPDIR", str(base))
    names, descriptors = _names(SHM), len(_names(OPEN_FILES))
    before = set(psutil.Process().children(recursive=True))
    yield base
    assert not set(psutil.Process().children(recursive=True)) - before
    assert not {name for name in _names(SHM) - names if "trilane" in name}
    assert bus_folders(base) == set()
    end = time.monotonic() + 2  # a thread of ZeroMQ may still be closing its own
    while len(_names(OPEN_FILES)) > descriptors and time.monotonic() < end:
        time.sleep(0.02)
    assert len(_names(OPEN_FILES)) <= descriptors, _open_files()


@pytest.fixture
def no_new_process() -> Iterator[None]:
    """After the test this process has the children that it had before."""
    before = set(psutil.Process().children(recursive=True))
    yield
    assert not set(psutil.Process().children(recursive=True)) - before


def _names(folder: Path) -> set[str]:
    return {entry.name for entry in folder.iterdir()}
