"""The models and ratios of `bench scheduler` and `bench handoff`, against timelines and figures worked out by hand."""

from __future__ import annotations

import inspect
from dataclasses import dataclass

import pytest

from trilane.bench import handoff, scheduler
from trilane.scheduler.events import Graph, Settings, chain
from trilane.scheduler.stats import samples_needed
from trilane.scheduler.virtual import simulate


@dataclass(frozen=True)
class Case:
    """Stages `a` and `c` on the CPU, `b` on the GPU, and a frame released every nanosecond from 0 on."""

    edge: str
    service_ns: dict[str, int]
    presented_ns: list[int]

    @property
    def graph(self) -> Graph:
        return chain((("a", "cpu"), ("b", "gpu"), ("c", "cpu")), self.edge, "c")

    def service(self, stage: str, _unit: str, _frame: int, _begin_ns: int) -> int:
        return self.service_ns[stage]


CASES = [
    # Frame 1 cannot begin before b0 has given its slot back at 7, and the CPU then does c0 first:
    # a0 0-2, b0 2-7, c0 7-10, a1 10-12, b1 12-17, c1 17-20, a2 20-22, b2 22-27, c2 27-30.
    Case("single", {"a": 2, "b": 5, "c": 3}, [10, 20, 30]),
    # a0 0-2, a1 2-4, b0 2-7, b1 7-12, c0 7-10, a2 10-12, c1 12-15, b2 12-17, c2 17-20.
    Case("double", {"a": 2, "b": 5, "c": 3}, [10, 15, 20]),
    # At 7 the CPU holds a2 behind c0, so c1, ready at 12, waits for it; at 15 both c1 and a3 could be held next, and c1
    # is the older frame: a0 0-2, a1 2-4, b0 2-7, b1 7-12, c0 7-15, a2 15-17, b2 17-22, c1 17-25, a3 25-27, c2 27-35,
    # b3 27-32, c3 35-43.
    Case("double", {"a": 2, "b": 5, "c": 8}, [15, 25, 35, 43]),
]


@pytest.mark.parametrize("case", CASES)
def test_the_scheduler_presents_at_the_times_worked_out_by_hand(case: Case) -> None:
    settings = Settings(len(case.presented_ns), "pipelined", period_ns=1)
    done = simulate(case.graph, settings, case.service, keep=True)
    assert [job.end_ns for job in done.jobs if job.stage == "c"] == case.presented_ns


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("way", [scheduler.SIMPY, scheduler.LEAN])
def test_simpys_models_present_at_the_times_worked_out_by_hand(way: str, case: Case) -> None:
    pytest.importorskip("simpy")
    model = scheduler._models()[way](case.graph, case.service, len(case.presented_ns), 1)
    assert model.run() == case.presented_ns


def test_the_lean_model_takes_one_timeout_for_each_release_and_job() -> None:
    pytest.importorskip("simpy")
    model = scheduler._models()[scheduler.LEAN](CASES[1].graph, CASES[1].service, 3, 1)
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
    """299 for p99: 1 - 0.99^298 is 0.94997, 1 - 0.99^299 is 0.95047. Of 0 to 300 p99 is 297. Five for p50."""
    values = [float(value) for value in range(301)]
    assert handoff.over_rounds("p99", [values, [value + 2 for value in values]], 99) == {
        "p99_us": 298.0,
        "p99_low_us": 297.0,
        "p99_high_us": 299.0,
    }
    assert None not in handoff.over_rounds("p99", [values, values[:299]], 99).values()
    assert set(handoff.over_rounds("p99", [values, values[:298]], 99).values()) == {None}
    assert handoff.over_rounds("p50", [values[:5]], 50)["p50_us"] is not None
    assert inspect.signature(handoff.measure).parameters["frames"].default >= samples_needed(0.99)
