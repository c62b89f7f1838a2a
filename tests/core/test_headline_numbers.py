"""The numbers that a person reads first move as the truth is changed: by how much, theory says.

Here: a stage made slower, a rate, a cap, other programs on a core, power, the place of the camera. Elsewhere, by the
same rule: a stage that is the slowest, or shares a core (test_efficiency); pictures made transparent, shifted, tinted
(test_image_error, test_run_check, golden/test_solid_avatars, golden/test_run_check); a network, texture or body
exchanged (test_validation); how much of the cores other programs have (test_placement_choice); what two runs differ by
(test_comparison).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from support.run_folders import write_run
from trilane.apps.explain.explained_run import explain_run
from trilane.apps.explain.scene_plan import ScenePlan
from trilane.hw_profiles.application import Plan
from trilane.hw_profiles.governor import Governor
from trilane.hw_profiles.predict import predict
from trilane.hw_profiles.prediction import ApplicationPrediction
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.reference_networks import NetworkSpec, reference_network
from trilane.hw_profiles.schema import Profile
from trilane.pipeline.journal import records_of
from trilane.pipeline.reckoning import Reckoned, reckoned
from trilane.scene.crop import Rect
from trilane.scene.planner import FrameWork
from trilane.scheduler.events import Graph, SetDuty, Settings, chain
from trilane.scheduler.placement import Place
from trilane.scheduler.shared_units import Member, simulate_beside
from trilane.scheduler.virtual import Simulation, simulate
from trilane.stages.configure import configure
from trilane.stages.cpu.pose import FramePlan
from trilane.stages.run_options import RunOptions
from trilane.units import UNITS

FRAMES = 200
#: Of a mean over so many frames: the first and the last frames are no steady state, and are counted in it.
NEAR = 0.02
US = 1000
UNIT_OF = {"pose": "cpu", "raster": "gpu", "infer": "dsp", "composite": "gpu"}
STAGE_US = {"pose": 15, "raster": 25, "infer": 60, "composite": 20}
ALONE_US, INFER_US = sum(STAGE_US.values()), STAGE_US["infer"]
PLACES = {"cpu": Place((1,), 1), "gpu": Place((2,), 1), "dsp": Place((0,), 1)}


def graph() -> Graph:
    return chain(UNIT_OF.items(), "double", "composite")


def service(times_us: Mapping[str, int]) -> Callable[..., int]:
    return lambda stage, *_: times_us[stage] * US


def found_of(run: Simulation, settings: Settings) -> Reckoned:
    assert run.recording is not None
    return reckoned(graph(), settings, PLACES, records_of(run.recording, run.jobs))


def shares(found: Reckoned) -> dict[tuple[str, str], float]:
    total = sum(found.budget.values())
    return {part: ns / total for part, ns in found.budget.items()}


def frame_us(run: Simulation) -> float:
    return float(run.report["frame_time_ms"]["mean"]) * 1e6 / US


# A stage made slower where it does not hold the rate: the path and the latency have all of it, the frame time nothing.


@pytest.mark.parametrize("slower", [0.0, 0.2, 0.5, 1.0])
@pytest.mark.parametrize("stage", STAGE_US)
def test_of_frames_at_a_slow_rate_a_slower_stage_moves_latency_path_and_misses(stage: str, slower: float) -> None:
    """A frame each 400 us, which takes 120 us alone: its latency is the sum of its stages, and what is left of the time
    waits for the rate. The deadline lies 3 us behind that sum: a fifth of pose is 3 us, of any other stage 4 or more.
    """
    times, period_us, due_us = STAGE_US | {stage: round(STAGE_US[stage] * (1 + slower))}, 400, ALONE_US + 3
    settings = Settings(FRAMES, period_ns=period_us * US, deadline_ns=due_us * US)
    run, late_us = simulate(graph(), settings, service(times), keep=True), sum(times.values())
    assert 1e3 * run.report["latency_ms"]["mean"] == pytest.approx(late_us)
    assert frame_us(run) == pytest.approx(period_us)
    assert run.report["deadline_misses"] == (FRAMES if late_us > due_us else 0)
    found, waited = found_of(run, settings), 1 - late_us / period_us
    wanted = {("work", name): us / period_us for name, us in times.items()}
    assert shares(found) == pytest.approx(wanted | {("release", "pose"): waited}, abs=1e-6)
    assert found.figures["bottleneck"] == "release"
    assert found.figures["bound"]["unit"]["share"] == pytest.approx(waited)
    assert found.figures["bound"]["stage"]["name"] == "infer"
    of_units = [sum(us for name, us in times.items() if UNIT_OF[name] == unit) for unit in PLACES]
    assert found.figures["efficiency"] == pytest.approx(max(of_units) / period_us, rel=NEAR)
    assert found.figures["machine_efficiency"] == pytest.approx(late_us / period_us / 3, rel=NEAR)


# A unit held by a cap, and frames held by a rate.


@pytest.mark.parametrize("permille", [1000, 500, 250])
def test_a_held_unit_moves_frame_time_throttled_share_and_efficiency(permille: int) -> None:
    """The dsp works for 60 us, then rests until that was its share of the time. It bounds the run held or not."""
    settings, duty = Settings(FRAMES), permille / 1000
    run = simulate(graph(), settings, service(STAGE_US), inputs=[(0, SetDuty("dsp", permille))], keep=True)
    assert frame_us(run) == pytest.approx(INFER_US / duty, rel=NEAR)
    assert run.report["units"]["dsp"]["busy"] == pytest.approx(duty, abs=NEAR)
    assert run.report["units"]["dsp"]["idle"]["throttled"] == pytest.approx(1 - duty, abs=NEAR)
    found = found_of(run, settings)
    assert shares(found).get(("throttled", "infer"), 0.0) == pytest.approx(1 - duty, abs=NEAR)
    assert (found.figures["bottleneck"], found.figures["bound"]["stage"]["name"]) == ("dsp", "infer")
    assert found.figures["bound"]["unit"]["share"] == pytest.approx(1, abs=NEAR)
    assert found.figures["efficiency"] == pytest.approx(duty, rel=NEAR)
    assert found.figures["machine_efficiency"] == pytest.approx(ALONE_US / 3 * duty / INFER_US, rel=NEAR)


@pytest.mark.parametrize("period_us", [60, 150, 300, 600])
def test_frames_held_by_a_rate_move_what_bounds_the_run(period_us: int) -> None:
    """A frame alone takes 120 us, half of them the dsp's: beyond 180 us a frame the wait for the next is the most."""
    settings = Settings(FRAMES, period_ns=period_us * US)
    run = simulate(graph(), settings, service(STAGE_US), keep=True)
    assert (frame_us(run), run.report["fps"]) == pytest.approx((period_us, 1e6 / period_us), rel=1e-6)
    found = found_of(run, settings)
    waited = max(1 - ALONE_US / period_us, 0)
    assert shares(found).get(("release", "pose"), 0.0) == pytest.approx(waited, abs=NEAR)
    assert found.figures["bottleneck"] == ("release" if period_us > 180 else "dsp")
    assert found.figures["efficiency"] == pytest.approx(INFER_US / period_us, rel=NEAR)


