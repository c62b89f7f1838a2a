"""The pose stage: a frame's number to a packet that says everything, the same every time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.small_pipeline import assets_of, without_bytes
from trilane.body.kinematics import Skeleton
from trilane.errors import BadInputError, TrilaneError
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.stage import UnitContext
from trilane.scene.crop import Rect
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene
from trilane.scene.tensor_layout import MARGIN_PX, lay_out
from trilane.shapes import shape_buckets
from trilane.stages.config import RunConfig
from trilane.stages.cpu.pose import PoseStage, build
from trilane.stages.packets import pose_dtype
from trilane.transport.packets import Packet, SlotLayout, view_packet

OUTPUT = (480, 640)


def config(bundle: Path, out_dir: Path, **scene: Any) -> RunConfig:
    made = Scene(**scene)
    settings = {unit: UnitSettings(cores=(0,), threads=1) for unit in ("cpu", "gpu", "dsp")}
    return RunConfig(scene=made, out_dir=out_dir, avatar_dirs=(bundle,) * len(made.avatars), units=settings)


def pose_stage(config: RunConfig) -> PoseStage:
    return PoseStage(config, assets_of(config))


def bound(stage: PoseStage, avatars: int = 1) -> Packet:
    layout = SlotLayout(pose_dtype(avatars), 0)
    packet = view_packet(memoryview(bytearray(layout.slot_bytes)), layout)
    stage.bind([], [packet])
    return packet


def test_a_packet_says_everything_of_its_frame(tiny_bundle: Path, tmp_path: Path) -> None:
    stage = pose_stage(config(tiny_bundle, tmp_path, fps=25.0))
    packet = bound(stage)
    before = time.monotonic_ns()
    assert without_bytes(stage.run(50, None, 0)) == {"visible": 1.0, "level": 5.0, "error_px": 0.0}
    pose, avatar = packet.header, packet.header["avatars"][0]
    assert (int(pose["frame"]), float(pose["media_time_s"]), int(pose["avatar_count"])) == (50, 2.0, 1)
    assert before <= int(pose["t_sampled_ns"]) <= time.monotonic_ns()
    assert tuple(pose["tensor_shape"]) in shape_buckets("256")
    assert avatar["visible"] == 1
    assert tuple(avatar["tensor_rect"]) == (0, 0, *pose["tensor_shape"])
    rect = avatar["rect"]
    aspect = (rect[2] - rect[0]) * OUTPUT[1] / ((rect[3] - rect[1]) * OUTPUT[0])
    assert aspect == pytest.approx(pose["tensor_shape"][1] / pose["tensor_shape"][0], rel=1e-4)


def test_the_skinned_feet_stand_on_the_floor(tiny_bundle: Path, tmp_path: Path) -> None:
    stage = pose_stage(config(tiny_bundle, tmp_path))
    packet = bound(stage)
    for frame in (0, 31, 150):
        stage.run(frame, None, 0)
        joints = packet.header["avatars"][0]["joints"].astype(np.float64)
        ankles = [joints[k] @ [0.131 * side, -0.859, -0.001, 1.0] for k, side in ((7, 1), (8, -1))]
        assert 0.05 < min(place[1] for place in ankles) < 0.11


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
    stage = pose_stage(config(tiny_bundle, tmp_path, avatars=(AvatarSpec(), spec)))
    packet = bound(stage, 2)
    assert stage.run(0, None, 0)["visible"] == 1.0
    assert packet.header["avatars"]["visible"].tolist() == [1, 0]
    only_hidden = pose_stage(config(tiny_bundle, tmp_path, avatars=(spec,)))
    packet = bound(only_hidden)
    assert without_bytes(only_hidden.run(0, None, 0)) == {"visible": 0.0}
    assert tuple(packet.header["tensor_shape"]) in shape_buckets("256")


def test_an_avatar_that_no_pose_brings_into_the_picture_is_not_posed(
    tiny_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stands behind the camera; the other one is posed in every frame."""
    posed: list[float] = []
    pose = Skeleton.pose

    def noted(self: Skeleton, *args: Any) -> Any:
        posed.append(float(args[2][2, 3]))
        return pose(self, *args)

    away = AvatarSpec(position=(0.0, 0.0, 40.0), heading_deg=30.0)
    stage = pose_stage(config(tiny_bundle, tmp_path, avatars=(away, AvatarSpec())))
    bound(stage, 2)
    monkeypatch.setattr(Skeleton, "pose", noted)
    for frame in range(3):
        assert stage.run(frame, None, 0)["visible"] == 1.0
    assert posed == [0.0] * 3


def test_a_rung_limits_the_pixels_of_the_tensor(tiny_bundle: Path, tmp_path: Path) -> None:
    """Of 160 x 160 pixels all, then a quarter; the shape that is taken is the densest within them."""
    own = config(tiny_bundle, tmp_path, size="auto")
    stepped = own.model_copy(
        update={"own_pixels": 160 * 160, "works": (1000, 250), "shapes": ((64, 32), (96, 64), (160, 96), (192, 128))}
    )
    stage = pose_stage(stepped)
    packet = bound(stage)
    shapes = []
    for rung in (0, 1, 0):
        stage.step_to(rung)
        stage.run(30 + rung, None, 0)
        shapes.append(tuple(packet.header["tensor_shape"].tolist()))
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
    packet = bound(stage)
    for rung, expected in ((0, [first, second]), (1, [second, first])):
        stage.step_to(rung)
        for frame, shape in zip((9, 10), expected, strict=True):
            stage.forget()
            stage._made.clear()
            stage.run(frame, None, 0)
            assert tuple(packet.header["tensor_shape"].tolist()) == shape


def test_two_avatars_share_the_tensor(tiny_bundle: Path, tmp_path: Path) -> None:
    pair = (AvatarSpec(position=(-0.6, 0, 0)), AvatarSpec(position=(0.6, 0, 0), motion="builtin:idle"))
    stage = pose_stage(config(tiny_bundle, tmp_path, avatars=pair))
    packet = bound(stage, 2)
    stage.run(0, None, 0)
    (_, left, _, width), second = sorted(packet.header["avatars"]["tensor_rect"].tolist(), key=lambda cell: cell[1])
    assert second[1] >= left + width + MARGIN_PX


def test_nan_never_leaves_the_stage(tiny_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = pose_stage(config(tiny_bundle, tmp_path, camera=CameraSpec(source="builtin:static")))
    bound(stage)
    mover = type(stage._actors[0].mover)
    monkeypatch.setattr(mover, "sample", lambda *_: (np.full((55, 3), np.nan), np.zeros(3)))
    with pytest.raises(TrilaneError, match="frame 3: the pose of avatar 0 is not finite"):
        stage.run(3, None, 0)


def test_edges_are_checked(tiny_bundle: Path, tmp_path: Path) -> None:
    asked = config(tiny_bundle, tmp_path)
    unit = UnitContext("cpu", asked.units["cpu"], assets_of(asked))
    stage = build({"config": asked.model_dump(mode="json")}, unit)
    packet = bound(stage)
    with pytest.raises(ValueError, match="no input edge"):
        stage.bind([packet], [])
    with pytest.raises(ValueError, match="needs an output slot"):
        stage.run(0, None, None)
    stage.close()


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
