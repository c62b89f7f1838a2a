"""What runs of real processes leave behind, which is nothing, and how a test finds a unit's process."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from support import doubles
from trilane.pipeline.unit_starter import UnitStarter
from trilane.stages import PRELOAD

SHM = Path("/dev/shm")  # noqa: S108 - looked at, not written to
OPEN_FILES = Path("/proc/self/fd")
PATIENCE_S = 60.0


def _open_files() -> list[str]:
    return [str((OPEN_FILES / name).readlink()) for name in _names(OPEN_FILES) if (OPEN_FILES / name).is_symlink()]


@pytest.fixture(scope="session")
def starter() -> Iterator[UnitStarter]:
    """A fork server that has imported what units need; runs of many tests come from it."""
    with UnitStarter((*PRELOAD, doubles.MODULE)) as starter:
        yield starter


@pytest.fixture
def nothing_left(
    starter: UnitStarter,  # noqa: ARG001 - what lives before the test
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Path]:
    """After the test: no new child, no name in /dev/shm, no bus folder; yields the folder that those would be in."""
    base = tmp_path_factory.mktemp("t")
    monkeypatch.setattr("tempfile.tempdir", str(base))
    monkeypatch.setenv("TMPDIR", str(base))
    names, descriptors = _names(SHM), len(_names(OPEN_FILES))
    before = set(psutil.Process().children(recursive=True))
    yield base
    _none_since(before)
    assert not {name for name in _names(SHM) - names if "trilane" in name}
    assert [*base.glob("trilane-*")] == []
    end = time.monotonic() + PATIENCE_S  # a thread of ZeroMQ may still be closing its own
    while len(_names(OPEN_FILES)) > descriptors and time.monotonic() < end:
        time.sleep(0.02)
    assert len(_names(OPEN_FILES)) <= descriptors, _open_files()


@pytest.fixture
def no_new_process(starter: UnitStarter) -> Iterator[None]:  # noqa: ARG001 - what lives before the test
    """After the test this process has the children that it had before."""
    before = set(psutil.Process().children(recursive=True))
    yield
    _none_since(before)


def _none_since(before: set[psutil.Process]) -> None:
    """None lives that was not there `before`; of one that has ended, its parent takes leave within the time."""
    new = set(psutil.Process().children(recursive=True)) - before
    assert not [process for process in new if _lives(process)]
    assert not psutil.wait_procs(new, PATIENCE_S)[1]


def _lives(process: psutil.Process) -> bool:
    with contextlib.suppress(psutil.NoSuchProcess):
        return bool(process.status() != psutil.STATUS_ZOMBIE)
    return False


def _names(folder: Path) -> set[str]:
    return {entry.name for entry in folder.iterdir()}
