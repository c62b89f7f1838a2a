"""`trilane plan`: phases, costs and totals of a scene, each against the parts that they are put together from."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from trilane.apps.cli.explain import app
from trilane.apps.explain.scene_plan import (
    ALWAYS,
    BODY,
    MESH,
    PIPELINED,
    TENSOR,
    CostModel,
    PlannedFrame,
    ScenePlan,
    draw_plan,
    least_frame_ms,
    phases,
)
from trilane.avatars.bundle import add_mesh_levels, load_bundle
from trilane.avatars.mesh_levels import MeshLevel
from trilane.avatars.network_file import reshaped
from trilane.avatars.validation import size_loss
from trilane.body.joints import Skeleton
from trilane.body.skinning import DETAILS, CpuSkinner
from trilane.errors import BadInputError
from trilane.hw_profiles.application import Plan, stage_times_ms, steady
from trilane.hw_profiles.network_work import Network, count_work
from trilane.hw_profiles.predict import predict
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.schema import corners_of
from trilane.scene.crop import Rect
from trilane.scene.planner import FrameWork
from trilane.scene.tensor_budget import MOST_DENSITY
from trilane.stages.avatar_assets import shaped_body, staged_of
from trilane.stages.configure import Checked, configure
from trilane.stages.cpu.pose import FramePlan, SeenAvatar
from trilane.stages.run_options import RunOptions

CHIP, CAP = "snapdragon-888", "sustained_high_performance"
SCENE = """
frames = 40
size = "auto"
error_budget_px = 2.0
[output]
width = 320
height = 240
[camera]
source = "builtin:far"
[[avatars]]
bundle = "{bundle}"
"""


@pytest.fixture(scope="module")
def folder(tiny_bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scene small.toml."""
    made = tmp_path_factory.mktemp("explained")
    (made / "small.toml").write_text(SCENE.format(bundle=tiny_bundle))
    return made


@pytest.fixture(scope="module")
def checked(folder: Path) -> Checked:
    return configure(RunOptions(scene=str(folder / "small.toml"), runtime="ort"), folder, lambda: {"hardware": False})


def explained(folder: Path, *options: str) -> Any:
    chip = [] if "--profile" in options else ["--profile", CHIP]
    result = CliRunner().invoke(app, ["plan", str(folder / "small.toml"), *chip, *options])
    assert result.exit_code == 0, result.output
    return result


@pytest.fixture(scope="module")
def printed(folder: Path) -> str:
    """The document as the command prints it, which takes a second."""
    return str(explained(folder, "--json").stdout)


@pytest.fixture
def document(printed: str) -> Any:
    return json.loads(printed)


def planned(frame: int, shape: tuple[int, int] | None, *levels: int) -> PlannedFrame:
    seen = {number: SeenAvatar(Rect(0, 0, 1, 1), level, 0.1) for number, level in enumerate(levels)}
    return PlannedFrame(frame, FramePlan(FrameWork.FULL if shape else FrameWork.NONE, shape, None, seen), {})


def test_frames_of_one_kind_are_a_phase() -> None:
    """Another shape, another level of detail or another avatar begins the next one."""
    small, large = (64, 64), (96, 64)
    frames = [
        planned(0, small, 2),
        planned(1, small, 2),
        planned(2, large, 2),
        planned(3, large, 3),
        planned(4, large, 3, 3),
        planned(5, None),
        planned(6, None),
        planned(7, small, 2),
    ]
    frames.append(PlannedFrame(8, replace(frames[-1].plan, work=FrameWork.REUSE), {}))
    assert [[one.frame for one in group] for group in phases(frames)] == [[0, 1], [2], [3], [4], [5, 6], [7], [8]]


