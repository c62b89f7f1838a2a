"""Pictures of whole scenes made in this process: those of the stages and of the plan `full`."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.arrays import F32, F64, to_light
from trilane.avatars.bundle import CLOTHES_STANDOFF_M
from trilane.bench.lib import full_picture
from trilane.bench.lib.cast import Box, Cast, RasterLayer, blended, premultiplied
from trilane.bench.lib.full_picture import SAMPLES, FullPictures, true_pictures
from trilane.bench.lib.stage_chain import AvatarFrames
from trilane.body.body import load_body
from trilane.stages.configure import Checked
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.stages.gpu import opengl
from trilane.stages.gpu.composite_painters import AvatarPainter, PicturePainter
from trilane.training.clothing import LOOKS, clothing_layers, find_landmarks
from trilane.training.sample_renderer import ClothedBody
from trilane.training.surface import body_arrays
from trilane.units import AVATARS


def test_blending_is_what_the_painter_does_on_the_same_grid(gl: Any) -> None:
    """Bytes as the network gives them, a tensor pixel for each pixel: one byte off at most, as drivers round sRGB."""
    rng = np.random.default_rng(0)
    output, box = (48, 80), Box(-10, 30, 22, 94)
    background, rgba = (rng.integers(0, 256, (*shape, n), dtype=np.uint8) for shape, n in ((output, 3), (box.shape, 4)))
    texture = gl.texture(output[::-1], 4, internal_format=opengl.SRGB8_ALPHA8)
    target = gl.framebuffer([texture])
    below, avatar = PicturePainter(gl, output), AvatarPainter(gl, [box.shape])
    below.upload(background)
    avatar.upload(box.shape, rgba.reshape(-1))
    target.use()
    below.draw()
    avatar.draw(target, box.shape, tuple(box.rect(output)), (0, 0, *box.shape))
    drawn = np.frombuffer(target.read(components=3, alignment=1), np.uint8).reshape(*output, 3)
    own = blended(background, [RasterLayer(box, -1.0, premultiplied(rgba / 255.0))])
    assert np.abs(drawn.astype(int) - own).max() <= 1
    for picture in (own, drawn):
        changed = (picture != background).any(axis=-1)
        assert changed[:22, 30:].mean() > 0.95 and changed.sum() == changed[:22, 30:].sum()


def test_full_changes_nothing_where_nobody_is(checked: Checked) -> None:
    """Outside the boxes, `full` and the composite stage's own frame have the bytes of the background."""
    frames, cast = AvatarFrames(checked), Cast(checked)
    background, frame = frames.background(5), frames.frame(5)
    (box,) = cast.boxes(5)
    picture = FullPictures(cast).frame(5, background)
    reach = max(box.shape) // 2 + 2  # the stages' rectangle is a square, as their tensor is
    row, column = (box.top + box.bottom) // 2, (box.left + box.right) // 2
    around = Box(row - reach, column - reach, row + reach, column + reach).on((128, 160))
    for found, place in ((picture, box), (frame, around)):
        outside = np.ones(found.shape[:2], bool)
        outside[place.top : place.bottom, place.left : place.right] = False
        assert outside.mean() > 0.3
        assert np.array_equal(found[outside], background[outside])
        assert (found != background).any(axis=-1)[~outside].mean() > 0.2


