"""The parts of a run on processes, each beside doubles of its neighbours: what they send, note, say and put back."""

from __future__ import annotations

import contextlib
import json
import math
import os
import resource
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.errors import BadInputError, MissingPartError, TrilaneError, UnitLostError
from trilane.pipeline import (
    bound_stage,
    fork_server,
    isolated,
    lifecycle,
    preconditions,
    run,
    run_log,
    shared_assets,
    unit_loop,
)
from trilane.pipeline.bound_stage import BoundStage
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, UnitSettings
from trilane.pipeline.isolated import IsolatedTimes
from trilane.pipeline.lifecycle import close_units, listen_before_run, start_units
from trilane.pipeline.regions import EdgeRegion, edge_regions
from trilane.pipeline.requests import FrameRequestQueue
from trilane.pipeline.result import Failure
from trilane.pipeline.run_log import RunLog, UnitError, after_stderr
from trilane.pipeline.signals import Interrupts
from trilane.pipeline.stage import UnitContext
from trilane.pipeline.unit_processes import UnitMessage
from trilane.pipeline.unit_spec import UnitSpec
from trilane.scheduler.events import FrameRequest, Settings, Stop
from trilane.transport.job_pipe import JobPipe, JobPipeEnd, job_pipe_pair
from trilane.transport.messages import (
    Close,
    Closed,
    Done,
    Duration,
    Failed,
    MessageError,
    Ping,
    Pong,
    Ready,
    RunIsolated,
    RunJob,
)
from trilane.transport.packets import Packet, SlotLayout, header_dtype, view_packet

OWN = header_dtype([("own", "<u2")])
MS = 1_000_000


def packets(header: np.dtype[Any], count: int) -> list[Packet]:
    layout = SlotLayout(header, 8)
    return [view_packet(memoryview(bytearray(layout.slot_bytes)), layout) for _ in range(count)]


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


# bound_stage.py


def test_a_first_stage_gets_a_header_with_frame_time_and_epoch() -> None:
    inner, outputs = FakeStage(), packets(OWN, 2)
    stage = BoundStage("pose", inner, [], outputs, 0)
    before = time.monotonic_ns()
    assert stage.run(7, -1, 1, 3) == {"shade": 3}
    header = outputs[1].header
    assert (int(header["frame"]), int(header["epoch"]), inner.runs) == (7, 3, [(7, None, 1)])
    assert before <= int(header["t_sampled_ns"]) <= time.monotonic_ns()
    assert stage.sampled_ns(-1, 1) == int(header["t_sampled_ns"])
    assert (int(outputs[0].header["frame"]), stage.sampled_ns(0, 1), stage.sampled_ns(-1, -1)) == (0, 0, 0)
    assert stage.sampled_ns(-1, 0) == 0
    assert inner.bound == ([], outputs)
    stage.close()
    assert inner.closed


@pytest.mark.parametrize(("target", "own"), [(OWN, 9), (header_dtype([("other", "<u4")]), 0)])
def test_a_header_is_passed_on_whole_or_with_its_frame_alone(target: np.dtype[Any], own: int) -> None:
    inputs, outputs = packets(OWN, 3), packets(target, 2)
    inputs[2].header["frame"], inputs[2].header["t_sampled_ns"] = 5, 1234
    inputs[2].header["epoch"], inputs[2].header["own"] = 1, 9
    inner = FakeStage()
    BoundStage("raster", inner, inputs, outputs, 0).run(5, 2, 1, 4)
    header = outputs[1].header
    assert [int(header[name]) for name in ("frame", "t_sampled_ns", "epoch")] == [5, 1234, 4]
    assert int(header[target.names[3]]) == own
    assert (int(inputs[2].header["epoch"]), inner.runs) == (1, [(5, 2, 1)])
    assert not outputs[0].header.reshape(1).view("u1").any()


def test_all_fields_of_a_frame_are_copied_to_another_header() -> None:
    source, target = packets(OWN, 1)[0].header, packets(header_dtype(), 1)[0].header
    source["frame"], source["t_sampled_ns"], source["epoch"] = 1, 2, 3
    bound_stage._copy_fields(source, target)
    assert target.tolist() == (1, 2, 3)


def test_a_last_stage_has_no_slot_to_write() -> None:
    inner = FakeStage()
    BoundStage("present", inner, packets(OWN, 1), [], 0).run(5, 0, -1, 4)
    assert inner.runs == [(5, 0, None)]


