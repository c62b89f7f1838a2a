"""Pipelines that share a chip: the memory that they take from each other, heat, and one alone, in closed form."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest

from support.pipeline_files import ADDITIONS, additions
from support.trace_reading import read_trace
from trilane.apps.predict import asked_pipelines as sources
from trilane.errors import BadInputError
from trilane.hw_profiles import shared_chip
from trilane.hw_profiles.application import Plan, Variant, stage_times_ms, steady
from trilane.hw_profiles.host_model import UNMEASURED, with_network
from trilane.hw_profiles.network_work import Network, count_work
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.reference_networks import NetworkSpec, reference_network
from trilane.hw_profiles.schema import corners_of
from trilane.hw_profiles.shared_chip import Together, predict_beside, together
from trilane.hw_profiles.tenants import SKIPS, Tenant, moved_bytes
from trilane.scene.planner import FrameWork
from trilane.stages import avatar_assets
from trilane.units import SUSTAINED

CHIP = load_profile("snapdragon-888")
CORNERS = corners_of(CHIP, SUSTAINED)
SIDE = 512


def bare(unit: Any, fps: float = 0.5, side: int = SIDE) -> Tenant:
    network = Network({}, 1, 1, 1, "packed", count_work(additions(side)))
    return Tenant(f"additions on {unit}", "", (network,), (0,), fps, unit, is_bare=True)


def avatar(size: int = 256, fps: float = 30.0, frames: tuple[int, ...] = (0,)) -> Tenant:
    spec = NetworkSpec("mobilenetv2", "batch", size, size, 16, "packed")
    return Tenant("avatar", "", (reference_network(spec),), frames, fps)


def response_ms(found: Together, number: int) -> float:
    value: float = found.runs[number].report["response_ms"]["mean"]
    return value


def time_ms(tenant: Tenant, use: float) -> float:
    """Of an addition while `use` of the bandwidth is taken: the application's infer stage less its hand-over."""
    memory = CHIP.memory.model_copy(
        update={"application_use_fraction": CHIP.memory.application_use_fraction.model_copy(update={"value": use})}
    )
    chip = CHIP.model_copy(update={"memory": memory})
    times = stage_times_ms(chip, Plan(tenant.networks[0], tenant.unit), CORNERS)
    return times["infer", tenant.unit] - CHIP.application.handover_ms.or_else(0.0)


def test_networks_on_two_units_take_memory_from_each_other_while_both_run() -> None:
    """Both begin at once. The longer one is slow until the shorter one has ended, then as fast as alone."""
    two = [bare("gpu"), bare("dsp")]
    alone = [time_ms(each, 0.0) for each in two]
    bandwidth = CHIP.memory.bandwidth_gb_s.or_else(0.0) * 1e9
    tensor = 32 * SIDE * SIDE  # 8 MB, of which the DSP holds 4: half of each travels twice, the first and last whole
    bytes_ = [3 * ADDITIONS * tensor * CHIP.units["gpu"].element_bytes, (ADDITIONS + 1) * tensor]
    assert [moved_bytes(each.networks[0].work, CHIP.units[each.unit]) for each in two] == bytes_
    demand = [count / (ms / 1e3) / bandwidth for count, ms in zip(bytes_, alone, strict=True)]
    beside = [time_ms(each, demand[1 - number]) for number, each in enumerate(two)]
    assert all(slow > 1.05 * ms for slow, ms in zip(beside, alone, strict=True))
    shorter = min((0, 1), key=lambda number: beside[number])
    longer = 1 - shorter
    done = beside[shorter] / beside[longer]
    expected = beside[shorter] + (1 - done) * alone[longer]
    found = together(CHIP, two, CORNERS)
    assert response_ms(found, shorter) == pytest.approx(beside[shorter], rel=1e-4)
    assert response_ms(found, longer) == pytest.approx(expected, rel=1e-4)
    assert found.runs[longer].report["units"][two[longer].unit]["idle"]["preempted"] == 0


def test_networks_on_one_unit_follow_each_other_and_do_not_slow_each_other() -> None:
    two = [bare("dsp"), bare("dsp")]
    found = together(CHIP, two, CORNERS)
    alone = time_ms(two[0], 0.0)
    assert [response_ms(found, number) for number in (0, 1)] == pytest.approx([alone, 2 * alone], rel=1e-4)


