"""Which runs are trusted: each fact at its limit, alone and with the others."""

from __future__ import annotations

from typing import Any

import pytest

from trilane.apps.run.verdict import trust_of
from trilane.machine import Machine
from trilane.pipeline.run_metrics import ProcessorState
from trilane.pipeline.surroundings import processor_of

QUIET = {"clock": "host", "other_programs": 0.004}


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ({}, "quiet machine (other programs 0.4 %)"),
        ({"other_programs": 0.05}, "quiet machine (other programs 5.0 %)"),
        ({"other_programs": 0.0501}, "UNSURE: other programs took 5.0 % of its cores"),
        ({"other_programs": 0.27}, "UNSURE: other programs took 27 % of its cores"),
        ({"other_programs": None}, "UNSURE: nobody knows what other programs took of its cores"),
        ({"other_programs": 0.5, "clock": "virtual"}, "computed in virtual time"),
        ({"temperature_c": {"sensor": 89.9}}, "quiet machine (other programs 0.4 %)"),
        ({"temperature_c": {"sensor": 90.0}}, "UNSURE: the hottest sensor had 90 °C at the end"),
        ({"processor": {"throttles": 0}}, "quiet machine (other programs 0.4 %)"),
        ({"processor": {"throttles": 1}}, "UNSURE: heat slowed its cores down 1 time"),
        ({"processor": {"clock_begin_ghz": 3.0, "clock_end_ghz": 2.71}}, "quiet machine (other programs 0.4 %)"),
        (
            {"processor": {"clock_begin_ghz": 3.0, "clock_end_ghz": 2.5}},
            "UNSURE: the clock of its cores changed from 3.00 to 2.50 GHz",
        ),
        (
            {"processor": {"clock_begin_ghz": 2.5, "clock_end_ghz": 3.0}},
            "UNSURE: the clock of its cores changed from 2.50 to 3.00 GHz",
        ),
        (
            {"other_programs": 0.3, "processor": {"throttles": 4}, "temperature_c": {"sensor": 99.0}},
            "UNSURE: other programs took 30 % of its cores; heat slowed its cores down 4 times; "
            "the hottest sensor had 99 °C at the end",
        ),
    ],
)
def test_each_fact_that_spoils_a_run_is_said(facts: dict[str, Any], said: str) -> None:
    trust = trust_of(QUIET | facts)
    assert trust.said == said
    assert trust.trusted is not said.startswith("UNSURE")


def test_the_processor_is_looked_at_before_and_after(monkeypatch: pytest.MonkeyPatch) -> None:
    facts = iter([(3.0, 5), (2.0, 7)])

    class Here(Machine):
        def __init__(self, clock: float, count: int) -> None:
            self.core_clock_ghz = lambda cores: clock if cores == [1] else None  # type: ignore[method-assign,assignment]
            self.throttles = lambda cores: count if cores == [1] else None  # type: ignore[method-assign,assignment]

    monkeypatch.setattr("trilane.machine.here", Here(*next(facts)))
    state = processor_of([1])
    monkeypatch.setattr("trilane.machine.here", Here(*next(facts)))
    assert state() == ProcessorState(clock_begin_ghz=3.0, clock_end_ghz=2.0, throttles=2)
    assert processor_of([0])() == ProcessorState()