def test_the_body_is_in_one_place_at_every_density(checked: Checked, monkeypatch: pytest.MonkeyPatch) -> None:
    """Painted as the light that its pixels' cover is: averaging and enlarging keep the sum and the middle of light.

    Only the reads differ. They are at most half a pixel apart, so a row or a column of cover is off by a quarter of a
    pixel at either end, and its middle by no more.
    """
    cast = Cast(checked)
    for folder, data in cast.avatars.items():
        cast.avatars[folder] = replace(data, texture=np.ones_like(data.texture))

    def paint(tensor: F64) -> F32:
        return np.concatenate([np.ones((*tensor.shape[:2], 3)), tensor[..., :1]], axis=-1).astype(np.float32)

    monkeypatch.setattr(full_picture, "float_network", lambda _: (paint, "cover"))
    full, black, found = FullPictures(cast), np.zeros((128, 160, 3), np.uint8), []
    for times in (Fraction(1), Fraction(2), Fraction(1, 2)):
        monkeypatch.setattr(full_picture, "fineness", lambda *_, times=times: times)
        light = to_light(full.frame(5, black)[..., 0] / 255.0)
        rows, columns = np.indices(light.shape)
        assert light.sum() > 100
        found.append(((light * rows).sum() / light.sum(), (light * columns).sum() / light.sum()))
    for other in found[1:]:
        assert np.abs(np.subtract(other, found[0])).max() < 0.25


@pytest.mark.parametrize("name", AVATARS)
def test_the_truth_is_what_the_training_draws(name: str, far_scene: Any, tmp_path: Path, gl: Any) -> None:
    """The clothes of the avatar's look on the skin; on the offsets, which are these clothes, they would stand off."""
    cast = Cast(far_scene(name, tmp_path))
    (data,), (seen,), look = cast.avatars.values(), cast.seen(5), LOOKS[name]
    true = true_pictures(cast, gl)
    assert true is not None and data.shaped.body.offsets is not None
    skin = body_arrays(load_body(data.bundle.body_path).shape(data.bundle.manifest.betas).bare())
    landmarks = find_landmarks(skin.vertices, skin.joints, skin.weights)
    clothed = ClothedBody(gl, clothing_layers(skin, landmarks, look), landmarks, SAMPLES, look)
    wanted = clothed.render(seen.joints, seen.view, seen.projection, seen.box.shape)
    (layer,) = true.layers(5)
    assert (wanted[..., 3] == 255).any()
    differs = np.abs(layer.light - premultiplied(wanted / 255.0)).max(axis=-1) > 0.02
    assert differs.sum() <= 0.02 * (wanted[..., 3] > 0).sum()  # a skin that was moved out and back is rounded otherwise


def test_the_cast_has_room_for_its_clothes(checked: Checked) -> None:
    """Its rectangle is that of the mesh and what stands off it, which is larger than the mesh's alone on every side."""
    cast = Cast(checked)
    (actor,) = cast._actors
    posed = actor.skeleton.pose(*actor.mover.sample(0.5), actor.mover.world)
    clip = cast.projection(15) @ cast._camera.sample(0.5)
    clothed, bare = (
        MeshBounds(actor.data.shaped, standoff_m=off).rect(posed, clip) for off in (CLOTHES_STANDOFF_M, 0.0)
    )
    found = actor.bounds.rect(posed, clip)
    assert found == clothed and bare is not None and found is not None
    assert found.x0 < bare.x0 and found.y0 < bare.y0 and found.x1 > bare.x1 and found.y1 > bare.y1


def test_the_cast_is_where_the_pose_stage_says(checked: Checked) -> None:
    """The same moment, joints and camera to the bit, and a box around the rectangle that the stages crop by."""
    cast = Cast(checked)
    (seen,) = cast.seen(5)
    frames = AvatarFrames(checked)
    frames.frame(5)
    pose = frames.posed
    avatar = pose["avatars"][0]
    assert np.array_equal(seen.joints, avatar["joints"])
    assert np.array_equal(seen.view.astype(np.float32), pose["view"])
    own, cropped = seen.box.rect((128, 160)), avatar["rect"]
    pixel = 2 / 128
    assert own.y0 <= cropped[1] + pixel and own.y1 >= cropped[3] - pixel  # the body is tall: its height decides
    (data,) = cast.avatars.values()
    pelvis = avatar["joints"][0] @ np.append(data.shaped.joints[0], 1.0)
    clip = seen.projection @ seen.view @ np.append(pelvis, 1.0)
    assert np.abs(clip[:2] / clip[3]).max() < 0.5  # the hips are in the middle of the box
    assert seen.depth == pytest.approx(-clip[3], abs=1e-5)