def test_networks_that_divide_a_core_do_not_slow_each_other_by_the_memory() -> None:
    """Two at once on half of the core each: both take twice as long, and no more."""
    units = {**CHIP.units, "dsp": CHIP.units["dsp"].model_copy(update={"core": "core 1"})}
    two = [bare("dsp"), bare("dsp")]
    found = together(CHIP.model_copy(update={"units": units}), two, CORNERS)
    alone = time_ms(two[0], 0.0)
    assert [response_ms(found, number) for number in (0, 1)] == pytest.approx([2 * alone] * 2, rel=1e-4)


def test_an_avatar_takes_its_share_of_the_memory_all_the_time_and_two_take_twice_as_much() -> None:
    own = CHIP.memory.application_use_fraction.or_else(0.0)
    for avatars in (1, 2):
        network = bare("dsp", 5, 64)
        found = together(CHIP, [network, *[avatar() for _ in range(avatars)]], CORNERS)
        assert found.stages_ms[0]["infer"] == pytest.approx(time_ms(network, avatars * own), rel=1e-5)


def test_others_take_at_most_nearly_all_of_the_memory() -> None:
    """Nine tenths are the application's own, so two avatars would take 1.8 of it: a twentieth is left."""
    use = CHIP.memory.application_use_fraction.model_copy(update={"value": 0.9})
    chip = CHIP.model_copy(update={"memory": CHIP.memory.model_copy(update={"application_use_fraction": use})})
    one = bare("dsp", 5, 64)
    found = together(chip, [one, avatar(64), avatar(64)], CORNERS)
    assert found.stages_ms[0]["infer"] == pytest.approx(time_ms(one, 0.95), rel=1e-5)


@pytest.mark.parametrize(("fps", "seconds"), [(30.0, 10.0), (4.0, 16.0), (0.08, 600.0)])
def test_a_run_lasts_ten_seconds_or_64_frames_but_no_more_than_ten_minutes(fps: float, seconds: float) -> None:
    """A stop ends it with the frame in flight: at most one period before it, or a job of a millisecond behind it."""
    found = together(CHIP, [bare("dsp", 10 * fps, 32), bare("gpu", fps, 32)], CORNERS)
    assert seconds - 0.11 / fps <= found.runs[0].report["duration_s"] <= seconds + 0.001


def test_a_tenant_is_refused_for_its_unit_and_its_mean_skips_frames_without_a_network() -> None:
    with pytest.raises(BadInputError, match=r"^additions on cpu: unit: found 'cpu', expected gpu or dsp$"):
        bare("cpu")
    with pytest.raises(BadInputError, match=r"0\.001 to 1000"):
        bare("dsp", float("nan"))
    small, large = avatar(128), avatar(256)
    both = replace(small, networks=(*small.networks, *large.networks))
    means = [together(CHIP, [each], CORNERS).stages_ms[0]["infer"] for each in (small, large)]
    for frames, mean in (((0, 1, SKIPS, 1), (means[0] + 2 * means[1]) / 3), ((SKIPS,), means[0])):
        found = together(CHIP, [replace(both, frames=frames)], CORNERS)
        assert found.stages_ms[0]["infer"] == pytest.approx(mean, rel=1e-6)


def test_an_avatar_alone_is_what_predict_says_of_its_network() -> None:
    one = avatar()
    single = steady(CHIP, Plan(one.networks[0], "dsp", Variant("latest", "double")), CORNERS)
    found = together(CHIP, [one], CORNERS)
    assert found.runs[0].report["latency_ms"]["mean"] == pytest.approx(single.latency_ms, rel=1e-5)
    assert found.frame_ms == pytest.approx(single.frame_ms, rel=1e-5)


def test_every_avatar_in_view_is_posed_and_drawn() -> None:
    """Three in view: three poses, the vertices of three; one tensor, one picture. Of one and three in turns, two.

    With levels of a mesh, the vertices of three may be those of half a mesh.
    """
    one, app = avatar(), CHIP.application
    three = replace(one, name="three", avatars=(3,))
    turns = replace(one, name="turns", networks=one.networks * 2, avatars=(1, 3), frames=(0, 1))
    coarse = replace(three, meshes=(0.5,))
    single, many, mean, few = (together(CHIP, [each], CORNERS).stages_ms[0] for each in (one, three, turns, coarse))
    gpu = CHIP.units["gpu"].clock(CORNERS[1])
    vertices_ms = app.vertices.or_else(0) * app.raster_ns_per_vertex.or_else(0) / gpu / 1e6
    assert vertices_ms > 0.01
    for found, more, meshes in ((many, 2, 3), (mean, 1, 2), (few, 2, 0.5)):
        assert found["pose"] == pytest.approx((1 + more) * single["pose"], abs=1e-5)
        assert found["raster"] == pytest.approx(single["raster"] + (meshes - 1) * vertices_ms, abs=1e-5)
        assert all(found[stage] == single[stage] for stage in ("infer", "composite", "present"))


