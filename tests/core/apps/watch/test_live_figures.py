"""The figures of a moment: by hand from a small journal, and at every step beside what the scheduler has."""

from __future__ import annotations

import gc
import random
import sys
from collections.abc import Iterator
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any

import pytest

from support.told_journal import told_journal
from trilane.apps.watch.figures import MomentFigures, Moved, Shares
from trilane.apps.watch.live_figures import LiveFigures
from trilane.pipeline.journal import SCHEMA, Accounted, Begun, Counted, Ended, Record, Stepped, Worked, journal_of
from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    NEVER,
    Finish,
    FrameRequest,
    Graph,
    Hold,
    Outcome,
    OutcomeKind,
    SetDuty,
    Settings,
    StageSpec,
    Start,
    Stop,
    UnitDied,
    UnitReady,
    chain,
)
from trilane.scheduler.virtual import VirtualDriver, simulate

MS = 1_000_000
S = 1_000_000_000


def followed(core: Core, driver: VirtualDriver) -> Iterator[list[Record]]:
    """The journal of a run in virtual time, as a run writes it: the records of each step."""
    accounts: dict[str, int] = {}
    counts: Any = ({}, {})
    deadline_ns, booked = NEVER, 0
    while core.outcome is None:
        now_ns, events = driver.wait(deadline_ns)
        actions, deadline_ns = core.step(now_ns, events)
        driver.perform(now_ns, actions)
        changed = [unit for unit in core.units.values() if accounts.get(unit.name) != unit.account]
        accounts.update((unit.name, unit.account) for unit in changed)
        found = (core.ledger.lost_by_cause, core.ledger.dropped_by_cause)
        yield [
            Stepped(now_ns, events, actions),
            *(Accounted(now_ns, unit.name, unit.account) for unit in changed),
            *(Worked(job, {}) for job in driver.jobs[booked:]),
            *([Counted(now_ns, *found)] if found != counts else []),
        ]
        booked, counts = len(driver.jobs), found


def of(begun: Begun, records: list[Record]) -> LiveFigures:
    figures = LiveFigures(begun)
    for record in records:
        figures.add(record)
    return figures


def rounded(shares: Shares, total_ms: float) -> dict[str, float]:
    """In ms, without those that are 0."""
    row = {"busy": shares.busy, **shares.idle}
    assert sum(row.values()) == pytest.approx(1)
    return {name: round(share * total_ms, 3) for name, share in row.items() if share}


def test_a_journal_by_hand() -> None:
    figures = of(*told_journal()).now(1070 * MS)
    assert (figures.t_ms, figures.window_s, figures.run_s, figures.clock, figures.is_over) == (
        70,
        0.07,
        0.07,
        "host",
        0,
    )
    u, v = figures.units["u"], figures.units["v"]
    # u was assigned 0-60: busy 20 + 25 - 5, preempted 5, overhead the rest
    assert rounded(u.run, 70) == {"busy": 40, "preempted": 5, "overhead": 15, "blocked": 10}
    assert rounded(v.run, 70) == {"busy": 40, "starved": 30}  # b1 still runs, from 50 on
    assert (u.window, v.window) == (u.run, v.run)
    assert [(each.jobs, each.restarts, each.is_up, each.stage, each.frame) for each in (u, v)] == [
        (2, 0, True, "", -1),
        (1, 0, True, "b", 1),
    ]
    frames = figures.frames
    assert (frames.requested, frames.presented, frames.in_flight, frames.lost, frames.dropped) == (9, 1, 1, {}, ())
    assert frames.not_begun == 7
    assert figures.latency_ms["p50"] == 40 - 2
    assert (figures.latency_ms["samples"], figures.frame_time_ms["samples"]) == (1, 0)
    assert (figures.fps, figures.run_fps) == (pytest.approx(1 / 0.07), None)
    a, b = figures.stages["a"], figures.stages["b"]
    assert (a.unit, a.waiting, a.service_ms, a.bytes) == ("u", 0, 22.5, {"written": Moved(400, 200)})
    assert (b.waiting, b.service_ms, b.bytes) == (0, 20, {"read": Moved(100, 100), "written": Moved(7, 7)})
    assert figures.temperature_c == {"device": 31.5, "sensor": 60}
    assert (figures.duty, figures.memory_bytes) == ({"u": 0.5}, {"u": 2e6})
    assert [(note.t_ms, note.text) for note in figures.notes] == [(60, "so it is")]