class FakeTime:
    """A clock that moves by what is slept, and 1 µs with every look."""

    def __init__(self) -> None:
        self.now_ns, self.slept = 5 * MS, []

    def monotonic_ns(self) -> int:
        self.now_ns += 1000
        return self.now_ns

    def monotonic(self) -> float:
        return self.monotonic_ns() / 1e9

    def sleep(self, seconds: float) -> None:
        self.slept.append(round(seconds * 1e9))
        self.now_ns += round(seconds * 1e9)


def test_a_hold_sleeps_until_shortly_before_its_end_and_then_watches(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = FakeTime()
    monkeypatch.setattr(bound_stage, "time", clock)
    bound_stage.hold_until(7 * MS)
    assert clock.slept == [2 * MS - 1000 - 150_000]
    assert clock.now_ns == 7 * MS
    bound_stage.hold_until(7 * MS + 151_000)  # 150 µs are left at the first look: too short to sleep
    assert (len(clock.slept), clock.now_ns) == (1, 7 * MS + 151_000)


def test_a_job_is_held_for_its_pace_and_one_without_a_pace_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = FakeTime()
    monkeypatch.setattr(bound_stage, "time", clock)
    start = clock.now_ns
    BoundStage("present", FakeStage(), packets(OWN, 1), [], 3 * MS).run(0, 0, -1, 0)
    assert clock.now_ns == start + 1000 + 3 * MS
    BoundStage("present", FakeStage(), packets(OWN, 1), [], 0).run(0, 0, -1, 0)
    assert (clock.now_ns, len(clock.slept)) == (start + 2000 + 3 * MS, 1)


# description.py, regions.py, unit_spec.py

UNITS = {"left": UnitSettings(cores=(1, 0), threads=2), "right": UnitSettings(cores=(3, 1), threads=1, spin=True)}
STAGES = tuple(
    PipelineStage(name=name, unit=unit, factory="json:loads", pace_ns=pace)
    for name, unit, pace in (("in", "left", 0), ("mid", "right", 5), ("out", "left", 0))
)
EDGES = (PipelineEdge(payload_bytes=100, header=OWN, rule="single"), PipelineEdge(payload_bytes=5000, rule="fifo:3"))


def pipeline(**changes: Any) -> Pipeline:
    return Pipeline(**{"stages": STAGES, "edges": EDGES, "units": UNITS, **changes})


def test_a_description_answers_what_follows_from_it() -> None:
    described = pipeline()
    assert described.edge_names == ["in->mid", "mid->out"]
    assert described.joints["mid->out"] == (STAGES[1], STAGES[2])
    assert (described.rule, described.with_rule("double").rule) == ("single,fifo:3", "double")
    assert described.with_rule("double").edges[1] == EDGES[1].model_copy(update={"rule": "double"})
    assert (described.scheduler_cores, described.run_cores) == ((1, 0), (0, 1, 3))
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


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"units": {"left": UNITS["left"]}}, "no settings of unit right, expected them in `units`"),
        ({"units": {}}, "no settings of unit left, right"),
        ({"edges": EDGES[:1]}, "1 edges"),
        ({"edges": (EDGES[0], EDGES[1].model_copy(update={"rule": "no"}))}, "edge 'no'"),
        ({"stages": (), "edges": ()}, "at least 1 item"),
        ({"latency_to": "none"}, "latency to 'none'"),
    ],
)
def test_a_description_that_does_not_fit_together_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        pipeline(**changes)


@pytest.mark.parametrize(
    ("model", "values"),
    [
        (UnitSettings, {"cores": (), "threads": 1}),
        (UnitSettings, {"cores": (0,), "threads": 0}),
        (UnitSettings, {"cores": (0,), "threads": 1, "extra": 1}),
        (PipelineEdge, {"payload_bytes": -1}),
        (PipelineEdge, {"payload_bytes": 1, "header": np.dtype([("t_sampled_ns", "<i8"), ("frame", "<u8")])}),
        (PipelineEdge, {"payload_bytes": 1, "header": np.dtype([("frame", "<u8"), ("t_sampled_ns", "<i8")])}),
        (
            PipelineEdge,
            {"payload_bytes": 1, "header": np.dtype([("frame", "<i8"), ("t_sampled_ns", "<i8"), ("epoch", "<u4")])},
        ),
        (PipelineEdge, {"payload_bytes": 1, "header": header_dtype([("own", "O")])}),
        (PipelineEdge, {"payload_bytes": 1, "header": "[('frame'"}),
        (PipelineEdge, {"payload_bytes": 1, "header": "5"}),
        (PipelineEdge, {"payload_bytes": 1, "header": None}),
        (PipelineStage, {"name": "a b", "unit": "u", "factory": "m:f"}),
        (PipelineStage, {"name": "a", "unit": "u v", "factory": "m:f"}),
        (PipelineStage, {"name": "a", "unit": "u", "factory": "m.f"}),
        (PipelineStage, {"name": "a", "unit": "u", "factory": "m:f", "pace_ns": -1}),
    ],
)
def test_values_that_a_description_cannot_have_are_refused(model: Any, values: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="validation error"):
        model(**values)


