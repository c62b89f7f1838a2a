"""The pose stage: a frame's number to a packet that says everything, and what other stages make of a frame's work."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.small_pipeline import assets_of, packet, packets, without_bytes
from trilane.arrays import shape_buckets
from trilane.avatars.bundle import add_mesh_levels, load_bundle
from trilane.avatars.mesh_levels import MeshLevel
from trilane.body.joints import Skeleton
from trilane.body.skinning import DETAILS, FrameSkinner
from trilane.errors import BadInputError
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.stage import Skip, UnitContext
from trilane.scene.crop import MARGIN_PX, Rect, lay_out
from trilane.scene.planner import FrameWork, shown_by, work_of
from trilane.scene.schema import AvatarSpec, CameraSpec, OutputSpec, Scene
from trilane.stages.avatar_assets import staged_of
from trilane.stages.config import RunConfig, pose_dtype, posed_vertices, posed_vertices_bytes
from trilane.stages.cpu.pose import PoseStage, build
from trilane.stages.cpu.present import PresentStage
from trilane.stages.gpu.composite import DrawnFrames
from trilane.transport.packets import Packet

OUTPUT = (480, 640)
UNITS = {unit: UnitSettings(cores=(0,), threads=1) for unit in ("cpu", "gpu", "dsp")}


def config(bundle: Path, out_dir: Path, **scene: Any) -> RunConfig:
    made = Scene(**scene)
    return RunConfig(scene=made, out_dir=out_dir, avatar_dirs=(bundle,) * len(made.avatars), units=UNITS)


def pose_stage(config: RunConfig) -> PoseStage:
    return PoseStage(config, assets_of(config))


def bound(stage: PoseStage, avatars: int = 1, payload_bytes: int = 0) -> Packet:
    slot = packet(payload_bytes, avatars)
    stage.bind([], [slot])
    return slot


def test_a_frame_is_the_same_whatever_came_before(tiny_bundle: Path, tmp_path: Path) -> None:
    first, second = (pose_stage(config(tiny_bundle, tmp_path)) for _ in range(2))
    packets = bound(first), bound(second)
    for frame in (7, 250, 90):
        first.run(frame, None, 0)
    second.run(90, None, 0)
    for key in ("view", "projection", "tensor_shape", "avatars"):
        assert packets[0].header[key].tobytes() == packets[1].header[key].tobytes()


def test_an_avatar_out_of_the_picture_is_not_visible(tiny_bundle: Path, tmp_path: Path) -> None:
    spec = AvatarSpec(position=(0.0, 0.0, 40.0))
    stays = CameraSpec(place="none")
    stage = pose_stage(config(tiny_bundle, tmp_path, avatars=(AvatarSpec(), spec), camera=stays))
    slot = bound(stage, 2)
    assert stage.run(0, None, 0)["visible"] == 1.0
    assert slot.header["avatars"]["visible"].tolist() == [1, 0]
    only_hidden = pose_stage(config(tiny_bundle, tmp_path, avatars=(spec,), camera=stays))
    slot = bound(only_hidden)
    assert without_bytes(only_hidden.run(0, None, 0)) == {"visible": 0.0}
    assert tuple(slot.header["tensor_shape"]) in shape_buckets("256")


def test_a_rung_limits_the_pixels_of_the_tensor(tiny_bundle: Path, tmp_path: Path) -> None:
    """Of 160 x 160 pixels all, then a quarter; the shape that is taken is the densest within them."""
    own = config(tiny_bundle, tmp_path, size="auto")
    stepped = own.model_copy(
        update={"own_pixels": 160 * 160, "works": (1000, 250), "shapes": ((64, 32), (96, 64), (160, 96), (192, 128))}
    )
    stage = pose_stage(stepped)
    slot = bound(stage)
    shapes = []
    for rung in (0, 1, 0):
        stage.step_to(rung)
        stage.run(30 + rung, None, 0)
        shapes.append(tuple(slot.header["tensor_shape"].tolist()))
    assert shapes == [(192, 128), (96, 64), (192, 128)]
    assert 192 * 128 <= 160 * 160 and 96 * 64 <= 160 * 160 // 4 < 160 * 96


def test_the_tensor_has_the_shape_that_was_foreseen_for_its_second(tiny_bundle: Path, tmp_path: Path) -> None:
    """On either rung its own changes, the second from frame 10 on; both shapes are as dense for a body that stands."""
    standing = AvatarSpec(motion="builtin:t-pose", heading_deg=90.0)
    own = config(tiny_bundle, tmp_path, size="auto", avatars=(standing,), camera=CameraSpec(source="builtin:static"))
    first, second = (256, 96), (256, 128)
    changes = (((0.0, first), (10 / 30, second)), ((0.0, second), (10 / 30, first)))
    planned = {"own_pixels": 256 * 128, "works": (1000, 999), "shapes": (first, second), "changes": changes}
    stage = pose_stage(own.model_copy(update=planned))
    slot = bound(stage)
    for rung, expected in ((0, [first, second]), (1, [second, first])):
        stage.step_to(rung)
        for frame, shape in zip((9, 10), expected, strict=True):
            stage.forget()
            stage._made.clear()
            stage.run(frame, None, 0)
            assert tuple(slot.header["tensor_shape"].tolist()) == shape


def test_edges_are_checked(tiny_bundle: Path, tmp_path: Path) -> None:
    asked = config(tiny_bundle, tmp_path)
    unit = UnitContext("cpu", asked.units["cpu"], assets_of(asked))
    stage = build({"config": asked.model_dump(mode="json")}, unit)
    slot = bound(stage)
    with pytest.raises(ValueError, match="no input edge"):
        stage.bind([slot], [])
    with pytest.raises(ValueError, match="needs an output slot"):
        stage.run(0, None, None)
    stage.close()


@pytest.mark.parametrize("skins", [False, True])
def test_a_far_avatar_is_drawn_with_a_level_of_its_mesh(tiny_bundle: Path, tmp_path: Path, skins: bool) -> None:
    """A level that moves the surface by 2 cm: the middle of the picture shows half a pixel as 3.9 cm at 40 m, and as
    3 mm at 3 m (480 pixels, 50 deg).

    At 40 m the slot begins with the vertices of the level, which are some of the whole body's.
    """
    bundle = load_bundle(shutil.copytree(tiny_bundle, tmp_path / "levelled"))
    shaped, none = bundle.shaped_body(), np.zeros((1, 54), np.float32)
    faces, uv_faces = (rows[::40].copy() for rows in (shaped.body.faces, shaped.body.uv_faces))
    level = MeshLevel(faces, uv_faces, np.array([0.02], np.float32), none, none, 0.0)
    add_mesh_levels(bundle, [level])
    used = np.unique(faces)
    drawn = {}
    for metres in (3.0, 40.0):
        standing = AvatarSpec(motion="builtin:t-pose", position=(0.0, 0.0, -metres))
        still = CameraSpec(source="builtin:static", place="none")
        made = config(bundle.folder, tmp_path, avatars=(standing,), camera=still)
        counts = (len(shaped.vertices),) if skins else ()
        stage = pose_stage(made.model_copy(update={"posed_vertices": counts}))
        slot = bound(stage, 1, posed_vertices_bytes(counts))
        figures = stage.run(0, None, 0)
        mesh = int(slot.header["avatars"][0]["mesh"])
        drawn[metres] = (mesh, figures["triangles"])
        assert figures["error_px"] <= 0.5
        if skins and mesh:
            own, whole = posed_vertices(slot.payload, counts)[0], np.zeros_like(shaped.vertices)
            mover = staged_of(assets_of(made)).movers[0]
            pose, place = mover.sample(0.0)
            posed = Skeleton(shaped.joints, shaped.body.parents).pose(pose, place, mover.world)
            FrameSkinner(shaped, DETAILS[stage.plan.seen[0].level]).skin_into(posed, whole)
            np.testing.assert_allclose(own[: len(used)], whole[used], atol=1e-5)
            assert not own[len(used) :].any()
    assert drawn == {3.0: (0, len(shaped.body.faces)), 40.0: (1, len(faces))}


def test_a_plan_that_models_everything_draws_the_whole_mesh(tiny_bundle: Path, tmp_path: Path) -> None:
    bundle = load_bundle(shutil.copytree(tiny_bundle, tmp_path / "levelled"))
    shaped, none = bundle.shaped_body(), np.zeros((1, 54), np.float32)
    level = MeshLevel(shaped.body.faces[:9], shaped.body.uv_faces[:9], np.zeros(1, np.float32), none, none, 0.0)
    add_mesh_levels(bundle, [level])
    for plan, mesh in (("planned", 1), ("fixed", 0), ("full", 0)):
        stage = pose_stage(config(bundle.folder, tmp_path, plan=plan))
        slot = bound(stage)
        stage.run(0, None, 0)
        assert int(slot.header["avatars"][0]["mesh"]) == mesh


sides = st.tuples(st.floats(-1, 0.9), st.floats(0.02, 2)).map(lambda p: (p[0], min(p[0] + p[1], 1.0)))
rects = st.tuples(sides, sides).map(lambda p: Rect(p[0][0], p[1][0], p[0][1], p[1][1]))


@given(st.lists(rects, min_size=1, max_size=8), st.sampled_from(["256", "320x192", "512"]))
def test_crops_hold_their_bodies_and_cells_keep_their_distance(found: list[Rect], size: str) -> None:
    layout = lay_out(found, OUTPUT, shape_buckets(size))
    taken = np.zeros((layout.shape[0] + MARGIN_PX, layout.shape[1] + MARGIN_PX), dtype=int)
    for rect, (crop, (top, left, height, width)) in zip(found, layout.crops, strict=True):
        assert crop.x0 <= rect.x0 + 1e-9
        assert crop.y0 <= rect.y0 + 1e-9
        assert crop.x1 >= rect.x1 - 1e-9
        assert crop.y1 >= rect.y1 - 1e-9
        assert top + height <= layout.shape[0]
        assert left + width <= layout.shape[1]
        assert top >= 0
        assert left >= 0
        taken[top : top + height + MARGIN_PX, left : left + width + MARGIN_PX] += 1
        shown = crop.width * OUTPUT[1] / (crop.height * OUTPUT[0])
        assert shown == pytest.approx(width / height, rel=1e-6)
    assert taken.max() == 1


@given(st.lists(rects, min_size=2, max_size=8), st.sampled_from(["256", "512"]))
def test_avatars_share_the_tensor_in_proportion_to_their_area(found: list[Rect], size: str) -> None:
    """One scale for all, to the pixel that rounding up may add to each side."""
    layout = lay_out(found, OUTPUT, shape_buckets(size))
    pixels = [cell[3] / (crop.width * OUTPUT[1] / 2) for crop, cell in layout.crops]
    assert max(pixels) == pytest.approx(min(pixels), rel=1e-6)


def test_margins_shrink_before_avatars_are_left_out() -> None:
    small = [Rect(-0.5, -0.5, 0.5, 0.5)] * 8
    assert len(lay_out(small, OUTPUT, [(32, 32)]).crops) == 8
    with pytest.raises(BadInputError, match="8 avatars"):
        lay_out(small, OUTPUT, [(2, 2)])


def never() -> bool:
    raise AssertionError("asked in vain")


def test_a_frame_is_made_again_only_when_something_differs() -> None:
    assert work_of(b"a", b"a", None, never) is FrameWork.REUSE
    assert work_of(b"b", b"a", b"b", never) is FrameWork.NONE
    assert work_of(b"c", b"a", b"b", lambda: True) is FrameWork.FULL
    assert work_of(b"c", b"a", None, lambda: False) is FrameWork.NONE
    assert work_of(b"a", None, None, lambda: True) is FrameWork.FULL
    assert int(FrameWork.FULL) == 0  # what a header says that nobody wrote to


def test_what_is_shown_differs_by_its_last_bit() -> None:
    view, pose = np.eye(4), np.zeros((55, 3))
    other = pose.copy()
    other[54, 2] = np.nextafter(0.0, 1.0)
    assert shown_by([view, pose]) == shown_by([view.copy(), pose.copy()])
    assert len({shown_by([view, pose]), shown_by([view, other]), shown_by([np.eye(4) * 2, pose])}) == 3


def bound_pose(bundle: Path, folder: Path, slots: int = 2, **scene: Any) -> tuple[PoseStage, list[Any]]:
    still = CameraSpec(source="builtin:static", place="none")
    stage = pose_stage(config(bundle, folder, camera=still, **scene))
    made = packets(pose_dtype(len(scene["avatars"])), slots, 0)
    stage.bind([], made)
    return stage, [slot.header for slot in made]


def test_a_still_avatar_is_posed_once_until_the_stage_must_forget(tiny_bundle: Path, tmp_path: Path) -> None:
    stage, (first, second) = bound_pose(tiny_bundle, tmp_path, avatars=(AvatarSpec(motion="builtin:t-pose"),))
    assert type(stage.run(4, None, 0)) is dict
    second["epoch"] = 9
    assert without_bytes(stage.run(5, None, 1)) == Skip(visible=1.0)
    assert [int(header["work"]) for header in (first, second)] == [FrameWork.FULL, FrameWork.REUSE]
    assert [int(header["picture"]) for header in (first, second)] == [4, 4]
    assert [int(second[name]) for name in ("frame", "epoch")] == [5, 9]
    assert float(second["media_time_s"]) == 5 / 30
    for name in ("view", "projection", "avatars", "avatar_count", "tensor_shape"):
        assert first[name].tobytes() == second[name].tobytes()
    stage.forget()
    assert type(stage.run(6, None, 1)) is dict
    assert (int(second["work"]), int(second["picture"])) == (FrameWork.FULL, 6)


def test_who_is_off_the_screen_is_neither_skinned_nor_drawn(
    tiny_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind the camera; that the body moves changes nothing, and to forget makes no frame full in which nobody is."""
    stage, (header, _) = bound_pose(tiny_bundle, tmp_path, avatars=(AvatarSpec(position=(0.0, 0.0, 40.0)),))
    monkeypatch.setattr(type(stage._actors[0].body.bounds), "rect", lambda *_: never())
    for frame in (0, 1, 30):
        assert without_bytes(stage.run(frame, None, 0)) == Skip(visible=0.0)
        assert (int(header["work"]), int(header["picture"])) == (FrameWork.NONE, -1)
        stage.forget()


