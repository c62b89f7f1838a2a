"""The models and ratios of `bench scheduler` and `bench handoff`, against timelines and figures worked out by hand."""

from __future__ import annotations

import pytest

from trilane.bench import handoff, scheduler
from trilane.scheduler.events import Graph, Settings, chain
from trilane.scheduler.virtual import simulate

SERVICE_NS = {"a": 2, "b": 5, "c": 3}
#: `a` and `c` share the CPU; frames 0, 1, 2 are released at 0, 1, 2.
#: With one slot, frame 1 cannot begin before b0 has given its slot back at 7, and the CPU then does c0 first:
#: a0 0-2, b0 2-7, c0 7-10, a1 10-12, b1 12-17, c1 17-20, a2 20-22, b2 22-27, c2 27-30.
#: With two: a0 0-2, a1 2-4, b0 2-7, b1 7-12, c0 7-10, a2 10-12, c1 12-15, b2 12-17, c2 17-20.
BY_HAND = {"single": [10, 20, 30], "double": [10, 15, 20]}


def graph_with(edge: str) -> Graph:
    return chain((("a", "cpu"), ("b", "gpu"), ("c", "cpu")), edge, "c")


def service(stage: str, _unit: str, _frame: int, _begin_ns: int) -> int:
    return SERVICE_NS[stage]


@pytest.mark.parametrize("edge", BY_HAND)
def test_the_scheduler_presents_at_the_times_worked_out_by_hand(edge: str) -> None:
    done = simulate(graph_with(edge), Settings(3, "pipelined", period_ns=1), service, keep=True)
    assert [job.end_ns for job in done.jobs if job.stage == "c"] == BY_HAND[edge]


@pytest.mark.parametrize("edge", BY_HAND)
@pytest.mark.parametrize("way", [scheduler.SIMPY, scheduler.LEAN])
def test_simpys_models_present_at_the_times_worked_out_by_hand(way: str, edge: str) -> None:
    pytest.importorskip("simpy")
    assert scheduler._models()[way](graph_with(edge), service, 3, 1).run() == BY_HAND[edge]


def test_the_lean_model_takes_one_timeout_for_each_release_and_job() -> None:
    pytest.importorskip("simpy")
    model = scheduler._models()[scheduler.LEAN](graph_with("double"), service, 3, 1)
    assert scheduler._count_events(model.env) == 3 * 4


def test_ratios_are_those_of_the_same_round() -> None:
    """Medians of the seconds would say 2 / 4; round by round it is 0.5, 0.25 and 1."""
    seconds = {"trilane": [2.0, 4.0, 8.0], "simpy lean": [1.0, 1.0, 8.0]}
    result = scheduler.compared(seconds)
    assert result["over_trilane"] == {"simpy lean": {"median": 0.5, "low": 0.25, "high": 1.0}}
    assert result["over_simpy_lean"] == 0.5 and result["over_simpy"] is None


def test_peers_are_set_against_the_run_round_by_round() -> None:
    """Readable: 5 - 3, 9 - 4; read: 7 - 8, 12 - 10. A peer that is ahead in one round alone is not ahead."""
    times: dict[tuple[str, int], list[handoff.Times]] = {
        (handoff.PIPELINE, 256): [([3.0], [8.0]), ([4.0], [10.0])],
        (handoff.SLOT, 256): [([1.0], [6.0]), ([1.0], [6.0])],
        ("peer", 256): [([5.0], [7.0]), ([9.0], [12.0])],
    }
    assert handoff.against_peers(times) == {
        "ahead": {"peer": True},
        "read_ahead": {"peer": False},
        "slower_us": {"peer": {256: (2.0, 5.0)}},
        "read_slower_us": {"peer": {256: (-1.0, 2.0)}},
        "slower_than_slot_us": {"peer": {256: (4.0, 8.0)}},
        "read_slower_than_slot_us": {"peer": {256: (1.0, 6.0)}},
    }


def test_a_percentile_is_given_of_as_many_values_as_it_needs() -> None:
    hundred = [float(value) for value in range(101)]
    assert handoff.over_rounds("p99", [hundred, [value + 2 for value in hundred]], 99) == {
        "p99_us": 100.0,
        "p99_low_us": 99.0,
        "p99_high_us": 101.0,
    }
    assert set(handoff.over_rounds("p99", [hundred, hundred[:99]], 99).values()) == {None}
    assert handoff.over_rounds("p50", [hundred[:3]], 50)["p50_us"] is not None
