"""What a unit worked, waited for its core and slept: against threads of which every nanosecond is known."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from support.small_pipeline import pipeline
from trilane.pipeline import realtime_clock
from trilane.pipeline.job_times import (
    HELD_NS,
    JOBS_PER_LOOK,
    LOSS_NS,
    CoreMeter,
    JobClock,
    Lost,
    lost_in_job,
    most_preempted_ns,
)
from trilane.pipeline.realtime_clock import CpuTimes, use_of_cores
from trilane.pipeline.result import RunLog
from trilane.scheduler.events import JobDone
from trilane.transport.messages import Done

TICKS = 400
FILES = Path("/proc/self/fd")


@pytest.mark.parametrize(
    ("wall", "cpu", "delay", "cores", "preempted", "asleep"),
    [
        (100, 100, 0, 1, 0, 0),
        (100, 60, 40, 1, 40, 0),
        (100, 60, 10, 1, 10, 30),
        (100, 60, 90, 1, 40, 0),  # three threads: two of them waited while the third ran
        (100, 0, 0, 1, 0, 100),
        (100, 101, 5, 1, 0, 0),  # the clocks are not read at the same instant
        (100, 200, 0, 2, 0, 0),
        (100, 120, 80, 2, 40, 0),  # both threads had no core for 40
        (100, 60, 40, 2, 40, 0),  # one thread, which had none for 40
        (100, 100, 0, 2, 0, 0),  # one thread, which ran throughout
        (100, 160, 40, 2, 20, 0),  # one of two threads had none for 40
        (100, 120, 40, 2, 25, 0),  # 1.6 threads were ready at a time
        (0, 0, 7, 1, 0, 0),
    ],
)
def test_a_job_by_hand(wall: int, cpu: int, delay: int, cores: int, preempted: int, asleep: int) -> None:
    assert lost_in_job(wall, cpu, delay, cores, has_device=False) == Lost(preempted, asleep)
    assert lost_in_job(wall, cpu, delay, cores, has_device=True) == Lost(preempted, 0)


class Threads:
    """Threads of one unit on cores that others use too, tick by tick: ready at random, run as there is a free core."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self.cpu = self.delay = self.ran = self.none_had_a_core = 0

    def tick(self, ready: int, had: int) -> None:
        self.cpu += had
        self.delay += ready - had
        self.ran += had > 0
        self.none_had_a_core += ready > 0 and had == 0


def simulated(draw: random.Random, cores: int, units: list[Threads]) -> None:
    """Each tick, the cores go to ready threads, drawn at random."""
    for _ in range(TICKS):
        ready = [draw.randint(0, unit.threads) for unit in units]
        wanting = [place for place, count in enumerate(ready) for _ in range(count)]
        draw.shuffle(wanting)
        for place, unit in enumerate(units):
            unit.tick(ready[place], wanting[:cores].count(place))


@pytest.mark.parametrize("seed", range(30))
def test_units_are_busy_for_no_more_than_their_cores(seed: int) -> None:
    """By construction: busy is at most the CPU time, and no more of that can be had than the cores give."""
    draw = random.Random(seed)
    cores = draw.randint(1, 4)
    units = [Threads(draw.randint(1, 5)) for _ in range(draw.randint(1, 5))]
    simulated(draw, cores, units)
    busy = []
    for unit in units:
        lost = lost_in_job(TICKS, unit.cpu, unit.delay, cores, has_device=False)
        busy.append(TICKS - lost.preempted_ns - lost.asleep_ns)
        assert 0 <= busy[-1] <= min(unit.cpu, TICKS)
    assert sum(busy) <= cores * TICKS


@pytest.mark.parametrize("seed", range(30))
def test_on_one_core_the_shares_are_the_true_ones(seed: int) -> None:
    """With one thread exactly; with several, busy is exact, and preempted at most the time in which none ran."""
    draw = random.Random(seed)
    units = [Threads(draw.choice((1, 1, 3))) for _ in range(draw.randint(1, 4))]
    simulated(draw, 1, units)
    for unit in units:
        lost = lost_in_job(TICKS, unit.cpu, unit.delay, 1, has_device=False)
        assert TICKS - lost.preempted_ns - lost.asleep_ns == unit.ran
        assert unit.none_had_a_core <= lost.preempted_ns <= TICKS - unit.ran
        if unit.threads == 1:
            assert lost.preempted_ns == unit.none_had_a_core


