"""Around a run's loop, beside doubles of its units: what must be so before, start, close, settings."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from support.small_pipeline import ToldTime, pipeline
from trilane import machine
from trilane.errors import BadInputError
from trilane.pipeline import result, surroundings, unit_processes
from trilane.pipeline.controls import FrameRequestQueue, Interrupts
from trilane.pipeline.realtime_clock import HeldTime
from trilane.pipeline.result import Failure, RunLog, UnitError, after_stderr
from trilane.pipeline.surroundings import prompt_answers
from trilane.pipeline.unit_processes import UnitMessage, close_units, listen_before_run, start_units
from trilane.scheduler.events import FrameRequest, Hold, Stop
from trilane.signals import interrupting
from trilane.transport.messages import Close, Closed, Failed, PongMessage, Ready

S = 1_000_000_000


def test_cores_that_are_not_there_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.here, "cores", lambda: (0, 1))
    said = r"^cores of unit right: found 3, expected some of this process's: 0, 1$"
    with pytest.raises(BadInputError, match=said):
        surroundings.check_cores(pipeline())
    monkeypatch.setattr(machine.here, "cores", lambda: (0, 1, 3))
    surroundings.check_cores(pipeline())


def test_the_first_failure_stands_and_every_message_is_said() -> None:
    said: list[str] = []
    log = RunLog(said.append)
    log.say("one")
    log.fail_with(Failed(1, 3, "two"))
    log.fail_with(Failed(1, 4, "three"))
    log.fail("four")
    assert (log.messages, said, log.failure) == (["one", "two"], ["one", "two"], Failure("two", 3))
    quiet = RunLog()
    quiet.fail("five")
    quiet.say("six")
    assert (quiet.failure, quiet.messages) == (Failure("five", 1), ["six"])
    assert (UnitError("x").exit_code, UnitError("x", 4).exit_code, str(UnitError("x"))) == (1, 4, "x")
    assert (after_stderr("a\nb\n"), after_stderr("")) == ("it wrote last: b", "")
    assert result.Failure("x").exit_code == 1


def test_requests_come_in_order_wake_the_run_and_end_with_it() -> None:
    told: list[Any] = []
    queue = FrameRequestQueue(told.append, lambda: told.append("ended"), told.append)
    for causes in ({}, {"raster->infer:stale": 1}, {"raster->infer:stale": 2}):
        queue.tell_unanswered(causes)
    assert told == [{"raster->infer:stale": 1}]
    told.clear()
    with pytest.raises(BlockingIOError):
        os.eventfd_read(queue.fd)
    queue.request()
    queue.request(3)
    queue.end()
    assert os.eventfd_read(queue.fd) == 3
    assert queue.events() == [FrameRequest(1), FrameRequest(3), Stop()]
    assert queue.events() == []
    assert not os.get_inheritable(queue.fd) and not queue.is_open.is_set()
    queue.answered(5)
    queue.close()
    queue.close()
    queue.request()
    assert (told, queue.is_open.is_set(), queue.events()) == ([5, "ended"], True, [])
    with pytest.raises(OSError, match=r"Bad file"):
        os.fstat(queue.fd)


def test_interrupts_are_counted_wake_the_poller_and_are_given_back() -> None:
    """SIGQUIT is ignored before, and stays so."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGPIPE)
    mine = signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    others = (signal.signal(signal.SIGHUP, signal.SIG_DFL), signal.signal(signal.SIGQUIT, signal.SIG_IGN))
    before = [signal.getsignal(number) for number in numbers]
    try:
        with Interrupts() as interrupts:
            assert signal.getsignal(signal.SIGPIPE) == signal.SIG_IGN
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGHUP)
            signal.raise_signal(signal.SIGQUIT)
            assert interrupts.count == 3
            assert os.read(interrupts.fd, 9) == bytes([signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
            with pytest.raises(BlockingIOError):
                os.read(interrupts.fd, 9)
            wakes = signal.set_wakeup_fd(-1)
            assert wakes == interrupts._write_fd
        assert [signal.getsignal(number) for number in numbers] == before
        assert signal.set_wakeup_fd(-1) == -1
        for fd in (interrupts.fd, wakes):
            with pytest.raises(OSError, match=r"Bad file"):
                os.fstat(fd)
    finally:
        signal.signal(signal.SIGPIPE, mine)
        signal.signal(signal.SIGHUP, others[0])
        signal.signal(signal.SIGQUIT, others[1])


def test_each_signal_that_would_end_the_process_ends_the_run_and_a_continued_one_is_counted() -> None:
    """SIGUSR2 has a handler of the program's own, which is left alone."""
    heard: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU)}
    try:
        for number in before:
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGUSR2, lambda number, _frame: heard.append(number))
        with interrupting(), Interrupts() as interrupts:
            for number in (signal.SIGXCPU, signal.SIGUSR2, signal.SIGUSR1, signal.SIGCONT):
                signal.raise_signal(number)
            assert (interrupts.count, interrupts.last, interrupts.continued) == (2, signal.SIGUSR1, 1)
        assert heard == [signal.SIGUSR2]
        assert signal.getsignal(signal.SIGUSR1) == signal.getsignal(signal.SIGXCPU) == signal.SIG_DFL
        assert signal.getsignal(signal.SIGCONT) == signal.SIG_DFL
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_a_signal_before_the_run_ends_a_command_as_ctrl_c_does_and_is_named(capfd: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), interrupting():
        signal.raise_signal(signal.SIGTERM)
    assert capfd.readouterr().err == "interrupted by SIGTERM\n"
    assert signal.getsignal(signal.SIGTERM) == before


