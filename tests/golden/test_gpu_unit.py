"""The GPU unit's two stages on real slots: what they write, and what the presented frame looks like."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from support.doubles import lose_context
from support.small_pipeline import assets_of, packet
from trilane.avatars.bundle import load_bundle
from trilane.errors import TrilaneError, UnitLostError
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.stage import UnitContext
from trilane.scene.schema import PlaneSpec, Scene
from trilane.stages.config import Quantisation, RunConfig
from trilane.stages.gpu import composite
from trilane.stages.gpu import raster as raster_stage
from trilane.stages.gpu.composite import CompositeStage
from trilane.stages.gpu.raster import PackedAvatar, PackedPass, RasterStage
from trilane.transport.packets import Packet

TENSOR = (96, 64)
OUTPUT = (240, 320)
ENCODING = Quantisation(6 / 255, 117)
Camera = Callable[..., Any]


def fill_pose(slot: Packet, joints: Any, view: Any, projection: Any, rect: Any, tensor: Any = TENSOR) -> None:
    """One visible avatar that fills the tensor."""
    slot.header["avatar_count"], slot.header["tensor_shape"] = 1, tensor
    slot.header["view"], slot.header["projection"] = view, projection
    avatar = slot.header["avatars"][0]
    avatar["visible"], avatar["rect"], avatar["tensor_rect"] = 1, rect, (0, 0, *tensor)
    avatar["joints"] = joints


@pytest.fixture
def raster(gl: Any, person: Any, neural_texture: Any) -> tuple[RasterStage, Packet, Packet]:
    """A raster stage with one input and one output slot."""
    packed = PackedPass(gl, 16, ENCODING, deferred=True)
    stage = RasterStage([packed], [PackedAvatar(packed, person.mesh, neural_texture)], [TENSOR])
    source, target = packet(0), packet(TENSOR[0] * TENSOR[1] * 16 + 64)
    stage.bind([source], [target])
    return stage, source, target


def test_crop_is_the_same_picture_enlarged(raster: Any, person: Any, camera: Camera) -> None:
    """The lower left quarter of the screen, drawn as the whole tensor, shows the lower left of the body."""
    stage, source, target = raster
    view, projection = camera((0, 0.9, 3), (0, 0.9, 0), 40, 64 / 96)
    whole, quarter = (np.empty((*TENSOR, 16), np.uint8) for _ in range(2))
    for tensor, rect in ((whole, (-1, -1, 1, 1)), (quarter, (-1, -1, 0, 0))):
        fill_pose(source, person.pose(np.zeros(165)), view, projection, rect)
        stage.run(0, 0, 0)
        tensor[:] = target.payload[: tensor.size].reshape(tensor.shape)
    seen, enlarged = ((t != ENCODING.zero_point).any(axis=-1) for t in (whole, quarter))
    assert seen[48:, :32].sum() > 100
    assert abs(enlarged[::2, ::2].sum() - seen[48:, :32].sum()) < 0.15 * seen[48:, :32].sum()
    assert not target.payload[whole.size :].any()


def test_an_unseen_avatar_is_background(raster: Any) -> None:
    """Every byte is the zero point, and bytes behind the tensor are left alone."""
    stage, source, target = raster
    source.header["avatar_count"], source.header["tensor_shape"] = 1, TENSOR
    stage.run(0, 0, 0)
    size = TENSOR[0] * TENSOR[1] * 16
    assert (target.payload[:size] == ENCODING.zero_point).all()
    assert not target.payload[size:].any()


def test_a_frame_with_nan_joints_is_refused(raster: Any, person: Any, camera: Camera) -> None:
    """The frame ends with an error that names it, before anything is drawn."""
    stage, source, _ = raster
    joints = person.pose(np.zeros(165))
    joints[7, 1, 2] = np.nan
    fill_pose(source, joints, *camera((0, 1, 3), (0, 1, 0)), (-1, -1, 1, 1))
    with pytest.raises(TrilaneError, match="frame 12: avatar 0"):
        stage.run(12, 0, 0)


def test_a_lost_context_is_an_error_not_a_stale_tensor(raster: Any, person: Any, camera: Camera) -> None:
    """Without a context OpenGL's calls do nothing, in silence."""
    stage, source, _ = raster
    fill_pose(source, person.pose(np.zeros(165)), *camera((0, 1, 3), (0, 1, 0)), (-1, -1, 1, 1))
    stage.run(0, 0, 0)
    lose_context()
    with pytest.raises(UnitLostError, match="context was lost"):
        stage.run(1, 0, 0)