@pytest.fixture
def tasks(tmp_path: Path) -> Path:
    """A folder in the place of the kernel's, with a thread 7 that has waited for 500 ns."""
    (tmp_path / "schedstat").write_text("123456 0 9\n")
    (tmp_path / "task").mkdir()
    waited(tmp_path / "task", 7, 500)
    return tmp_path / "task"


def waited(tasks: Path, thread: int, delay_ns: int) -> None:
    (tasks / str(thread)).mkdir(exist_ok=True)
    (tasks / str(thread) / "schedstat").write_text(f"123456 {delay_ns} 9\n")


def test_the_meter_counts_from_its_making_on_and_finds_new_threads(tasks: Path) -> None:
    waited(tasks, 3, 10**9)  # not the unit's
    meter = CoreMeter({3}, str(tasks.parent))
    assert meter.threads == 1
    assert meter.delay_ns() == 0
    waited(tasks, 7, 750)
    waited(tasks, 3, 2 * 10**9)
    assert meter.delay_ns() == 250
    waited(tasks, 8, 40)
    assert meter.delay_ns() == 0
    meter.look()
    assert meter.threads == 2
    waited(tasks, 7, 751)
    assert meter.delay_ns() == 41
    assert meter.delay_ns() == 0
    meter.close()


def test_cpu_time_is_that_of_all_threads_and_files_are_closed() -> None:
    before = len(list(FILES.iterdir()))
    meter = CoreMeter()
    counted: list[int] = []

    def compute() -> None:
        counted.append(sum(range(300_000)))

    meter.cpu_ns()
    threads = [threading.Thread(target=compute) for _ in range(3)]
    for thread in threads:
        thread.start()
        meter.look()
    for thread in threads:
        thread.join()
    meter.delay_ns()  # of threads that have ended meanwhile too
    meter.look()
    first_ns = meter.cpu_ns()
    assert 0 < meter.cpu_ns() < first_ns
    assert meter.delay_ns() >= 0
    meter.close()
    assert len(list(FILES.iterdir())) == before


