"""Several pipelines on the same hardware, in virtual time: timelines worked out on paper, and rules on drawn ones."""

from __future__ import annotations

import random
from itertools import pairwise
from typing import Any

import pytest

from support import plain_graph_scheduler
from support.plain_scheduler import drawn, service_of, skips_of, with_bypass
from support.second_accounts import largest_difference, second_accounts
from trilane.scheduler.events import NEVER, Abort, Graph, Input, SetDuty, Settings, StageSpec, Stop, chain
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.recording import replay
from trilane.scheduler.shared_units import ONE, TURNS, BesideDriver, Member, Runs, Waiting, simulate_beside
from trilane.scheduler.virtual import Simulation, simulate
from trilane.unexpected_value import UnexpectedValue

MS = 1_000_000
ALONE = chain([("infer", "dsp")], "double", "infer")
TWO = chain([("draw", "gpu"), ("infer", "dsp")], "double", "infer")


def member(graph: Any, settings: Settings, **ms: float) -> Member:
    """Jobs of each stage take the milliseconds that stand beside its name."""
    times = {stage: round(each * MS) for stage, each in ms.items()}
    return Member(graph, settings, lambda stage, *_: times[stage])


def rows(jobs: Any, unit: str = "dsp") -> list[tuple[int, float, float]]:
    """Frame, begin and end in ms of the jobs of a unit."""
    return [(job.frame, job.begin_ns / MS, job.end_ns / MS) for job in jobs if job.unit == unit]


def shares_ms(report: Any, unit: str) -> dict[str, float]:
    """The time of a unit in ms, without what is zero."""
    row = report["units"][unit]
    total = report["duration_s"] * 1e3
    parts = {"busy": row["busy"], **row["idle"]}
    return {name: round(share * total, 6) for name, share in parts.items() if round(share * total, 6)}


def test_two_pipelines_take_turns_on_a_unit() -> None:
    """A: three jobs of 3 ms; B: three of 5 ms, all there from the first: A B A B A B, each waits for the other."""
    a, b = simulate_beside([member(ALONE, Settings(3), infer=3), member(ALONE, Settings(3), infer=5)], keep=True)
    assert rows(a.jobs) == [(0, 0, 3), (1, 8, 11), (2, 16, 19)]
    assert rows(b.jobs) == [(0, 3, 8), (1, 11, 16), (2, 19, 24)]
    assert shares_ms(a.report, "dsp") == {"busy": 9, "preempted": 10}
    assert shares_ms(b.report, "dsp") == {"busy": 15, "preempted": 9}
    assert (a.report["duration_s"], b.report["duration_s"]) == (0.019, 0.024)


def test_three_pipelines_take_turns_whoever_hands_out_first() -> None:
    """C comes at 1 ms, B at 2 ms, while A's first job runs: in turn it is B, then C, then A."""
    late = [Settings(1, arrivals_ns=(at * MS,)) for at in (2, 1)]
    each = [member(ALONE, Settings(2), infer=3), *(member(ALONE, settings, infer=4) for settings in late)]
    a, b, c = simulate_beside(each, keep=True)
    assert rows(a.jobs) == [(0, 0, 3), (1, 11, 14)]
    assert rows(b.jobs) == [(0, 3, 7)]
    assert rows(c.jobs) == [(0, 7, 11)]
    assert shares_ms(c.report, "dsp") == {"busy": 4, "starved": 1, "preempted": 6}


def test_all_that_is_ready_in_one_instant_counts_whoever_is_told_first() -> None:
    """At 6 ms A's second job ends and B's frame is released: A had the unit last, so B has it now."""
    a, b = simulate_beside(
        [member(ALONE, Settings(3), infer=3), member(ALONE, Settings(1, arrivals_ns=(6 * MS,)), infer=1)], keep=True
    )
    assert rows(a.jobs) == [(0, 0, 3), (1, 3, 6), (2, 7, 10)]
    assert rows(b.jobs) == [(0, 6, 7)]


def test_the_earliest_deadline_goes_first_and_what_has_none_last() -> None:
    """Frames at 0, 10, 20 of A (due in 30) and B (due in 8), C has no deadline: B A C at first, then B before A."""
    paced = [Settings(2, period_ns=10 * MS, deadline_ns=due * MS) for due in (30, 8)]
    each = [member(ALONE, paced[0], infer=3), member(ALONE, paced[1], infer=2), member(ALONE, Settings(3), infer=4)]
    a, b, c = simulate_beside(each, turns="deadline", keep=True)
    assert rows(b.jobs) == [(0, 0, 2), (1, 13, 15)]
    assert rows(a.jobs) == [(0, 2, 5), (1, 15, 18)]
    assert rows(c.jobs) == [(0, 5, 9), (1, 9, 13), (2, 18, 22)]
    assert (a.report["deadline_misses"], b.report["deadline_misses"]) == (0, 0)


