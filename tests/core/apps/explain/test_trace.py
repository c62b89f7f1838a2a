"""The trace of a run says what the run did: read back packet by packet, and compared with the run and its core."""

from __future__ import annotations

import ctypes
import io
import json
import os
import random
import tracemalloc
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from itertools import islice, pairwise
from typing import Any

import pytest

from support.trace_reading import ReadTrace, read_trace
from trilane.apps.explain.trace import (
    MOST_WAITING,
    Lanes,
    RunTracks,
    Tiles,
    write_trace,
    write_tracks,
)
from trilane.apps.explain.trace_sinks import PLAIN_BYTES, ChromeSink, PacketSink
from trilane.hw_profiles.application import application_graph
from trilane.pipeline.journal import (
    SCHEMA,
    Accounted,
    Begun,
    Counted,
    Ended,
    Record,
    Said,
    Sampled,
    Stepped,
    Worked,
    journal_of,
)
from trilane.pipeline.measurements.trace_slices import packets_in
from trilane.scheduler.events import (
    Abort,
    Dispatch,
    Finish,
    FrameRequest,
    Graph,
    Hold,
    Job,
    JobDone,
    Outcome,
    OutcomeKind,
    Settings,
    StageSpec,
    Stop,
    UnitDied,
    UnitReady,
    chain,
)
from trilane.scheduler.ledger import BLOCKED, STARVED, JobRecord
from trilane.scheduler.virtual import Simulation, simulate

MS = 1_000_000
STAGES = (("pose", "cpu"), ("raster", "gpu"), ("infer", "dsp"), ("composite", "gpu"), ("present", "cpu"))
MEAN_MS = {"pose": 1.2, "raster": 3.0, "infer": 13.0, "composite": 2.0, "present": 3.0}
FACTS = {
    "clock": "virtual",
    "config": {"scene": {"name": "default", "fps": 60, "avatars": ["a", "b"], "planes": []}, "latch": None},
}