def test_the_file_of_a_thread_that_ends_between_opening_and_reading_is_closed(
    tasks: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ended(*_: int) -> bytes:
        raise ProcessLookupError

    before = len(list(FILES.iterdir()))
    monkeypatch.setattr(os, "pread", ended)
    meter = CoreMeter(process=str(tasks.parent))
    assert meter.threads == 0
    meter.close()
    assert len(list(FILES.iterdir())) == before


def done(begin: int, end: int, cpu: int, cpu_before: int) -> Done:
    return Done(0, begin, end, 0, 0, 0, 0, 0, cpu, cpu_before, {})


def test_cpu_time_before_the_run_does_not_count_and_spinning_between_jobs_does() -> None:
    """The run begins at 100. Before the first job the unit had spun 900 ns, of which at most 50 are the run's."""
    times = CpuTimes({"u": 1})
    times.add("u", "a", done(150, 200, 50, 900), 100)
    times.add("u", "b", done(260, 300, 30, 60), 100)
    assert (times.in_jobs_ns["u"], times.between_ns["u"]) == (80, 110)
    assert times.of_unit_s("u") == pytest.approx(190e-9)
    assert {stage: [*each.kept] for stage, each in times.stage_ns.items()} == {"a": [50], "b": [30]}


def test_cpu_time_between_jobs_that_cannot_be_is_not_hidden() -> None:
    """Ten jobs on one core, one every 10 ns, each after 37 ns of CPU time: of the first 37 only 10 count."""
    times = CpuTimes({"u": 1})
    for begin in range(110, 210, 10):
        times.add("u", "a", done(begin, begin, 0, 37), 100)
    assert times.between_ns["u"] == 10 + 9 * 37
    (row,) = use_of_cores({"u": (0,)}, {"u": times.of_unit_s("u")}, {"u": 0.0}, 100e-9)
    assert row.cpu == pytest.approx(3.43) and not row.is_possible


def test_cpu_time_of_the_units_of_some_cores_is_at_most_what_they_had() -> None:
    """u and v on core 0, w on both cores; a run of 2 s."""
    rows = use_of_cores(
        {"u": (0,), "v": (0,), "w": (1, 0)}, {"u": 1.0, "v": 0.9, "w": 1.5}, {"u": 0.5, "v": 0.4, "w": 1.0}, 2.0
    )
    assert [row[:2] for row in rows] == [((0,), ("u", "v")), ((0, 1), ("u", "v", "w"))]
    assert [row.cpu for row in rows] == pytest.approx([0.95, 0.85])
    assert [row.busy for row in rows] == pytest.approx([0.9, 0.95])
    assert all(row.is_possible for row in rows)
    too_much = use_of_cores({"u": (0,), "v": (0,)}, {"u": 1.2, "v": 0.9}, {"u": 0.6, "v": 0.4}, 2.0)
    assert [row.is_possible for row in too_much] == [False]


def test_a_run_without_any_time_used_nothing() -> None:
    (row,) = use_of_cores({"u": (0, 1)}, {"u": 1.0}, {"u": 0.5}, 0.0)
    assert (row.cpu, row.busy) == (0.0, 0.25)


def test_what_cpu_time_leaves_of_the_cores_is_the_most_that_can_be_preempted() -> None:
    assert [most_preempted_ns(100, cpu, 1) for cpu in (0, 60, 100, 130)] == [100, 40, 0, 0]
    assert most_preempted_ns(100, 61, 2) == 69


def test_the_end_of_a_job_has_the_fields_of_the_unit_s_answer() -> None:
    """The clock of a run passes them on by their places."""
    assert JobDone._fields[2:] == Done._fields[1:8]
    assert (JobDone._fields[1], Done._fields[0]) == ("job", "id")


class Told:
    """The time, and a meter of `threads` threads: what they say next, in us."""

    def __init__(self, threads: int = 1) -> None:
        self.threads, self.looks = threads, 0
        self.times: list[int] = []
        self.cpu: list[int] = []
        self.delay: list[int] = []

    def say(self, times: list[int], cpu: list[int], delay: list[int]) -> None:
        """All that is asked until the next call, no less: what was said before has been asked."""
        assert (self.times, self.cpu, self.delay) == ([], [], [])
        self.times, self.cpu, self.delay = times, cpu, delay

    def look(self) -> None:
        self.looks += 1

    def now_ns(self) -> int:
        return self.times.pop(0) * 1000

    def cpu_ns(self) -> int:
        return self.cpu.pop(0) * 1000

    def delay_ns(self) -> int:
        return self.delay.pop(0) * 1000


def ready(cores: int = 1, threads: int = 1) -> tuple[JobClock, Told]:
    """Of a unit with two stages, at 0."""
    told = Told(threads)
    told.say([0], [9], [9])
    return JobClock(told, cores, 2, told.now_ns), told


def measured(clock: JobClock, stage: int, dispatch_us: int, *, works_asleep: bool = False) -> tuple[float, ...]:
    """A job's begin, end, preempted, asleep, preempted before, CPU time and CPU time before, in us."""
    clock.begin(stage, dispatch_us * 1000)
    clock.end(works_asleep)
    _, begin, end, _, *lost, skips, cpu, cpu_before, _ = clock.done(3, 0, {})
    assert skips == 0
    return tuple(value / 1000 for value in (begin, end, *lost, cpu, cpu_before))


def test_a_job_that_computes_costs_one_look_at_the_cpu_clock_before_its_answer() -> None:
    """Of 1010 us of CPU time since 0, 1000 are the job's, for that is how long it took."""
    clock, told = ready()
    told.say([50, 1050], [1010], [])
    assert measured(clock, 0, 20) == (50, 1050, 0, 0, 0, 1000, 10)
    told.say([1060], [5], [30])  # of 30 us without a core at most 10 were after the job
    clock.answered()
    told.say([1065, 1165], [100], [])  # 5 us on the core and 10 without from 1050 to 1065
    assert measured(clock, 0, 0) == (1065, 1165, 0, 0, 10, 100, 5)


def test_a_unit_that_had_its_job_for_long_asks_what_it_waited_for() -> None:
    """From 0 to 400: 100 on the core, 250 without. The job to 1400: 600 on it, 300 without, 100 asleep."""
    clock, told = ready()
    told.say([399, 400, 1400], [100, 600], [250, 300])
    assert measured(clock, 0, 290) == (400, 1400, 300, 100, 250, 600, 100)
    told.say([], [3], [40])
    clock.answered()
    told.say([1501, 1502, 1602], [7, 100], [20])  # since the end: 60 without a core, 10 on it
    assert measured(clock, 1, 0) == (1502, 1602, 0, 0, 60, 100, 10)


def test_a_job_is_given_its_core_s_loss_above_the_threshold_alone() -> None:
    clock, told = ready()
    told.say([50, 150], [80], [])  # 20 us, unread: it slept, for all that is known
    assert measured(clock, 0, 40) == (50, 150, 0, 20, 0, 80, 0)
    told.say([160], [5], [18])
    clock.answered()
    told.say([160, 260], [79], [15])
    assert measured(clock, 0, 150) == (160, 260, 15, 6, 5, 79, 5)
    assert told.looks == 1
    told.say([], [0], [0])
    clock.answered()
    assert told.looks == 2  # where time is lost a new thread may be the reason


def test_a_stage_that_lost_time_is_measured_from_its_begin_the_other_one_is_not() -> None:
    """A device works while stage 0 sleeps for 400 of 500 us; 60 more before each job's begin it had no core."""
    clock, told = ready()
    told.say([50, 550], [100], [0])
    assert measured(clock, 0, 20, works_asleep=True) == (50, 550, 0, 0, 0, 100, 0)
    told.say([], [5], [0])
    clock.answered()
    told.say([700, 740], [40], [])
    assert measured(clock, 1, 620) == (700, 740, 0, 0, 0, 40, 5)
    told.say([750], [5], [0])
    clock.answered()
    told.say([839, 840, 1340], [10, 100], [60, 30])
    assert measured(clock, 0, 760, works_asleep=True) == (840, 1340, 30, 0, 60, 100, 15)


def test_cpu_time_of_further_threads_between_jobs_is_not_the_job_s() -> None:
    """Two threads on four cores: 200 us of spinning before the job; in it two threads can have had 2 x 100 us."""
    clock, told = ready(4, 2)
    told.say([50, 51, 151], [200, 170], [])
    assert measured(clock, 0, 40) == (51, 151, 0, 0, 0, 170, 200)
    told.say([151], [0], [0])
    clock.answered()
    told.say([160, 161, 261], [0, 150], [50])  # 25 us of one core may be lost
    assert measured(clock, 0, 151) == (161, 261, 25, 0, 0, 150, 0)


def test_threads_are_looked_for_now_and_then_where_no_job_loses_time() -> None:
    clock, told = ready()
    for job in range(1, 2 * JOBS_PER_LOOK + 1):
        told.say([10 * job, 10 * job + 5, 10 * job + 6], [5, 0], [0])
        assert measured(clock, 0, 10 * job)[5] == 5
        clock.answered()
        assert told.looks == 1 + job // JOBS_PER_LOOK


class OneThread:
    """The time, and a meter of a unit's only thread, which runs, waits for its core and sleeps as it is told."""

    threads = 1

    def __init__(self) -> None:
        self.now = self.cpu = self.delay = self.told_cpu = self.told_delay = 0

    def spend(self, ran: int, waited: int, slept: int) -> None:
        self.now += ran + waited + slept
        self.cpu += ran
        self.delay += waited

    def look(self) -> None:
        """There is one thread."""

    def now_ns(self) -> int:
        return self.now

    def cpu_ns(self) -> int:
        passed, self.told_cpu = self.cpu - self.told_cpu, self.cpu
        return passed

    def delay_ns(self) -> int:
        passed, self.told_delay = self.delay - self.told_delay, self.delay
        return passed


@pytest.mark.parametrize("seed", range(20))
def test_no_time_is_counted_twice_and_the_thresholds_hide_no_more_than_they_may(seed: int) -> None:
    """Truth: what one thread did in and between 60 jobs. It goes to sleep and is woken in RECEIVE ns of CPU time."""
    draw = random.Random(seed)
    thread, receive = OneThread(), 15_000
    clock = JobClock(thread, 1, 1, thread.now_ns)
    cpu = sum_of_cpu = 0
    for _ in range(60):
        thread.spend(0, 0, draw.choice((0, 10**6)))
        dispatch_ns = thread.now
        before = draw.choice((0, 5_000, 60_000, 3 * 10**6)), draw.choice((0, 0, 50_000))
        thread.spend(receive, *before)
        clock.begin(0, dispatch_ns)
        lost = draw.choice((0, 9_000, 30_000, 2 * 10**6)), draw.choice((0, 0, 9_000, 10**6))
        thread.spend(draw.randrange(10**6), *lost)
        clock.end(False)
        done = clock.done(0, 0, {})
        wall = done.t_end_ns - done.t_begin_ns
        assert abs(done.preempted_ns - lost[0]) <= LOSS_NS + receive + HELD_NS
        assert 0 <= wall - done.preempted_ns - done.asleep_ns <= done.cpu_ns
        assert abs(done.preempted_before_ns - before[0]) <= HELD_NS
        sum_of_cpu += done.cpu_ns + done.cpu_before_ns
        cpu = thread.cpu
        thread.spend(4_000, 0, 0)
        clock.answered()
    assert sum_of_cpu == cpu


# What a report says of cores.

MS = 1_000_000
PIPELINE = pipeline().with_rule("double")


def a_report() -> dict[str, Any]:
    idle = {"preempted": 0.1}
    return {
        "units": {"left": {"busy": 0.5, "idle": dict(idle)}, "right": {"busy": 0.25, "idle": dict(idle)}},
        "stages": {"mid": {}, "out": {}},
        "duration_s": 0.001,
    }


def test_accounts_that_contradict_themselves_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """`right` has 2.5 ms of CPU time in a run of 1 ms on two cores."""
    monkeypatch.setattr(realtime_clock, "counts_run_delay", lambda: False)
    cpu = CpuTimes({"left": 2, "right": 2})
    cpu.add("right", "mid", Done(0, MS, 2 * MS, 0, 0, 0, 0, 0, 2 * MS, MS // 2, {}), 0)
    report, heard = a_report(), []
    realtime_clock.add_accounts(report, PIPELINE, cpu, RunLog(heard.append))
    right = report["units"]["right"]
    assert (right["cpu_s"], right["cpu_in_jobs_s"], right["idle"]) == (0.0025, 0.002, {"preempted": None})
    assert report["units"]["left"]["idle"] == {"preempted": None}
    assert (report["stages"]["mid"]["cpu_ms"]["mean"], report["stages"]["out"]["cpu_ms"]["samples"]) == (2.0, 0)
    assert [(row["cores"], row["cpu"], row["busy"]) for row in report["core_shares"]] == [
        ((0, 1), 0.0, 0.25),
        ((1, 3), pytest.approx(1.25), 0.125),
        ((0, 1, 3), pytest.approx(2.5 / 3), 0.25),
    ]
    assert heard == ["right had 125.0% of the time of cores (1, 3): please report this", realtime_clock.NO_RUN_DELAY]


def test_a_process_of_one_thread_has_one_that_is_counted() -> None:
    """And nothing of what it waited before counts."""
    program = """
from trilane.pipeline.job_times import CoreMeter, counts_run_delay
meter = CoreMeter()
print(meter.threads, int(counts_run_delay()), meter._born_ns)
meter.close()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    threads, counts, born_ns = map(int, done.stdout.split())
    assert (threads, born_ns) == (counts, 0)
