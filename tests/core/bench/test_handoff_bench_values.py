"""`bench handoff`: the document of rounds that are told, both ends of a hand-over, and who is asked in which order."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.bench import handoff
from trilane.bench.handoff import BARE, PIPELINE, SLOT
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.host import host_units
from trilane.scheduler.ledger import JobRecord
from trilane.transport.wakeup import UNIT_NS

#: Microseconds of each variant in the first round at 256 KiB; four times as much at 1024, and 3 more in the second.
BASE = {SLOT: 10.0, BARE: 5.0, "peer": 20.0, PIPELINE: 12.0}
READ = 100.0


def told(variant: str, size: int, number: int, frames: int) -> handoff.Times:
    """All frames alike but the last, which takes 50 longer; reading takes 100 more."""
    one = BASE[variant] * size / 256 + 3 * number
    readable = [one] * (frames - 1) + [one + 50]
    return readable, [value + READ for value in readable]


@pytest.fixture
def order(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Everything that a measurement does, with no process."""
    done: list[Any] = []

    class Pair:
        def __init__(self, _context: Any, channel: tuple[str, int], written: int) -> None:
            self.variant, size = channel
            self.size, self.turn = size // 1024, 0
            done.append(("made", self.variant, size, written))

        def run(self, frames: int) -> handoff.Times:
            done.append((self.variant, self.size))
            self.turn += 1
            return told(self.variant, self.size, self.turn - 1, frames)

        def close(self) -> None:
            done.append(("closed", self.variant, self.size))

    turns: list[int] = []

    def through(size: int, frames: int) -> handoff.Times:
        done.append((PIPELINE, size))
        turns.append(size)
        return told(PIPELINE, size, turns.count(size) - 1, frames)

    @contextmanager
    def awake() -> Iterator[str]:
        yield "awake"
        done.append("asleep")

    def absent(_size: int, _context: Any) -> Any:
        done.append("asked for what is absent")
        raise ModuleNotFoundError("nothing", name="nothing")

    names = (SLOT, BARE, "peer")
    channels: dict[str, Any] = {name: lambda size, _context, name=name: (name, size) for name in names}
    monkeypatch.setattr(handoff, "CHANNELS", {**channels, "gone": absent})
    monkeypatch.setattr(handoff, "Pair", Pair)
    monkeypatch.setattr(handoff, "_through_pipeline", through)
    monkeypatch.setattr(handoff, "awake", awake)
    return done


def test_two_rounds_at_two_sizes(order: list[Any]) -> None:
    """Variants begin a place later in each round, the run through the scheduler comes last."""
    result = handoff.measure(kib=(1024, 256), frames=10, rounds=2)
    ours = [SLOT, BARE, "peer"]
    made = [
        ("made", name, kib * 1024, 256 * 1024 if name == BARE else kib * 1024) for name in ours for kib in (1024, 256)
    ]
    first = [(name, kib) for kib in (1024, 256) for name in (SLOT, BARE, "peer", PIPELINE)]
    second = [(name, kib) for kib in (1024, 256) for name in (BARE, "peer", SLOT, PIPELINE)]
    closed = [("closed", name, kib) for name in ours for kib in (1024, 256)]
    assert order == [*made, "asked for what is absent", *first, *second, *reversed(closed), "asleep"]
    assert [(row["kib"], row["way"]) for row in result["rows"]] == [
        (kib, name) for kib in (256, 1024) for name in (*ours, PIPELINE)
    ]
    none = {f"{key}_{end}": None for key in ("p99", "read_p99") for end in ("us", "low_us", "high_us")}
    assert result["rows"][5] == {
        "way": BARE,
        "kib": 1024,
        "frames": 20,
        "p50_us": 21.5,
        "p50_low_us": 20.0,
        "p50_high_us": 23.0,
        "max_us": 73.0,
        "read_p50_us": 121.5,
        "read_p50_low_us": 120.0,
        "read_p50_high_us": 123.0,
        **none,
    }
    assert result["met"] == {SLOT: None, PIPELINE: None}
    assert result["p50_largest_over_smallest"] == {SLOT: 41.5 / 11.5, BARE: 21.5 / 6.5, PIPELINE: 49.5 / 13.5}
    assert result["slower_us"] == {"peer": {256: (8.0, 8.0), 1024: (32.0, 32.0)}} == result["read_slower_us"]
    assert result["slower_than_slot_us"] == {"peer": {256: (10.0, 10.0), 1024: (40.0, 40.0)}}
    assert result["read_slower_than_slot_us"] == result["slower_than_slot_us"]
    assert result["ahead"] == result["read_ahead"] == {"peer": True}
    assert list(result["absent"]) == ["gone"]
    assert result["absent"]["gone"].startswith("nothing is not installed: ") and "peers" in result["absent"]["gone"]
    assert result["config"] == {"frames": 10, "rounds": 2, "idle_cores": "awake"}


