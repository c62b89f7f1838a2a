"""Predictions: the application in virtual time, heat over minutes, tables, and what limits them."""

from __future__ import annotations

import copy
import math
from collections import Counter
from dataclasses import astuple
from itertools import pairwise
from pathlib import Path
from statistics import fmean as mean_of
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.errors import BadInputError
from trilane.hw_profiles import governor as governor_module
from trilane.hw_profiles import host_model
from trilane.hw_profiles.application import (
    MOST_FPS,
    REFERENCE,
    Plan,
    Variant,
    reference_frame_ms,
    stage_times_ms,
    steady,
)
from trilane.hw_profiles.governor import GOVERNORS, ThermalState, Throttle, over_time
from trilane.hw_profiles.host_model import on_cores, place_units
from trilane.hw_profiles.predict import _frame_times, ema_range_ms, predict, predict_table, what_if
from trilane.hw_profiles.profile_files import load_profile, load_tables, parse_profile
from trilane.hw_profiles.reference_networks import NetworkSpec, read_table, reference_network
from trilane.hw_profiles.schema import CORNERS, Profile, corners_of
from trilane.scheduler.placement import CpuCore, Place
from trilane.units import UNITS, UnitName

NETWORK = reference_network(NetworkSpec("resnet18", "batch", 512, 512, 16))
SUSTAINED, BURST = "sustained_high_performance", "burst"
RUNTIMES: tuple[UnitName, ...] = ("gpu", "dsp")


@pytest.mark.parametrize("runtime", RUNTIMES)
@pytest.mark.parametrize("side", [128, 256, 512, 1024])
@pytest.mark.parametrize("layout", ["packed", "split"])
def test_the_closed_form_of_the_fit_is_what_the_scheduler_does(runtime: UnitName, side: int, layout: str) -> None:
    profile = load_profile("snapdragon-888")
    plan, corners = (
        Plan(reference_network(NetworkSpec("resnet18", "batch", side, side, 8, layout)), runtime),
        corners_of(profile, SUSTAINED),
    )
    expected = reference_frame_ms(profile, plan, corners)
    assert steady(profile, plan, corners).frame_ms == pytest.approx(expected, rel=0.002)
    assert steady(profile, plan, corners, quick=True).frame_ms == pytest.approx(expected, rel=0.002)


@pytest.mark.parametrize("policy", ["sequential", "pipelined", "latest", "deadline"])
@pytest.mark.parametrize("edge", ["single", "fifo:3"])
def test_every_way_of_working_runs_and_accounts_for_its_time(policy: str, edge: str) -> None:
    profile = load_profile("snapdragon-888")
    now = steady(profile, Plan(NETWORK, "dsp", Variant(policy, edge)), corners_of(profile, SUSTAINED))
    assert now.frame_ms >= max(now.stages_ms.values()) - 1e-6
    for unit in UNITS:
        assert now.busy[unit] + sum(now.idle[unit].values()) == pytest.approx(1.0)


def test_no_frame_in_time_has_no_latency_rather_than_the_least_one() -> None:
    """A deadline is three periods after the release, so no frame is in time where the network alone takes longer."""
    profile = load_profile("snapdragon-888")
    corners = corners_of(profile, SUSTAINED)
    network = reference_network(NetworkSpec("resnet18", "batch", 1024, 1024, 16))
    network_ms = steady(profile, Plan(network, "dsp"), corners).stages_ms["infer"]
    for periods, is_any in ((1.5, True), (3.5, False)):  # periods of a frame that the network takes
        now = steady(
            profile, Plan(network, "dsp", Variant("deadline", "double", fps=periods * 1e3 / network_ms)), corners
        )
        assert (now.latency_ms is not None, now.dropped < 1) == (is_any, is_any)
    assert now.frame_ms == pytest.approx(network_ms)


def test_the_display_caps_what_is_fast() -> None:
    profile = load_profile("snapdragon-888")
    now = steady(
        profile,
        Plan(reference_network(NetworkSpec("resnet18", "batch", 256, 256, 8)), "dsp"),
        corners_of(profile, SUSTAINED),
    )
    assert now.capped
    assert now.frame_ms == pytest.approx(16.6)