def test_interrupts_do_nothing_outside_the_main_thread() -> None:
    before, seen = signal.getsignal(signal.SIGINT), []

    def enter() -> None:
        with Interrupts():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert seen == [before]


class FakeProcesses:
    """Answers each `listen` with the next of `script`; notes what it is told."""

    def __init__(self, script: Sequence[Any] = (), pids: Mapping[str, int] | None = None) -> None:
        self.script, self.pids = deque(script), dict(pids or {})
        self.told: list[Any] = []
        self.places = {"in": 0, "mid": 0, "out": 1}

    def start(self, unit: str) -> None:
        self.told.append(("start", unit))

    def connected(self, unit: str) -> None:
        self.told.append(("connected", unit))

    def send(self, unit: str, message: Any) -> None:
        self.told.append((unit, message))

    def listen(self, timeout_ms: int) -> list[UnitMessage]:
        assert timeout_ms == 200
        return [UnitMessage(*row) for row in self.script.popleft()]

    def why_ended(self, unit: str) -> str:
        return f"; it was {unit}"

    def wait_for_end(self, units: list[str]) -> None:
        self.told.append(("wait", units))


NOBODY: Any = SimpleNamespace(count=0)


def test_units_are_started_all_at_once_and_waited_for_until_the_last_is_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    """Started at 5.001 and 5.002 ms; looks at 5.003 (the end), 5.004, 5.005 (left), 5.006, 5.007 (right)."""
    monkeypatch.setattr(unit_processes, "time", ToldTime())
    processes: Any = FakeProcesses([[("left", Ready(4))], [], [("right", Ready(5))]])
    took = start_units(processes, ["left", "right"], NOBODY)
    assert {unit: round(ms, 6) for unit, ms in took.items()} == {"left": 0.004, "right": 0.006}
    assert processes.told == [("start", "left"), ("start", "right"), ("connected", "left"), ("connected", "right")]


def test_units_that_are_not_ready_in_time_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = ToldTime()
    processes: Any = FakeProcesses()
    processes.listen = lambda _: clock.sleep(60.1) or []
    monkeypatch.setattr(unit_processes, "time", clock)
    with pytest.raises(UnitError, match=r"^unit a, b was not ready after 120 s$"):
        start_units(processes, ["b", "a"], NOBODY)
    assert len(clock.slept) == 2


