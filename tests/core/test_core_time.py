"""What a unit worked, waited for its core and slept: against threads of which every nanosecond is known."""

from __future__ import annotations

import random
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from trilane.pipeline import core_meter, job_times
from trilane.pipeline.core_meter import CoreMeter
from trilane.pipeline.core_shares import Lost, lost_in_job, preempted_ns
from trilane.pipeline.cpu_use import CpuTimes, use_of_cores
from trilane.pipeline.job_times import JobClock, JobTimes
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


def test_a_device_works_while_its_unit_sleeps_but_not_while_it_is_preempted() -> None:
    assert lost_in_job(100, 10, 30, 1, has_device=True) == Lost(30, 0)
    assert preempted_ns(100, 10, 30, 1) == 30


@pytest.fixture
def tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in the place of the kernel's, with a thread 7 that has waited for 500 ns."""
    monkeypatch.setattr(core_meter, "TASKS", str(tmp_path))
    monkeypatch.setattr(core_meter, "counts_run_delay", lambda: True)
    waited(tmp_path, 7, 500)
    return tmp_path


def waited(tasks: Path, thread: int, delay_ns: int) -> None:
    (tasks / str(thread)).mkdir(exist_ok=True)
    (tasks / str(thread) / "schedstat").write_text(f"123456 {delay_ns} 9\n")


def test_the_meter_counts_from_its_making_on_and_finds_new_threads(tasks: Path) -> None:
    waited(tasks, 3, 10**9)  # not the unit's
    meter = CoreMeter(others={3})
    assert meter.delay_ns() == 0
    waited(tasks, 7, 750)
    waited(tasks, 3, 2 * 10**9)
    assert meter.delay_ns() == 250
    waited(tasks, 8, 40)
    assert meter.delay_ns() == 0
    meter.look()
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


def done(begin: int, end: int, cpu: int, cpu_before: int) -> Done:
    return Done(0, begin, end, 0, 0, 0, 0, cpu, cpu_before, {})


def test_cpu_time_before_the_run_does_not_count_and_spinning_between_jobs_does() -> None:
    """The run begins at 100. Before the first job the unit had spun 900 ns, of which at most 50 are the run's."""
    times = CpuTimes({"u": 1})
    times.add("u", "a", done(150, 200, 50, 900), 100)
    times.add("u", "b", done(260, 300, 30, 60), 100)
    assert (times.in_jobs_ns["u"], times.between_ns["u"]) == (80, 110)
    assert times.of_unit_s("u") == pytest.approx(190e-9)
    assert dict(times.stage_ns) == {"a": [50], "b": [30]}


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


class ToldMeter:
    """Says what it is told: (CPU time, run delay) of each piece of time, in turn."""

    def __init__(self, *pieces: tuple[int, int]) -> None:
        self._cpu_ns, self._delay_ns = ([piece[index] for piece in pieces] for index in (0, 1))

    def look(self) -> None:
        """There are no threads."""

    def cpu_ns(self) -> int:
        return self._cpu_ns.pop(0)

    def delay_ns(self) -> int:
        return self._delay_ns.pop(0)


def test_a_job_and_the_time_before_it_are_measured_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ready at 1000. To 1400: 100 on the core, 250 without. The job to 2400: 600 on it, 300 without, 100 asleep."""
    instants = iter([1000, 1400, 1400, 2400])
    monkeypatch.setattr(job_times, "time", SimpleNamespace(monotonic_ns=lambda: next(instants)))
    clock = JobClock(ToldMeter((7, 9), (100, 250), (600, 300)), 1)  # type: ignore[arg-type]
    clock.begin()
    assert clock.end(works_asleep=False) == JobTimes(1400, 2400, 300, 100, 250, 600, 100)
