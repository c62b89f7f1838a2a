"""A pipeline as data and in memory: what its description says, and what a stage finds in its slots and arrays."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np
import pytest

from support.small_pipeline import OWN, UNITS, FakeStage, ToldTime, packets, pipeline, spec_of
from trilane.pipeline import unit_loop
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.memory import edge_regions
from trilane.pipeline.stage import UnitContext
from trilane.pipeline.unit_loop import BoundStage, UnitSpec
from trilane.transport.packets import header_dtype

MS = 1_000_000


def context() -> UnitContext:
    return UnitContext("left", UnitSettings(cores=(0,), threads=1), {})


@pytest.mark.parametrize("slot", [0, 1])
def test_a_first_stage_gets_a_header_with_frame_time_and_epoch(slot: int) -> None:
    inner, outputs = FakeStage(), packets(OWN, 2)
    stage = BoundStage("pose", inner, [], outputs, 0, context())
    before = time.monotonic_ns()
    assert stage.run(7, -1, slot, 3) == {"shade": 3}
    header = outputs[slot].header
    assert (int(header["frame"]), int(header["epoch"]), inner.runs) == (7, 3, [(7, None, slot)])
    assert before <= int(header["t_sampled_ns"]) <= time.monotonic_ns()
    assert stage.sampled_ns(-1, slot) == int(header["t_sampled_ns"])
    assert (int(outputs[1 - slot].header["frame"]), stage.sampled_ns(-1, 1 - slot)) == (0, 0)
    assert stage.sampled_ns(0, slot) == 0
    assert before <= stage.sampled_ns(-1, -1) <= int(header["t_sampled_ns"])  # a single stage has no header
    assert inner.bound == ([], outputs)
    stage.close()
    assert inner.closed


@pytest.mark.parametrize(("target", "own"), [(OWN, 9), (header_dtype([("other", "<u4")]), 0)])
def test_a_header_is_passed_on_whole_or_with_its_frame_alone(target: np.dtype[Any], own: int) -> None:
    taken, given = 2, 1
    inputs, outputs = packets(OWN, 3), packets(target, 2)
    inputs[taken].header["frame"], inputs[taken].header["t_sampled_ns"] = 5, 1234
    inputs[taken].header["epoch"], inputs[taken].header["own"] = 1, 9
    inner = FakeStage()
    BoundStage("raster", inner, inputs, outputs, 0, context()).run(5, taken, given, 4)
    header = outputs[given].header
    assert [int(header[name]) for name in ("frame", "t_sampled_ns", "epoch")] == [5, 1234, 4]
    assert int(header[target.names[3]]) == own
    assert (int(inputs[taken].header["epoch"]), inner.runs) == (1, [(5, taken, given)])
    assert not outputs[1 - given].header.reshape(1).view("u1").any()


def test_a_last_stage_has_no_slot_to_write() -> None:
    inner = FakeStage()
    BoundStage("present", inner, packets(OWN, 1), [], 0, context()).run(5, 0, -1, 4)
    assert inner.runs == [(5, 0, None)]


def test_the_first_stage_is_told_of_another_rung_before_its_frame() -> None:
    """Once for each change; a later stage is told of none."""

    class Stepped(FakeStage):
        def step_to(self, rung: int) -> None:
            self.runs.append(f"rung {rung}")

    first, later = Stepped(), Stepped()
    stages = (
        BoundStage("pose", first, [], packets(OWN, 1), 0, context()),
        BoundStage("present", later, packets(OWN, 1), [], 0, context()),
    )
    for frame, rung in enumerate((0, 2, 2, 0)):
        stages[0].run(frame, -1, 0, 1, rung=rung)
        stages[1].run(frame, 0, -1, 1, rung=rung)
    frames = [(frame, None, 0) for frame in range(4)]
    assert first.runs == [frames[0], "rung 2", *frames[1:3], "rung 0", frames[3]]
    assert later.runs == [(frame, 0, None) for frame in range(4)]


def test_a_hold_sleeps_until_shortly_before_its_end_and_then_watches(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = ToldTime()
    monkeypatch.setattr(unit_loop, "time", clock)
    unit_loop.hold_until(7 * MS)
    assert clock.slept == [2 * MS - 1000 - 150_000]
    assert clock.now_ns == 7 * MS
    unit_loop.hold_until(7 * MS + 151_000)  # 150 µs are left at the first look: too short to sleep
    assert (len(clock.slept), clock.now_ns) == (1, 7 * MS + 151_000)
    unit_loop.hold_until(clock.now_ns + 1001)  # at the first look a nanosecond is left
    assert clock.now_ns == 7 * MS + 153_000


def test_a_job_is_held_for_its_pace_and_one_without_a_pace_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = ToldTime()
    monkeypatch.setattr(unit_loop, "time", clock)
    start = clock.now_ns
    BoundStage("present", FakeStage(), packets(OWN, 1), [], 3 * MS, context()).run(0, 0, -1, 0)
    assert clock.now_ns == start + 1000 + 3 * MS
    BoundStage("present", FakeStage(), packets(OWN, 1), [], 0, context()).run(0, 0, -1, 0)
    assert (clock.now_ns, len(clock.slept)) == (start + 2000 + 3 * MS, 1)


def test_a_stage_works_asleep_on_a_device_of_its_unit_or_at_the_pace_of_a_chip() -> None:
    unit = context()
    plain, paced = (BoundStage("a", FakeStage(), [], [], pace_ns, unit) for pace_ns in (0, 1))
    assert (plain.works_asleep, paced.works_asleep) == (False, True)
    unit.use_device("card")  # by another stage of the unit, or in a later job
    assert (plain.works_asleep, paced.works_asleep) == (True, True)


def test_every_edge_has_a_region_of_its_slots_which_is_closed_at_the_end() -> None:
    with edge_regions(pipeline()) as regions:
        assert list(regions) == ["in->mid", "mid->out"]
        assert [(region.slots, region.payload_bytes) for region in regions.values()] == [(1, 100), (3, 5000)]
        assert regions["in->mid"].header == OWN
        assert regions["mid->out"].layout.total_bytes == 3 * (4096 + 8192)
        sizes = [os.fstat(region.fd).st_size for region in regions.values()]
        assert sizes == [2 * 4096, 3 * 3 * 4096]
    for region in regions.values():
        with pytest.raises(OSError, match=r"Bad file"):
            os.fstat(region.fd)


def test_a_spec_numbers_its_descriptors_anew_and_changes_nothing_else() -> None:
    spec = spec_of()
    assert spec.fds == [10, 11, 12, 13, 14]
    again = spec.renumbered({fd: fd + 100 for fd in spec.fds})
    assert again.fds == [110, 111, 112, 113, 114]
    assert again.renumbered({fd + 100: fd for fd in spec.fds}) == spec
    assert UnitSpec.model_validate_json(spec.model_dump_json()) == spec


def test_what_two_stages_share_is_made_once() -> None:
    made: list[int] = []
    unit = UnitContext("gpu", UNITS["left"], {})
    first = unit.shared("context", lambda: made.append(1) or object())
    assert unit.shared("context", lambda: made.append(2) or object()) is first
    assert unit.shared("other", lambda: 7) == 7
    assert made == [1]
    assert UnitContext("gpu", UNITS["left"], {}).shared("context", lambda: 8) == 8
