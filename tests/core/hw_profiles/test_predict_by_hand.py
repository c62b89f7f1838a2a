"""Predictions by hand: a chip of round numbers, whose settled state is given and whose heat is worked out."""

from __future__ import annotations

import copy
import math
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.errors import BadInputError
from trilane.hw_profiles import over_time, predict
from trilane.hw_profiles.application import REFERENCE, Plan, Steady, Variant
from trilane.hw_profiles.governor import ThermalState, Throttle
from trilane.hw_profiles.network_time import Interval
from trilane.hw_profiles.over_time import Moment
from trilane.hw_profiles.profile_files import load_tables, parse_profile
from trilane.hw_profiles.rates import FrameInterval
from trilane.hw_profiles.schema import CORNERS, Profile
from trilane.hw_profiles.unit_times import JobTime
from trilane.units import UNITS

NETWORK: Any = SimpleNamespace(
    facts={"encoder": "e", "norm": "n"},
    height=320,
    width=192,
    channels=12,
    layout="packed",
    work=SimpleNamespace(weights=3_000_000, macs=5_000_000_000),
)
STATED = {
    "thermal.base_power_w": 1.5,
    "application.display_ms": 16.0,
    "application.ema20_half_range_fraction": 0.25,
    "thermal.ambient_c": 20.0,
    "thermal.device_k_per_w": 4.0,
    "thermal.device_time_s": 100.0,
    "thermal.skin_limit_c": 40.0,
    "thermal.junction_limit_c": 90.0,
    "thermal.poll_s": 2.0,
}


def changed(changes: dict[str, float | None]) -> Profile:
    """The chip snapdragon-888 with other numbers; None for an unknown one."""
    data, path = load_tables("snapdragon-888")
    data = copy.deepcopy(data)
    for key, value in changes.items():
        *tables, last = key.split(".")
        table = data
        for name in tables:
            table = table[name]
        table[last] = {"kind": "unknown", "source": "s"} if value is None else {
            "kind": "assumed", "source": "s", "value": value,
        }  # fmt: skip
    return parse_profile(data, path)