@pytest.mark.parametrize(
    ("p50", "p99", "met"), [(150.0, 500.0, True), (151.0, 500.0, False), (150.0, 501.0, False), (150.0, None, None)]
)
def test_the_limits_are_met_at_the_largest_size(p50: float, p99: float | None, met: bool | None) -> None:
    small = [{"way": name, "kib": 256, "p50_us": 100.0, "p99_us": 900.0} for name in handoff.OURS]
    large = [{"way": name, "kib": 1024, "p50_us": p50, "p99_us": p99} for name in handoff.OURS]
    found = handoff._verdicts([*large, *small], 1024)
    assert found["met"] == {SLOT: met, PIPELINE: met}
    assert found["p50_largest_over_smallest"] == dict.fromkeys(handoff.OURS, p50 / 100)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"kib": (256, 300, 299)}, "--kib: found 299, expected 256, 1024, 4096, 16384"),
        ({"frames": 9}, "--frames: found 9, expected at least 10"),
        ({"rounds": 0}, "--rounds: found 0, expected at least 1"),
    ],
)
def test_what_cannot_be_measured_is_refused(asked: dict[str, Any], words: str) -> None:
    with pytest.raises(BadInputError, match=f"^{words}$"):
        handoff.measure(**asked)


class End:
    """One end of a pipe or a channel, which notes what is done to it; `answers` come, errors are raised."""

    def __init__(self, log: list[Any], name: str, *answers: Any) -> None:
        self._log, self._name, self._answers = log, name, [*answers]
        self.payload = np.zeros(16, np.uint8)
        self.closed = 0

    def recv(self) -> Any:
        answer = self._answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def poll(self, seconds: float) -> bool:
        self._log.append((self._name, "waits", seconds))
        return bool(self._answers)

    def send(self, what: Any) -> None:
        self._log.append((self._name, what))

    def send_bytes(self, what: bytes) -> None:
        self._log.append((self._name, what))

    def recv_bytes(self) -> None:
        self._log.append((self._name, "came"))

    def buffer(self) -> np.ndarray:
        return self.payload

    def hand_over(self) -> None:
        self._log.append(("handed over", self.payload.tolist()))

    def receive(self) -> np.ndarray:
        self._log.append("received")
        return self.payload

    def release(self) -> None:
        self._log.append("released")

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What a child does to itself and the clock, which goes on by 10 ns with every look."""
    done: list[Any] = []
    now = iter(range(10, 10_000, 10))
    told = SimpleNamespace(sleep=lambda seconds: done.append(("slept", seconds)), monotonic_ns=lambda: next(now))
    monkeypatch.setattr(handoff, "time", told)
    monkeypatch.setattr(handoff.os, "sched_setaffinity", lambda *asked: done.append(("cores", *asked)))
    monkeypatch.setattr(handoff.signal, "signal", lambda *asked: done.append(("signal", *asked)))
    monkeypatch.setattr(handoff, "use_slice", lambda ns: done.append(("slice", ns)))
    return done


BEGUN = [("signal", signal.SIGINT, signal.SIG_IGN), ("cores", 0, (1,)), ("slice", UNIT_NS)]


def test_the_producer_writes_looks_at_the_clock_hands_over_and_waits(log: list[Any]) -> None:
    pipe, ack, end = End(log, "pipe", 2, 1, EOFError()), End(log, "ack"), End(log, "end")
    channel: Any = SimpleNamespace(producer=lambda: end)
    handoff.produce(pipe, ack, channel, (1,), 12)  # type: ignore[arg-type]

    def frame(value: int) -> list[Any]:
        return [("slept", 0.001), ("handed over", [value] * 12 + [0] * 4), ("ack", "came")]

    assert log == [
        *BEGUN,
        *[("pipe", "ready"), *frame(0), *frame(1), ("pipe", [10, 20])],
        *[*frame(0), ("pipe", [30])],
    ]


def test_the_consumer_looks_at_the_clock_before_and_after_it_reads(log: list[Any]) -> None:
    pipe, ack, end = End(log, "pipe", 1, 1, EOFError()), End(log, "ack"), End(log, "end")
    end.payload[12:] = 9
    channel: Any = SimpleNamespace(consumer=lambda: end)
    handoff.consume(pipe, ack, channel, (1,), 8)  # type: ignore[arg-type]
    frame = ["received", "released", ("ack", b"\0")]
    assert log == [*BEGUN, ("pipe", "ready"), *frame, ("pipe", ([10], [20])), *frame, ("pipe", ([30], [40]))]
    del log[:]
    pipe = End(log, "pipe", 1)
    handoff.consume(pipe, ack, channel, (1,), 16)  # type: ignore[arg-type]
    assert isinstance(log[-1][1], TrilaneError)
    assert "TrilaneError: a slot of 16 bytes holds others than were written" in str(log[-1][1])


class Context:
    """Stands for multiprocessing's."""

    def __init__(self, log: list[Any], answers: dict[int, list[Any]]) -> None:
        self.log, self.answers = log, answers
        self.pipes: list[tuple[End, End]] = []
        self.processes: list[Any] = []

    def Pipe(self) -> tuple[End, End]:  # noqa: N802 - multiprocessing's name
        place = len(self.pipes)
        self.pipes.append(
            (End(self.log, f"ours {place}", *self.answers.get(place, ())), End(self.log, f"theirs {place}"))
        )
        return self.pipes[-1]

    def Process(self, **asked: Any) -> Any:  # noqa: N802 - multiprocessing's name
        place, log = len(self.processes), self.log
        calls = {name: lambda *more, name=name: log.append((name, place, *more)) for name in ("start", "join", "kill")}
        self.processes.append(SimpleNamespace(**asked, **calls))
        return self.processes[-1]