# Other programs on a core of the run.


def beside_programs(count: int) -> Simulation:
    """So many programs compute all the time on the core of the dsp; the kernel gives each an equal share of it."""
    seats = {"dsp": "core 0"}
    run = Member(graph(), Settings(FRAMES), service(STAGE_US), seats)
    longer_ns = 100_000_000  # than the run
    spin = chain([("spin", "other")], "double", "spin")
    program = Member(spin, Settings(1), lambda *_: longer_ns, {"other": "core 0"})
    return simulate_beside([run, *[program] * count], divided=["core 0"], keep=True)[0]


@pytest.mark.parametrize("programs", [0, 1, 2, 3])
def test_other_programs_move_frame_time_bound_preempted_share_and_efficiency(programs: int, tmp_path: Path) -> None:
    """Of n + 1 that want the core the dsp has one share: its 60 us take n + 1 times as long, and of the time n shares
    were nobody's of this run. No part of them is work."""
    run, lost = beside_programs(programs), programs / (programs + 1)
    assert frame_us(run) == pytest.approx(INFER_US * (programs + 1), rel=NEAR)
    assert run.report["units"]["dsp"]["busy"] == pytest.approx(1 - lost, abs=NEAR)
    assert run.report["units"]["dsp"]["idle"]["preempted"] == pytest.approx(lost, abs=NEAR)
    found = found_of(run, Settings(FRAMES))
    assert shares(found).get(("preempted", "infer"), 0.0) == pytest.approx(lost, abs=NEAR)
    assert shares(found)["work", "infer"] == pytest.approx(1 - lost, abs=NEAR)
    if programs != 1:  # with one both have a half
        assert found.figures["bottleneck"] == ("other programs" if programs else "dsp")
        assert found.figures["bound"]["unit"]["share"] == pytest.approx(max(lost, 1 - lost), abs=NEAR)
    assert found.figures["bound"]["stage"]["name"] == "infer"
    assert found.figures["efficiency"] == pytest.approx(1 - lost, rel=NEAR)
    assert found.figures["machine_efficiency"] == pytest.approx(ALONE_US / 3 / (INFER_US * (programs + 1)), rel=NEAR)
    folder = tmp_path / "run"
    document = explain_run(
        write_run(folder, run, cores={unit: place.cores for unit, place in PLACES.items()})
    ).as_json()
    assert 1e3 * document["nobodys_ms"] == pytest.approx(INFER_US * programs, abs=INFER_US * (programs + 1) * NEAR)