def settled(plan: Plan, capped: bool = False) -> Steady:
    """Five stages of 1, 8, 20, 4 and 2 ms; busy 0.1, 0.6 and 0.8."""
    stages = {"pose": 1.0, "raster": 8.0, "infer": 20.0, "composite": 4.0, "present": 2.0}
    units: Any = {"pose": "cpu", "raster": "gpu", "infer": plan.runtime, "composite": "gpu", "present": "cpu"}
    return Steady(
        frame_ms=25.0,
        latency_ms=41.0,
        capped=capped,
        unit_of=units,
        stages_ms=stages,
        busy={"cpu": 0.1, "gpu": 0.6, "dsp": 0.8},
        idle={unit: {"starved": 0.01 * n, "blocked": 0.02} for n, unit in enumerate(UNITS)},
        dropped=0.125,
    )


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Settled states are given; what was asked of the parts."""
    asked: list[Any] = []

    def steady(profile: Profile, plan: Plan, corners: Any, **options: bool) -> Steady:
        asked.append((profile.name, plan, corners, options))
        return settled(plan, capped=len(asked) == 1)

    monkeypatch.setattr(predict, "steady", steady)
    monkeypatch.setattr(over_time, "steady", steady)
    monkeypatch.setattr(predict, "isolated_job_time", lambda *_: JobTime({"fixed": 2.0, "convolution": 16.0}))
    monkeypatch.setattr(predict, "relative_error", lambda job, unit: {18.0: 0.125}[job.total_ms] * (unit is not None))
    monkeypatch.setattr(predict, "price", lambda *_: None)
    monkeypatch.setattr(predict, "interval", lambda *_: AROUND)
    monkeypatch.setattr(predict, "unheld_times", lambda *_: TIMES)
    monkeypatch.setattr(predict, "power_of", lambda *given: list(given))
    return asked


AROUND = Interval(15.0, 22.0, ("it is so",))
#: Held to 16 ms by the display, 20 to 24 ms are left of 12, 20 and 24.
TIMES = FrameInterval(20.0, 12.0, 24.0)


def power_of(profile: Profile, corners: Any) -> dict[str, float]:
    busy = {"cpu": 0.1, "gpu": 0.6, "dsp": 0.8}
    return {unit: profile.units[unit].power_w(corner, busy[unit]) for unit, corner in zip(UNITS, corners, strict=True)}


def test_an_answer_about_the_settled_application(asked: list[Any]) -> None:
    profile = changed(STATED)
    plan = Plan(NETWORK, "dsp", Variant("pipelined", "double", 2, 24.0), 0.25)
    found = predict.predict(profile, plan, "burst")
    corners = tuple(profile.performance_profiles["burst"].corner(unit) for unit in UNITS)
    assert asked == [("snapdragon-888", plan, corners, {})]
    power = sum(power_of(profile, corners).values()) + 1.5
    assert found.pop("power") == [profile, plan, corners, AROUND]
    assert found.pop("power_w") == pytest.approx(power)
    assert found.pop("energy_mj_per_frame") == pytest.approx(25 * power)
    energy = found.pop("xrbench")
    assert energy.keys() == {"energy"}
    assert energy["energy"] == pytest.approx(predict.energy_score(25 * power))
    assert found == {
        "schema": 1,
        "clock": "virtual",
        "machine": {"profile": "snapdragon-888", "title": profile.title},
        "config": {
            "encoder": "e", "norm": "n", "size": "320x192", "channels": 12, "layout": "packed", "runtime": "dsp",
            "policy": "pipelined", "edge": "double", "batch": 2, "fps": 24.0, "gpu_share": 0.25,
            "performance_profile": "burst", "minutes": 0.0, "governor": profile.thermal.governor,
        },
        "network": {
            "parameters_m": 3.0, "gmac": 5.0, "alone_ms": 18.0, "parts_ms": {"fixed": 2.0, "convolution": 16.0},
            "low_ms": 15.0, "high_ms": 22.0, "why": ["it is so"],
        },
        "frame_time_ms": {
            "mean": 25.0, "p50": 25.0, "p90": 25.0, "p95": 25.0, "p99": 25.0, "max": 25.0,
            "ema20_min": 18.75, "ema20_max": 31.25, "low": 20.0, "high": 30.0,
        },
        "latency_ms": {"mean": 41.0},
        "fps": 40.0,
        "fps_start": 40.0,
        "fps_settled": 40.0,
        "display_capped": True,
        "stages": {
            "pose": {"unit": "cpu", "service_ms": {"mean": 1.0}},
            "raster": {"unit": "gpu", "service_ms": {"mean": 8.0}},
            "infer": {"unit": "dsp", "service_ms": {"mean": 20.0}},
            "composite": {"unit": "gpu", "service_ms": {"mean": 4.0}},
            "present": {"unit": "cpu", "service_ms": {"mean": 2.0}},
        },
        "units": {
            "cpu": {"busy": 0.1, "idle": {"starved": 0.0, "blocked": 0.02}},
            "gpu": {"busy": 0.6, "idle": {"starved": 0.01, "blocked": 0.02}},
            "dsp": {"busy": 0.8, "idle": {"starved": 0.02, "blocked": 0.02}},
        },
        "efficiency": 20.0 / 2 / 25.0,
        "base_power_w": 1.5,
        "base_power_kind": "assumed",
        "temperature_c": {},
        "caps": {"throttled_share": 0.0, "first_throttled_s": None},
        "timeline": [],
        "expected_error": 0.125,
        "confidence": 0.875,
        "notes": [],
    }  # fmt: skip


def moment(number: int, frame_ms: float) -> Moment:
    corners: Any = ("max", "turbo", "svs")
    return Moment(2.0 * number, frame_ms, 30.0 + number, 60.0 - number, 3.0 + number, number > 7, corners)


def test_an_answer_about_minutes_is_of_its_moments(asked: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve moments of 20 ms and three of 40: the mean is 24; of the last fifth 40, which is 25 frames a second."""
    words = []
    moments = [moment(number, 20.0 if number <= 12 else 40.0) for number in range(1, 16)]
    monkeypatch.setattr(predict, "over_time", lambda *asked: words.append(asked) or moments)
    profile, plan = changed(STATED), Plan(NETWORK, "gpu")
    found = predict.predict(profile, plan, "burst", 0.5, "power_allocator")
    assert words == [(profile, plan, "burst", 0.5, "power_allocator")] and len(asked) == 1
    assert found["power_w"] == 11.0 and found["energy_mj_per_frame"] == pytest.approx(11 * 24)
    assert found["power"][2] == ("max", "turbo", "svs")
    assert found["frame_time_ms"] == {
        "low": 24 * 16 / 20, "high": 24 * 24 / 20,
        "mean": 24.0, "p50": 20.0, "p90": 40.0, "p95": 40.0, "p99": 40.0, "max": 40.0, "ema20_min": 18.0,
        "ema20_max": 30.0,
    }  # fmt: skip
    assert (found["fps"], found["fps_start"], found["fps_settled"]) == (1000 / 24, 50.0, 25.0)
    assert found["temperature_c"] == {"device_end": 45.0, "device_max": 45.0, "junction_max": 59.0}
    assert found["caps"] == {"throttled_share": 8 / 15, "first_throttled_s": 16.0}
    assert found["config"]["governor"] == "power_allocator" and found["config"]["minutes"] == 0.5
    assert found["timeline"][12] == {
        "t_s": 26.0, "fps": 25.0, "device_c": 43.0, "junction_c": 47.0, "power_w": 16.0,
        "corners": {"cpu": "max", "gpu": "turbo", "dsp": "svs"},
    }  # fmt: skip
    assert len(found["timeline"]) == 15