def test_the_latency_histogram_has_the_frame_between_its_bounds() -> None:
    latencies = of(*told_journal()).now().latencies
    place = latencies.bounds_s.index(0.04)
    assert latencies.counts[place] == latencies.count == 1
    assert latencies.sum_s == pytest.approx(0.038)
    assert list(latencies.bounds_s) == sorted(set(latencies.bounds_s))


def test_sources_and_error_stand_beside_the_figures() -> None:
    begun, records = told_journal()
    figures = of(begun, records).now()
    assert figures.accuracy == {"default": {"source": "no figures", "why": "never validated"}}
    assert figures.sources["fps"] == figures.sources["temperature_c.sensor"] == "measured in this run"
    assert figures.sources["temperature_c"] == "computed"
    assert figures.sources["accuracy.default"] == "no figures"
    computed = LiveFigures(begun._replace(facts={"clock": "virtual"})).now()
    assert (computed.sources["fps"], computed.accuracy, computed.began_at) == ("computed", {}, "")


def test_the_window_forgets_and_the_run_does_not() -> None:
    begun, records = told_journal()
    figures = of(begun, records)
    half = figures.now(1020 * MS + 5 * S)
    # the window begins at 20: v was busy 20-40, starved 40-50, and b1 has run ever since
    assert rounded(half.units["v"].window, 5000) == {"busy": 4990, "starved": 10}
    assert rounded(half.units["v"].run, 5020) == {"busy": 4990, "starved": 30}
    cut = figures.now(1030 * MS + 5 * S)
    # a1 began at 25 and is cut at 30: of its 20 busy and 5 preempted ms four fifths are left; assigned 30-60
    assert rounded(cut.units["u"].window, 5000) == {"busy": 16, "preempted": 4, "overhead": 10, "blocked": 4970}
    later = figures.now(1041 * MS + 5 * S)
    assert (later.fps, later.latency_ms["samples"], later.latencies.count) == (0, 0, 1)
    assert later.stages["b"].service_ms == 0
    assert later.stages["b"].bytes == {"read": Moved(100, 0), "written": Moved(7, 0)}


def test_a_unit_that_dies_has_no_job_and_comes_back() -> None:
    begun, records = told_journal()
    death = Stepped(1070 * MS, (UnitDied("v"),), (Start("v"),))
    figures = of(begun, [*records, death, Counted(1070 * MS, {"died:v": 1}, {})])
    now = figures.now(1080 * MS)
    assert (now.units["v"].is_up, now.units["v"].restarts, now.units["v"].stage) == (False, 1, "")
    assert (now.frames.in_flight, now.frames.lost) == (0, {"died:v": 1})
    assert rounded(now.units["v"].run, 80) == {"busy": 20, "starved": 30, "overhead": 30}
    figures.add(Stepped(1090 * MS, (UnitReady("v"),), ()))
    assert figures.now().units["v"].is_up


def test_drops_of_the_step_that_ends_the_run_leave_no_queue_behind() -> None:
    begun, records = told_journal()
    finish = Stepped(1061 * MS, (), (Finish(Outcome(OutcomeKind.GAVE_UP, "u")),))
    now = of(begun, [*records, finish, Counted(1061 * MS, {}, {"a->b:stale": 2})]).now()
    assert (now.stages["b"].waiting, now.units["v"].stage) == (0, "")