def test_what_goes_wrong_before_the_run_is_raised() -> None:
    with pytest.raises(UnitError, match=r"^no network$") as failed:
        listen_before_run(FakeProcesses([[("left", Failed(-1, 3, "no network"))]]), NOBODY)  # type: ignore[arg-type]
    assert failed.value.exit_code == 3
    with pytest.raises(UnitError, match=r"^unit left ended before the run began; it was left$"):
        listen_before_run(FakeProcesses([[("left", None)]]), NOBODY)  # type: ignore[arg-type]
    with pytest.raises(KeyboardInterrupt):
        listen_before_run(FakeProcesses([[]]), SimpleNamespace(count=1))  # type: ignore[arg-type]
    messages = listen_before_run(FakeProcesses([[("left", PongMessage())]]), NOBODY)  # type: ignore[arg-type]
    assert messages == [("left", PongMessage())]


def closed(script: Sequence[Any], interrupts: Any = NOBODY) -> tuple[FakeProcesses, RunLog]:
    processes, log = FakeProcesses(script, {"left": 1, "right": 2}), RunLog()
    close_units(processes, log, interrupts)  # type: ignore[arg-type]
    return processes, log


def test_units_close_their_files_and_are_waited_for() -> None:
    processes, log = closed([[("left", Closed())], [("left", None)], [("right", Closed())]])
    assert sorted(processes.told[:2]) == [("left", Close()), ("right", Close())]
    assert processes.told[2:] == [("wait", ["left", "right"])]
    assert (log.failure, log.messages, len(processes.script)) == (None, [], 0)


def test_a_unit_that_fails_or_ends_while_it_closes_is_said() -> None:
    _, log = closed([[("left", Failed(-2, 4, "disk full")), ("left", Closed()), ("right", Closed())]])
    assert (log.failure, log.messages) == (Failure("disk full", 4), ["disk full"])
    _, log = closed([[("left", Closed()), ("right", None)]])
    assert log.failure == Failure("unit right ended before its files were closed; it was right", 1)


def test_units_that_do_not_close_are_named_unless_somebody_has_lost_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = ToldTime()
    monkeypatch.setattr(unit_processes, "time", clock)
    script = [[], []]
    monkeypatch.setattr(FakeProcesses, "listen", lambda self, _: clock.sleep(15.1) or self.script.popleft())
    _, log = closed(script)
    assert log.failure == Failure("unit left, right did not close its files", 1)
    _, log = closed([[], []], SimpleNamespace(count=1))
    assert log.failure == Failure("unit left, right did not close its files", 1)
    processes, log = closed([], SimpleNamespace(count=2))
    assert (log.failure, processes.told[-1]) == (None, ("wait", ["left", "right"]))


def test_a_run_that_was_never_held_says_nothing() -> None:
    held = HeldTime()
    held.hear(3 * S, [Stop(), Hold(-1)])
    assert (held.until(9 * S), held.sentence(9 * S)) == (0, "")


def test_steps_within_a_hold_do_not_end_it() -> None:
    """Held from 1 to 4 s with a step at 2, and from 6 s on."""
    held = HeldTime()
    for at_s, frames in ((1, 0), (2, 1), (4, -1), (6, 0)):
        held.hear(at_s * S, [Hold(frames)])
    assert [held.until(at_s * S) for at_s in (6, 8)] == [3 * S, 5 * S]
    assert held.sentence(8 * S).startswith("held for 5.0 s by who watched it: shares of units")


def test_answers_are_prompt_inside_the_run_alone() -> None:
    before = sys.getswitchinterval(), gc.isenabled()
    with prompt_answers():
        assert (sys.getswitchinterval(), gc.isenabled()) == (pytest.approx(0.0002), False)
    assert (sys.getswitchinterval(), gc.isenabled()) == before