def test_of_equal_deadlines_the_next_in_turn_goes_first() -> None:
    """Both release at 0 and 10 ms, due 10 ms later. B had the unit last at 10, so A begins again."""
    paced = Settings(2, period_ns=10 * MS, deadline_ns=10 * MS)
    a, b = simulate_beside([member(ALONE, paced, infer=3)] * 2, turns="deadline", keep=True)
    assert rows(a.jobs) == [(0, 0, 3), (1, 10, 13)]
    assert rows(b.jobs) == [(0, 3, 6), (1, 13, 16)]


def test_a_pipeline_of_two_stages_beside_a_network_at_a_rate() -> None:
    """A draws (2 ms, its own gpu) and infers (4 ms); N infers every 10 ms for 5 ms on the same dsp.

    dsp: N0 0-5, A0 5-9 (drawn at 2), A1 9-13 (drawn at 4; N has no job), N1 13-18 (released at 10), A2 18-22.
    The gpu draws 0 and 1 into the two slots; 2 once 0 was inferred (9-11), 3 is not there.
    """
    a, n = simulate_beside(
        [member(TWO, Settings(3), draw=2, infer=4), member(ALONE, Settings(2, period_ns=10 * MS), infer=5)], keep=True
    )
    assert rows(a.jobs, "gpu") == [(0, 0, 2), (1, 2, 4), (2, 9, 11)]
    assert rows(a.jobs) == [(0, 5, 9), (1, 9, 13), (2, 18, 22)]
    assert rows(n.jobs) == [(0, 0, 5), (1, 13, 18)]
    assert shares_ms(a.report, "dsp") == {"busy": 12, "starved": 2, "preempted": 8}
    assert shares_ms(a.report, "gpu") == {"busy": 6, "blocked": 5, "starved": 11}
    assert shares_ms(n.report, "dsp") == {"busy": 10, "starved": 5, "preempted": 3}


def test_jobs_of_a_divided_seat_each_have_an_equal_share() -> None:
    """A has 3 ms and B 5 ms of work on one core: A ends at 6, B at 8."""
    a, b = simulate_beside(
        [member(ALONE, Settings(1), infer=3), member(ALONE, Settings(1), infer=5)], divided=["dsp"], keep=True
    )
    assert (rows(a.jobs), rows(b.jobs)) == ([(0, 0, 6)], [(0, 0, 8)])
    assert shares_ms(a.report, "dsp") == {"busy": 3, "preempted": 3}
    assert shares_ms(b.report, "dsp") == {"busy": 5, "preempted": 3}


def test_units_of_one_pipeline_divide_a_core_too() -> None:
    """draw (2 ms) and infer (3 ms) on one core: draw 0 0-2; then infer 0 and draw 1 share it until 6; infer 1 alone.

    From 2 to 6 both have had 2 ms, so draw 1 is done, infer 0 has 1 ms left and ends at 7; infer 1 7-10.
    """
    seats = {"gpu": "core 0", "dsp": "core 0"}
    times = {"draw": 2 * MS, "infer": 3 * MS}
    one = Member(TWO, Settings(2), lambda stage, *_: times[stage], seats)
    (done,) = simulate_beside([one], divided=["core 0"], keep=True)
    assert rows(done.jobs, "gpu") == [(0, 0, 2), (1, 2, 6)]
    assert rows(done.jobs) == [(0, 2, 7), (1, 7, 10)]
    assert shares_ms(done.report, "gpu") == {"busy": 4, "preempted": 2, "starved": 4}


