"""The parent's side of units, with `sleep` in the place of each: what it hands over, hears, keeps and ends."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
import zmq

from trilane.errors import TrilaneError
from trilane.pipeline import unit_processes, unit_starter
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, UnitSettings
from trilane.pipeline.memory import EdgeRegion
from trilane.pipeline.unit_loop import UnitSpec
from trilane.pipeline.unit_processes import UnitMessage, UnitProcesses
from trilane.pipeline.unit_starter import StartedUnit, UnitStarter
from trilane.transport.messages import Done, HeartbeatSocket, JobPipe, JobPipeEnd, Ping, PongMessage, Ready
from trilane.transport.packets import header_dtype

PIPELINE = Pipeline(
    stages=tuple(
        PipelineStage(name=name, unit=unit, factory="json:loads")
        for name, unit in (("in", "left"), ("mid", "right"), ("out", "left"))
    ),
    edges=(PipelineEdge(payload_bytes=1),) * 2,
    units={"left": UnitSettings(cores=(1, 0), threads=3), "right": UnitSettings(cores=(0,), threads=1)},
    module_folders=(Path("stages"),),
)
REGIONS = {
    name: EdgeRegion(fd=fd, slots=2, header=header_dtype(), payload_bytes=1)
    for name, fd in (("in->mid", 90), ("mid->out", 91))
}


def done(number: int) -> Done:
    return Done(number, 1, 2, 3, 4, 5, 6, 0, 7, 8, {})


class FakeStarter:
    """Starts `sleep`; the test speaks for it over `pipes` and `stderr`, which are the unit's own ends."""

    def __init__(self) -> None:
        self.specs: dict[str, UnitSpec] = {}
        self.pipes: dict[str, JobPipe] = {}
        self.stderr: dict[str, int] = {}
        self.sleepers: dict[str, subprocess.Popen[bytes]] = {}
        self.codes: dict[str, int] = {}

    def start(self, spec: UnitSpec, stderr_fd: int) -> StartedUnit:
        self.specs[spec.unit] = spec
        self.pipes[spec.unit] = JobPipe(JobPipeEnd(*(os.dup(fd) for fd in spec.job_pipe)))
        self.stderr[spec.unit] = os.dup(stderr_fd)
        sleeper = self.sleepers[spec.unit] = subprocess.Popen(["sleep", "60"], process_group=0)
        code_fd, self.codes[spec.unit] = os.pipe()
        return StartedUnit(sleeper.pid, os.pidfd_open(sleeper.pid), os.open(os.devnull, os.O_RDONLY), code_fd)

    def renew(self) -> str:
        return "the server ended"

    def leave(self, unit: str) -> None:
        self.pipes.pop(unit).close()
        os.close(self.stderr.pop(unit))
        os.close(self.codes.pop(unit))


