"""A pipeline as data and in memory: what its description says, and what a stage finds in its slots and arrays."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from support.small_pipeline import EDGES, OWN, STAGES, UNITS, ToldTime, packets, pipeline, spec_of
from trilane import machine
from trilane.errors import BadInputError, TrilaneError
from trilane.pipeline import memory, unit_loop
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, UnitSettings
from trilane.pipeline.memory import edge_regions
from trilane.pipeline.stage import UnitContext
from trilane.pipeline.unit_loop import BoundStage, UnitSpec
from trilane.transport.packets import Packet, header_dtype

MS = 1_000_000


class FakeStage:
    def __init__(self, error: Exception | None = None) -> None:
        self.error, self.runs, self.bound, self.closed = error, [], None, False

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        self.bound = (inputs, outputs)

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        self.runs.append((frame, slot_in, slot_out))
        if self.error is not None:
            raise self.error
        return {"shade": 3}

    def close(self) -> None:
        self.closed = True
        if self.error is not None:
            raise self.error


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
    assert (stage.sampled_ns(0, slot), stage.sampled_ns(-1, -1)) == (0, 0)
    assert inner.bound == ([], outputs)
    stage.close()
    assert inner.closed


@pytest.mark.parametrize(("taken", "given"), [(2, 1), (0, 0)])
@pytest.mark.parametrize(("target", "own"), [(OWN, 9), (header_dtype([("other", "<u4")]), 0)])
def test_a_header_is_passed_on_whole_or_with_its_frame_alone(
    target: np.dtype[Any], own: int, taken: int, given: int
) -> None:
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


def test_all_fields_of_a_frame_are_copied_to_another_header() -> None:
    source, target = packets(OWN, 1)[0].header, packets(header_dtype(), 1)[0].header
    source["frame"], source["t_sampled_ns"], source["epoch"] = 1, 2, 3
    unit_loop._copy_fields(source, target)
    assert target.tolist() == (1, 2, 3)


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


def test_a_description_answers_what_follows_from_it() -> None:
    described = pipeline()
    assert described.edge_names == ["in->mid", "mid->out"]
    assert described.joints["mid->out"] == (STAGES[1], STAGES[2])
    assert (described.rule, described.with_rule("double").rule) == ("single,fifo:3", "double")
    assert described.with_rule("double").edges[1] == EDGES[1].model_copy(update={"rule": "double"})
    assert (described.scheduler_cores, described.run_cores) == ((1, 0), (0, 1, 3))
    assert pipeline(stages=STAGES[:2], edges=EDGES[:1]).scheduler_cores == (1, 0)
    assert described.stages_of("left") == (STAGES[0], STAGES[2])
    graph = described.graph()
    assert [(stage.name, stage.unit) for stage in graph.stages] == [("in", "left"), ("mid", "right"), ("out", "left")]
    assert (graph.edges, graph.latency_to) == (("single", "fifo:3"), "out")
    assert pipeline(latency_to="mid").graph().latency_to == "mid"
    assert (PipelineEdge(payload_bytes=0).rule, PipelineEdge(payload_bytes=0).header) == ("double", header_dtype())
    assert (STAGES[0].settings, STAGES[0].pace_ns, UNITS["left"].spin) == ({}, 0, False)
    assert (described.module_folders, described.preload, described.latency_to) == ((), (), "")


def test_a_description_goes_through_json() -> None:
    assert Pipeline.model_validate_json(pipeline().model_dump_json()) == pipeline()


NAMES = "['in', 'mid', 'out']"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"units": {"left": UNITS["left"]}}, ": found no settings of unit right, expected them in `units`"),
        ({"units": {}}, ": found no settings of unit left, right, expected them in `units`"),
        ({"edges": EDGES[:1]}, f": found 1 edges and latency to 'out' for stages {NAMES}, expected one edge fewer "),
        ({"edges": (EDGES[0], EDGES[1].model_copy(update={"rule": "no"}))}, ": found edge 'no', expected single, "),
        ({"stages": (), "edges": ()}, ".stages: found (), expected Tuple should have at least 1 item "),
        ({"latency_to": "none"}, f": found 2 edges and latency to 'none' for stages {NAMES}, expected one edge fewer "),
    ],
)
def test_a_description_that_does_not_fit_together_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(BadInputError) as caught:
        pipeline(**changes)
    assert str(caught.value).startswith("Pipeline" + said)


@pytest.mark.parametrize(
    ("model", "values", "wrong", "found"),
    [
        (UnitSettings, {"cores": (), "threads": 1}, "cores", "()"),
        (UnitSettings, {"cores": (0,), "threads": 0}, "threads", "0"),
        (UnitSettings, {"cores": (0,), "threads": 1, "extra": 1}, "extra", "an unknown field"),
        (UnitSettings, {"threads": 1}, "cores", "nothing"),
        (PipelineEdge, {"payload_bytes": -1}, "payload_bytes", "-1"),
        *(
            (PipelineEdge, {"payload_bytes": 1, "header": header}, "header", f"header {header!r}")
            for header in (
                np.dtype([("t_sampled_ns", "<i8"), ("frame", "<u8")]),
                np.dtype([("frame", "<u8"), ("t_sampled_ns", "<i8")]),
                np.dtype([("frame", "<i8"), ("t_sampled_ns", "<i8"), ("epoch", "<u4")]),
                header_dtype([("own", "O")]),
                "5",
                None,
            )
        ),
        (PipelineEdge, {"payload_bytes": 1, "header": "[('frame'"}, "header", """header "[('frame'\""""),
        (PipelineStage, {"name": "a b", "unit": "u", "factory": "m:f"}, "name", "'a b'"),
        (PipelineStage, {"name": "a", "unit": "u v", "factory": "m:f"}, "unit", "'u v'"),
        (PipelineStage, {"name": "a", "unit": "u", "factory": "m.f"}, "factory", "'m.f'"),
        (PipelineStage, {"name": "a", "unit": "u", "factory": "m:f", "pace_ns": -1}, "pace_ns", "-1"),
    ],
)
def test_values_that_a_description_cannot_have_are_refused(
    model: Any, values: dict[str, Any], wrong: str, found: str
) -> None:
    """The field is named, and what stands in it."""
    with pytest.raises(BadInputError) as caught:
        model(**values)
    assert (caught.value.where, caught.value.found) == (f"{model.__name__}.{wrong}", found)