def test_the_network_on_the_gpu_shares_it_with_drawing() -> None:
    profile = load_profile("snapdragon-888")
    corners = corners_of(profile, SUSTAINED)
    times = stage_times_ms(profile, Plan(NETWORK, "gpu"), corners)
    together = sum(ms for (_, unit), ms in times.items() if unit == "gpu")
    assert steady(profile, Plan(NETWORK, "gpu", Variant("pipelined", "double")), corners).frame_ms == pytest.approx(
        together, rel=0.01
    )


@pytest.mark.parametrize("runtime", RUNTIMES)
@pytest.mark.parametrize("governor", GOVERNORS)
@pytest.mark.parametrize("side", [256, 512, 1024])
def test_sustained_holds_its_rate_for_half_an_hour(runtime: UnitName, governor: str, side: int) -> None:
    profile = load_profile("snapdragon-888")
    moments = over_time(
        profile,
        Plan(reference_network(NetworkSpec("resnet18", "batch", side, side, 16)), runtime),
        SUSTAINED,
        30,
        governor,
    )
    frames = [m.frame_ms for m in moments if m.t_s >= 60]
    assert max(frames) <= 1.02 * min(frames)
    assert max(max(m.device_c, m.junction_c) for m in moments) <= 55


@pytest.mark.parametrize("runtime", RUNTIMES)
@pytest.mark.parametrize("governor", GOVERNORS)
def test_burst_is_faster_first_and_throttled_later(runtime: UnitName, governor: str) -> None:
    profile, plan = load_profile("snapdragon-888"), Plan(NETWORK, runtime)
    burst, sustained = (over_time(profile, plan, name, 30, governor) for name in (BURST, SUSTAINED))
    assert burst[0].frame_ms < 0.95 * sustained[0].frame_ms
    assert burst[-1].frame_ms > 1.05 * burst[0].frame_ms
    assert burst[-1].throttled
    assert max(m.device_c for m in burst) <= profile.thermal.skin_limit_c.or_else(0) + 1


def test_throttling_has_hysteresis() -> None:
    """Corners change a handful of times in half an hour, not at every poll."""
    moments = over_time(load_profile("snapdragon-888"), Plan(NETWORK, "gpu"), BURST, 30)
    changes = sum(a.corners != b.corners for a, b in pairwise(moments))
    assert 1 <= changes <= 20


def test_a_table_keeps_its_columns_and_answers_every_row(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    lines = ["# a comment", "encoder,norm,params_m,size,channels,layout,mine"]
    for encoder in ("resnet18", "mobilenetv2", "mobilenetv3", "efficientnet-lite0"):
        lines += [f"{encoder},{norm},6.6,{size},16,packed,x" for norm in ("batch", "instance") for size in (256, "640")]
    path.write_text("\n".join([*lines, "resnet18,group,,384x192,8,split,"]) + "\n")
    rows = list(predict_table(load_profile("snapdragon-888"), read_table(path)))
    assert len(rows) == 17
    assert rows[0] | {"encoder": "resnet18", "size": 256, "channels": 16, "mine": "x", "params_m": "6.6"} == rows[0]
    for row in rows:
        for runtime in RUNTIMES:
            assert row[f"app_{runtime}_ms"] >= row[f"bench_{runtime}_ms"] > 0
            assert row[f"app_{runtime}_ms_min"] <= row[f"app_{runtime}_ms"] <= row[f"app_{runtime}_ms_max"]
        assert 0 < row["confidence"] < 1


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"variant": Variant(policy="best")}, "best"),
        ({"variant": Variant(batch=0)}, "batch"),
        ({"gpu_share": 1.0}, "gpu-share"),
        ({"gpu_share": 0.5, "unit": "gpu"}, "gpu-share"),
        ({"unit": "cpu"}, "cpu"),
    ],
)
def test_a_plan_out_of_range_is_refused(change: dict[str, object], word: str) -> None:
    with pytest.raises(BadInputError, match=word):
        Plan(**{"network": NETWORK, "unit": "dsp", **change})  # type: ignore[arg-type]