def test_frames_that_show_nobody_new_skip_the_network() -> None:
    found = together(CHIP, [avatar(frames=(0, SKIPS, SKIPS))], CORNERS)
    row = found.runs[0].report
    assert row["stages"]["infer"]["jobs"] == pytest.approx(row["frames"]["presented"] / 3, abs=1)


def test_a_display_holds_an_avatar_but_no_network() -> None:
    found = together(CHIP, [avatar(fps=500), bare("dsp", 100, 32)], CORNERS)
    assert found.frame_ms == pytest.approx(CHIP.application.display_ms.or_else(0.0), rel=1e-3)
    assert found.runs[1].report["frame_time_ms"]["mean"] == pytest.approx(10, rel=1e-3)


def test_more_than_a_unit_can_do_is_dropped_and_late_and_counted() -> None:
    """Twice what fits: each has half of its frames, and none of those is there before the next one comes."""
    fps = 1e3 / time_ms(bare("dsp"), 0.0)
    answer = predict_beside(CHIP, [replace(bare("dsp", fps), name=name) for name in "ab"])
    for row in answer["pipelines"]:
        assert row["in_time"] < 0.05
        assert row["frame_time_ms"]["mean"] == pytest.approx(2e3 / fps, rel=0.01)
        assert row["alone"]["in_time"] > 0.95
        shares = row["units"]["dsp"]
        assert shares["busy"] + sum(shares["idle"].values()) == pytest.approx(1)
        assert shares["idle"]["preempted"] == pytest.approx(0.5, abs=0.02)
    assert answer["units"]["dsp"]["busy"] == pytest.approx(1, abs=0.01)
    assert sum(answer["units"]["dsp"]["by_pipeline"].values()) == pytest.approx(answer["units"]["dsp"]["busy"])


def test_a_policy_that_keeps_old_frames_lets_one_wait_and_turns_others_away() -> None:
    """Released four times as often as the network can take them."""
    one = avatar(512, 30)
    times = stage_times_ms(CHIP, Plan(one.networks[0], "dsp"), CORNERS)
    chip = CHIP.model_copy(
        update={
            "application": CHIP.application.model_copy(
                update={"display_ms": CHIP.application.display_ms.model_copy(update={"value": 0.1})}
            )
        }
    )
    fast = replace(one, fps=4e3 / times["infer", "dsp"], variant=Variant("pipelined", "double"))
    report = together(chip, [fast], CORNERS).runs[0].report
    frames = report["frames"]
    assert frames["dropped"] == {"source->pose:queue_full": frames["requested"] - frames["presented"]}
    assert frames["presented"] == pytest.approx(frames["requested"] / 4, rel=0.05)


def test_what_it_settles_to_is_the_last_fifth_of_the_time() -> None:
    """Ten moments, of which the last two have frames of 30 and 40 ms."""
    reports = {
        corner: SimpleNamespace(runs=[None, SimpleNamespace(report={"frame_time_ms": {"mean": ms}})])
        for corner, ms in (("early", 20.0), ("late", 30.0), ("last", 40.0))
    }
    moments: list[Any] = [SimpleNamespace(corners=corner) for corner in ["early"] * 8 + ["late", "last"]]
    assert shared_chip._settled_ms(moments, reports.__getitem__, 1) == 35.0  # type: ignore[arg-type]
    assert shared_chip._settled_ms([], reports.__getitem__, 1) is None  # type: ignore[arg-type]


def test_what_is_said_of_a_machine_and_of_turns() -> None:
    host, two = load_profile("host"), [avatar()] * 2
    (_, turns) = shared_chip._notes(CHIP, two, "deadline")
    assert turns == "a unit that several pipelines have handed a job takes them by deadline, each job to its end"
    (_, shares, said) = shared_chip._notes(host, two, "deadline")
    assert "divide it in equal shares" in shares and said.startswith(UNMEASURED)
    measured = with_network(host, avatar().networks[0].work, {1: 5.0}, 0.1, "measured by a test")
    assert shared_chip._notes(measured, two, "deadline")[2].startswith("the first pipeline was measured by a test;")