def test_phases_cover_the_scene_and_add_up(document: Any) -> None:
    rows, totals = document["phases"], document["totals"]
    assert [row["first_frame"] for row in rows] == [0, *(row["last_frame"] + 1 for row in rows[:-1])]
    assert rows[-1]["last_frame"] == 39
    assert [row["frames"] for row in rows] == [row["last_frame"] - row["first_frame"] + 1 for row in rows]
    for key in ("pixels", "gmac", "work_ms"):
        assert totals[key] == pytest.approx(sum(row["frames"] * row["cost"][key] for row in rows))
        assert totals[f"fixed_{key}"] - totals[key] == pytest.approx(
            sum(row["frames"] * row["saved"][key] for row in rows)
        )
    assert totals["frame_ms"] == pytest.approx(sum(row["frames"] * row["cost"]["frame_ms"] for row in rows) / 40)
    assert totals["fixed_pixels"] == 40 * 512 * 512
    assert {tuple(row["tensor"]) for row in rows} <= {tuple(shape) for shape in document["shapes"]}


def test_a_phase_says_what_is_modelled_and_its_error(document: Any) -> None:
    (avatar,) = document["avatars"]
    is_measured = bool(size_loss(load_bundle(avatar["bundle"]), 1).curve)
    for row in document["phases"]:
        assert 0 < row["density"][0] <= row["density"][1]
        assert is_measured or row["density"][1] <= MOST_DENSITY
        assert row["work"] == "full"
        assert row["cost"]["pixels"] == row["tensor"][0] * row["tensor"][1]
        (avatar,) = row["avatars"]
        assert avatar["modelled"] in [detail.name for detail in DETAILS[:-1]]
        assert 0 <= avatar["measured_px"] <= avatar["bound_px"] <= 2.0
        assert row["why"] == (
            "the fewest pixels within 0.04 dB of the best size, by the table `by_size` in the manifest"
            if is_measured
            else "2.25 tensor pixels along a side of a pixel of the picture: more make no better picture"
            if row["density"][1] == MOST_DENSITY
            else "the pixels that the network was trained to paint, in the shape that fits best of those that are ready"
        )
    assert document["sources"] == {
        "bound_px": "proved bound, in pixels of the picture",
        "measured_px": "measured in this run, at a phase's first frame, at the vertices that are drawn",
        "pixels, gmac": "counted",
        "ms": "computed",
    }