def a_run(frames: int = 40, graph: Graph | None = None, **options: Any) -> Simulation:
    """Times vary by a tenth; `options` are of the settings and of the driver."""
    driver = {name: options.pop(name) for name in ("faults", "inputs", "skips") if name in options}

    def service(stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
        return int(MEAN_MS[stage] * MS * random.Random(f"{stage} {frame}").uniform(0.9, 1.1))

    return simulate(
        graph or application_graph("double"),
        Settings(frames, **options),
        service,
        message_delay_ns=30_000,
        restart_ns=40 * MS,
        keep=True,
        **driver,
    )


def records_of(done: Simulation) -> Iterator[Record]:
    assert done.recording is not None
    return journal_of(done.recording, done.jobs, FACTS, done.report)


def trace_of(records: Iterator[Record]) -> ReadTrace:
    file = io.BytesIO()
    write_trace(records, file)
    return read_trace(file.getvalue())


def with_bypass(edge: str = "double") -> Graph:
    stages = tuple(StageSpec(name, unit) for name, unit in STAGES)
    return Graph(stages, (edge,) * 4, "composite", ("pose", "composite"))


RUNS: dict[str, dict[str, Any]] = {
    "pipelined": {},
    "sequential": {"policy": "sequential"},
    "latest": {"policy": "latest", "period_ns": 9 * MS, "deadline_ns": 27 * MS},
    "deadline": {"policy": "deadline", "period_ns": 11 * MS, "deadline_ns": 33 * MS},
    "triple": {"graph": application_graph("triple")},
    "orphan": {"graph": application_graph("orphan:4")},
    "deaths": {"faults": [(150 * MS, "dsp"), (310 * MS, "gpu"), (311 * MS, "cpu")]},
    "deaths of the first": {
        "faults": [(MS // 2, "cpu"), *((at * MS, "cpu") for at in range(60, 900, 37))],
        "max_failures": 99,
    },
    "gives up": {"faults": [(at * MS, "dsp") for at in range(100, 90_000, 10)], "max_failures": 2},
    "bypass and drops": {
        "graph": with_bypass("triple"),
        "skips": lambda frame, _fresh: frame % 3 == 1,
        "policy": "latest",
        "period_ns": 7 * MS,
        "deadline_ns": 21 * MS,
    },
    "queue": {"period_ns": 5 * MS, "deadline_ns": 40 * MS, "in_queue": 3, "queue_timeout_ns": 31 * MS},
    "asked": {"asked": True, "inputs": [(at * MS, FrameRequest(3)) for at in range(0, 200, 10)]},
    "held": {"period_ns": 9 * MS, "inputs": [(30 * MS, Hold(0)), (90 * MS, Hold(2)), (150 * MS, Hold(-1))]},
    "held and stopped": {"inputs": [(40 * MS, Hold(0)), (60 * MS, Hold(3)), (61 * MS, Stop())]},
    "stopped": {"inputs": [(130 * MS, Stop())]},
    "aborted": {"inputs": [(130 * MS, Abort())]},
    "bypass": {"graph": with_bypass(), "skips": lambda frame, _fresh: frame % 3 == 1},
}


@cache
def run_named(name: str) -> Simulation:
    return a_run(**RUNS[name])


@pytest.mark.parametrize("name", RUNS)
def test_every_presented_frame_is_one_arrow_through_its_stages(name: str) -> None:
    done = run_named(name)
    trace = trace_of(records_of(done))
    stages_of: dict[int, list[str]] = defaultdict(list)
    for _, piece in sorted(trace.slices, key=lambda each: each[1].begin_ns):
        for flow in piece.flows:
            stages_of[flow - 1].append(piece.name)
    in_order = [stage for stage, _ in STAGES]
    skipping = [stage for stage in in_order if stage not in ("raster", "infer")]
    presented = {job.frame for job in done.jobs if job.stage == "present"}
    assert len(presented) == done.report["frames"]["presented"]
    for frame in presented:
        assert stages_of[frame] == (skipping if name.startswith("bypass") and len(stages_of[frame]) == 3 else in_order)
    skipped = sum(len(stages_of[frame]) == 3 for frame in presented)
    assert skipped == done.report["frames"].get("skipped", 0)
    idle = [piece for _, piece in trace.slices if piece.name in ("starved", "blocked", "overhead")]
    assert idle and not any(piece.flows for piece in idle)


@pytest.mark.parametrize("name", RUNS)
def test_slices_of_a_unit_add_up_to_the_report(name: str) -> None:
    """`read_trace` has refused slices that lie over each other; here their sums are those that the ledger kept."""
    done = run_named(name)
    trace = trace_of(records_of(done))
    total_ns = done.report["duration_s"] * 1e9
    for unit, row in done.report["units"].items():
        sums: Counter[str] = Counter()
        for piece in trace.of(f"clock/{unit}"):
            sums["busy" if piece.flows else piece.name] += piece.end_ns - piece.begin_ns
        wanted = {"busy": row["busy"], **{cause: share for cause, share in row["idle"].items() if share}}
        assert {cause: ns / total_ns for cause, ns in sums.items() if ns} == {
            cause: pytest.approx(share, abs=1e-9) for cause, share in wanted.items() if share
        }


BY_HAND: tuple[Record, ...] = (
    Begun(
        SCHEMA,
        chain((("a", "u"), ("b", "v")), "double", "b"),
        Settings(2, "latest", period_ns=10 * MS, deadline_ns=12 * MS),
        FACTS,
    ),
    Stepped(5, (UnitReady("u"), UnitReady("v")), (Dispatch(Job(0, "u", "a", 0, -1, 0, 0)),)),
    Accounted(5, "v", STARVED),
    Sampled(5, {"temperature_c.device": 31.5, "duty.gpu": 800, "strange": 1}),
    Said(6, "all is well"),
    Stepped(2 * MS, (JobDone("u", 0, 7, 2 * MS - 3, 7),), (Dispatch(Job(1, "v", "b", 0, 0, -1, 0)),)),
    Worked(JobRecord("a", "u", 0, 5, 5, 7, 2 * MS - 3, 700, 80), {"bytes_read": 64, "instructions": 9.0, "other": 1}),
    Accounted(2 * MS, "u", STARVED),
    Stepped(10 * MS + 5, (), (Dispatch(Job(2, "u", "a", 1, -1, 1, 0)),)),
    Stepped(11 * MS, (JobDone("u", 2, 10 * MS + 9, 11 * MS, 9),), ()),
    Worked(
        JobRecord("a", "u", 1, 10 * MS + 5, 10 * MS + 5, 10 * MS + 9, 11 * MS), {"bytes_read": 64, "instructions": 8.5}
    ),
    Stepped(16 * MS, (JobDone("v", 1, 3 * MS, 15 * MS, 0, 0, 0, 600),), ()),
    Worked(JobRecord("b", "v", 0, MS, 2 * MS, 3 * MS, 15 * MS, 0, 0, 600), {}),
    Accounted(16 * MS, "v", BLOCKED),
    Stepped(20 * MS, (UnitDied("v"),), (Finish(Outcome(OutcomeKind.GAVE_UP, "v")),)),
    Counted(20 * MS, {"gave_up:v": 1}, {}),
    Ended(21 * MS, {}),
)


def test_a_run_written_by_hand_track_by_track() -> None:
    trace = trace_of(iter(BY_HAND))
    paths = {trace.path(number): rank for number, (_, _, rank) in trace.tracks.items()}
    assert list(dict.fromkeys(path.partition("/")[0] for path in paths)) == ["trilane, virtual clock"]
    root = "trilane, virtual clock"

    def seen(path: str) -> list[tuple[Any, ...]]:
        return [(one.name, one.begin_ns, one.end_ns, one.notes, one.flows) for one in trace.of(f"{root}/{path}")]

    assert seen("u") == [
        ("overhead", 5, 7, {}, ()),
        ("a", 7, 2 * MS - 3, {"frame": 0, "wait_us": 0, "preempted_ns": 700, "asleep_ns": 80}, (1,)),
        ("overhead", 2 * MS - 3, 2 * MS, {}, ()),
        ("starved", 2 * MS, 10 * MS + 5, {}, ()),
        ("overhead", 10 * MS + 5, 10 * MS + 9, {}, ()),
        ("a", 10 * MS + 9, 11 * MS, {"frame": 1, "wait_us": 0}, (2,)),
        ("starved", 11 * MS, 20 * MS, {}, ()),
    ]
    assert seen("v") == [
        ("starved", 5, 2 * MS, {}, ()),
        ("overhead", 2 * MS, 3 * MS, {"preempted_ns": 600}, ()),
        ("b", 3 * MS, 15 * MS, {"frame": 0, "wait_us": 2000}, (1,)),
        ("overhead", 15 * MS, 16 * MS, {}, ()),
        ("blocked", 16 * MS, 20 * MS, {}, ()),
    ]
    assert seen("u/a") == [("0", 7, 2 * MS - 3, {}, ()), ("1", 10 * MS + 9, 11 * MS, {}, ())]
    assert seen("v/b") == [("0", 3 * MS, 15 * MS, {}, ())]
    assert seen("Expected frames") == [("0", 5, 12 * MS + 5, {}, ()), ("1", 10 * MS + 5, 22 * MS + 5, {}, ())]
    assert seen("Actual frames") == [("late 0", 5, 15 * MS, {"late_us": 2999}, ())]
    assert [(one.track, one.name, one.begin_ns, one.notes) for one in trace.instants] == [
        (f"{root}/messages", "all is well", 6, {}),
        (f"{root}/Lost and dropped", "lost gave_up:v", 20 * MS, {"frame": 1}),
    ]
    assert {path.removeprefix(f"{root}/"): counts for path, counts in trace.counts.items()} == {
        "device temperature": [(5, 31.5)],
        "gpu duty": [(5, 800)],
        "strange": [(5, 1)],
        "Frames in flight": [(5, 1), (10 * MS + 5, 2), (16 * MS, 1), (20 * MS, 0)],
        "v/b/frames that wait": [(11 * MS, 1), (20 * MS, 0)],
        "u/a/bytes read": [(7, 64)],
        "u/a/instructions": [(7, 9), (10 * MS + 9, 8.5)],
    }
    ((_, run),) = [each for each in trace.slices if each[1].name == "run"]
    assert (run.track, run.begin_ns, run.end_ns) == (f"{root}/run", 5, 21 * MS)
    assert run.notes["config"] == {
        "scene": {"name": "default", "fps": 60, "avatars": ["a", "b"], "planes": "none"},
        "latch": "none",
    }
    assert run.notes["times"] == "ns of simulated time from 0 on"
    assert run.notes["scheduler"]["policy"] == "latest"
    assert run.notes["edges"] == ["double"]
    assert not any(trace.open.values())
    assert paths[f"{root}/u"] < paths[f"{root}/v"] and paths[f"{root}/Expected frames"] < paths[f"{root}/u"]


def test_without_deadlines_a_frame_is_late_by_the_rate_of_its_scene() -> None:
    """60 frames a second are asked for; in a pipeline none is late, for the slowest stage takes 13 ms, else all are."""
    assert all(
        not one.name.startswith("late") for one in trace_of(records_of(run_named("pipelined"))).of("Actual frames")
    )
    done = run_named("sequential")
    trace = trace_of(records_of(done))
    actual, expected = trace.of("Actual frames"), trace.of("Expected frames")
    ends = [one.end_ns for one in actual]
    period_ns = round(1e9 / 60)
    assert [(one.begin_ns, one.end_ns) for one in expected] == [(end, end + period_ns) for end in ends[:-1]]
    assert [one.name.startswith("late") for one in actual[1:]] == [b - a > period_ns for a, b in pairwise(ends)]
    assert sum(one.name.startswith("late") for one in actual) == 39


def test_a_killed_run_ends_where_its_journal_does() -> None:
    trace = trace_of(iter(BY_HAND[:9]))
    assert [one.name for one in trace.of("clock/u")] == ["overhead", "a", "overhead", "starved"]
    assert trace.of("clock/run")[0].end_ns == 10 * MS + 5


@pytest.mark.parametrize("value", [1e300, -1e300, float(1 << 63)])
def test_a_counter_beyond_64_bits_is_written_as_a_real_number(value: float) -> None:
    large = [
        one._replace(figures={"bytes_read": value}) if isinstance(one, Worked) and one.job.frame == 0 else one
        for one in BY_HAND
    ]
    assert trace_of(iter(large)).counts["trilane, virtual clock/u/a/bytes read"][0] == (7, value)


def test_chrome_json_has_the_same_slices_and_counters() -> None:
    for name in ("pipelined", "latest", "deaths"):
        trace, text = trace_of(records_of(run_named(name))), io.StringIO()
        write_tracks(ChromeSink(text), {"trilane": records_of(run_named(name))})
        events = json.loads(text.getvalue())["traceEvents"]
        of_kind = defaultdict(list)
        for event in events:
            of_kind[event["ph"]].append(event)
        titles = {event["tid"]: event["args"]["name"] for event in of_kind["M"] if event["name"] == "thread_name"}
        found = Counter(
            (titles[one["tid"]], one["name"], round(one["ts"] * 1000), round((one["ts"] + one["dur"]) * 1000))
            for one in of_kind["X"]
        )
        root = "trilane, virtual clock/"
        wanted = Counter(
            (one.track.removeprefix(root).replace("/", ": "), one.name, one.begin_ns, one.end_ns)
            for _, one in trace.slices
            if one.name != "run"
        )
        assert found == wanted
        arrows = Counter((event["id"], event["ph"]) for event in of_kind["s"] + of_kind["t"] + of_kind["f"])
        through = {frame for frame, kind in arrows if kind == "f"}
        assert len(through) == run_named(name).report["frames"]["presented"]
        assert all(arrows[frame, "s"] == arrows[frame, "f"] == 1 and arrows[frame, "t"] == 3 for frame in through)
        assert len(of_kind["C"]) == sum(map(len, trace.counts.values()))
        assert len(of_kind["i"]) == len(trace.instants)
        assert len(of_kind["B"]) == len(of_kind["E"]) == 1


def endless(frames: int, **settings: int) -> Iterator[Record]:
    """A journal of two stages that take 5 ms each in turns, record by record."""
    yield Begun(SCHEMA, chain((("a", "u"), ("b", "v")), "double", "b"), Settings(frames, **settings), FACTS)
    yield Stepped(0, (UnitReady("u"), UnitReady("v")), ())
    for frame in range(frames):
        at_ns, number = frame * 10 * MS, 2 * frame
        half_ns, end_ns = at_ns + 5 * MS, at_ns + 10 * MS
        yield Stepped(at_ns, (), (Dispatch(Job(number, "u", "a", frame, -1, 0, 0)),))
        done = (JobDone("u", number, at_ns, half_ns, at_ns),)
        yield Stepped(half_ns, done, (Dispatch(Job(number + 1, "v", "b", frame, 0, -1, 0)),))
        yield Accounted(half_ns, "u", STARVED)
        yield Worked(JobRecord("a", "u", frame, at_ns, at_ns, at_ns, half_ns), {"bytes_read": frame})
        yield Stepped(end_ns, (JobDone("v", number + 1, half_ns, end_ns, 0),), ())
        yield Accounted(end_ns, "v", STARVED)
        yield Worked(JobRecord("b", "v", frame, half_ns, half_ns, half_ns, end_ns), {})


def allocated_bytes() -> int:
    """What the C library has given out and not got back (mallinfo2 of glibc 2.33)."""

    class Mallinfo2(ctypes.Structure):
        _fields_ = [
            (name, ctypes.c_size_t)
            for name in [
                "arena",
                "ordblks",
                "smblks",
                "hblks",
                "hblkhd",
                "usmblks",
                "fsmblks",
                "uordblks",
                "fordblks",
                "keepcost",
            ]
        ]

    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = Mallinfo2
    info = mallinfo2()
    return int(info.uordblks + info.hblkhd)


def test_memory_is_flat_however_long_a_run_lasts() -> None:
    """From frame 500 to 2000 nothing is added: neither Python's objects nor what lies behind the packets.

    The second is what C has allocated. Resident memory also changes with the pages that the kernel takes and gives.
    """
    with open(os.devnull, "wb") as nothing:  # noqa: PTH123
        records = endless(2000)
        begun = next(records)
        assert isinstance(begun, Begun)
        sink = PacketSink(nothing)
        tracks = RunTracks(sink, begun)

        def write(frames: int) -> tuple[int, int]:
            for record in islice(records, 7 * frames):
                tracks.add(record)
            sink._write_block()  # what is not in the file yet
            return tracemalloc.get_traced_memory()[0], allocated_bytes()

        tracemalloc.start()
        try:
            before, before_c = write(500)
            after, after_c = write(1500)
        finally:
            tracemalloc.stop()
    assert after - before < 1500 * 16
    assert after_c - before_c < 1500 * 16  # the smallest piece that C gives takes 32


def test_ten_minutes_are_less_than_50_mb() -> None:
    """At 75 frames a second, with every counter that a job may have changing at every job."""
    figures = ("bytes_read", "bytes_written", "bytes_uploaded", "bytes_read_back", "instructions", "cache_misses")

    def with_figures(records: Iterator[Record]) -> Iterator[Record]:
        for record in records:
            if isinstance(record, Worked):
                record = record._replace(figures={name: record.job.begin_ns % 9_999_991 for name in figures})
            yield record

    for name in ("pipelined", "latest"):
        begun, *records = with_figures(records_of(run_named(name)))
        frames = run_named(name).report["frames"]["presented"]
        sizes, packets = [], []
        for plain_bytes in (PLAIN_BYTES, 0):
            file = io.BytesIO()
            write_tracks(PacketSink(file, plain_bytes), {name: iter([begun, *records])})
            sizes.append(len(file.getvalue()) / frames)
            packets.append(list(packets_in(file.getvalue())))
        assert packets[0] == packets[1]
        plain, packed = sizes
        assert plain < 2500
        ten_minutes = 10 * 60 * 75
        assert PLAIN_BYTES + (ten_minutes - PLAIN_BYTES / plain) * packed < 50e6


@pytest.mark.parametrize(("deadline_ns", "late"), [(10 * MS, 0), (10 * MS - 1, 20)])
def test_a_frame_that_is_done_at_its_deadline_is_in_time(deadline_ns: int, late: int) -> None:
    trace = trace_of(endless(20, period_ns=10 * MS, deadline_ns=deadline_ns))
    assert sum(one.name.startswith("late") for one in trace.of("Actual frames")) == late


def test_slices_that_come_out_of_order_are_written_in_order_and_cut() -> None:
    tiles: Tiles[str] = Tiles()
    tiles.start(10)
    tiles.add(20, 30, "b")
    assert list(tiles.take()) == []
    tiles.add(10, 20, "a")
    assert list(tiles.take()) == [(10, 20, "a"), (20, 30, "b")]
    tiles.add(25, 40, "lies over b")
    tiles.add(26, 29, "within b")
    tiles.add(50, 60, "after a gap")
    assert list(tiles.take()) == [(30, 40, "lies over b")]
    assert list(tiles.take(rest=True)) == [(50, 60, "after a gap")]
    for number in range(MOST_WAITING + 1):
        tiles.add(100 + 2 * number, 101 + 2 * number, "")
    assert [begin_ns for begin_ns, _, _ in tiles.take()] == [100]


def test_lanes_are_used_again_and_few() -> None:
    lanes = Lanes(2)
    assert [lanes.place(0, 10), lanes.place(5, 15), lanes.place(10, 20), lanes.place(16, 18)] == [
        (0, 0),
        (1, 5),
        (0, 10),
        (1, 16),
    ]
    assert lanes.place(17, 30) == (1, 18)
    three = Lanes(3)
    assert [three.place(0, 10), three.place(5, 15), three.place(10, 20)] == [(0, 0), (1, 5), (0, 10)]
    assert lanes.place(17, 19) == (0, 19)
    assert lanes.place(30, 31) == (0, 30)
