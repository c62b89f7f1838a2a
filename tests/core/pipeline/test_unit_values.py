"""Inside a unit's process, beside a double of the scheduler: what it answers, on which cores, what it is born with."""

from __future__ import annotations

import errno
import os
import threading
import time
from collections import deque
from collections.abc import Mapping, Set
from types import SimpleNamespace
from typing import Any

import pytest

from support.small_pipeline import OWN, UNITS, FakeStage, packets, spec_of
from trilane import machine
from trilane.errors import BadInputError, MissingPartError, TrilaneError, UnitLostError
from trilane.pipeline import unit_loop
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.job_times import LOSS_NS
from trilane.pipeline.stage import UnitContext
from trilane.pipeline.unit_loop import BoundStage, UnitSpec
from trilane.transport.messages import Close, Closed, Failed, MessageError, Ping, PongMessage, Ready, RunJob


def context() -> UnitContext:
    return UnitContext("right", UNITS["right"], {})


LATER_NS = 1 << 62  # so no job was dispatched long before it began


class ToldMeter:
    """Each look at the CPU clock is 100 ns after the one before, each at the run delay 2; notes how often it looked.

    There are two threads, so that the CPU clock is read before each job.
    """

    threads = 2

    def __init__(self, others: Set[int]) -> None:
        self.others, self.looks = others, 0

    def cpu_ns(self) -> int:
        return 100

    def delay_ns(self) -> int:
        return 2

    def look(self) -> None:
        self.looks += 1


class SlowStage(FakeStage):
    """Takes so long that its times differ."""

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        time.sleep(2 * LOSS_NS / 1e9)
        return super().run(frame, slot_in, slot_out)


class FakeLink:
    """A unit's end of its link, with the messages that it will receive; notes what it sends."""

    def __init__(self, *script: Any) -> None:
        self.job_pipe = self
        self.script, self.sent, self.beats, self.ended = deque(script), [], [], False

    def receive(self) -> Any:
        if not self.script:
            self.ended = True
            return None
        return self.script.popleft()

    def send(self, message: Any) -> None:
        self.sent.append(message)

    def send_heartbeat(self, message: Any) -> None:
        self.beats.append(message)


def no_counter(_attributes: bytes, _flags: int) -> int:
    """The processor of these tests has no counters."""
    raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))


def served(monkeypatch: pytest.MonkeyPatch, link: FakeLink, stages: list[Any]) -> int:
    core = min(machine.here.cores())
    before = set(machine.here.cores())
    spec = spec_of(settings=UnitSettings(cores=(core,), threads=1), run_cores=(core,))
    monkeypatch.setattr(unit_loop, "build_stages", lambda _: stages)
    monkeypatch.setattr(machine.here, "open_counter", no_counter)
    collector: list[str] = []
    tidy = SimpleNamespace(collect=lambda: collector.append("collect"), freeze=lambda: collector.append("freeze"))
    monkeypatch.setattr(unit_loop, "gc", tidy)
    try:
        return unit_loop._serve(spec, link)  # type: ignore[arg-type]
    finally:
        assert collector == ["collect", "freeze"]  # what was built is never looked at again
        os.sched_setaffinity(0, before)


def test_a_unit_answers_every_message_once(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = SlowStage(), SlowStage()
    outputs = packets(OWN, 2)
    stages = [
        BoundStage("a", first, [], outputs, 0, context()),
        BoundStage("b", second, packets(OWN, 2), [], 1, context()),
    ]
    outputs[0].header["epoch"] = 9
    link = FakeLink(RunJob(11, 0, 5, -1, 1, 2, LATER_NS, 0), Ping(), RunJob(12, 1, 6, 1, -1, 2, LATER_NS, 0), Close())
    meters: list[ToldMeter] = []
    monkeypatch.setattr(unit_loop, "CoreMeter", lambda others: meters.append(ToldMeter(others)) or meters[0])
    others = unit_loop._threads() - {os.getpid()}
    before = time.monotonic_ns()
    assert served(monkeypatch, link, stages) == 0
    one, two, end = link.sent
    assert (one.id, two.id, one.metrics) == (11, 12, {"shade": 3.0})
    assert before <= one.t_begin_ns <= one.t_sampled_ns <= one.t_end_ns <= two.t_begin_ns <= two.t_end_ns
    assert (two.t_sampled_ns, end) == (0, Closed())
    wall_ns = one.t_end_ns - one.t_begin_ns  # on one core: 100 ns worked, 2 ns waited for it, the rest slept
    assert one[4:10] == (2, wall_ns - 102, 0, 0, 100, 100)
    assert two[4:10] == (2, 0, 2, 0, 100, 200)  # held to a pace: the chip worked
    assert [(meter.others, meter.looks) for meter in meters] == [(others, 3)]  # at the start, after a job
    assert link.beats == [Ready(os.getpid()), PongMessage()]
    assert (first.runs, second.runs) == ([(5, None, 1)], [(6, 1, None)])
    assert [int(packet.header["epoch"]) for packet in outputs] == [9, 2]
    assert first.closed and second.closed


def test_a_unit_ends_when_its_pipe_does_and_refuses_what_is_not_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert served(monkeypatch, FakeLink(), []) == 1
    with pytest.raises(MessageError, match=r"PongMessage\(\) is not for a unit"):
        served(monkeypatch, FakeLink(PongMessage()), [])


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (ValueError("dark\n  night"), 1, "stage a, frame 5: ValueError: dark night"),
        (BadInputError("file", "this", "that"), 2, "file: found this, expected that"),
        (MissingPartError("no part", "get one"), MissingPartError("", "").exit_code, "no part"),
    ],
)
def test_a_stage_that_fails_is_an_answer_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], error: Exception, code: int, said: str
) -> None:
    stage = BoundStage("a", SlowStage(error), [], packets(OWN, 1), 0, context())
    link = FakeLink(RunJob(11, 0, 5, -1, 0, 0, 0, 0), Close())
    assert served(monkeypatch, link, [stage]) == code
    assert [(answer.id, answer.exit_code) for answer in link.sent[:2]] == [(11, code), (-2, code)]
    assert link.sent[0].message.startswith(said)
    assert link.sent[2:] == [Closed()]
    assert type(error).__name__ in capfd.readouterr().err


