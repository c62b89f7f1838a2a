"""The governor of a run: duties of a performance profile, temperatures from busy time, throttling with hysteresis."""

from __future__ import annotations

from itertools import pairwise

import pytest

from trilane.errors import BadInputError
from trilane.hw_profiles.application import application_graph
from trilane.hw_profiles.governor import Governor
from trilane.hw_profiles.profile_files import load_runnable
from trilane.hw_profiles.schema import Profile
from trilane.scheduler.events import SetDuty, Settings
from trilane.scheduler.virtual import simulate
from trilane.units import UNITS

S = 1_000_000_000


@pytest.fixture
def phone() -> Profile:
    return load_runnable("snapdragon-888")


def worked(governor: Governor, seconds: int, share: float = 1.0) -> list[tuple[int, SetDuty]]:
    """Ticks each second, every unit busy for `share` of what its duty allows."""
    events = [(0, event) for event in governor.begin(0)]
    busy = dict.fromkeys(UNITS, 0)
    duty = dict.fromkeys(UNITS, 1000)
    for second in range(1, seconds + 1):
        for _, event in events:
            duty[event.unit] = event.permille  # type: ignore[index]
        busy = {unit: busy[unit] + round(share * duty[unit] * S / 1000) for unit in UNITS}
        events += [(second, event) for event in governor.tick(second * S, busy)]
    return events


def test_a_performance_profile_is_its_corners_duty(phone: Profile) -> None:
    requested = {event.unit: event.permille for event in Governor(phone, "power_saver").begin(0)}
    corners = phone.performance_profiles["power_saver"]
    assert requested == {unit: round(1000 * phone.units[unit].clock(getattr(corners, unit))) for unit in UNITS}
    assert Governor(phone, "burst").begin(0) == []


def test_burst_is_throttled_at_the_limit_and_let_go_below_it(phone: Profile) -> None:
    governor = Governor(phone, "burst")
    events = worked(governor, 3600)
    caps, temperatures = governor.report()["caps"], governor.report()["temperature_c"]
    assert 0 < caps["first_throttled_s"] < 3600
    assert temperatures["device_max"] < phone.thermal.skin_limit_c.or_else(0) + 1
    steps = [event.permille for _, event in events if event.unit == "dsp"]
    assert any(after < before for before, after in pairwise([1000, *steps]))
    assert all(0 < row["duty"] <= row["duty_mean"] <= 1 for row in caps["units"].values())


def test_idle_units_stay_cool_and_unthrottled(phone: Profile) -> None:
    governor = Governor(phone, "sustained_high_performance")
    worked(governor, 1800, share=0.05)
    assert governor.report()["caps"]["throttled_share"] == 0
    assert governor.report()["temperature_c"]["device_max"] < phone.thermal.skin_limit_c.or_else(0)


def test_power_is_that_of_the_units_and_of_the_rest(phone: Profile) -> None:
    governor = Governor(phone, "burst")
    assert governor.due_ns == 0  # whoever asks before the run begins
    governor.begin(0)
    assert governor.power_w is None
    governor.tick(S, dict.fromkeys(UNITS, 0))
    rest = phone.thermal.base_power_w.or_else(0)
    assert governor.power_w == pytest.approx(rest + sum(phone.units[unit].idle_w.or_else(0) for unit in UNITS))
    governor.tick(2 * S, dict.fromkeys(UNITS, S))
    full = rest + sum(phone.units[unit].power_max_w.or_else(0) for unit in UNITS)
    assert governor.power_w == pytest.approx((full + rest + sum(phone.units[u].idle_w.or_else(0) for u in UNITS)) / 2)


def test_a_capped_pipeline_is_as_slow_as_its_duty(phone: Profile) -> None:
    events = [(0, event) for event in Governor(phone, "power_saver").begin(0)]
    times = {"pose": 1, "raster": 4, "infer": 10, "composite": 3, "present": 1}
    result = simulate(
        application_graph(), Settings(200), lambda stage, *_: times[stage] * 1_000_000, inputs=events, keep=True
    )
    duty = next(event.permille for _, event in events if event.unit == "dsp") / 1000
    assert result.report["frame_time_ms"]["mean"] == pytest.approx(10 / duty, rel=0.02)
    assert result.report["units"]["dsp"]["idle"]["throttled"] == pytest.approx(1 - duty, abs=0.03)


@pytest.mark.parametrize(("profile", "governor"), [("turbo", None), ("burst", "ondemand")])
def test_names_that_are_not_known_are_refused(phone: Profile, profile: str, governor: str | None) -> None:
    with pytest.raises(BadInputError, match="expected"):
        Governor(phone, profile, governor)


@pytest.mark.parametrize(
    ("name", "prompt"), [("sustained_high_performance", True), ("burst", True), ("balanced", False)]
)
def test_idle_cores_may_sleep_under_the_profiles_that_save_power(phone: Profile, name: str, prompt: bool) -> None:
    assert Governor(phone, name).is_prompt is prompt