def test_a_scene_is_planned_frame_by_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames of 64x96 and 32x32 with some that skip; a network for each shape and what is in view, as they come.

    In the last one a quarter of a mesh is drawn. Avatar c has a network of its own, so its frame has two tensors.
    """
    full, reuse = FrameWork.FULL, FrameWork.REUSE
    wide, small = (64, 96), (32, 32)
    works: list[Any] = [
        (full, wide, "a", 1.0),
        (reuse, wide, "a", 1.0),
        (full, small, "abc", 2.5),
        (full, wide, "ab", 2.0),
        (full, wide, "b", 0.25),
    ]

    def decide(frame: int) -> Any:
        work, shape, seen, meshes = works[frame % len(works)]
        return SimpleNamespace(plan=SimpleNamespace(work=work, shape=shape, seen=seen, meshes=meshes))

    scene = SimpleNamespace(frames=700, fps=24.0)
    config = SimpleNamespace(scene=scene, networks_of=lambda seen: (0, 1) if "c" in seen else (0,))
    checked = SimpleNamespace(config=config, assets="assets")
    monkeypatch.setattr(sources, "configure", lambda *_: checked)
    files = [SimpleNamespace(shape=(1, 80, 112, channels), channels=channels) for channels in (12, 8)]
    monkeypatch.setattr(sources, "networks_of", lambda _: files)
    monkeypatch.setattr(sources, "ScenePlan", lambda *_: SimpleNamespace(decide=decide))
    monkeypatch.setattr(avatar_assets, "reshaped", lambda file, *shape: SimpleNamespace(model=(file.channels, *shape)))
    monkeypatch.setattr(avatar_assets, "count_work", lambda model: model)
    monkeypatch.setattr(avatar_assets, "one_after_the_other", tuple)
    (found,) = sources.tenants(["home.toml@12:gpu"], Variant("deadline", "single"))
    assert (found.name, found.source, found.fps, found.unit) == ("home", "home.toml@12:gpu", 12.0, "gpu")
    assert (found.variant, found.is_bare) == (Variant("deadline", "single"), False)
    assert [(each.height, each.width, each.channels, each.work) for each in found.networks] == [
        (64, 96, 12, ((12, *wide),)),
        (64, 32, 12, ((12, *small), (8, *small))),
        (64, 96, 12, ((12, *wide),)),
        (64, 96, 12, ((12, *wide),)),
    ]
    assert found.networks[0] is found.networks[2] is found.networks[3] and found.avatars == (1, 3, 2, 1)
    assert found.meshes == (1.0, 2.5, 2.0, 0.25)
    assert found.frames == (0, SKIPS, 1, 2, 3) * 120
    works[:] = [(FrameWork.NONE, None, "", 0.0)]
    (nobody,) = sources.tenants(["home.toml"])
    assert (nobody.fps, nobody.frames[:2], nobody.networks[0].height) == (24.0, (SKIPS, SKIPS), 80)


def test_heat_is_that_of_all_together() -> None:
    """Power of the DSP by the share of time in which both keep it busy; so the device ends hotter than with one."""
    two = [avatar(512, 30), replace(avatar(512, 15), name="second")]
    one, both = (predict_beside(CHIP, which, minutes=10) for which in (two[:1], two))
    assert [(row["name"], row["kind"], row["unit"]) for row in both["pipelines"]] == [
        ("avatar", "avatar", "dsp"),
        ("second", "avatar", "dsp"),
    ]
    assert {(row["policy"], row["edge"]) for row in both["pipelines"]} == {("latest", "double")}
    dsp = CHIP.units["dsp"]
    assert both["unit_power_w"]["dsp"] == pytest.approx(dsp.power_w(CORNERS[2], both["units"]["dsp"]["busy"]))
    assert both["units"]["dsp"]["busy"] > 1.3 * one["units"]["dsp"]["busy"]
    assert both["temperature_c"]["device_end"] > one["temperature_c"]["device_end"] + 0.5
    assert all(row["frame_ms_settled"] > 0 for row in both["pipelines"])


def test_what_is_typed_is_read() -> None:
    read = sources.asked
    assert read("portrait") == ("portrait", "portrait", None, None)
    assert read("a@home.toml")[1:3] == ("a@home.toml", None)
    assert read("a@home.toml@24")[1:3] == ("a@home.toml", 24.0)
    assert read("n@b.onnx@7.5:gpu")[1:] == ("n@b.onnx", 7.5, "gpu")


BAD = {
    "a rate of zero": ("network.onnx@0", "rate '0', expected frames a second, 0.001 to 1000"),
    "a negative rate": ("network.onnx@-30", "rate '-30'"),
    "no number": ("network.onnx@fast", "rate 'fast'"),
    "an infinite rate": ("network.onnx@inf", "rate 'inf'"),
    "a huge rate": ("network.onnx@1e9", "rate '1e9'"),
    "above the most": ("network.onnx@1000.5", "0.001 to 1000"),
    "an empty rate": ("network.onnx@", "rate ''"),
    "no file": ("@30", "no scene and no file"),
    "an empty unit": ("network.onnx@30:", "pipeline 'network.onnx@30:': found unit '', expected gpu or dsp"),
    "an unknown unit": ("network.onnx@30:npu", "unit 'npu', expected gpu or dsp"),
    "a network without a rate": ("net@work.onnx", "such as net@work.onnx@30; by itself: --network net@work.onnx"),
    "a missing network": ("missing.onnx@30", "missing.onnx"),
    "an unknown scene": ("beach", "'beach'"),
    "a missing scene": ("missing.toml@20", "missing.toml"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(
    case: str, command: Callable[..., tuple[str, str]], monkeypatch: Any, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    text, said = BAD[case]
    _, message = command("predict", "builtin-not-reached.toml" if "scene" in case else text, code=2)
    _, beside = command("predict", text, "--beside", text, code=2)
    assert said in beside
    assert said in message or "scene" in case


def test_options_that_do_not_go_with_a_scene_are_refused(command: Callable[..., tuple[str, str]]) -> None:
    for arguments, said in (
        (("--beside", "portrait"), "--beside without a scene"),
        (("portrait", "--encoder", "resnet18", "--what-if"), "--encoder, --what-if beside a scene"),
        (("portrait", "--turns", "lottery"), "--turns: found 'lottery', expected round-robin or deadline"),
        (("portrait", "--policy", "none"), "--policy: found 'none'"),
        (("portrait", "--edge", "tripel"), "--edge: found edge 'tripel'"),
        (("portrait", *["--beside", "portrait"] * 8), "9 pipelines, expected at most 8"),
    ):
        assert said in command("predict", *arguments, code=2)[1]


def test_a_network_of_one_frame_has_no_frame_time(
    command: Callable[..., tuple[str, str]], tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    onnx.save(additions(32), "add.onnx")
    row = next(line for line in command("predict", "add.onnx@0.001")[0].splitlines() if "│ add" in line)
    assert row.split("│")[3].strip() == "-"


def test_two_networks_as_a_table_and_as_json(
    command: Callable[..., tuple[str, str]], check_printed: Callable[[str, str], None], tmp_path: Path, monkeypatch: Any
) -> None:
    """Of networks alone, which say nothing of this machine."""
    monkeypatch.chdir(tmp_path)
    onnx.save(additions(64), "add.onnx")
    two = ("predict", "add.onnx@60", "--beside", "add.onnx@20:gpu", "--profile", "snapdragon-888")
    check_printed("predict-beside", command(*two, "--minutes", 5)[0])
    answer = json.loads(command(*two, "--json")[0])
    assert [(row["name"], row["kind"], row["unit"]) for row in answer["pipelines"]] == [
        ("add (1)", "network", "dsp"),
        ("add (2)", "network", "gpu"),
    ]
    assert np.isclose(answer["units"]["dsp"]["by_pipeline"]["add (1)"], answer["units"]["dsp"]["busy"])


def test_the_trace_of_pipelines_beside_each_other_has_the_shares_of_the_answer(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: Callable[..., tuple[str, str]]
) -> None:
    """Each is a group of tracks; the time in which its units work is what the answer says of it."""
    two = [avatar(), bare("gpu", fps=30.0, side=64)]
    monkeypatch.setattr(sources, "tenants", lambda *_: two)
    file = tmp_path / "both.pftrace"
    out, _ = command("predict", "any", "--beside", "other@2", "--trace", file, "--json")
    answer, trace = json.loads(out), read_trace(file.read_bytes())
    for row in answer["pipelines"]:
        (run,) = trace.of(f"{row['name']}, virtual clock/run")
        assert run.notes["config"]["turns"] == "round-robin"
        for unit, share in row["units"].items():
            busy_ns = sum(
                one.end_ns - one.begin_ns - one.notes.get("preempted_ns", 0)
                for one in trace.of(f"{row['name']}, virtual clock/{unit}")
                if one.flows
            )
            assert busy_ns / (run.end_ns - run.begin_ns) == pytest.approx(share["busy"], abs=1e-9)