def test_a_fixed_size_is_explained_as_such_and_its_picture_named_in_one_line(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / f"{'wide' * 40}.png"
    result = explained(folder, "--json", "--size", "64x64", "--out", str(file))
    assert file.is_file() and f"picture: {file}" in result.stderr.splitlines()
    rows = json.loads(result.stdout)["phases"]
    assert {tuple(row["tensor"]) for row in rows} == {(64, 64)}
    assert {row["why"] for row in rows} == {"the scene fixes the tensor's size"}
    assert all(row["density"] is None for row in rows)


def test_a_tensor_that_most_side_limits_says_so_and_claims_no_loss(tiny_bundle: Path, tmp_path: Path) -> None:
    """A body of about 75 x 30 pixels needs more than 32 x 32; without the limit, nothing speaks of it."""
    text = SCENE.format(bundle=tiny_bundle)
    (tmp_path / "small.toml").write_text(text.replace('size = "auto"', 'size = "auto"\nmost_side = 32'))
    small = json.loads(explained(tmp_path, "--json").stdout)
    assert {row["why"] for row in small["phases"]} == {"as many pixels as most_side = 32 allows: the avatars need more"}
    assert small["image"]["psnr_loss_db"] is None and "most_side = 32" in small["image"]["source"]
    (tmp_path / "small.toml").write_text(text)
    large = json.loads(explained(tmp_path, "--json").stdout)
    assert "most_side" not in json.dumps([large["phases"], large["image"]])


def test_the_table_names_avatars_reasons_in_order_and_how_to_read_it(checked: Checked, folder: Path) -> None:
    """The scene's notes are on stderr, as those of a run, so that nothing that was decided is silent."""
    result = explained(folder)
    assert "avatar1: " in result.stdout
    assert "density: tensor pixels for one pixel of the picture, along a side; bound: the largest" in result.stdout
    firsts = [int(line.split()[1]) for line in result.stdout.splitlines() if "and others like it" in line]
    assert firsts and firsts == sorted(firsts)
    told = [note for note in checked.notes if not note.startswith(("runtime", "skinning"))]
    assert told and all(note in result.stderr and note not in result.stdout for note in told)


def test_costs_are_those_of_the_profile(tiny_bundle: Path) -> None:
    """As `trilane predict` computes them; a frame with nobody in view needs neither raster nor network."""
    network, chip = load_bundle(tiny_bundle).read_network(), load_profile(CHIP)
    costs, corners = CostModel([network], CHIP, CAP), corners_of(chip, CAP)
    work = count_work(reshaped(network, 96, 64).model)
    plan = Plan(Network({}, 96, 64, network.channels, "packed", work), "dsp", PIPELINED)
    times = {stage: ms for (stage, _), ms in stage_times_ms(chip, plan, corners).items()}
    cost = costs.of((96, 64))
    assert (cost.pixels, cost.gmac) == (96 * 64, work.macs / 1e9)
    assert cost.work_ms == pytest.approx(sum(times.values()))
    assert cost.frame_ms == pytest.approx(steady(chip, plan, corners, quick=True).frame_ms)
    nothing = costs.of(None)
    assert (nothing.pixels, nothing.gmac) == (0, 0.0)
    assert nothing.work_ms == pytest.approx(times["pose"] + times["composite"] + times["present"])
    assert nothing.frame_ms == chip.application.display_ms.or_else(0) == 16.6
    assert set(ALWAYS) == {"pose", "composite", "present"}


def test_each_avatar_in_view_has_its_joints_and_vertices(tiny_bundle: Path) -> None:
    """0.3 ms of pose and 10,475 vertices of 5 ns each, by clocks; the tensor, network and picture are shared."""
    network, chip = load_bundle(tiny_bundle).read_network(), load_profile(CHIP)
    costs, corners = CostModel([network], CHIP, CAP), corners_of(chip, CAP)
    app, described = chip.application, Network({}, 96, 64, 16, "packed", count_work(reshaped(network, 96, 64).model))
    one, five = (stage_times_ms(chip, Plan(described, "dsp", avatars=count), corners) for count in (1, 5))
    cpu, gpu = (chip.units[unit].clock(corner) for unit, corner in zip(("cpu", "gpu"), corners, strict=False))
    drawn = app.vertices.or_else(0) * app.raster_ns_per_vertex.or_else(0) / gpu / 1e6
    more = {stage: five[stage, unit] - ms for (stage, unit), ms in one.items()}
    assert app.pose_ms.or_else(0) > 0 < drawn
    assert more["pose"] == pytest.approx(4 * app.pose_ms.or_else(0) / cpu)
    assert more["raster"] == pytest.approx(4 * drawn)
    assert {more[stage] for stage in ("infer", "composite", "present")} == {0}
    assert costs.of((96, 64), 5).work_ms - costs.of((96, 64), 1).work_ms == pytest.approx(more["pose"] + more["raster"])
    assert costs.of((96, 64), 5).gmac == costs.of((96, 64)).gmac
    with pytest.raises(BadInputError, match="avatars: found 0"):
        Plan(described, "dsp", avatars=0)


def test_phases_and_the_fixed_square_count_the_avatars_in_view(tiny_bundle: Path, tmp_path: Path) -> None:
    """Two of three: the third stands behind the camera in every frame."""
    more = '[[avatars]]\nbundle = "{bundle}"\nmotion = "builtin:idle"\nposition = [{x}, 0.0, {z}]\n'
    text = SCENE + more.replace("{x}", "0.8").replace("{z}", "0.0") + more.replace("{x}", "0.0").replace("{z}", "90.0")
    (tmp_path / "small.toml").write_text(text.format(bundle=tiny_bundle))
    document = json.loads(explained(tmp_path, "--json", "--frames", "4").stdout)
    costs = CostModel([load_bundle(tiny_bundle).read_network()], CHIP, CAP)
    for row in document["phases"]:
        cost, fixed = costs.of(tuple(row["tensor"]), 2), costs.of((512, 512), 2)
        assert [one["avatar"] for one in row["avatars"]] == [0, 1]
        assert (row["cost"]["work_ms"], row["cost"]["frame_ms"]) == (cost.work_ms, cost.frame_ms)
        assert row["saved"]["work_ms"] == fixed.work_ms - cost.work_ms
    assert document["totals"]["fixed_work_ms"] == pytest.approx(4 * costs.of((512, 512), 2).work_ms)


def test_a_level_of_the_mesh_costs_its_vertices_and_the_fixed_square_the_whole_mesh(
    tiny_bundle: Path, tmp_path: Path
) -> None:
    bundle = load_bundle(shutil.copytree(tiny_bundle, tmp_path / "levelled"))
    shaped, none = bundle.shaped_body(), np.zeros((1, 54), np.float32)
    faces, uv_faces = (rows[:9].copy() for rows in (shaped.body.faces, shaped.body.uv_faces))
    add_mesh_levels(bundle, [MeshLevel(faces, uv_faces, np.zeros(1, np.float32), none, none, 0.0)])
    (tmp_path / "small.toml").write_text(SCENE.format(bundle=bundle.folder))
    (row,) = json.loads(explained(tmp_path, "--json", "--frames", "2").stdout)["phases"]
    costs = CostModel([bundle.read_network()], CHIP, CAP)
    shape, share = tuple(row["tensor"]), len(np.unique(faces)) / len(shaped.vertices)
    assert row["avatars"][0]["mesh"]["level"] == 1
    cost = costs.of(shape, 1, meshes=share)
    assert row["cost"]["work_ms"] == cost.work_ms < costs.of(shape, 1).work_ms
    assert row["saved"]["work_ms"] == costs.of((512, 512), 1).work_ms - cost.work_ms
    table = " ".join(explained(tmp_path, "--frames", "2").stdout.split())
    assert f"mesh level 1 (9 of {len(shaped.body.faces)} triangles), " in table


def test_a_frame_without_network_takes_as_long_as_its_busiest_core() -> None:
    """No display: pose and present follow each other on the CPU; on one core all three stages do."""
    times: Any = {("pose", "cpu"): 2.0, ("composite", "gpu"): 3.0, ("present", "cpu"): 1.5}

    def chip(display: float, **cores: str) -> Any:
        units = {unit: SimpleNamespace(core=cores.get(unit)) for unit in ("cpu", "gpu", "dsp")}
        return SimpleNamespace(units=units, application=SimpleNamespace(display_ms=Known(display)))

    assert least_frame_ms(chip(0.0), times) == 3.5
    assert least_frame_ms(chip(0.0, cpu="a", gpu="a"), times) == 6.5
    assert least_frame_ms(chip(16.6), times) == 16.6


class Known(NamedTuple):
    """A cost that a profile has."""

    value: float

    def or_else(self, _other: float) -> float:
        return self.value


def test_on_this_machine_units_are_placed_as_in_a_prediction(
    checked: Checked, monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    """For the shape of most frames, on two cores."""
    for module in ("host", "predict"):
        monkeypatch.setattr(f"trilane.hw_profiles.{module}.usable_cores", lambda: (0, 1))
    monkeypatch.setattr("trilane.apps.explain.scene_plan.usable_cores", lambda: (0, 1))
    document = json.loads(explained(folder, "--json", "--profile", "host").stdout)
    frames = {tuple(row["tensor"]): 0 for row in document["phases"]}
    for row in document["phases"]:
        frames[tuple(row["tensor"])] += row["frames"]
    shape = max(frames, key=lambda one: frames[one])
    network = load_bundle(checked.config.avatar_dirs[0]).read_network()
    described = Network({}, *shape, network.channels, "packed", count_work(reshaped(network, *shape).model))
    expected = predict(load_profile("host"), Plan(described, "dsp", PIPELINED), CAP).placement
    assert document["placement"]["units"] == expected["units"]
    assert document["placement"]["predicted_ms"] == expected["predicted_ms"]
    assert f"{expected['rule_ms']:.1f} ms. A run measures" in document["placement"]["why"]


def test_what_a_run_may_be_asked_can_be_explained(folder: Path, tmp_path: Path) -> None:
    """The same scene as a run with these options has: its picture, rate, motion and camera, and where it is skinned."""
    picture, scene = (
        ["--fps", "24", "--picture", "200x120"],
        ["--motion", "builtin:idle", "--camera", "builtin:closeup"],
    )
    options = [*picture, *scene, "--skinning", "gpu", "--frames", "6"]
    document = json.loads(explained(folder, "--json", *options).stdout)
    request = RunOptions(
        scene=str(folder / "small.toml"),
        motion="builtin:idle",
        camera="builtin:closeup",
        frames=6,
        skinning="gpu",
        runtime="ort",
        fps=24,
        picture="200x120",
    )
    asked = configure(request, tmp_path)
    plan = ScenePlan(asked.config, asked.assets)
    groups = phases([plan.decide(frame) for frame in range(6)])
    assert (document["config"]["fps"], document["config"]["output"]) == (24, [120, 200])
    assert [row["tensor"] for row in document["phases"]] == [list(group[0].plan.shape or ()) for group in groups]
    assert document["avatars"][0]["skinned_on"] == "gpu"
    assert "--picture: found '12', expected WIDTHxHEIGHT" in str(
        CliRunner().invoke(app, ["plan", str(folder / "small.toml"), "--picture", "12"]).exception
    )


def test_cores_that_are_asked_for_are_kept(tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two cores: the other units go where frames are shortest; a network on both cores may share them."""
    for module in ("hw_profiles.host", "hw_profiles.predict", "apps.explain.scene_plan"):
        monkeypatch.setattr(f"trilane.{module}.usable_cores", lambda: (0, 1))
    costs = CostModel([load_bundle(tiny_bundle).read_network()], "host", CAP)
    free = costs.placement((96, 64))
    every = {"cpu": (1,), "gpu": (0,), "dsp": (0, 1)}
    placed = costs.placement((96, 64), asked=every)
    assert {unit: tuple(row["cores"]) for unit, row in placed["units"].items()} == every
    assert placed["units"]["dsp"]["threads"] == 2
    assert placed["why"] == "cpu 1, gpu 0, dsp 0,1 (2 threads): as asked"
    one = costs.placement((96, 64), asked={"gpu": (1,)})
    assert one["units"]["gpu"] == {"cores": [1], "threads": 1} and "gpu 1, dsp" in one["why"]
    assert "as asked, the others for the least predicted frame time; by the rule" in one["why"]
    assert one["predicted_ms"] <= 1.03 * free["predicted_ms"]
    with pytest.raises(BadInputError, match="--cores: found cores of snapdragon-888, expected --profile host"):
        CostModel([load_bundle(tiny_bundle).read_network()], CHIP, CAP).placement(None, asked={"gpu": (0,)})


def test_measured_errors_are_those_of_the_drawn_vertices(checked: Checked) -> None:
    """Of the vertices on the picture, the furthest between the whole body and what the pose stage wrote."""
    plan = ScenePlan(checked.config, checked.assets)
    frame = plan.decide(7)
    body, staged = shaped_body(checked.assets, 0), staged_of(checked.assets)
    t_s = 7 / checked.config.scene.fps
    posed = Skeleton(body.joints, body.body.parents).pose(*staged.movers[0].sample(t_s), staged.movers[0].world)
    clip = staged.camera.projection(t_s, (240, 320)) @ staged.camera.sample(t_s)

    def places(vertices: Any) -> Any:
        points = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1) @ clip.T
        ndc = points[:, :3] / points[:, 3:]
        pixels = np.stack([(ndc[:, 0] + 1) * 160, (1 - ndc[:, 1]) * 120], axis=1)
        return np.where((np.abs(ndc) <= 1).all(axis=1)[:, None], pixels, np.nan)

    exact = places(CpuSkinner(body).vertices(posed))
    np.testing.assert_allclose(plan.places(7, 0), exact, atol=1e-6)
    drawn = places(plan._drawn[0].astype(np.float64))
    assert plan.measured_px(7, 0) == pytest.approx(np.nanmax(np.linalg.norm(exact - drawn, axis=1)), abs=1e-6)
    assert frame.plan.seen[0].level < len(DETAILS) - 1


def test_a_vertex_is_on_the_picture_from_the_near_plane_to_the_far_one(checked: Checked) -> None:
    """A camera that looks along -z from the origin, 90 degrees high and wide, near 1 and far 3: a point at depth d has
    the clip depth 2 d - 3, from -1 to 3 = w, so the nearer half of the depths has a negative one."""
    plan = ScenePlan(checked.config, checked.assets)
    projection = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -2, -3], [0, 0, -1, 0]])
    plan._staged = SimpleNamespace(  # type: ignore[assignment]
        camera=SimpleNamespace(
            projection=lambda _t_s, output: projection * output[1] / output[0] / (4 / 3), sample=lambda _t_s: np.eye(4)
        )
    )
    points = np.array(
        [(0.5, 0.5, -1.0), (0.6, -0.3, -1.2), (0, 0, -3), (0, 0, -0.99), (0, 0, -3.01), (0, 0, 2), (2, 0, -1.5)]
    )
    found = plan._places(points, 5)
    np.testing.assert_allclose(found[:3], [(240, 60), (240, 150), (160, 120)])
    assert np.isnan(found[3:]).all()


def test_the_picture_shows_bodies_and_rectangles(checked: Checked, tmp_path: Path) -> None:
    plan = ScenePlan(checked.config, checked.assets)
    frame = plan.decide(0)
    draw_plan(plan, [frame], tmp_path / "plan.png")
    pixels = np.array(Image.open(tmp_path / "plan.png"))
    assert pixels.shape == (240, 320, 3)
    for colour, rect in ((TENSOR, frame.crops[0]), (MESH, frame.plan.seen[0].rect)):
        rows, columns = np.nonzero((pixels == colour).all(axis=2))
        assert columns.min() == pytest.approx((rect.x0 + 1) * 160, abs=1)
        assert columns.max() == pytest.approx((rect.x1 + 1) * 160, abs=2)
        assert rows.min() == pytest.approx((1 - rect.y1) * 120, abs=1)
        assert rows.max() == pytest.approx((1 - rect.y0) * 120, abs=2)
    assert (pixels == BODY).all(axis=2).sum() > 5


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--profile", "no-such-chip"], "no-such-chip"),
        (["--frames", "0"], "frames: found 0"),
        (["--size", "300"], "a multiple of 32"),
        (["--out", "/nowhere/at/all.png"], "/nowhere"),
        (["--out", "plan.jpg"], "--out: found 'plan.jpg', expected a name that ends in .png"),
    ],
)
def test_wrong_options_are_named(folder: Path, options: list[str], words: str) -> None:
    result = CliRunner().invoke(app, ["plan", str(folder / "small.toml"), *options])
    assert result.exit_code != 0
    assert words in result.output + str(result.exception)


def test_the_full_plan_is_not_run(tiny_bundle: Path, tmp_path: Path) -> None:
    (tmp_path / "full.toml").write_text(f'plan = "full"\n[[avatars]]\nbundle = "{tiny_bundle}"\n')
    result = CliRunner().invoke(app, ["plan", str(tmp_path / "full.toml")])
    said = f"{tmp_path / 'full.toml'}: plan: found full, expected planned or fixed; `trilane bench planner` draws"
    assert said in str(result.exception)
    (tmp_path / "both.toml").write_text('plan = "fixed"\nsize = "auto"\n')
    result = CliRunner().invoke(app, ["plan", str(tmp_path / "both.toml")])
    assert 'size = "auto" with plan = "fixed"' in str(result.exception)