def test_of_one_pipelines_jobs_on_a_seat_the_first_handed_out_goes_first() -> None:
    """A draws (2 ms) and shows (1 ms) on core 0, and infers (3 ms) elsewhere. B has core 0 from 2 to 12.

    Meanwhile A has handed out draw 1, at 2, then show 0, at 5, and so they follow. Infer 1 is done at 17.
    """
    graph = chain([("draw", "gpu"), ("infer", "dsp"), ("show", "cpu")], "double", "infer")
    times = {"draw": 2 * MS, "infer": 3 * MS, "show": MS}
    core = {"gpu": "core 0", "cpu": "core 0"}
    one = Member(graph, Settings(2), lambda stage, *_: times[stage], core)
    other = Member(ALONE, Settings(1), lambda *_: 10 * MS, {"dsp": "core 0"})
    a, b = simulate_beside([one, other], keep=True)
    assert rows(b.jobs) == [(0, 2, 12)]
    assert rows(a.jobs, "gpu") == [(0, 0, 2), (1, 12, 14)]
    assert rows(a.jobs) == [(0, 2, 5), (1, 14, 17)]
    assert rows(a.jobs, "cpu") == [(0, 14, 15), (1, 17, 18)]


def test_a_job_is_slower_only_while_what_slows_it_runs() -> None:
    """A: 4 ms on the dsp; B: 3 ms on the gpu, at half A's speed: 1.5 ms of A are done by 3, the rest alone until 5.5.

    It is busy all that time."""
    other = chain([("infer", "gpu")], "double", "infer")

    def speed(job: Runs, others: Any) -> int:
        return ONE // 2 if job.unit == "dsp" and others else ONE

    a, b = simulate_beside(
        [member(ALONE, Settings(1), infer=4), member(other, Settings(1), infer=3)], speed=speed, keep=True
    )
    assert (rows(a.jobs), rows(b.jobs, "gpu")) == ([(0, 0, 5.5)], [(0, 0, 3)])
    assert shares_ms(a.report, "dsp") == {"busy": 5.5}


def test_a_stop_ends_each_pipeline_with_its_frames_in_flight() -> None:
    """Stopped at 7 ms of endless frames: what each has in hand by then is done. A was handed job 2 at 3, B at 6 ms."""
    stop = ((7 * MS, Stop()),)
    times = {"infer": 3 * MS}
    each = [Member(ALONE, Settings(1000), lambda stage, *_: times[stage], inputs=stop) for _ in range(2)]
    a, b = simulate_beside(each, keep=True)
    assert rows(a.jobs) == [(0, 0, 3), (1, 6, 9), (2, 12, 15)]
    assert rows(b.jobs) == [(0, 3, 6), (1, 9, 12), (2, 15, 18)]
    assert a.report["frames"]["requested"] == 3


def test_an_abort_takes_the_waiting_jobs_of_its_pipeline_off_the_seat() -> None:
    """A waits from 0 with one job in the seat's line and is aborted at 2 ms; B goes on as if A were not there."""
    times = {"infer": 3 * MS}
    a = Member(ALONE, Settings(9), lambda stage, *_: times[stage], inputs=((2 * MS, Abort()),))
    done = simulate_beside([a, member(ALONE, Settings(3), infer=5)], turns="deadline", keep=True)
    assert rows(done[1].jobs) == [(0, 3, 8), (1, 8, 13), (2, 13, 18)]


def test_a_frame_that_was_dropped_while_it_waited_for_a_seat_keeps_its_deadline() -> None:
    """c holds each frame past its deadline while b waits for the seat that the second pipeline takes, 20 ms a job."""
    fork = [("a", ()), ("b", ("a",)), ("c", ("a",)), ("d", ("b", "c"))]
    stages = tuple(StageSpec(name, f"unit_{name}", tuple(map(Input, read))) for name, read in fork)
    paced = Settings(40, "deadline", period_ns=8 * MS, deadline_ns=35 * MS)
    times = {"a": 2 * MS, "b": 8 * MS, "c": 25 * MS, "d": MS}
    a = Member(Graph(stages, ("double",) * 3, "d"), paced, lambda stage, *_: times[stage], {"unit_b": "dsp"})
    done = simulate_beside([a, member(ALONE, Settings(40), infer=20)], turns="deadline", keep=True)
    check_accounts(done)
    assert done[0].report["frames"]["dropped"]


@pytest.mark.parametrize("name", TURNS)
def test_each_rule_of_turns_takes_one_of_those_that_wait(name: str) -> None:
    waiting = [Waiting(2, 30, 1), Waiting(0, NEVER, 2), Waiting(1, 20, 3)]
    assert min(waiting, key=TURNS[name]) == waiting[1 if name == "round-robin" else 2]


def test_unknown_turns_are_refused() -> None:
    with pytest.raises(UnexpectedValue, match="lottery"):
        BesideDriver([member(ALONE, Settings(1), infer=1)], turns="lottery")


