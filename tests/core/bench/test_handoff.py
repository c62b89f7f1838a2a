"""`bench handoff`: the document of rounds that are told, and its channels, both ends in this process.

Ends in processes of their own are tested in process/test_scheduling_benches.py.
"""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.bench import handoff
from trilane.bench.handoff import BARE, PIPELINE, SLOT
from trilane.bench.lib import handoff_variants
from trilane.bench.lib.handoff_variants import CHANNELS, IceoryxChannel, _SlotEnd
from trilane.errors import BadInputError, TrilaneError
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.stage import UnitContext
from trilane.scheduler.ledger import JobRecord
from trilane.transport.messages import RunJob
from trilane.transport.packets import SlotLayout, header_dtype, view_packet

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
    """Which variants run and end, with no process."""
    done: list[Any] = []

    class Pair:
        def __init__(self, _context: Any, channel: tuple[str, int], written: int) -> None:
            self.variant, self.size, self.turn = channel[0], channel[1] // 1024, 0
            assert written == (256 * 1024 if self.variant == BARE else channel[1])

        def run(self, frames: int) -> handoff.Times:
            done.append((self.variant, self.size))
            self.turn += 1
            return told(self.variant, self.size, self.turn - 1, frames)

        def close(self) -> None:
            done.append("closed")

    def through(size: int, frames: int) -> handoff.Times:
        done.append((PIPELINE, size))
        return told(PIPELINE, size, done.count((PIPELINE, size)) - 1, frames)

    @contextmanager
    def awake() -> Iterator[str]:
        yield "awake"

    def absent(_size: int, _context: Any) -> Any:
        raise ModuleNotFoundError("nothing", name="nothing")

    names = (SLOT, BARE, "peer")
    channels: dict[str, Any] = {name: lambda size, _context, name=name: (name, size) for name in names}
    for name, double in (("CHANNELS", {**channels, "gone": absent}), ("ChannelPair", Pair), ("awake", awake)):
        monkeypatch.setattr(handoff, name, double)
    monkeypatch.setattr(handoff, "_through_pipeline", through)
    return done