def test_a_slot_that_holds_a_drawing_need_not_be_drawn_again() -> None:
    drawn = DrawnFrames()
    still, other = (3, 0, b"v", b"p"), (3, 1, b"v", b"p")
    assert drawn.slot_of(still, 0) is None
    assert drawn.note(0, still, 7, None) == 0
    assert (drawn.slot_of(still, 1), drawn.slot_of(other, 1), drawn.slot_of(None, 0)) == (0, None, None)
    assert drawn.note(1, still, 8, 0) == 8  # 1 + 7
    assert (drawn.slot_of(still, 1), drawn.slot_of(still, 0)) == (1, 0)
    assert drawn.note(0, other, 9, None) == 0
    assert (drawn.slot_of(still, 0), drawn.slot_of(other, 1)) == (1, 0)
    assert drawn.note(0, still, 10, 1) == 8
    assert drawn.note(0, None, 11, None) == 0
    assert drawn.slot_of(None, 0) is None


def test_a_repeated_frame_is_digested_and_shown_as_the_one_that_it_repeats(tmp_path: Path) -> None:
    """Frames 0 to 5: 1 and 2 say that they are 0, 4 says 3; 5 says 0, which was not the last one, so it is digested."""
    slots = packets(pose_dtype(1), 3, 64 * 64 * 3)
    for number, slot in enumerate(slots):
        slot.payload[:] = 50 * number + 1
    scene = Scene(output=OutputSpec(width=64, height=64))
    stage = PresentStage(RunConfig(scene=scene, out_dir=tmp_path, avatar_dirs=(), units=UNITS))
    stage.bind(slots, [])
    for frame, slot, repeats in ((0, 0, 0), (1, 0, 1), (2, 0, 1), (3, 1, 0), (4, 1, 4), (5, 2, 1)):
        slots[slot].header["repeats"] = repeats
        stage.run(frame, slot, None)
    stage.close()
    (file,) = (tmp_path / "segments").glob("*.sha256")
    digests = [line.split()[1] for line in file.read_text().splitlines()]
    assert digests[0] == digests[1] == digests[2] and digests[3] == digests[4]
    assert len(set(digests)) == 3