def test_a_job_longer_than_its_core_waits_for_one_is_a_defect_of_the_caller() -> None:
    with pytest.raises(RuntimeError, match="hang_ns"):
        simulate_beside([member(ALONE, Settings(1, hang_ns=MS), infer=3)])


def member_of(seed: int, *, bypassed: bool) -> Member:
    """A drawn pipeline; no faults."""
    graph, settings, _, _, duties = drawn(seed)
    graph = with_bypass(seed, graph) if bypassed else graph
    inputs = tuple((0, SetDuty(name, duty)) for name, duty in duties.items())
    return Member(graph, settings, service_of(seed), skips=skips_of(seed), inputs=inputs)


@pytest.mark.parametrize("bypassed", [False, True])
@pytest.mark.parametrize("seed", range(16))
def test_one_pipeline_alone_does_what_it_does_without_the_others_driver(seed: int, bypassed: bool) -> None:
    one = member_of(seed, bypassed=bypassed)
    (beside,) = simulate_beside([one], keep=True)
    alone = simulate(one.graph, one.settings, one.service, skips=one.skips, inputs=one.inputs, keep=True)
    assert beside.recording is not None
    assert alone.recording is not None
    assert beside.jobs == alone.jobs
    assert beside.report["units"] == alone.report["units"]
    assert beside.report["frame_time_ms"] == alone.report["frame_time_ms"]
    assert beside.report["frames"]["dropped"] == alone.report["frames"]["dropped"]


@pytest.mark.parametrize("turns", TURNS)
@pytest.mark.parametrize("seed", range(12))
def test_the_accounts_and_the_turns_of_drawn_pipelines_hold(seed: int, turns: str) -> None:
    draw = random.Random(seed)
    members = [member_of(1000 * seed + number, bypassed=draw.random() < 0.5) for number in range(draw.randint(2, 4))]
    done = simulate_beside(members, turns=turns, keep=True)
    check_accounts(done)
    for unit in ("cpu", "gpu", "dsp"):
        jobs = sorted(
            ((job, number) for number, each in enumerate(done) for job in each.jobs if job.unit == unit),
            key=lambda pair: (pair[0].begin_ns, pair[0].end_ns),
        )
        check_unit(jobs)
        if turns == "round-robin":
            check_turns(jobs)


@pytest.mark.parametrize("turns", TURNS)
@pytest.mark.parametrize("seed", range(12))
def test_the_accounts_of_drawn_graphs_on_shared_seats_hold(seed: int, turns: str) -> None:
    members = []
    for number in range(3):
        graph, settings, *_ = plain_graph_scheduler.drawn(3 * seed + number, yields=True)
        members.append(Member(graph, settings, service_of(seed), dict.fromkeys(graph.units, "dsp")))
    check_accounts(simulate_beside(members, turns=turns, keep=True))


def check_accounts(done: list[Simulation]) -> None:
    """Each recording gives the same run again, and each unit's shares add up to 1 and to the second accounts."""
    for each in done:
        assert each.recording is not None
        assert list(replay(each.recording)) == []
        assert largest_difference(each.report["units"], second_accounts(each.recording, each.jobs)) < 1e-12
        for row in each.report["units"].values():
            assert row["busy"] + sum(row["idle"].values()) == pytest.approx(1, abs=1e-12)
            assert min(row["idle"].values()) >= 0


def check_unit(jobs: list[tuple[JobRecord, int]]) -> None:
    """One job at a time; and the unit is never idle while a job waits for it."""
    for (before, _), (after, _) in pairwise(jobs):
        assert after.begin_ns >= before.end_ns
    ends = {job.end_ns for job, _ in jobs}
    assert all(job.begin_ns in ends for job, _ in jobs if job.preempted_before_ns)


def check_turns(jobs: list[tuple[JobRecord, int]]) -> None:
    """No pipeline has the unit twice while one job of another waits all that time."""
    for place, (job, number) in enumerate(jobs):
        since_ns = job.begin_ns - job.preempted_before_ns
        passed = [other for each, other in jobs[:place] if each.begin_ns > since_ns and other != number]
        assert len(passed) == len(set(passed)), (job, passed)


def test_a_driver_in_which_nothing_can_happen_says_so() -> None:
    """Units that never begin: their first events are taken away."""
    driver = BesideDriver([member(ALONE, Settings(1), infer=3)])
    driver._heap.clear()
    with pytest.raises(RuntimeError, match=r"^the simulation stands still: no event and no deadline is left$"):
        driver.run()