def test_unknown_names_are_refused() -> None:
    profile, plan = load_profile("snapdragon-888"), Plan(NETWORK, "dsp")
    with pytest.raises(BadInputError, match="warp"):
        predict(profile, plan, "warp")
    with pytest.raises(BadInputError, match="magic"):
        predict(profile, plan, minutes=1, governor="magic")
    with pytest.raises(BadInputError, match="minutes"):
        predict(profile, plan, minutes=-1)
    with pytest.raises(BadInputError, match="edge"):
        predict(profile, Plan(NETWORK, "dsp", Variant(edge="quadruple")))


def test_every_alternative_is_what_predict_says_of_the_same_policy_and_edge() -> None:
    """At the display's rate: the scene's is so high that the display decides."""
    profile = load_profile("snapdragon-888")
    for row in what_if(profile, NETWORK, "dsp", SUSTAINED)[:-2]:  # the last two have batches and a share of the GPU
        alone = predict(profile, Plan(NETWORK, "dsp", Variant(row["policy"], row["edge"], fps=MOST_FPS)), SUSTAINED)
        means = {"frame_ms": alone.frame_time_ms.mean, "latency_ms": alone.latency_ms.mean}
        assert {key: row[key] for key in means} == pytest.approx(means), row["name"]


def test_half_an_hour_says_where_it_begins_and_where_it_settles() -> None:
    """Under burst the mean of 30 minutes is neither: it lies between the first moment's rate and the last fifth's."""
    profile, plan = load_profile("snapdragon-888"), Plan(NETWORK, "dsp")
    answer, moments = predict(profile, plan, BURST, 30), over_time(profile, plan, BURST, 30)
    last = [m.frame_ms for m in moments if m.t_s > 24 * 60]
    assert answer.fps_start == pytest.approx(1e3 / moments[0].frame_ms)
    assert answer.fps_settled == pytest.approx(1e3 * len(last) / sum(last))
    assert answer.fps_settled < 0.97 * answer.fps < 0.97 * answer.fps_start


def with_cores(profile: Profile, **cores: str) -> Profile:
    """`profile` with the core of each named unit."""
    units = {name: unit.model_copy(update={"core": cores.get(name, "")}) for name, unit in profile.units.items()}
    return profile.model_copy(update={"units": units})


@pytest.mark.parametrize(("layout", "raster_ms"), [("split", 0.0252), ("packed", 0.0094)])
def test_stages_beside_the_network_by_hand(monkeypatch: pytest.MonkeyPatch, layout: str, raster_ms: float) -> None:
    """Clocks of 1/4 and 1/2; batches of two. 10 channels take three passes of four, each with the 500 vertices of two
    avatars at 2 ns where they are split; 100 pixels at 0.5 ns for each of the three: 6150 ns and 2150. Read at 0.25 ns:
    of each pixel 4 bytes a pass, or 16 in all: 300 ns and 400."""
    known = SimpleNamespace
    app = known(
        **{
            name: known(or_else=lambda _, value=value: value)
            for name, value in {
                "vertices": 500,
                "raster_ns_per_vertex": 2.0,
                "raster_ns_per_pixel": 0.5,
                "readback_ns_per_byte": 0.25,
                "pose_ms": 1.5,
                "composite_ms": 1.0,
                "present_ms": 2.0,
            }.items()
        }
    )
    units = {"cpu": known(clock=lambda corner: corner / 4), "gpu": known(clock=lambda corner: corner / 2)}
    plan: Any = known(
        network=known(layout=layout, channels=10, pixels=100), variant=known(batch=2), avatars=2, meshes=None
    )
    monkeypatch.setattr("trilane.hw_profiles.application._network_ms", lambda *_: {("infer", "dsp"): 7.0})
    found = stage_times_ms(known(application=app, units=units), plan, (1, 1, 1))  # type: ignore[arg-type]
    assert list(found) == [
        ("pose", "cpu"),
        ("raster", "gpu"),
        ("infer", "dsp"),
        ("composite", "gpu"),
        ("present", "cpu"),
    ]
    assert [*found.values()] == pytest.approx([24.0, raster_ms, 7.0, 4.0, 16.0], rel=1e-12)


