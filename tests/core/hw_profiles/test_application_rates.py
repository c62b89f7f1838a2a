"""The application at a rate, by hand: what holds it, what it needs when nothing does, and a row of the comparison."""

from __future__ import annotations

from typing import Any

import pytest

from trilane.hw_profiles import predict
from trilane.hw_profiles.application import REFERENCE, Plan, Variant, stage_times_ms, steady
from trilane.hw_profiles.network_time import Interval
from trilane.hw_profiles.predict import (
    around_frame,
    at_rate,
    every_variant,
    held_to,
    least_ms,
    load_of,
    unheld_times,
)
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.rates import FrameInterval, Wanted, device_power
from trilane.hw_profiles.reference_networks import NetworkSpec, reference_network
from trilane.hw_profiles.schema import corners_of
from trilane.scheduler.policy import POLICIES
from trilane.transport.slots import EDGES

PROFILE = load_profile("snapdragon-888")
CORNERS = corners_of(PROFILE, "burst")
NETWORK = reference_network(NetworkSpec("mobilenetv2", "batch", 256, 256, 16))
PLAN = Plan(NETWORK, "dsp")
PACED = Plan(NETWORK, "dsp", Variant("latest", "double"))


def test_a_policy_that_releases_frames_has_the_rate_itself() -> None:
    assert held_to(PLAN, None) == PLAN and held_to(PACED, None) == PACED
    assert held_to(PLAN, 24.0) == Plan(NETWORK, "dsp", REFERENCE, most_fps=24.0)
    assert held_to(PACED, 24.0) == Plan(NETWORK, "dsp", Variant("latest", "double", fps=24.0))


@pytest.mark.parametrize("plan", [PLAN, PACED, Plan(NETWORK, "dsp", Variant("pipelined", "double"))])
def test_a_held_application_has_the_rate_and_works_less(plan: Plan) -> None:
    """Twenty frames a second: each unit works for its stages, twenty times a second."""
    held = steady(PROFILE, held_to(plan, 20.0), CORNERS)
    assert held.frame_ms == pytest.approx(50.0, rel=2e-3)
    times = stage_times_ms(PROFILE, plan, CORNERS)
    for unit in ("gpu", "dsp"):
        work = sum(ms for (_, other), ms in times.items() if other == unit)
        assert held.busy[unit] == pytest.approx(work / 50, rel=0.02)


def test_what_a_frame_needs_when_nothing_holds_it() -> None:
    """In the reference application raster, network and composite follow each other, whatever the display does."""
    times = stage_times_ms(PROFILE, PLAN, CORNERS)
    others = sum(ms for (stage, _), ms in times.items() if stage in ("raster", "composite"))
    handover = PROFILE.application.handover_ms.or_else(0)
    network = times["infer", "dsp"] - handover
    around = Interval(0.5 * network, 5 * network, ())
    found = unheld_times(PROFILE, held_to(PLAN, 5.0), CORNERS, around, network)
    assert found == pytest.approx([others + handover + factor * network for factor in (1, 0.5, 5)], rel=0.01)
    assert found.ms < (PROFILE.application.display_ms.value or 0) < found.high_ms


@pytest.mark.parametrize(
    ("frame", "least", "low", "high"),
    [
        (30.0, 16.0, 20.0, 45.0),  # nothing holds it
        (33.3, 33.3, 33.3, 45.0),  # held, but not at the slow end
        (50.0, 50.0, 50.0, 50.0),  # held in any case
        (60.0, 16.0, 40.0, 90.0),  # a mean over minutes, hot: the same factors
    ],
)
def test_the_interval_of_a_frame(frame: float, least: float, low: float, high: float) -> None:
    found = around_frame(frame, FrameInterval(30.0, 20.0, 45.0), least)
    assert found == pytest.approx({"low": low, "high": high})


def test_the_least_time_between_frames() -> None:
    display = PROFILE.application.display_ms.value
    assert least_ms(PROFILE, PLAN) == least_ms(PROFILE, held_to(PLAN, 500.0)) == display
    assert least_ms(PROFILE, held_to(PLAN, 20.0)) == least_ms(PROFILE, held_to(PACED, 20.0)) == 50.0


def test_the_load_is_that_of_the_stages() -> None:
    """Two frames a job: the times of a job, divided. The display bounds the rate, a wanted rate does not."""
    plan = Plan(NETWORK, "dsp", Variant("pipelined", "double", 2))
    load, times = load_of(PROFILE, held_to(plan, 5.0)), stage_times_ms(PROFILE, plan, CORNERS)
    assert load.work_ms(CORNERS)["dsp"] == times["infer", "dsp"] / 2
    assert load.work_ms(CORNERS)["gpu"] == pytest.approx((times["raster", "gpu"] + times["composite", "gpu"]) / 2)
    assert load.frame_ms(CORNERS) == pytest.approx(PROFILE.application.display_ms.value or 0)


def test_every_policy_with_every_edge_is_compared_once() -> None:
    variants = list(every_variant())
    assert variants[0] == REFERENCE
    assert sorted(v[:2] for v in variants) == sorted((policy, edge) for policy in POLICIES for edge in EDGES)


@pytest.mark.parametrize(("frame_ms", "holds"), [(40.0, True), (40.05, True), (40.2, False)])
def test_a_row_of_the_comparison(frame_ms: float, holds: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """At 25 frames a second, two thousandths may be missing."""
    asked: list[Any] = []
    now = steady(PROFILE, PLAN, CORNERS)
    told = type(now)(**{**vars(now), "frame_ms": frame_ms, "latency_ms": 70.0, "dropped": 0.25})
    monkeypatch.setattr(predict, "steady", lambda *given: asked.append(given) or told)
    row = at_rate(PROFILE, PACED, CORNERS, 25.0)
    assert asked == [(PROFILE, held_to(PACED, 25.0), CORNERS)]
    power = row.pop("power_w")
    assert power == pytest.approx(device_power(PROFILE, now.busy, CORNERS, {}).w)
    assert row == {
        **{"name": "latest, double", "policy": "latest", "edge": "double", "frame_ms": frame_ms},
        **{"fps": 1e3 / frame_ms, "latency_ms": 70.0, "holds": holds, "dropped": 0.25},
    }
    assert at_rate(PROFILE, PLAN, CORNERS, 25.0)["name"] == "reference application"


def test_an_answer_at_a_rate_and_within_a_power() -> None:
    """Held to 20 frames a second; 1.75 W leave less than what the display would show, at lower corners."""
    found = predict.predict(PROFILE, PLAN, "burst", wanted=Wanted(20.0, 1.75))
    assert found.fps == pytest.approx(20.0, rel=2e-3) and found.config.fps == 20.0
    assert found.rate and found.rate.holds and found.rate.fps == 20.0
    free = predict.predict(PROFILE, PLAN, "burst")
    assert found.power_w < free.power_w and free.config.fps == 30.0
    assert found.power.w == pytest.approx(found.power_w) and free.rate is None
    limit = found.power_limit
    assert limit.idle_w < limit.power_w <= 1.75 and limit.limited_by == "power"
    assert limit.corners["dsp"] != CORNERS[2]
    assert 0 < limit.fps < free.fps