@pytest.fixture
def started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[UnitProcesses, FakeStarter]]:
    """Both units, started; afterwards no process, file or folder is left."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    before = psutil.Process().num_fds()
    starter = FakeStarter()
    processes = UnitProcesses(PIPELINE, REGIONS, 92, starter)  # type: ignore[arg-type]
    for unit in ("left", "right"):
        processes.start(unit)
    yield processes, starter
    processes.close()
    assert [sleeper.wait(60) for sleeper in starter.sleepers.values()] == [-signal.SIGKILL] * 2
    for unit in list(starter.pipes):
        starter.leave(unit)
    assert processes.pids == {}
    assert processes._poller.closed and processes._context.closed
    last = time.monotonic() + 5
    while psutil.Process().num_fds() > before + 1 and time.monotonic() < last:
        time.sleep(0.01)  # threads of ZeroMQ may still be closing their own
    assert psutil.Process().num_fds() <= before + 1
    assert not list(tmp_path.iterdir())


def heard(processes: UnitProcesses, count: int) -> list[UnitMessage]:
    messages: list[UnitMessage] = []
    for _ in range(20):
        messages += processes.listen(500)
        if len(messages) >= count:
            break
    return messages


Started = tuple[UnitProcesses, FakeStarter]


def test_jobs_go_out_and_answers_come_in(started: Started) -> None:
    processes, starter = started
    assert processes.listen(0) == []
    processes.send("right", Ping())
    processes.send("nobody", Ping())
    assert (starter.pipes["right"].receive(), starter.pipes["left"].receive()) == (Ping(), None)
    answers = [done(number) for number in range(3)]
    for answer in answers:
        starter.pipes["right"].send(answer)
    assert heard(processes, 3) == [UnitMessage("right", answer) for answer in answers]


def test_heartbeats_come_in_and_the_name_of_their_socket_goes(started: Started) -> None:
    processes, starter = started
    context = zmq.Context()
    beats = HeartbeatSocket(context)
    endpoint = starter.specs["left"].endpoint
    beats.socket.connect(endpoint)
    beats.send_heartbeat(Ready(5))
    assert heard(processes, 1) == [UnitMessage("left", Ready(5))]
    folder = Path(endpoint.removeprefix("ipc://")).parent
    assert folder.is_dir()
    processes.connected("left")
    processes.connected("left")
    processes.connected("nobody")
    assert not folder.exists()
    beats.send_heartbeat(PongMessage())
    assert heard(processes, 1) == [UnitMessage("left", PongMessage())]
    beats.socket.send(b"\xffno")
    with pytest.raises(TrilaneError, match=r"^unit left sent bytes that are not a message: unknown message"):
        heard(processes, 1)
    beats.close()
    context.term()


def test_what_a_unit_said_comes_before_its_end_and_its_last_line_is_kept(started: Started) -> None:
    processes, starter = started
    os.write(starter.stderr["right"], b"x" * 9000 + b"\nlast words\n")
    for number in range(2):
        starter.pipes["right"].send(done(number))
    processes.kill("nobody")
    processes.kill("right")
    starter.sleepers["right"].wait(60)
    starter.leave("right")
    assert heard(processes, 3) == [UnitMessage("right", m) for m in (done(0), done(1), None)]
    assert processes.stderr_tails["right"] == "x" * (8192 - 12) + "\nlast words"
    assert processes.why_ended("right") == "; it wrote last: last words"
    assert (processes.why_ended("left"), processes.renew_starter()) == ("", "the server ended")
    assert list(processes.pids) == ["left"]


@pytest.mark.parametrize(
    ("code", "is_ours", "why"),
    [
        (b"-9", False, "; it was killed by signal 9; it wrote last: words"),
        (b"-9", True, "; it wrote last: words"),
        (b"3", False, "; it wrote last: words"),
        (b"", False, "; it wrote last: words"),
    ],
)
def test_a_signal_from_elsewhere_is_told(started: Started, code: bytes, is_ours: bool, why: str) -> None:
    """But none that was sent here, nor one that the fork server does not tell."""
    processes, starter = started
    os.write(starter.stderr["left"], b"words\n")
    os.write(starter.codes["left"], code)
    if is_ours:
        processes.kill("left")
    else:
        starter.sleepers["left"].kill()
    starter.leave("left")
    assert heard(processes, 1) == [UnitMessage("left", None)]
    assert processes.why_ended("left") == why


def test_bytes_that_are_no_message_end_the_run_and_name_the_unit(started: Started) -> None:
    processes, starter = started
    os.write(starter.pipes["left"]._writes, b"\xffno")
    with pytest.raises(TrilaneError, match=r"^unit left sent bytes that are not a message: unknown message"):
        heard(processes, 1)


def test_a_unit_that_has_closed_its_ends_wakes_nobody_again(started: Started) -> None:
    """Its job pipe and its stderr stay readable for ever; its process still lives."""
    processes, starter = started
    starter.pipes["left"].send(done(0))
    starter.leave("left")
    assert heard(processes, 1) == [UnitMessage("left", done(0))]
    for _ in range(2):
        processes.listen(0)
    assert processes._poller.poll(0) == []
    assert list(processes.pids) == ["left", "right"]
    starter.pipes["right"].send(done(1))
    assert heard(processes, 1) == [UnitMessage("right", done(1))]


def test_what_is_watched_wakes_a_listener_once(started: Started) -> None:
    processes, _ = started
    fd = os.eventfd(1, os.EFD_NONBLOCK)
    processes.watch(fd)
    assert processes.listen(5000) == []
    with pytest.raises(BlockingIOError):
        os.eventfd_read(fd)
    os.close(fd)


def test_units_that_leave_by_themselves_are_waited_for_and_others_not_for_ever(started: Started) -> None:
    processes, starter = started
    threading.Timer(0.05, starter.sleepers["left"].kill).start()
    processes.wait_for_end(["left"], 10)
    assert list(processes.pids) == ["right"]
    processes.wait_for_end(["right"], 0.01)
    assert list(processes.pids) == ["right"]


# the parent's end of the fork server, without one


@pytest.fixture
def starter_with(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., tuple[UnitStarter, list[socket.socket]]]]:
    """A starter whose fork servers are those given, the last again and again; and their ends of the sockets."""
    ends: list[socket.socket] = []

    def make(*servers: Any, stderr: bytes = b"", are_open: bool = True) -> tuple[UnitStarter, list[socket.socket]]:
        def spawn(_starter: UnitStarter, theirs: socket.socket) -> Any:
            ends.append(theirs.dup())
            if not are_open:
                ends[-1].shutdown(socket.SHUT_RDWR)
            return servers[min(len(ends), len(servers)) - 1]

        monkeypatch.setattr(UnitStarter, "_spawn", spawn)
        starter = UnitStarter()
        os.write(starter._stderr, stderr)
        return starter, ends

    yield make
    for end in ends:
        end.close()


class FakeServer:
    def __init__(self, code: int | None) -> None:
        self.code, self.calls, self.pid, self.deaf = code, [], os.getpid(), 0

    @property
    def returncode(self) -> int | None:
        return self.code

    def wait(self, timeout: float | None = None) -> int:
        self.calls.append(("wait", timeout))
        if self.code is None and timeout is not None:
            raise subprocess.TimeoutExpired("server", timeout)
        return self.code or 0

    def kill(self) -> None:
        self.calls.append("kill")
        if self.calls.count("kill") == self.deaf + 1:
            self.code = -9


def spec() -> UnitSpec:
    return UnitSpec(
        unit="left", endpoint="ipc://x", job_pipe=JobPipeEnd(0, 1), assets_fd=2, settings=PIPELINE.units["left"],
        scheduler_cores=(0,), run_cores=(0, 1), stages=(), module_folders=(), edges={}, inputs={}, outputs={},
    )  # fmt: skip


Starter = Callable[..., tuple[UnitStarter, list[socket.socket]]]


@pytest.mark.parametrize(
    ("answer", "passed", "said"),
    [
        (b"123", 2, ""),
        *((b"123", few, "^unit left could not be started: too many open files: ulimit -n 4096$") for few in (0, 1)),
    ],
)
def test_a_unit_is_asked_for_with_its_spec_and_files(
    starter_with: Starter, answer: bytes, passed: int, said: str
) -> None:
    """The third of its files is the lifeline, whose other end is the caller's; without an answer it is nobody's."""
    server = FakeServer(None)
    starter, (theirs,) = starter_with(server)
    socket.send_fds(theirs, [answer], [0] * passed)
    unit = None
    if said:
        with pytest.raises(TrilaneError, match=said):
            starter.start(spec(), 2)
    else:
        unit = starter.start(spec(), 2)
        os.close(unit.pidfd)
        os.close(unit.code_fd)
        assert unit.pid == 123
    packet, fds, *_ = socket.recv_fds(theirs, 9999, 10)
    assert json.loads(packet) == {"unit": "left", "cores": [1, 0], "threads": 3, "fds": [0, 1, 2]}
    assert len(fds) == 6
    assert UnitSpec.model_validate_json(os.pread(fds[0], 9999, 0)) == spec()
    poller = select.poll()
    poller.register(fds[2], select.POLLIN)
    if unit is not None:
        assert not poller.poll(0)
        os.close(unit.lifeline)
    assert poller.poll(0) == [(fds[2], select.POLLHUP)]
    for fd in fds:
        os.close(fd)
    server.calls.clear()
    starter.close()
    assert server.calls[:2] == [("wait", 0.0), ("wait", 5.0)]


SERVER = "the fork server, which every unit comes from,"


@pytest.mark.parametrize(
    ("code", "stderr", "said"),
    [
        (None, b"one\ntwo\nthree\n", "three"),
        (3, b"x" * 9000 + b"\nno file \xff\n", "no file \ufffd"),
        (-9, b"a warning", f"{SERVER} was killed by signal 9"),
        (3, b"", f"{SERVER} ended with exit code 3"),
        (None, b"", "the fork server gave no answer in 60 s"),
    ],
)
def test_why_a_unit_could_not_be_started_is_said(
    starter_with: Starter, code: int | None, stderr: bytes, said: str
) -> None:
    """After three fork servers, or a fourth in the place of one that is known to have ended."""
    server = FakeServer(code)
    server.deaf = 9
    starter, ends = starter_with(server, stderr=stderr, are_open=False)
    with pytest.raises(TrilaneError, match=f"^unit left could not be started: {said}$"):
        starter.start(spec(), 2)
    assert len(ends) == (3 if code is None else 4)
    server.code = 0
    starter.close()


def test_a_process_that_is_stopped_is_told_from_others(started: Started) -> None:
    processes, starter = started
    assert processes.stopped == set()
    starter.sleepers["left"].send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, starter.sleepers["left"].pid, os.WSTOPPED | os.WNOWAIT)
    assert processes.stopped == {"left"}
    assert not unit_starter.is_stopped(1 << 22)  # above every process number


@pytest.mark.parametrize("answers", [True, False])
def test_a_call_is_made_once_more_where_the_fork_server_has_ended(starter_with: Starter, answers: bool) -> None:
    """One that no server hears fails at once, and so does the second; with a server that lives there is one call."""
    starter, ends = starter_with(FakeServer(-9 if answers else None), FakeServer(None), are_open=False)
    assert starter.call("os:getcwd").result() is None
    assert len(ends) == (2 if answers else 1)
    starter.close()


@pytest.mark.parametrize(("answer", "result"), [(b'{"a": 1}', {"a": 1}), (b'{"a": "b', None), (b'"\xc3', None)])
def test_an_answer_that_is_cut_off_is_none(starter_with: Starter, answer: bytes, result: object) -> None:
    starter, _ = starter_with(FakeServer(None))
    reads, writes = os.pipe()
    os.write(writes, answer)
    os.close(writes)
    assert unit_starter.ForkedCall(starter, "os:getcwd", reads).result() == result
    starter.close()


def test_a_call_that_is_not_answered_in_time_is_none(starter_with: Starter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unit_starter, "ANSWER_S", 0.01)
    starter, _ = starter_with(FakeServer(None))
    call = starter.call("os:getcwd")
    assert call.result() is None
    with pytest.raises(OSError, match="Bad file"):
        os.fstat(call._reads)
    starter.close()


# run_metrics.py


def test_a_unit_that_ends_by_itself_is_waited_for_and_what_it_started_is_ended() -> None:
    """Its shell leaves a sleeper in its group, and ends with 3 after a while."""
    shell = subprocess.Popen(["sh", "-c", "sleep 60 & sleep 0.15; exit 3"], process_group=0)
    process = object.__new__(unit_processes._Process)
    process.pid, process.pidfd = shell.pid, os.pidfd_open(shell.pid)
    process.wait()
    os.close(process.pidfd)
    assert shell.wait(60) == 3
    left = [each for each in psutil.process_iter(["name"]) if each.pid != shell.pid and _group(each.pid) == shell.pid]
    assert psutil.wait_procs(left, timeout=60)[1] == []


def _group(pid: int) -> int | None:
    try:
        return os.getpgid(pid)
    except (ProcessLookupError, PermissionError):
        return None


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
    processes = UnitProcesses(PIPELINE, REGIONS, 92, starter)
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