def test_units_that_share_a_core_work_in_turns() -> None:
    """The network on the GPU, which has the CPU's core: a frame takes the sum of all stages."""
    profile = with_cores(load_profile("snapdragon-888"), cpu="core 0", gpu="core 0")
    plan, corners = Plan(NETWORK, "gpu", Variant("pipelined", "double")), corners_of(profile, SUSTAINED)
    times = stage_times_ms(profile, plan, corners)
    cpu, gpu = (sum(ms for (_, unit), ms in times.items() if unit == name) for name in ("cpu", "gpu"))
    now = steady(profile, plan, corners)
    assert now.frame_ms == pytest.approx(cpu + gpu, rel=0.01)
    assert now.busy["cpu"] + now.busy["gpu"] <= 1
    assert now.busy["cpu"] / now.busy["gpu"] == pytest.approx(cpu / gpu)
    assert now.idle["cpu"]["preempted"] == pytest.approx(now.busy["gpu"])
    assert now.idle["gpu"]["preempted"] == pytest.approx(now.busy["cpu"])
    for unit in UNITS:
        assert now.busy[unit] + sum(now.idle[unit].values()) == pytest.approx(1.0)
    assert "preempted" not in now.idle["dsp"]
    assert "cpu and gpu share a core and work in turns" in predict(profile, plan).notes


def test_a_placed_network_has_the_rates_of_its_threads_and_no_other_unit_changes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The profile's rates are those of as many threads as the rule gives, here 4."""
    monkeypatch.setattr("trilane.hw_profiles.host.network_threads", lambda: 4)
    profile = load_profile("host")
    placement = {"cpu": Place((2,), 1), "gpu": Place((0, 1), 1), "dsp": Place((0, 1, 3), 3)}
    units = on_cores(profile, placement).units
    assert {name: unit.core for name, unit in units.items()} == {"cpu": "core 2", "gpu": "", "dsp": ""}
    for name in ("cpu", "gpu"):
        assert units[name].model_copy(update={"core": ""}) == profile.units[name].model_copy(update={"core": ""})
    for peak in ("peak_int8_tmac_s", "peak_fp16_tmac_s", "peak_fp32_tmac_s"):
        before, after = getattr(profile.units["dsp"], peak), getattr(units["dsp"], peak)
        assert after.value == pytest.approx(0.75 * before.or_else(0.0)) and after.kind == before.kind
    assert units["dsp"].threads == 3
    others = units["dsp"].model_dump(exclude={"core", "threads", *host_model.PEAKS})
    assert others == profile.units["dsp"].model_dump(exclude={"core", "threads", *host_model.PEAKS})


def test_units_with_cores_of_their_own_are_predicted_as_without() -> None:
    chip = load_profile("snapdragon-888")
    apart, plan = with_cores(chip, cpu="core 0", gpu="core 1", dsp="core 2"), Plan(NETWORK, "dsp")
    assert steady(apart, plan, corners_of(chip, SUSTAINED)) == steady(chip, plan, corners_of(chip, SUSTAINED))