def composed(
    gl: Any, person: Any, image: NDArray[np.uint8], camera: Any, rect: Any, joints: Any, **options: Any
) -> NDArray[np.uint8]:
    """The frame of a composite stage with the built-in room."""
    stage = CompositeStage(gl, OUTPUT, [TENSOR], [person.rest], None, **options)
    source, target = packet(image.size), packet(OUTPUT[0] * OUTPUT[1] * 3)
    stage.bind([source], [target])
    fill_pose(source, joints, *camera, rect)
    source.payload[:] = image.ravel()
    stage.run(0, 0, 0)
    stage.close()
    return target.payload.reshape(*OUTPUT, 3)


def disc() -> NDArray[np.uint8]:
    """A green disc with a soft rim; where it is transparent, the colour is red, which must not show."""
    y, x = np.indices(TENSOR) - np.array([47.5, 31.5])[:, None, None]
    alpha = np.clip(28 - np.hypot(x, y), 0, 1)
    image = np.zeros((*TENSOR, 4), np.uint8)
    image[..., 0], image[..., 1], image[..., 3] = np.where(alpha == 0, 255, 0), 160, np.rint(255 * alpha)
    return image


def test_frame_looks_as_it_did(gl: Any, person: Any, camera: Camera, golden: Any) -> None:
    """Room, contact shadow and disc. Tolerance: mean 1, 1 % of the bytes more than 8 off (drivers filter freely)."""
    view = camera((1.2, 1.5, 3.6), (0, 0.8, 0), 45, 4 / 3)
    frame = composed(gl, person, disc(), view, (-0.2, -0.3, 0.2, 0.5), person.pose(np.zeros(165)))
    golden("composite", frame, 1.0, 0.01)


def test_planes_lie_over_the_room_and_under_the_avatar(gl: Any, person: Any, camera: Camera) -> None:
    """A level plane lights the floor where it lies; the avatar's opaque pixels do not change."""
    scene = (
        disc(),
        camera((1.2, 1.5, 3.6), (0, 0.8, 0), 45, 4 / 3),
        (-0.2, -0.3, 0.2, 0.5),
        person.pose(np.zeros(165)),
    )
    plain, shown = composed(gl, person, *scene), composed(gl, person, *scene, planes=[PlaneSpec()])
    changed = (plain != shown).any(axis=2)
    assert 0.05 < changed.mean() < 0.6
    assert shown[changed].mean() > plain[changed].mean() + 5
    green = (plain == (0, 160, 0)).all(axis=2)
    assert green.sum() > 500
    assert not changed[green].any()


def built(bundle: Path, background: Path) -> tuple[RasterStage, CompositeStage]:
    """Both stages of a run of one avatar, made as a unit makes them: on one context."""
    config = RunConfig(
        scene=Scene(background=str(background), size="96x64"),
        out_dir=bundle,
        avatar_dirs=(bundle,),
        units={"gpu": UnitSettings(cores=(0,), threads=1)},
    )
    unit = UnitContext("gpu", config.units["gpu"], assets_of(config))
    settings = {"config": config.model_dump(mode="json")}
    return raster_stage.build(settings, unit), composite.build(settings, unit)


def test_the_factories_build_both_stages(tmp_path: Path, drawable_bundle: Path, person: Any, camera: Camera) -> None:
    """A picture as the background shows where the avatar's picture is empty."""
    path = tmp_path / "grey.png"
    Image.fromarray(np.full((30, 40, 3), 90, np.uint8)).save(path)
    drawn, composed_stage = built(drawable_bundle, path)
    zero_point = load_bundle(drawable_bundle).manifest.network.input.zero_point
    source, image = packet(0), packet(TENSOR[0] * TENSOR[1] * 16)
    frame = packet(640 * 480 * 3)
    drawn.bind([source], [image])
    fill_pose(source, person.pose(np.zeros(165)), *camera((0, 1, 3), (0, 1, 0)), (-1, -1, 1, 1))
    drawn.run(0, 0, 0)
    assert (image.payload[: TENSOR[0] * TENSOR[1] * 4] != zero_point).any()
    image.payload[:] = 0
    fill_pose(image, person.pose(np.zeros(165)), *camera((0, 1, 3), (0, 3, 0)), (-1, -1, 1, 1))
    composed_stage.bind([image], [frame])
    composed_stage.run(0, 0, 0)
    composed_stage.close()
    assert (frame.payload == 90).all()