def test_the_rules_of_a_run_are_refused_in_words() -> None:
    with pytest.raises(BadInputError, match="^the run's settings: found edge 'no', expected single"):
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
        with pytest.raises(OSError, match="Bad file"):
            os.fstat(region.fd)


def spec_of(**changes: Any) -> UnitSpec:
    values: dict[str, Any] = {
        "unit": "right",
        "endpoint": "ipc://none",
        "job_pipe": JobPipeEnd(10, 11),
        "assets_fd": 12,
        "settings": UNITS["right"],
        "scheduler_cores": (1, 0),
        "run_cores": (0, 1, 3),
        "stages": (STAGES[1],),
        "module_folders": (),
        "edges": {
            "in->mid": EdgeRegion(fd=13, slots=1, header=OWN, payload_bytes=100),
            "mid->out": EdgeRegion(fd=14, slots=3, header=header_dtype(), payload_bytes=5000),
        },
        "inputs": {"mid": "in->mid"},
        "outputs": {"mid": "mid->out"},
    }
    return UnitSpec(**{**values, **changes})


def test_a_spec_numbers_its_descriptors_anew_and_changes_nothing_else() -> None:
    spec = spec_of()
    assert spec.fds == [10, 11, 12, 13, 14]
    again = spec.renumbered({fd: fd + 100 for fd in spec.fds})
    assert again.fds == [110, 111, 112, 113, 114]
    assert again.renumbered({fd + 100: fd for fd in spec.fds}) == spec
    assert UnitSpec.model_validate_json(spec.model_dump_json()) == spec


# preconditions.py, run_log.py, requests.py, signals.py, stage.py


@pytest.mark.parametrize(("limit", "is_enough"), [(95, False), (96, True), (resource.RLIM_INFINITY, True)])
def test_ninety_six_open_files_are_enough(monkeypatch: pytest.MonkeyPatch, limit: int, is_enough: bool) -> None:
    asked = []
    monkeypatch.setattr(resource, "getrlimit", lambda what: asked.append(what) or (limit, 10**6))
    with (
        contextlib.nullcontext()
        if is_enough
        else pytest.raises(TrilaneError, match="limit of 95, expected at least 96")
    ):
        preconditions.check_open_files()
    assert asked == [resource.RLIMIT_NOFILE]


def test_cores_that_are_not_there_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    said = "^cores of unit right: found 3, expected some of this process's: 0, 1$"
    with pytest.raises(BadInputError, match=said):
        preconditions.check_cores(pipeline())
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 3})
    preconditions.check_cores(pipeline())


def test_only_finite_values_above_0_are_positive() -> None:
    preconditions.check_positive(a=None, b=1e-9, c=5)
    for value in (0, -1, math.inf, math.nan):
        with pytest.raises(BadInputError, match=f"fps: found {value}, expected more than 0"):
            preconditions.check_positive(frames=1, fps=value)


def test_a_run_is_refused_where_a_unit_imports_its_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    preconditions.refuse_in_a_unit()
    monkeypatch.setitem(sys.modules, "__main__", SimpleNamespace(__spec__=None))
    preconditions.refuse_in_a_unit()
    monkeypatch.setitem(
        sys.modules, "__main__", SimpleNamespace(__spec__=SimpleNamespace(name="trilane.pipeline.fork_server"))
    )
    with pytest.raises(BadInputError, match="^run_pipeline: found run_pipeline was called while a unit imported"):
        preconditions.refuse_in_a_unit()


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
    assert run_log.Failure("x").exit_code == 1


def test_requests_come_in_order_wake_the_run_and_end_with_it() -> None:
    told: list[Any] = []
    queue = FrameRequestQueue(told.append, lambda: told.append("ended"))
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
    with pytest.raises(OSError, match="Bad file"):
        os.fstat(queue.fd)