def test_the_rules_of_a_run_are_refused_in_words() -> None:
    with pytest.raises(BadInputError, match=r"^the run's settings: found edge 'no', expected single"):
        pipeline().with_rule("no")
    assert PipelineEdge(payload_bytes=0).rule == "double"
    assert PipelineStage(name="a-1", unit="u", factory="m.n:f", pace_ns=0).name == "a-1"


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


def test_assets_lie_on_pages_of_their_own_behind_the_index() -> None:
    fd = memory.share_assets({"a": np.arange(5000, dtype=np.uint8), "b": np.array([7], np.uint16)})
    try:
        assert os.fstat(fd).st_size == 4 * 4096
        length = int.from_bytes(os.pread(fd, 8, 0), "little")
        index = json.loads(os.pread(fd, length, 8))
        assert index["a"] == {"dtype": "|u1", "shape": [5000], "offset": 0}
        assert index["b"] == {"dtype": "<u2", "shape": [1], "offset": 8192}
        assert os.pread(fd, 2, 3 * 4096) == b"\7\0"
        assert not os.get_inheritable(fd)
    finally:
        os.close(fd)


def test_assets_that_fit_to_the_byte_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    for free, is_refused in ((4096, False), (4095, True)):
        monkeypatch.setattr(machine.here, "free_bytes", lambda free=free: free)
        if is_refused:
            with pytest.raises(TrilaneError, match=r"^assets: found 0 MiB, expected at most 0 MiB, which are free$"):
                memory.share_assets({})
        else:
            os.close(memory.share_assets({}))


def test_assets_that_find_no_room_leave_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(28, "No space left on device")

    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(TrilaneError, match=r"^assets: no room for 3 MiB: no space left on device$"):
        memory.share_assets({"a": np.zeros(3 << 20, np.uint8)})
    assert len(os.listdir("/proc/self/fd")) == before  # noqa: PTH208