def test_closing_names_its_stage_and_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    last = SlowStage()
    stages = [
        BoundStage("a", SlowStage(ValueError("x")), [], [], 0, context()),
        BoundStage("b", last, [], [], 0, context()),
    ]
    link = FakeLink(Close())
    assert served(monkeypatch, link, stages) == 1
    assert link.sent == [Failed(-2, 1, "unit right, closing a: ValueError: x"), Closed()]
    assert last.closed


def test_a_lost_unit_does_not_answer_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    link = FakeLink(RunJob(11, 0, 5, -1, 0, 0, 0, 0))
    stage = BoundStage("a", SlowStage(UnitLostError("context lost")), [], packets(OWN, 1), 0, context())
    with pytest.raises(UnitLostError):
        served(monkeypatch, link, [stage])
    assert link.sent == []


def test_a_unit_that_cannot_be_built_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: UnitSpec) -> list[BoundStage]:
        raise KeyError("weights")

    link = FakeLink()
    core = min(machine.here.cores())
    before = set(machine.here.cores())
    monkeypatch.setattr(unit_loop, "build_stages", fail)
    spec: Any = spec_of(settings=UnitSettings(cores=(core,), threads=1), run_cores=(core,))
    assert unit_loop._serve(spec, link) == 1  # type: ignore[arg-type]
    os.sched_setaffinity(0, before)
    assert (link.sent, link.beats) == ([Failed(-1, 1, "unit right: KeyError: 'weights'")], [])


def test_a_long_error_is_cut_at_whole_characters() -> None:
    link = FakeLink()
    code = unit_loop._fail(link, 5, "stage a", TrilaneError("é" * 1500))  # type: ignore[arg-type]
    assert (code, link.sent) == (TrilaneError("").exit_code, [Failed(5, TrilaneError("").exit_code, "é" * 1000)])
    unit_loop._fail(link, 5, "stage a", TrilaneError("x" + "é" * 1500))  # type: ignore[arg-type]
    assert link.sent[1].message == "x" + "é" * 999


def test_threads_that_were_started_while_building_go_back_to_the_units_cores() -> None:
    """On a machine of one core there is nothing to see."""
    here = set(machine.here.cores())
    if len(here) < 2:
        pytest.skip("one core")
    core, other = sorted(here)[:2]
    spec = spec_of(settings=UnitSettings(cores=(core,), threads=1), run_cores=(core, other))
    end, ids = threading.Event(), []

    def work() -> None:
        ids.append(threading.get_native_id())
        end.wait(60)

    early, late = threading.Thread(target=work), threading.Thread(target=work)
    early.start()
    try:
        with unit_loop.building_cores(spec):
            assert set(machine.here.cores()) == {core, other}
            late.start()
            while len(ids) < 2:
                time.sleep(0.001)
            assert os.sched_getaffinity(ids[1]) == {core, other}  # noqa: TID251 - of a thread
        assert (set(machine.here.cores()), os.sched_getaffinity(ids[1])) == ({core}, {core})  # noqa: TID251 - of a thread
        assert os.sched_getaffinity(ids[0]) == here  # noqa: TID251 - of a thread
    finally:
        end.set()
        os.sched_setaffinity(0, here)
        early.join()
        late.join()