def test_interrupts_are_counted_wake_the_poller_and_are_given_back() -> None:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGPIPE)
    mine = signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    before = [signal.getsignal(number) for number in numbers]
    try:
        with Interrupts() as interrupts:
            assert signal.getsignal(signal.SIGPIPE) == signal.SIG_IGN
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGTERM)
            assert interrupts.count == 2
            assert os.read(interrupts.fd, 9) == bytes([signal.SIGINT, signal.SIGTERM])
            with pytest.raises(BlockingIOError):
                os.read(interrupts.fd, 9)
            wakes = signal.set_wakeup_fd(-1)
            assert wakes == interrupts._write_fd
        assert [signal.getsignal(number) for number in numbers] == before
        assert signal.set_wakeup_fd(-1) == -1
        for fd in (interrupts.fd, wakes):
            with pytest.raises(OSError, match="Bad file"):
                os.fstat(fd)
    finally:
        signal.signal(signal.SIGPIPE, mine)


def test_interrupts_do_nothing_outside_the_main_thread() -> None:
    before, seen = signal.getsignal(signal.SIGINT), []

    def enter() -> None:
        with Interrupts():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert seen == [before]


def test_what_two_stages_share_is_made_once() -> None:
    made: list[int] = []
    unit = UnitContext("gpu", UNITS["left"], {})
    first = unit.shared("context", lambda: made.append(1) or object())
    assert unit.shared("context", lambda: made.append(2) or object()) is first
    assert unit.shared("other", lambda: 7) == 7
    assert made == [1]
    assert UnitContext("gpu", UNITS["left"], {}).shared("context", lambda: 8) == 8


# lifecycle.py, isolated.py


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
    monkeypatch.setattr(lifecycle, "time", FakeTime())
    processes: Any = FakeProcesses([[("left", Ready(4))], [], [("right", Ready(5))]])
    took = start_units(processes, ["left", "right"], NOBODY)
    assert {unit: round(ms, 6) for unit, ms in took.items()} == {"left": 0.004, "right": 0.006}
    assert processes.told == [("start", "left"), ("start", "right"), ("connected", "left"), ("connected", "right")]


def test_units_that_are_not_ready_in_time_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = FakeTime()
    processes: Any = FakeProcesses()
    processes.listen = lambda _: clock.sleep(60.1) or []
    monkeypatch.setattr(lifecycle, "time", clock)
    with pytest.raises(UnitError, match="^unit a, b was not ready after 120 s$"):
        start_units(processes, ["b", "a"], NOBODY)
    assert len(clock.slept) == 2


def test_what_goes_wrong_before_the_run_is_raised() -> None:
    with pytest.raises(UnitError, match="^no network$") as failed:
        listen_before_run(FakeProcesses([[("left", Failed(-1, 3, "no network"))]]), NOBODY)  # type: ignore[arg-type]
    assert failed.value.exit_code == 3
    with pytest.raises(UnitError, match="^unit left ended before the run began; it was left$"):
        listen_before_run(FakeProcesses([[("left", None)]]), NOBODY)  # type: ignore[arg-type]
    with pytest.raises(KeyboardInterrupt):
        listen_before_run(FakeProcesses([[]]), SimpleNamespace(count=1))  # type: ignore[arg-type]
    messages = listen_before_run(FakeProcesses([[("left", Pong())]]), NOBODY)  # type: ignore[arg-type]
    assert messages == [("left", Pong())]


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
    _, log = closed([[("left", Failed(-3, 4, "disk full")), ("left", Closed()), ("right", Closed())]])
    assert (log.failure, log.messages) == (Failure("disk full", 4), ["disk full"])
    _, log = closed([[("left", Closed()), ("right", None)]])
    assert log.failure == Failure("unit right ended before its files were closed; it was right", 1)


def test_units_that_do_not_close_are_named_unless_somebody_has_lost_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = FakeTime()
    monkeypatch.setattr(lifecycle, "time", clock)
    script = [[], []]
    monkeypatch.setattr(FakeProcesses, "listen", lambda self, _: clock.sleep(15.1) or self.script.popleft())
    _, log = closed(script)
    assert log.failure == Failure("unit left, right did not close its files", 1)
    processes, log = closed([], SimpleNamespace(count=2))
    assert (log.failure, processes.told[-1]) == (None, ("wait", ["left", "right"]))


def answers(*durations: Sequence[int]) -> list[Any]:
    return [[("right" if unit else "left", Duration(ns)) for unit, ns in enumerate(row) if ns] for row in durations]