def test_a_long_timeline_is_thinned_and_few_moments_settle_at_their_last() -> None:
    assert [each["t_s"] for each in over_time.timeline_of([moment(n, 1.0) for n in range(1080)])] == [
        6.0 * n for n in range(360)
    ]
    assert len(over_time.timeline_of([moment(n, 1.0) for n in range(719)])) == 719
    assert over_time.ends_of([moment(1, 10.0), moment(2, 40.0)]) == {"fps_start": 100.0, "fps_settled": 25.0}


def test_percentiles_of_a_hundred_moments() -> None:
    frames = [float(n) for n in range(100, 0, -1)]
    found = predict._frame_times(changed(STATED), 50.5, frames)
    assert [found[key] for key in ("p50", "p90", "p95", "p99", "max")] == [51, 91, 96, 100, 100]
    assert predict.ema_range_ms(changed(STATED), 18.0) == (16.0, 22.5), (
        "no frame is shown before the display's interval"
    )


def test_an_error_as_large_as_the_number_leaves_no_confidence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predict, "relative_error", lambda *_: 1.5)
    profile = changed({})
    assert predict._expected_error(profile, Plan(NETWORK, "dsp"), JobTime({})) == {
        "expected_error": 1.5,
        "confidence": 0,
    }


def test_alternatives_are_answered_row_by_row(asked: list[Any]) -> None:
    rows = predict.what_if(changed({}), NETWORK, "dsp", "burst")
    variants = [
        ("reference application", Variant("pipelined", "single"), 0.0),
        ("one frame at a time", Variant("sequential", "single"), 0.0),
        ("pipelined, two buffers", Variant("pipelined", "double"), 0.0),
        ("pipelined, newest of three buffers", Variant("pipelined", "triple"), 0.0),
        ("newest pose wins", Variant("latest", "double", 1, 1000.0), 0.0),
        ("newest pose wins, newest of three buffers", Variant("latest", "triple", 1, 1000.0), 0.0),
        ("pipelined, batches of 2", Variant("pipelined", "double", 2), 0.0),
        ("pipelined, 5 % of the network on the GPU", Variant("pipelined", "double"), 0.05),
    ]
    assert [each[1] for each in asked] == [Plan(NETWORK, "dsp", variant, share) for _, variant, share in variants]
    assert rows == [
        {"name": name, "policy": variant.policy, "edge": variant.edge, "frame_ms": 25, "fps": 40, "latency_ms": 41}
        for name, variant, _ in variants
    ]
    assert len(predict.what_if(changed({}), NETWORK, "gpu", "burst")) == 7