# Power. All of it is halved: what units take at work and at rest, and what the rest of the device takes.

OF_POWER = ("power_max_w", "idle_w")


def stated(quantity: Any, value: float) -> Any:
    return quantity.model_copy(update={"value": value})


def chip(times: float, **thermal: float) -> Profile:
    """The Snapdragon 888 with so many times its power, and other numbers of heat."""
    profile = load_profile("snapdragon-888")
    units = {
        name: unit.model_copy(
            update={key: stated(getattr(unit, key), getattr(unit, key).value * times) for key in OF_POWER}
        )
        for name, unit in profile.units.items()
    }
    heat = {"base_power_w": profile.thermal.base_power_w.or_else(0) * times, **thermal}
    changes = {key: stated(getattr(profile.thermal, key), value) for key, value in heat.items()}
    return profile.model_copy(update={"units": units, "thermal": profile.thermal.model_copy(update=changes)})


def burst(profile: Profile, minutes: float = 0.0) -> ApplicationPrediction:
    network = reference_network(NetworkSpec("resnet18", "batch", 512, 512, 16))
    return predict(profile, Plan(network, "dsp"), "burst", minutes)


def test_halved_power_halves_watts_and_energy_and_leaves_the_frames() -> None:
    whole, half = burst(chip(1.0)), burst(chip(0.5))
    assert (half.frame_time_ms, half.fps, half.units) == (whole.frame_time_ms, whole.fps, whole.units)
    watts = [
        (each.power_w, each.energy_mj_per_frame, each.base_power_w, each.power.w, each.power.low_w, each.power.high_w)
        for each in (half, whole)
    ]
    assert watts[0] == pytest.approx([value and value / 2 for value in watts[1]])
    # XRBench's score falls in a straight line from 1 at no energy
    assert 1 - half.xrbench["energy"] == pytest.approx((1 - whole.xrbench["energy"]) / 2)


AMBIENT_C, LIMIT_C, TIME_S, POLL_S = 25.0, 45.0, 100.0, 1.0