def test_each_stage_is_measured_on_its_own_unit_without_the_first_repetition() -> None:
    """in (left) and mid (right); out is the last and not measured. Per frame: the chain once, then each unit thrice.

    Of frame 4 the repetitions take 90, 10, 14: 90 does not count, the median is 12. Of frame 8: 20.
    """
    frame_4 = answers([50, 0], [0, 60], [90, 0], [10, 0], [14, 0], [0, 99], [0, 30], [0, 32])
    frame_8 = answers([50, 0], [0, 60], [90, 0], [20, 0], [20, 0], [0, 99], [0, 41], [0, 41])
    processes: Any = FakeProcesses([*frame_4, *frame_8])
    times = IsolatedTimes(pipeline().graph(), processes, NOBODY)
    assert times.mean_ns == {}
    times.measure([4, 8])
    assert times.mean_ns == {"in": 16, "mid": 36}
    left, right = ("left", RunIsolated(0, 4, -1, 0)), ("right", RunIsolated(0, 4, 0, 0))
    assert processes.told[:8] == [left, right, left, left, left, right, right, right]
    assert len(processes.told) == 16


def test_a_unit_is_handed_no_more_at_once_than_its_pipe_holds() -> None:
    assert (isolated.AT_ONCE, isolated.REPEATS, isolated.LIMIT_S) == (12, 2, 10)
    processes: Any = FakeProcesses([[("left", Duration(1))] * 12, [("right", Duration(5)), ("left", Duration(2))]])
    times = IsolatedTimes(pipeline().graph(), processes, NOBODY)
    assert times._durations_ns("left", [0] * 13, 3) == [1] * 12 + [2]


def test_measuring_begins_no_frame_after_its_time_and_waits_no_longer_than_for_a_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = FakeTime()
    monkeypatch.setattr(isolated, "time", clock)
    rows = answers([50, 0], [0, 60], [90, 0], [10, 0], [14, 0], [0, 99], [0, 30], [0, 32])
    processes: Any = FakeProcesses([*rows, *rows])
    take = processes.listen
    processes.listen = lambda ms: clock.sleep(1.5) or take(ms)
    times = IsolatedTimes(pipeline().graph(), processes, NOBODY)
    times.measure([4, 8, 9])
    assert len(processes.script) == 8  # 12 s have passed after the first frame
    processes.listen = lambda _: clock.sleep(121) or []
    with pytest.raises(UnitError, match="^unit left did not end its jobs within 120 s$"):
        times.measure([4])


# unit_loop.py


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


def served(monkeypatch: pytest.MonkeyPatch, link: FakeLink, stages: list[Any]) -> int:
    core = min(os.sched_getaffinity(0))
    before = os.sched_getaffinity(0)
    spec = spec_of(settings=UnitSettings(cores=(core,), threads=1), run_cores=(core,))
    monkeypatch.setattr(unit_loop, "build_stages", lambda _: stages)
    monkeypatch.setattr(unit_loop, "gc", SimpleNamespace(collect=lambda: 0, freeze=lambda: None))
    try:
        return unit_loop._serve(spec, link)  # type: ignore[arg-type]
    finally:
        os.sched_setaffinity(0, before)