def test_a_pair_is_two_processes_that_are_asked_the_reader_first() -> None:
    log: list[Any] = []
    answers = {0: ["ready", [1000, 2000]], 1: ["ready", ([1500, 4000], [2500, 6000])]}
    context, channel = Context(log, answers), End(log, "channel")
    pair = handoff.Pair(context, channel, 77)  # type: ignore[arg-type]
    (ours, theirs), (ours_too, theirs_too), between = context.pipes
    units = host_units()
    for process, target, pipe, ack, unit in zip(
        context.processes,
        (handoff.produce, handoff.consume),
        (theirs, theirs_too),
        between,
        ("gpu", "dsp"),
        strict=True,
    ):
        assert (process.target, process.daemon) == (target, True)
        assert process.args == (pipe, ack, channel, units[unit].cores, 77)
    assert [end.closed for end in (theirs, theirs_too, *between, ours, ours_too)] == [1, 1, 1, 1, 0, 0]
    assert log == [("start", 0), ("start", 1), ("ours 0", "waits", 120), ("ours 1", "waits", 120)]
    del log[:]
    assert pair.run(2) == ([0.5, 2.0], [1.5, 4.0])
    assert log[:2] == [("ours 1", 2), ("ours 0", 2)]
    del log[:]
    pair.close()
    assert log == [(name, place, *more) for place in (0, 1) for name, *more in (("join", 2), ("kill",), ("join",))]
    assert (ours.closed, ours_too.closed, channel.closed) == (1, 1, 1)


@pytest.mark.parametrize(("answer", "words"), [([TrilaneError("no slot")], "no slot"), ([], "no answer in 120 s")])
def test_a_child_that_does_not_come_up_ends_both(answer: list[Any], words: str) -> None:
    log: list[Any] = []
    context, channel = Context(log, {0: ["ready"], 1: answer}), End(log, "channel")
    with pytest.raises(TrilaneError, match=words):
        handoff.Pair(context, channel, 1)  # type: ignore[arg-type]
    assert ("kill", 0) in log and ("kill", 1) in log and channel.closed == 1


def job(stage: str, ready: int, begin: int, end: int) -> JobRecord:
    return JobRecord(stage, "dsp", 0, ready, 0, begin, end)


def test_a_run_is_read_from_the_readers_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = [job("infer", 1000, 3000, 8000), job("raster", 0, 1, 2), job("infer", 2000, 7000, 9000)]
    asked: list[Any] = []
    result = SimpleNamespace(interrupted=False, failure=None, presented=2, jobs=jobs)
    monkeypatch.setattr(handoff, "run_pipeline", lambda *what, **options: asked.append((what, options)) or result)
    assert handoff._through_pipeline(256, 2) == ([2.0, 5.0], [7.0, 7.0])
    (((pipeline, frames), options),) = asked
    assert [edge.payload_bytes for edge in pipeline.edges] == [0, 256 * 1024, 0]
    assert (frames, options) == (2, {"policy": "sequential"})
    with pytest.raises(TrilaneError, match="the run with 256 KiB failed: frames were lost"):
        handoff._through_pipeline(256, 3)
    result.failure = "it broke"
    with pytest.raises(TrilaneError, match="the run with 256 KiB failed: it broke"):
        handoff._through_pipeline(256, 2)
    result.interrupted = True
    with pytest.raises(KeyboardInterrupt):
        handoff._through_pipeline(256, 2)