def first_over_s(warmer_c: float) -> float | None:
    """When a device that ends `warmer_c` above the room, if nothing is done, is first seen over its limit.

    ambient + warmer (1 - exp(-t / tau)) = limit; the next poll sees it, and what is throttled is so from the one after.
    """
    if warmer_c <= LIMIT_C - AMBIENT_C:
        return None
    return math.ceil(-TIME_S * math.log(1 - (LIMIT_C - AMBIENT_C) / warmer_c) / POLL_S) * POLL_S


HEAT = {
    "ambient_c": AMBIENT_C,
    "skin_limit_c": LIMIT_C,
    "junction_limit_c": 1000.0,
    "device_time_s": TIME_S,
    "poll_s": POLL_S,
}


@pytest.mark.parametrize("times", [1.0, 0.5, 0.25])
def test_halved_power_moves_when_a_prediction_throttles_and_a_quarter_never_does(times: float) -> None:
    """At full power the device would end 60 degrees above the room, three times as far as it may."""
    kelvin_per_w = 60 / burst(chip(1.0)).power_w
    answer = burst(chip(times, device_k_per_w=kelvin_per_w, **HEAT), 3.0)
    over_s = first_over_s(60 * times)
    assert over_s == {1.0: 41, 0.5: 110, 0.25: None}[times]
    caps = answer.caps
    assert caps.first_throttled_s == (None if over_s is None else over_s + POLL_S)
    assert caps.throttled_share == pytest.approx(0 if over_s is None else 1 - over_s / 180)
    cool_s = 30.0
    (then,) = [row for row in answer.timeline if row["t_s"] == cool_s]
    assert then["device_c"] == pytest.approx(AMBIENT_C + 60 * times * (1 - math.exp(-cool_s / TIME_S)))