def test_a_unit_answers_every_message_once(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = FakeStage(), FakeStage()
    outputs = packets(OWN, 2)
    stages = [BoundStage("a", first, [], outputs, 0), BoundStage("b", second, packets(OWN, 2), [], 0)]
    link = FakeLink(RunJob(11, 0, 5, -1, 1, 2), Ping(), RunJob(12, 1, 6, 1, -1, 2), RunIsolated(1, 7, 0, -1), Close())
    before = time.monotonic_ns()
    assert served(monkeypatch, link, stages) == 0
    one, two, alone, end = link.sent
    assert (one.id, two.id, one.metrics) == (11, 12, {"shade": 3.0})
    assert before <= one.t_begin_ns <= one.t_sampled_ns <= one.t_end_ns <= two.t_begin_ns <= two.t_end_ns
    assert (two.t_sampled_ns, end) == (0, Closed())
    assert isinstance(alone, Duration) and 0 <= alone.value < time.monotonic_ns() - before
    assert link.beats == [Ready(os.getpid()), Pong()]
    assert (first.runs, second.runs) == ([(5, None, 1)], [(6, 1, None), (7, 0, None)])
    assert int(outputs[1].header["epoch"]) == 2
    assert first.closed and second.closed


def test_a_unit_ends_when_its_pipe_does_and_refuses_what_is_not_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert served(monkeypatch, FakeLink(), []) == 1
    with pytest.raises(MessageError, match=r"Pong\(\) is not for a unit"):
        served(monkeypatch, FakeLink(Pong()), [])


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
    stage = BoundStage("a", FakeStage(error), [], packets(OWN, 1), 0)
    link = FakeLink(RunJob(11, 0, 5, -1, 0, 0), RunIsolated(0, 5, -1, 0), Close())
    assert served(monkeypatch, link, [stage]) == code
    assert [(answer.id, answer.exit_code) for answer in link.sent[:3]] == [(11, code), (-2, code), (-3, code)]
    assert all(answer.message.startswith(said) for answer in link.sent[:2])
    assert link.sent[3:] == [Closed()]
    assert type(error).__name__ in capfd.readouterr().err


def test_closing_names_its_stage_and_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    last = FakeStage()
    stages = [BoundStage("a", FakeStage(ValueError("x")), [], [], 0), BoundStage("b", last, [], [], 0)]
    link = FakeLink(Close())
    assert served(monkeypatch, link, stages) == 1
    assert link.sent == [Failed(-3, 1, "unit right, closing a: ValueError: x"), Closed()]
    assert last.closed


def test_a_lost_unit_does_not_answer_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    link = FakeLink(RunJob(11, 0, 5, -1, 0, 0))
    stage = BoundStage("a", FakeStage(UnitLostError("context lost")), [], packets(OWN, 1), 0)
    with pytest.raises(UnitLostError):
        served(monkeypatch, link, [stage])
    assert link.sent == []


def test_a_unit_that_cannot_be_built_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: UnitSpec) -> list[BoundStage]:
        raise KeyError("weights")

    link = FakeLink()
    core = min(os.sched_getaffinity(0))
    before = os.sched_getaffinity(0)
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
    here = os.sched_getaffinity(0)
    if len(here) < 2:
        pytest.skip("one core")
    core, other = sorted(here)[:2]
    spec = spec_of(settings=UnitSettings(cores=(core,), threads=1), run_cores=(core, other))
    end, ids = threading.Event(), []

    def work() -> None:
        ids.append(threading.get_native_id())
        end.wait(10)

    early, late = threading.Thread(target=work), threading.Thread(target=work)
    early.start()
    try:
        with unit_loop.building_cores(spec):
            assert os.sched_getaffinity(0) == {core, other}
            late.start()
            while len(ids) < 2:
                time.sleep(0.001)
            assert os.sched_getaffinity(ids[1]) == {core, other}
        assert (os.sched_getaffinity(0), os.sched_getaffinity(ids[1])) == ({core}, {core})
        assert os.sched_getaffinity(ids[0]) == here
    finally:
        end.set()
        os.sched_setaffinity(0, here)
        early.join()
        late.join()


class NamedStage(FakeStage):
    def __init__(self, settings: Mapping[str, Any], unit: UnitContext) -> None:
        super().__init__()
        self.settings, self.unit = settings, unit


def test_stages_are_built_in_order_on_the_slots_of_their_edges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(unit_loop, "factory_named", lambda name: NamedStage if name == "json:loads" else None)
    assets_fd = shared_assets.share_assets({"one": np.arange(3)})
    stages = (STAGES[0].model_copy(update={"settings": {"a": 1}, "unit": "left"}), STAGES[2])
    with edge_regions(pipeline()) as regions:
        spec = spec_of(
            unit="left", stages=stages, edges=regions, assets_fd=assets_fd, module_folders=(tmp_path,),
            inputs={"out": "mid->out"}, outputs={"in": "in->mid"},
        )  # fmt: skip
        first, last = unit_loop.build_stages(spec)
    os.close(assets_fd)
    assert sys.path[0] == str(tmp_path)
    assert (first.name, last.name) == ("in", "out")
    inner: Any = [first._stage, last._stage]
    assert inner[0].settings == {"a": 1} and inner[0].unit is inner[1].unit
    assert (inner[0].unit.name, inner[0].unit.settings) == ("left", UNITS["right"])
    assert inner[0].unit.assets["one"].tolist() == [0, 1, 2]
    assert [[len(side) for side in stage.bound] for stage in inner] == [[0, 1], [3, 0]]
    assert inner[0].bound[1][0].header.dtype == OWN


def test_a_factory_is_found_by_module_and_name() -> None:
    assert unit_loop.factory_named("json:loads") is json.loads
    with pytest.raises(AttributeError):
        unit_loop.factory_named("json:none")


