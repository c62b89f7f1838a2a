"""Time slices that are asked for, and cores that are kept awake."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import psutil
import pytest

from trilane import machine
from trilane.machine import AWAKE, SHORTEST_SLICE_NS, UNIT_SLICE_NS, USUAL_SLICE, awake, use_slice


def test_a_slice_is_asked_for_and_given_back() -> None:
    """Whether the kernel takes the wish or not, what this thread may do and its niceness stay as they were."""
    before = os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)
    assert use_slice(SHORTEST_SLICE_NS) == use_slice(USUAL_SLICE)
    assert (os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)) == before


class FakeLibc:
    """Notes the system calls that it is asked for, and answers each with `answer`."""

    def __init__(self, answer: int) -> None:
        self.answer, self.calls = answer, []

    def syscall(self, *call: Any) -> int:
        self.calls.append(call)
        return self.answer


@pytest.mark.parametrize(("answer", "accepted"), [(0, True), (-1, False)])
def test_a_slice_is_asked_for_by_sched_setattr(monkeypatch: pytest.MonkeyPatch, answer: int, accepted: bool) -> None:
    """48 bytes: size, policy 0, no flags, niceness, priority 0, the slice as runtime, no deadline, no period."""
    libc = FakeLibc(answer)
    monkeypatch.setattr("ctypes.CDLL", lambda _: libc)
    monkeypatch.setattr("os.getpriority", lambda which, who: {(os.PRIO_PROCESS, 0): 3}[which, who])
    monkeypatch.setattr(machine.here, "architecture", lambda: "aarch64")
    assert use_slice(UNIT_SLICE_NS) is accepted
    assert libc.calls == [(274, 0, struct.pack("=IIQiIQQQ", 48, 0, 0, 3, 0, UNIT_SLICE_NS, 0, 0), 0)]


def test_where_slices_are_unknown_or_not_ours_nothing_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    libc = FakeLibc(0)
    monkeypatch.setattr("ctypes.CDLL", lambda _: libc)
    with monkeypatch.context() as patched:
        patched.setattr(machine.here, "architecture", lambda: "riscv64")
        assert use_slice(1) is False
    monkeypatch.setattr("os.sched_getscheduler", lambda _: os.SCHED_FIFO)
    assert use_slice(1) is False
    assert libc.calls == []


def test_the_file_that_keeps_cores_awake_is_held_open_inside_the_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "latency"
    monkeypatch.setattr(machine, "LATENCY_FILE", file)
    with awake() as idle_cores:
        assert idle_cores == f"sleep: {file}: no such file or directory"
    file.touch()
    is_open = lambda: str(file) in [each.path for each in psutil.Process().open_files()]  # noqa: E731
    with awake(wanted=False) as idle_cores:
        assert idle_cores == "sleep: the performance profile asks for no haste" and not file.read_bytes()
        assert not is_open()
    with awake() as idle_cores:
        assert idle_cores == AWAKE and is_open()
        assert file.read_bytes() == struct.pack("=i", 0)
    assert not is_open()