@pytest.mark.parametrize("times", [1.0, 0.5, 0.25])
def test_halved_power_moves_when_a_run_is_throttled(times: float) -> None:
    """The governor of a run, by the time that units really worked: here all of it."""
    profile = chip(1.0)
    full_w = profile.thermal.base_power_w.or_else(0)
    full_w += sum(profile.units[unit].power_max_w.or_else(0) for unit in UNITS)
    governor = Governor(chip(times, device_k_per_w=60 / full_w, **HEAT), "burst")
    duty = {event.unit: event.permille for event in governor.begin(0)}
    busy_ns = dict.fromkeys(UNITS, 0)
    for second in range(1, 31):
        busy_ns = {unit: ns + 1_000_000_000 * duty.get(unit, 1000) // 1000 for unit, ns in busy_ns.items()}
        assert governor.tick(second * 1_000_000_000, busy_ns) == []
    assert governor.power_w == pytest.approx(full_w * times)
    assert governor.temperatures_c["device"] == pytest.approx(AMBIENT_C + 60 * times * (1 - math.exp(-0.3)))
    for second in range(31, 181):
        busy_ns = {unit: ns + 1_000_000_000 * duty.get(unit, 1000) // 1000 for unit, ns in busy_ns.items()}
        duty |= {event.unit: event.permille for event in governor.tick(second * 1_000_000_000, busy_ns)}
    over_s = first_over_s(60 * times)
    assert governor.report()["caps"]["first_throttled_s"] == (None if over_s is None else over_s + POLL_S)


# The place of the camera: a pinhole by hand. The body stands at the origin, the camera looks along -Z.

EYE_M, FOV_DEG, ASPECT = 0.9, 60.0, 320 / 240
SCENE = """
frames = 1
size = "64"
output = {{width = 320, height = 240}}
camera = {{source = "{camera}", format = "arkit", fov_y_deg = 60.0, place = "none"}}
[[avatars]]
bundle = "{bundle}"
motion = "builtin:t-pose"
"""
#: From joints' bounds, which a rectangle holds, to the vertices within them.
AROUND_M = 0.2


class Seen(NamedTuple):
    """What a run decides for a camera.

    `depths_m`: from the body's middle to the camera, where its bounds begin and end. `tops_m`: how far its highest
    vertex, and the highest that its bounds may hold, are above the camera.
    """

    plan: FramePlan
    depths_m: tuple[float, float]
    tops_m: tuple[float, float]

    @property
    def rect(self) -> Rect:
        (only,) = self.plan.seen.values()
        return only.rect


@pytest.fixture(scope="module")
def seen_from(tiny_bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[float, float], Seen]:
    """By a camera `right` of the middle and `away` from it, in metres."""
    folder = tmp_path_factory.mktemp("camera")

    @cache
    def seen(right: float, away: float) -> Seen:
        rows = [[t_s, 1, 0, 0, right, 0, 1, 0, EYE_M, 0, 0, 1, away] for t_s in (0.0, 1.0)]
        camera, scene = folder / "camera.txt", folder / "scene.toml"
        camera.write_text("\n".join(" ".join(map(str, row)) for row in rows), encoding="utf-8")
        scene.write_text(SCENE.format(camera=camera, bundle=tiny_bundle), encoding="utf-8")
        checked = configure(
            RunOptions(scene=str(scene), runtime="ort", allow_empty=True), folder, lambda: {"hardware": False}
        )
        planned = ScenePlan(checked.config, checked.assets)
        decided, (_, heights_m, depths_m) = planned.decide(0), planned._exact(0, 0).T
        top_m = heights_m.max() - EYE_M
        depths_of = depths_m.min() - AROUND_M, depths_m.max() + AROUND_M
        return Seen(decided.plan, depths_of, (top_m, top_m + AROUND_M))

    return seen


@pytest.mark.parametrize("right", [0.25, -0.4])
def test_a_camera_moved_to_the_side_moves_the_body_to_the_other(seen_from: Any, right: float) -> None:
    """A point z before the middle moves by right / (4 - z) of what the picture has at a metre's distance."""
    before, after = seen_from(0.0, 4.0), seen_from(right, 4.0)
    a_metre = 1 / math.tan(math.radians(FOV_DEG / 2)) / ASPECT
    least, most = sorted(-right * a_metre / (4.0 - depth_m) for depth_m in before.depths_m)
    assert least < after.rect.x0 - before.rect.x0 < most
    assert least < after.rect.x1 - before.rect.x1 < most
    assert (after.rect.y0, after.rect.y1) == pytest.approx((before.rect.y0, before.rect.y1))


@pytest.mark.parametrize("away", [6.0, 8.0])
def test_a_camera_moved_back_makes_the_body_smaller(seen_from: Any, away: float) -> None:
    """A point z before the middle is (4 - z) / (away - z) times as far from the picture's middle as it was.

    One y above the camera is y / (away - z) of what half the picture has at a metre's distance.
    """
    before, after = seen_from(0.0, 4.0), seen_from(0.0, away)
    for distance_m, seen in ((4.0, before), (away, after)):
        a_metre = 1 / math.tan(math.radians(FOV_DEG / 2))
        tops = [a_metre * top / (distance_m - depth) for top, depth in zip(seen.tops_m, seen.depths_m, strict=True)]
        assert tops[0] < seen.rect.y1 < tops[1]
    least, most = sorted((4.0 - depth_m) / (away - depth_m) for depth_m in before.depths_m)
    for first, second in zip(before.rect, after.rect, strict=True):
        assert least < second / first < most


def test_a_camera_moved_past_the_body_leaves_nothing_to_do(seen_from: Any) -> None:
    """At 4 m the picture is 6.2 m wide, and an arm 0.9 m long."""
    assert (seen_from(0.0, 4.0).plan.work, len(seen_from(0.0, 4.0).plan.seen)) == (FrameWork.FULL, 1)
    for right, away in ((4.5, 4.0), (0.0, -4.0)):
        plan = seen_from(right, away).plan
        assert (plan.work, plan.shape, plan.seen) == (FrameWork.NONE, None, {})