def test_two_rounds_at_two_sizes(order: list[Any]) -> None:
    """Variants begin a place later in each round, the run through the scheduler comes last."""
    result = handoff.measure(kib=(1024, 256), frames=10, rounds=2)
    ours = [SLOT, BARE, "peer"]
    first = [(name, kib) for kib in (1024, 256) for name in (SLOT, BARE, "peer", PIPELINE)]
    second = [(name, kib) for kib in (1024, 256) for name in (BARE, "peer", SLOT, PIPELINE)]
    assert order == [*first, *second, *["closed"] * 6]
    assert [(row["kib"], row["way"]) for row in result["rows"]] == [
        (kib, name) for kib in (256, 1024) for name in (*ours, PIPELINE)
    ]
    assert result["rows"][5] == {
        **{"way": BARE, "kib": 1024, "frames": 20, "p50_us": 21.5, "p50_low_us": 20.0, "p50_high_us": 23.0},
        **{"max_us": 73.0, "read_p50_us": 121.5, "read_p50_low_us": 120.0, "read_p50_high_us": 123.0},
        **{f"{key}_{end}": None for key in ("p99", "read_p99") for end in ("us", "low_us", "high_us")},
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


def test_a_run_is_read_from_the_readers_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    times = (("infer", 1000, 3000, 8000), ("raster", 0, 1, 2), ("infer", 2000, 7000, 9000))
    jobs = [JobRecord(stage, "dsp", 0, ready, 0, begin, end) for stage, ready, begin, end in times]
    result = SimpleNamespace(interrupted=False, failure=None, presented=2, jobs=jobs)
    monkeypatch.setattr(handoff, "run_pipeline", lambda *_, **__: result)
    assert handoff._through_pipeline(256, 2) == ([2.0, 5.0], [7.0, 7.0])
    with pytest.raises(TrilaneError, match="the run with 256 KiB failed: frames were lost"):
        handoff._through_pipeline(256, 3)
    result.failure = "it broke"
    with pytest.raises(TrilaneError, match="the run with 256 KiB failed: it broke"):
        handoff._through_pipeline(256, 2)
    result.interrupted = True
    with pytest.raises(KeyboardInterrupt):
        handoff._through_pipeline(256, 2)


def test_a_slot_is_written_whole_and_read_whole() -> None:
    layout = SlotLayout(header_dtype(), 64)
    slots = [view_packet(memoryview(bytearray(layout.slot_bytes)), layout) for _ in range(2)]
    pipeline = handoff.handoff_pipeline(64)
    assert [(stage.name, stage.unit) for stage in pipeline.stages] == [*handoff.STAGES]
    assert [edge.payload_bytes for edge in pipeline.edges] == [0, 64, 0]
    unit = UnitContext("a", UnitSettings(cores=(0,), threads=1), {})
    by_name = {stage.name: handoff.build(stage.settings, unit) for stage in pipeline.stages}
    for name, stage in by_name.items():
        stage.bind(slots if name == "infer" else [], slots if name == "raster" else [])
    assert by_name["pose"].run(255, None, 0) == {} and not slots[0].payload.any()
    assert by_name["raster"].run(255, 0, 1) == {}
    assert (slots[1].payload == 4).all() and not slots[0].payload.any()
    assert by_name["infer"].run(255, 1, None) == {}
    by_name["present"].run(255, 1, None)
    with pytest.raises(TrilaneError, match="a slot of 64 bytes holds others than were written"):
        by_name["infer"].run(256, 1, 0)
    with pytest.raises(TrilaneError, match="64 bytes"):
        by_name["infer"].run(255, 0, None)
    slots[1].payload[63] = 5
    with pytest.raises(TrilaneError, match="64 bytes"):
        handoff.check_bytes(slots[1].payload, 4)


@pytest.mark.parametrize("name", ["iceoryx2", "pickled queue"])
def test_bytes_arrive_whole_and_nothing_is_left(name: str, request: pytest.FixtureRequest) -> None:
    """Two frames; a folder and a prefix of its own keep what iceoryx2 leaves, until `close`."""
    if name == "iceoryx2":
        pytest.importorskip("iceoryx2")
    before = {*handoff_variants.SHM.iterdir()}
    channel = CHANNELS[name](64, multiprocessing.get_context("spawn"))
    request.addfinalizer(channel.close)
    consumer, producer = channel.consumer(), channel.producer()
    for value in (7, 9):
        payload = producer.buffer()
        assert payload.shape == (64,) and payload.dtype == np.uint8
        payload[:] = value
        producer.hand_over()
        del payload
        found = consumer.receive()
        assert found.tolist() == [value] * 64
        del found
        consumer.release()
    folder = getattr(channel, "_folder", None)
    del producer, consumer
    channel.close()
    if name == "iceoryx2":
        assert not Path(str(folder)).exists() and not {*handoff_variants.SHM.glob("iox-*")} - before


def test_a_slots_messages_are_numbered_and_others_are_passed_over() -> None:
    sent: list[Any] = []
    answers = iter([None, "something else", RunJob(5, 0, 5, 0, 0, 0, 0, 0), None])
    pipe = SimpleNamespace(send=sent.append, receive=lambda: next(answers), ended=False)
    payload = np.zeros(8, np.uint8)
    end = _SlotEnd(payload, pipe)  # type: ignore[arg-type]
    for _ in range(3):
        end.hand_over()
    assert [(message.id, message.frame) for message in sent] == [(0, 0), (1, 1), (2, 2)]
    assert end.receive() is payload is end.buffer()
    pipe.ended = True
    with pytest.raises(EOFError):
        end.receive()


def test_without_iceoryx_the_parent_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "iceoryx2", None)
    with pytest.raises(ModuleNotFoundError):
        IceoryxChannel(64, None)  # type: ignore[arg-type]