# fork_server.py


class PrctlLibc:
    def __init__(self, answer: int) -> None:
        self.answer, self.calls = answer, []

    def prctl(self, *call: Any) -> int:
        self.calls.append(call)
        return self.answer


def test_a_process_dies_with_its_parent_or_at_once_when_that_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    libc, exits = PrctlLibc(0), []
    monkeypatch.setattr("ctypes.CDLL", lambda *_, **__: libc)
    monkeypatch.setattr(os, "_exit", exits.append)
    fork_server.die_with_parent(os.getppid())
    assert (libc.calls, exits) == ([(1, signal.SIGKILL, 0, 0, 0)], [])
    fork_server.die_with_parent(os.getppid() + 1)
    assert exits == [1]
    libc.answer = -1
    with pytest.raises(OSError, match="PR_SET_PDEATHSIG"):
        fork_server.die_with_parent(os.getppid())


UNIT_LIFE = """
import ctypes, json, os, signal, sys
from types import SimpleNamespace
from trilane.pipeline import fork_server

def serve(spec, number_of):
    death = ctypes.c_int()
    ctypes.CDLL(None).prctl(2, ctypes.byref(death), 0, 0, 0)
    print(json.dumps({
        "death": death.value, "name": open("/proc/self/comm").read().strip(), "own_group": os.getpgid(0) == os.getpid(),
        "cores": sorted(os.sched_getaffinity(0)), "threads": [os.environ[name] for name in fork_server.THREAD_LIMITS],
        "spec": spec, "fds": sorted(number_of), "sigchld": signal.getsignal(signal.SIGCHLD) == signal.SIG_DFL,
        "blocked": sorted(signal.pthread_sigmask(signal.SIG_BLOCK, [])), "shut": not os.path.exists(f"/proc/self/fd/{spec_fd}"),
    }), flush=True)
    print("last words", file=sys.stderr)
    if spec == "broken":
        raise ValueError("broken spec")
    return 7

fork_server.importlib = SimpleNamespace(import_module=lambda name: SimpleNamespace(serve=serve) if name == "trilane.pipeline.unit_loop" else None)
for spec in ("whole", "broken"):
    spec_fd = os.memfd_create("spec")
    os.write(spec_fd, json.dumps(spec).encode())
    said, theirs = os.pipe()
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGCHLD})
    request = {"unit": "left-handed-unit", "cores": [min(os.sched_getaffinity(0))], "threads": 3, "fds": [41]}
    server = os.getpid()
    if (pid := os.fork()) == 0:
        os._exit(fork_server._run_unit(request, [spec_fd, theirs, os.dup(1)], server))
    os.close(theirs)
    print(json.dumps([os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), os.read(said, 9999).decode().splitlines()]), flush=True)
"""


def test_a_unit_is_forked_into_a_life_of_its_own() -> None:
    """It dies with the server, has its name, group, cores and thread limits, and its error goes to its own stderr."""
    import subprocess

    done = subprocess.run([sys.executable, "-c", UNIT_LIFE], capture_output=True, text=True, timeout=60, check=True)
    life, (code, said), other, (broken_code, broken_said) = map(json.loads, done.stdout.splitlines())
    assert life == {
        "death": signal.SIGKILL,
        "name": "trilane-left-ha",
        "own_group": True,
        "cores": [min(os.sched_getaffinity(0))],
        "threads": ["3"] * 4,
        "spec": "whole",
        "fds": [41],
        "sigchld": True,
        "blocked": [],
        "shut": True,
    }
    assert (code, said, done.stderr) == (7, ["last words"], "")
    assert (other["spec"], broken_code) == ("broken", 1)
    assert (broken_said[0], broken_said[-1]) == ("last words", "ValueError: broken spec")


def test_a_process_is_called_by_its_unit() -> None:
    assert fork_server.process_name("dsp") == "trilane-dsp"
    assert fork_server.process_name("a-long-name-of-a-unit") == "trilane-a-long-"


# run.py


@pytest.mark.parametrize(("frames", "count"), [(1, 4), (60, 4), (75, 5), (239, 15), (240, 16), (9000, 16)])
def test_one_frame_in_fifteen_is_measured_alone(frames: int, count: int) -> None:
    assert run._isolated_share(frames) == count


def test_frames_to_measure_are_spread_over_the_run() -> None:
    assert run._spread(100, 4) == [0, 25, 50, 75]
    assert run._spread(3, 8) == [0, 1, 2]
    assert run._spread(10, 3) == [0, 3, 6]


