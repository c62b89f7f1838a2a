"""Staged scenes: their notes, and every field as an array."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.body.body import ShapedBody
from trilane.scene.camera.path import CameraPath, Optics
from trilane.scene.camera_placement import PlacedCamera
from trilane.scene.lens import Known, Lens, of_fov_y
from trilane.scene.motion.motion import Motion, Wrap
from trilane.scene.mover import Mover
from trilane.scene.schema import AvatarSpec, Scene
from trilane.scene.staging import Staged, stage_scene, staged_from_arrays, staged_to_arrays


def test_notes_of_a_staged_scene_say_what_they_are_of(body: ShapedBody) -> None:
    specs = (AvatarSpec(motion="builtin:t-pose"), AvatarSpec(motion="builtin:idle"))
    staged = stage_scene(Scene(avatars=specs), [body, body], Path("/"))
    motions = [f"motion: {note}" for mover in staged.movers for note in (*mover.motion.notes, *mover.notes)]
    assert staged.notes == (*motions, *(f"camera: {note}" for note in staged.camera.path.notes))
    assert len(motions) >= 4 and staged.notes[0] == "motion: built in: the T pose"


@pytest.mark.parametrize("wrap", Wrap)
@pytest.mark.parametrize("leg_m", [None, 0.8])
def test_every_field_survives_as_an_array(wrap: Wrap, leg_m: float | None) -> None:
    random = np.random.default_rng(4)
    motion = Motion(
        np.array([0.0, 0.5, 1.0]), random.normal(size=(3, 55, 3)), random.normal(size=(3, 3)),
        None if leg_m is None else random.normal(size=4), ("note",), wrap, leg_m, leg_m is None,
    )  # fmt: skip
    mover = Mover(
        motion,
        random.normal(size=(4, 4)),
        1.3,
        random.normal(size=3),
        np.array([0.0, 1.0]),
        np.array([2.0, 3.0]),
        ("n",),
    )
    lens = Optics((Lens(9.0, 8.0, 7.0, 6.0, 5.0, 4.0, Known.WIDTH), of_fov_y(33.0)), 0.2, 44.0, ((3, 4),), (1, 2))
    quats, places = random.normal(size=(2, 4)), random.normal(size=(2, 3))
    camera = CameraPath(
        np.array([0.0, 2.0]),
        quats,
        places,
        lens,
        ("c",),
        wrap,
        leg_m is None,
        pictures=("a", "b"),
        quarter=3,
        is_held=True,
        repeat_s=7.0,
        began_s=None if leg_m is None else 3.0,
    )
    placed = PlacedCamera(camera, random.normal(size=(3, 3)), random.normal(size=3), random.normal(size=(3, 3)), ("p",))
    arrays = staged_to_arrays(Staged((mover, mover), placed, ("all",)))
    again = staged_from_arrays(arrays)
    assert again.notes == () and len(again.movers) == 2
    assert ("mover.1.betas" in arrays, "mover.0.leg_m" in arrays) == (leg_m is not None, leg_m is not None)

    def same(ours: Any, theirs: Any) -> None:
        for field in dataclasses.fields(ours):
            if field.name == "notes":
                assert getattr(theirs, "notes") == ()  # noqa: B009
            elif dataclasses.is_dataclass(getattr(ours, field.name)):
                same(getattr(ours, field.name), getattr(theirs, field.name))
            else:
                np.testing.assert_array_equal(getattr(ours, field.name), getattr(theirs, field.name))

    same(mover, again.movers[1])
    same(placed, again.camera)