def test_what_bounds_the_run_is_known_after_some_frames_and_at_the_end_it_is_the_reports() -> None:
    """b takes 15 ms of each frame, a 5 of them beside it: every path is b's but for the first frame. Paths are walked
    back from each thirtieth frame as far as 32 before the newest, so that the first share is there after 62 intervals.
    """
    graph, times = chain((("a", "u"), ("b", "v")), "double", "b"), {"a": 5 * MS, "b": 15 * MS}
    run = simulate(graph, Settings(100), lambda stage, *_: times[stage], keep=True)
    assert run.recording is not None
    told = {**run.report, "bound": {"unit": {"name": "told", "share": 0.5}, "stage": None}}
    begun, *records = journal_of(run.recording, run.jobs, {}, told)
    assert isinstance(begun, Begun)
    live, finished, presented = LiveFigures(begun), LiveFigures(begun, finds_bound=False), 0
    for record in records[:-1]:
        for figures in (live, finished):
            figures.add(record)
        presented += isinstance(record, Worked) and record.job.stage == "b"
        assert finished.now().bound is None
        assert (live.now().bound is None) == (presented <= 62)
    bound = live.now().bound
    assert bound is not None
    assert bound.stage is not None
    assert (bound.unit.name, bound.stage.name) == ("v", "b")
    assert bound.unit.share == bound.stage.share == 1
    for figures in (live, finished):
        figures.add(records[-1])
        assert figures.now().as_json()["bound"] == told["bound"]