def test_settings_follow_from_policy_and_rate() -> None:
    assert run._settings("pipelined", 9, 30.0, None, 5, 0.0, None) == Settings(9, "pipelined", hang_ns=5)
    paced = run._settings("pipelined", 9, 30.0, 50.0, 5, 1.5, None)
    expected = Settings(9, "pipelined", period_ns=20 * MS, deadline_ns=60 * MS, hang_ns=5, latch_ns=1_500_000)
    assert paced == expected
    latest = run._settings("latest", 9, 30.0, None, 5, 0.0, None)
    assert (latest.period_ns, latest.deadline_ns, latest.asked) == (33_333_333, 99_999_999, False)
    requests: Any = object()
    assert run._settings("pipelined", 9, 30.0, None, 5, 0.0, requests).asked
    with pytest.raises(BadInputError, match="^the run's settings: found policy 'no'"):
        run._settings("no", 9, 30.0, None, 5, 0.0, None)
    assert (run.HANG_NS, run.DEADLINE_PERIODS) == (10 * 10**9, 3)


def test_the_scheduler_is_on_its_cores_and_back_afterwards() -> None:
    before = os.sched_getaffinity(0)
    with contextlib.suppress(ValueError), run._on_cores((min(before),)):
        assert os.sched_getaffinity(0) == {min(before)}
        raise ValueError
    assert os.sched_getaffinity(0) == before


@pytest.mark.parametrize("collects", [True, False])
def test_answers_are_prompt_inside_the_run_alone(monkeypatch: pytest.MonkeyPatch, collects: bool) -> None:
    calls: list[Any] = []
    monkeypatch.setattr(run, "use_slice", calls.append)
    monkeypatch.setattr(
        run,
        "gc",
        SimpleNamespace(
            isenabled=lambda: collects, disable=lambda: calls.append("off"), enable=lambda: calls.append("on")
        ),
    )
    before = sys.getswitchinterval()
    with run._prompt_answers():
        assert sys.getswitchinterval() == pytest.approx(0.0002)
        assert calls == ["off", 100_000]
    assert sys.getswitchinterval() == before
    assert calls[2:] == ([0, "on"] if collects else [0])


# shared_assets.py


def test_assets_lie_on_pages_of_their_own_behind_the_index() -> None:
    fd = shared_assets.share_assets({"a": np.arange(5000, dtype=np.uint8), "b": np.array([7], np.uint16)})
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
        monkeypatch.setattr("psutil.virtual_memory", lambda free=free: SimpleNamespace(available=free))
        if is_refused:
            with pytest.raises(TrilaneError, match="^assets: found 0 MiB, expected at most 0 MiB, which are free$"):
                shared_assets.share_assets({})
        else:
            os.close(shared_assets.share_assets({}))


def test_job_pipes_of_a_unit_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A whole unit in a thread's stead: it connects, is ready, answers Close and ends with 0."""
    import zmq

    from trilane.transport.heartbeats import HeartbeatSocket

    ours, theirs = job_pipe_pair()
    slices: list[int] = []
    monkeypatch.setattr(unit_loop, "use_slice", slices.append)
    monkeypatch.setattr(unit_loop, "context_on_cores", lambda cores: slices.append(cores) or zmq.Context())
    monkeypatch.setattr(unit_loop, "gc", SimpleNamespace(collect=lambda: 0, freeze=lambda: None))
    monkeypatch.setattr(unit_loop, "build_stages", lambda _: [])
    here = os.sched_getaffinity(0)
    context = zmq.Context()
    beats, pipe = HeartbeatSocket(context), JobPipe(ours)
    beats.socket.bind(f"ipc://{tmp_path}/h")
    spec = spec_of(
        endpoint=f"ipc://{tmp_path}/h", settings=UnitSettings(cores=tuple(here), threads=1), run_cores=tuple(here),
        job_pipe=theirs,
    )  # fmt: skip
    threading.Timer(0.05, pipe.send, [Close()]).start()
    raw = json.loads(spec.model_dump_json())
    assert unit_loop.serve(raw, {fd: fd for fd in spec.fds}) == 0
    assert beats.socket.poll(2000) and beats.receive() == [Ready(os.getpid())]
    assert pipe.receive() == Closed()
    assert pipe.receive() is None and pipe.ended
    assert slices == [(1, 0), 1_000_000]
    assert Done(1, 2, 3, 4, {}).metrics == {}
    beats.close()
    pipe.close()
    context.term()
