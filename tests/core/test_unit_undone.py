"""A unit that could not be started leaves nothing: no descriptor, no folder, no socket, no entry."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from support.small_pipeline import OWN, pipeline
from trilane.errors import TrilaneError
from trilane.pipeline import unit_processes
from trilane.pipeline.memory import EdgeRegion
from trilane.pipeline.unit_processes import UnitProcesses
from trilane.transport.packets import header_dtype

REGIONS = {
    "in->mid": EdgeRegion(fd=90, slots=1, header=OWN, payload_bytes=100),
    "mid->out": EdgeRegion(fd=91, slots=3, header=header_dtype(), payload_bytes=5000),
}


class Broken:
    """A fork server that is gone."""

    def start(self, *_: Any) -> None:
        raise TrilaneError("the fork server is gone")

    def end(self) -> str:
        return "it is gone"


def broken_link(monkeypatch: pytest.MonkeyPatch) -> None:
    def bind(*_: object) -> None:
        raise OSError(98, "Address already in use")

    monkeypatch.setattr(unit_processes.Link, "bind", bind)


def broken_stderr(monkeypatch: pytest.MonkeyPatch) -> None:
    def pipe2(_flags: int) -> None:
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(unit_processes.os, "pipe2", pipe2)


@pytest.mark.parametrize("spoil", [None, broken_link, broken_stderr])
def test_nothing_is_left(
    spoil: Callable[[pytest.MonkeyPatch], None] | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    starter: Any = Broken()
    processes = UnitProcesses(pipeline(), REGIONS, 92, starter)
    with pytest.raises(TrilaneError):
        processes.start("left")  # what ZeroMQ opens once is open now
    before = psutil.Process().num_fds()
    with monkeypatch.context() as patch:
        if spoil is not None:
            spoil(patch)
        for unit in ("left", "right", "left"):
            with pytest.raises((TrilaneError, OSError)):
                processes.start(unit)
    end_s = time.monotonic() + 60
    while psutil.Process().num_fds() > before and time.monotonic() < end_s:  # a thread of ZeroMQ closes its own
        time.sleep(0.02)
    assert psutil.Process().num_fds() <= before
    assert (processes.pids, list(tmp_path.iterdir())) == ({}, [])
    processes.close()