@pytest.mark.parametrize(("cores", "shared"), [((3,), "cpu gpu dsp"), ((0, 1), "cpu gpu"), ((0, 1, 2), "")])
def test_the_units_of_this_machine_share_cores_as_a_run_does(
    cores: tuple[int, ...], shared: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trilane.hw_profiles.host.usable_cores", lambda: cores)
    units = load_profile("host").units
    counts = Counter(unit.core for unit in units.values())
    assert " ".join(name for name, unit in units.items() if counts[unit.core] > 1) == shared


@pytest.mark.parametrize(("variant", "within"), [(Variant("pipelined", "double"), 1e-9), (REFERENCE, 0.01)])
@pytest.mark.parametrize("runtime", ["gpu", "dsp"])
def test_a_quick_answer_is_the_settled_one(variant: Variant, within: float, runtime: UnitName) -> None:
    """With two buffers a dozen frames are not enough: while the buffers fill, frames come up to 8 % faster."""
    profile = load_profile("snapdragon-888")
    plan = Plan(NETWORK, runtime, variant)
    corners = corners_of(profile, "power_saver")
    settled = steady(profile, plan, corners).frame_ms
    assert steady(profile, plan, corners, quick=True).frame_ms == pytest.approx(settled, rel=within)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_this_machine_in_virtual_time_is_placed_as_its_times_ask(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scheduler in virtual time finds no placement better by more than the model's margin."""
    cores = tuple(range(count))
    for module in ("host", "predict"):
        monkeypatch.setattr(f"trilane.hw_profiles.{module}.usable_cores", lambda: cores)
    profile, plan = load_profile("host"), Plan(NETWORK, "dsp", Variant("pipelined", "double"))
    corners = corners_of(profile, SUSTAINED)
    placed = place_units(profile, plan, corners, [CpuCore(number, number) for number in cores])
    frames = {each.frame_ns: steady(on_cores(profile, each.placement), plan, corners).frame_ms for each in placed.found}
    chosen = steady(on_cores(profile, placed.best.placement), plan, corners).frame_ms
    assert chosen <= 1.05 * min(frames.values())
    assert chosen <= 1.03 * steady(on_cores(profile, placed.rule.placement), plan, corners).frame_ms
    answer = predict(profile, plan)
    assert answer.placement == placed.facts
    assert answer.fps == pytest.approx(1e3 / chosen)
    assert any("placement: cpu 0" in note for note in answer.notes)


@pytest.mark.parametrize("fps", [0.0, 1e-300, 0.0009, 1001.0, float("nan")])
def test_a_rate_whose_period_is_no_number_of_nanoseconds_is_refused(fps: float) -> None:
    with pytest.raises(BadInputError, match=r"^fps: found .*, expected 0\.001 to 1000$"):
        Plan(NETWORK, "dsp", Variant(fps=fps))
    assert Plan(NETWORK, "dsp", Variant(fps=0.001)).variant.fps == 0.001


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


def changed(changes: dict[str, float]) -> Profile:
    """The chip snapdragon-888 with other numbers."""
    data, path = load_tables("snapdragon-888")
    data = copy.deepcopy(data)
    for key, value in changes.items():
        table, last = key.split(".")
        data[table][last] = {"kind": "assumed", "source": "s", "value": value}
    return parse_profile(data, path)


@pytest.mark.parametrize("minutes", [0, 2])
def test_an_answer_follows_from_its_moments(minutes: int) -> None:
    """The settled state stands for the moments where no time is given."""
    profile = load_profile("snapdragon-888")
    plan, corners = Plan(NETWORK, "dsp", Variant("pipelined", "double", 2, 24.0)), corners_of(profile, BURST)
    answer, now = predict(profile, plan, BURST, minutes), steady(profile, plan, corners)
    moments = over_time(profile, plan, BURST, minutes) if minutes else []
    frames = sorted(moment.frame_ms for moment in moments) or [now.frame_ms]
    mean = sum(frames) / len(frames)
    times, half = answer.frame_time_ms, profile.application.ema20_half_range_fraction.or_else(0) * mean
    assert (times.mean, times.p50, times.max) == pytest.approx((mean, frames[len(frames) // 2], frames[-1]))
    least = max(profile.application.display_ms.or_else(0), mean - half)
    assert (times.ema20_min, times.ema20_max) == pytest.approx((least, mean + half))
    assert answer.fps == pytest.approx(1e3 / mean) and answer.latency_ms.mean == now.latency_ms
    base = profile.thermal.base_power_w.or_else(0)
    watts = [base + sum(profile.units[u].power_w(c, now.busy[u]) for u, c in zip(UNITS, corners, strict=True))]
    power = mean_of([moment.power_w for moment in moments] or watts)
    assert (answer.power_w, answer.energy_mj_per_frame) == pytest.approx((power, power * mean))
    assert answer.xrbench == {"energy": pytest.approx(1 - power * mean / 1500)}
    assert answer.efficiency == pytest.approx(now.stages_ms["infer"] / 2 / now.frame_ms)
    assert {name: stage.service_ms.mean for name, stage in answer.stages.items()} == now.stages_ms
    assert {unit: row.busy for unit, row in answer.units.items()} == now.busy
    assert answer.network.gmac == NETWORK.work.macs / 1e9
    assert len(answer.timeline) == len(moments) == 60 * minutes
    config = answer.config
    assert (config.size, config.policy, config.batch, config.fps) == ("512x512", "pipelined", 2, 24.0)


def test_percentiles_of_a_hundred_moments() -> None:
    """No frame is shown before the display's interval."""
    profile, frames = changed(STATED), [float(n) for n in range(100, 0, -1)]
    found = _frame_times(profile, 50.5, frames)
    assert [found[key] for key in ("p50", "p90", "p95", "p99", "max")] == [51, 91, 96, 100, 100]
    assert ema_range_ms(profile, 18.0) == (16.0, 22.5)


def test_heat_follows_the_power_from_poll_to_poll(monkeypatch: pytest.MonkeyPatch) -> None:
    """A governor that lowers the DSP at the second poll, and looks at every one."""
    profile = changed(STATED)
    seen: list[Any] = []
    settled: list[Any] = []
    busy = {"cpu": 0.1, "gpu": 0.6, "dsp": 0.8}
    now = SimpleNamespace(frame_ms=25.0, busy=busy)
    monkeypatch.setattr(governor_module, "steady", lambda *asked: settled.append(asked) or now)

    def govern(profile: Profile, state: ThermalState, throttle: Throttle, requested: Any, power: Any) -> None:
        seen.append((profile.name, state.device_c, dict(requested), dict(power)))
        if len(seen) == 2:
            throttle.lower(requested, {"cpu": 0.0, "gpu": 0.0, "dsp": 1.0})

    monkeypatch.setitem(GOVERNORS, profile.thermal.governor, govern)
    found = over_time(profile, Plan(NETWORK, "dsp"), "burst", 0.13)
    device, junction = 20.0, dict.fromkeys(UNITS, 20.0)
    first = profile.performance_profiles["burst"]
    assert len(found) == len(seen) == 4, "round(7.8 s / 2 s)"
    for number, moment in enumerate(found):
        corners: Any = [getattr(first, unit) for unit in UNITS]
        if number >= 2:
            corners[2] = CORNERS[CORNERS.index(corners[2]) + 1]
        power = {u: profile.units[u].power_w(c, busy[u]) for u, c in zip(UNITS, corners, strict=True)}
        goal = 20 + 4 * (sum(power.values()) + 1.5)
        device = goal + (device - goal) * math.exp(-2 / 100)
        for unit in UNITS:
            numbers = profile.units[unit]
            above = device + (numbers.junction_k_per_w.value or 0) * power[unit]
            junction[unit] = above + (junction[unit] - above) * math.exp(-2 / (numbers.junction_time_s.value or 0))
        wanted = (2.0 * (number + 1), 25.0, device, max(junction.values()), sum(power.values()) + 1.5)
        assert astuple(moment)[:5] == pytest.approx(wanted)
        assert moment.throttled == (number >= 2) and moment.corners == tuple(corners)
        assert seen[number][1] == pytest.approx(device) and seen[number][3] == pytest.approx(power)
        assert seen[number][2] == {unit: CORNERS.index(getattr(first, unit)) for unit in UNITS}
    assert len(settled) == 2, "each state of the units is settled once"


@pytest.mark.parametrize(
    ("minutes", "governor", "message"),
    [
        (0.0, None, "minutes: found 0, expected above 0, at most 1440"),
        (1440.1, None, "minutes: found 1440.1, expected above 0, at most 1440"),
        (1.0, "ondemand", "governor: found 'ondemand', expected step_wise or power_allocator"),
    ],
)
def test_times_and_governors_that_are_not_known_are_refused(minutes: float, governor: str | None, message: str) -> None:
    with pytest.raises(BadInputError) as caught:
        over_time(load_profile("snapdragon-888"), Plan(NETWORK, "dsp"), "burst", minutes, governor)
    assert str(caught.value) == message