BYPASS = Graph(
    tuple(StageSpec(name, unit) for name, unit in zip("abcd", "uvwv", strict=True)), ("double",) * 3, "d", ("a", "d")
)
FOUR = chain(zip("abcd", "uvwv", strict=True), "double", "c")
PACE: dict[str, Any] = {"period_ns": 6 * MS, "deadline_ns": 18 * MS}
CASES: dict[str, tuple[Graph, Settings, dict[str, Any]]] = {
    "pipelined": (FOUR, Settings(60), {}),
    "sequential": (FOUR, Settings(30, "sequential"), {}),
    "latest": (FOUR, Settings(90, "latest", **PACE), {}),
    "mailbox": (chain(zip("abcd", "uvwv", strict=True), "orphan:4", "d"), Settings(90, "latest", **PACE), {}),
    "triple": (chain(zip("abcd", "uvwv", strict=True), "triple", "d"), Settings(90), {}),
    "deadline": (FOUR, Settings(90, "deadline", **PACE), {}),
    "queue": (FOUR, Settings(90, in_queue=2, queue_timeout_ns=30 * MS, **PACE), {}),
    "arrivals": (FOUR, Settings(40, arrivals_ns=tuple(3 * n * MS for n in range(40))), {}),
    "asked": (FOUR, Settings(40, asked=True), {"inputs": [(1, FrameRequest(9)), (50 * MS, FrameRequest(40))]}),
    "faults": (FOUR, Settings(90, max_failures=9), {"faults": [(31 * MS, "v"), (77 * MS, "u"), (99 * MS, "w")]}),
    "given up": (FOUR, Settings(90, max_failures=0, **PACE), {"faults": [(150 * MS, "v")]}),
    "held": (FOUR, Settings(90, **PACE), {"inputs": [(30 * MS, Hold(0)), (90 * MS, Hold(2)), (150 * MS, Hold(-1))]}),
    "stopped": (FOUR, Settings(90, **PACE), {"inputs": [(100 * MS, Stop())]}),
    "duty": (FOUR, Settings(40), {"inputs": [(20 * MS, SetDuty("w", 400))]}),
    "bypass": (BYPASS, Settings(90, "latest", **PACE), {"skips": lambda frame, fresh: frame % 3 > 0 and not fresh}),
    "bypass, faults": (
        BYPASS,
        Settings(90, max_failures=9),
        {"skips": lambda frame, fresh: frame % 4 > 1 and not fresh, "faults": [(40 * MS, "v"), (90 * MS, "u")]},
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_at_every_step_frames_are_where_the_scheduler_has_them(case: str) -> None:
    """And at the end the shares and times are those of the ledger, which keeps them by itself."""
    graph, settings, options = CASES[case]
    luck = random.Random(7)

    def service(*_: Any) -> int:
        return luck.randrange(MS, 9 * MS)

    driver = VirtualDriver(graph, settings, service, message_delay_ns=MS // 4, restart_ns=5 * MS, keep=True, **options)
    core, figures = driver.core, LiveFigures(Begun(SCHEMA, graph, settings, {"clock": "virtual"}))
    for records in followed(core, driver):
        for record in records:
            figures.add(record)
        if core.outcome is None:
            assert_frames(figures.now(), core)
    report = core.report(clock="virtual")
    figures.add(Ended(driver.core.now_ns + S, report))  # the units do no work after the last frame
    now = figures.now()
    assert_shares(now, report)
    frames = report["frames"]
    assert (now.frames.presented, now.frames.lost) == (frames["presented"], frames["lost_by_cause"])
    assert {f"{drop.edge}:{drop.cause}": drop.frames for drop in now.frames.dropped} == frames["dropped"]
    assert (now.frames.skipped, now.frames.in_flight) == (frames.get("skipped", 0), 0)
    assert {stage.waiting for stage in now.stages.values()} == {0}
    assert now.fps == now.run_fps == (pytest.approx(report["fps"]) if frames["presented"] > 1 else None)
    assert now.frame_time_ms == {key: report["frame_time_ms"][key] for key in now.frame_time_ms}
    assert now.latency_ms == report["latency_ms"]
    assert now.frame_times.count == report["frame_time_ms"]["samples"]
    assert (now.frame_times.count == max(frames["presented"] - 1, 0)) == (case != "held")
    assert now.latencies.sum_s == pytest.approx(sum(core.ledger.latency_ns) / S)


@pytest.mark.parametrize(("sooner", "later", "finds_bound"), [(350, 1000, False), (4200, 5500, True)])
def test_a_longer_run_takes_no_more_memory(sooner: int, later: int, finds_bound: bool) -> None:
    """Beyond the window of 5 s; what bounds the run is found in the last 4096 jobs and changes of each unit."""
    settings, graph = Settings(later), chain((("a", "u"), ("b", "v")), "double", "b")
    driver = VirtualDriver(graph, settings, lambda *_: 20 * MS, keep=True)
    figures = LiveFigures(Begun(SCHEMA, graph, settings, {}), finds_bound=finds_bound)
    sizes: dict[int, int] = {}
    for records in followed(driver.core, driver):
        for record in records:
            figures.add(record)
        if (presented := driver.core.ledger.presented_count) in (sooner, later):
            sizes[presented] = held_bytes(figures)
    assert sizes[later] < 1.02 * sizes[sooner]  # larger numbers take a few more bytes


def held_bytes(root: object) -> int:
    """Of all objects that can be reached from `root`, but for code."""
    seen: dict[int, object] = {}
    left: list[object] = [root]
    while left:
        one = left.pop()
        if id(one) not in seen and not isinstance(one, type | ModuleType | FunctionType | BuiltinFunctionType):
            seen[id(one)] = one
            left += gc.get_referents(one)
    return sum(map(sys.getsizeof, seen.values()))


def assert_frames(now: MomentFigures, core: Core) -> None:
    """Where frames are and what units do, beside the slots and queues of the scheduler."""
    assert now.frames.in_flight == len(core.frames)
    counts = (now.frames.presented, now.frames.in_flight, now.frames.not_begun, core.ledger.left_out)
    assert sum(counts) == now.frames.requested == core.settings.frames
    for stage in core.stages:
        waiting = len(core.source.queue) if stage.input is None else len(stage.input.ready)
        waiting += len(stage.bypassed.lines[1]) if stage.bypassed is not None else 0
        assert now.stages[stage.name].waiting == waiting, stage.name
    for name, unit in core.units.items():
        job = unit.queue[0] if unit.queue else None
        assert (now.units[name].stage, now.units[name].frame) == ((job.stage, job.frame) if job else ("", -1))
        assert sum((now.units[name].window.busy, *now.units[name].window.idle.values())) in (0, pytest.approx(1))


def assert_shares(now: MomentFigures, report: dict[str, Any]) -> None:
    for unit, row in report["units"].items():
        own = now.units[unit]
        assert (own.run.busy, own.run.idle) == (pytest.approx(row["busy"]), pytest.approx(row["idle"]))
        assert own.window.idle == pytest.approx(own.run.idle, abs=1e-6)  # the run is shorter than the window
        assert (own.jobs, own.restarts) == (row["jobs"], row["restarts"])