def test_a_row_of_a_table_has_both_runtimes(asked: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predict, "reference_network", {"a network": NETWORK}.__getitem__)
    rows: Any = [SimpleNamespace(spec="a network", cells={"encoder": "e", "size": "256"})] * 2
    counts: list[int] = []
    profile = changed(STATED)
    found = list(predict.predict_table(profile, rows, "burst", Variant("latest", "triple"), counts.append))
    wanted = {
        "encoder": "e", "size": 256,
        "bench_gpu_ms": 18.0, "app_gpu_ms": 25.0, "app_gpu_ms_min": 18.75, "app_gpu_ms_max": 31.25,
        "expected_error_gpu": 0.125,
        "bench_dsp_ms": 18.0, "app_dsp_ms": 25.0, "app_dsp_ms_min": 18.75, "app_dsp_ms_max": 31.25,
        "expected_error_dsp": 0.125,
        "confidence": 0.875,
    }  # fmt: skip
    assert found == [wanted] * 2 and list(found[0]) == list(wanted) and counts == [1, 2]
    assert [each[1:] for each in asked[:2]] == [
        (Plan(NETWORK, unit, Variant("latest", "triple")), asked[0][2], {"quick": True}) for unit in ("gpu", "dsp")
    ]
    assert predict.predict_table.__defaults__[:2] == ("sustained_high_performance", REFERENCE)  # type: ignore[index]


def test_heat_follows_the_power_from_poll_to_poll(asked: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """A governor that lowers the DSP at the second poll, and looks at every one."""
    profile = changed(STATED)
    seen: list[Any] = []

    def govern(profile: Profile, state: ThermalState, throttle: Throttle, requested: Any, power: Any) -> None:
        seen.append((profile.name, state.device_c, dict(requested), dict(power)))
        if len(seen) == 2:
            throttle.lower("dsp", requested["dsp"])

    monkeypatch.setitem(over_time.GOVERNORS, profile.thermal.governor, govern)
    found = over_time.over_time(profile, Plan(NETWORK, "dsp"), "burst", 0.13)
    device, junction = 20.0, dict.fromkeys(UNITS, 20.0)
    first = profile.performance_profiles["burst"]
    assert len(found) == len(seen) == 4, "round(7.8 s / 2 s)"
    for number, now in enumerate(found):
        corners: Any = [first.corner(unit) for unit in UNITS]
        if number >= 2:
            corners[2] = CORNERS[CORNERS.index(corners[2]) + 1]
        power = power_of(profile, corners)
        goal = 20 + 4 * (sum(power.values()) + 1.5)
        device = goal + (device - goal) * math.exp(-2 / 100)
        for unit in UNITS:
            numbers = profile.units[unit]
            above = device + (numbers.junction_k_per_w.value or 0) * power[unit]
            junction[unit] = above + (junction[unit] - above) * math.exp(-2 / (numbers.junction_time_s.value or 0))
        wanted = (2.0 * (number + 1), 25.0, device, max(junction.values()), sum(power.values()) + 1.5)
        assert (now.t_s, now.frame_ms, now.device_c, now.junction_c, now.power_w) == pytest.approx(wanted)
        assert now.throttled == (number >= 2) and now.corners == tuple(corners)
        assert seen[number][1] == pytest.approx(device) and seen[number][3] == pytest.approx(power)
        assert seen[number][2] == {unit: CORNERS.index(first.corner(unit)) for unit in UNITS}
    assert len(asked) == 2, "each state of the units is settled once"


@pytest.mark.parametrize(
    ("minutes", "governor", "message"),
    [
        (0.0, None, "minutes: found 0, expected above 0, at most 1440"),
        (1440.1, None, "minutes: found 1440.1, expected above 0, at most 1440"),
        (1.0, "ondemand", "governor: found 'ondemand', expected step_wise or power_allocator"),
    ],
)
def test_times_and_governors_that_are_not_known_are_refused(minutes: float, governor: str, message: str) -> None:
    with pytest.raises(BadInputError) as caught:
        over_time.over_time(changed({}), Plan(NETWORK, "dsp"), "burst", minutes, governor)
    assert str(caught.value) == message
