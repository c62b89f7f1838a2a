"""A scene with everything in its place: the motions on the floor, and a camera that films them.

Rule: this is the only way from a scene and its bodies to what is sampled per frame, so that what the command line
reports of a scene is what the pose stage does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from trilane.body.body import ShapedBody
from trilane.scene.camera.files import load_camera
from trilane.scene.camera_placement import place_camera
from trilane.scene.footage import Footage, filmed
from trilane.scene.motion.files import load_motion
from trilane.scene.mover import Mover, make_mover
from trilane.scene.placed_camera import PlacedCamera
from trilane.scene.schema import Scene


@dataclass(frozen=True)
class Staged:
    """`movers`: one per avatar of the scene. `notes`: what was decided about motions, floor and camera, for people."""

    movers: tuple[Mover, ...]
    camera: PlacedCamera
    notes: tuple[str, ...]


def stage_scene(scene: Scene, bodies: Sequence[ShapedBody], base: Path, footage: Footage | None = None) -> Staged:
    """Load the motions and the camera of `scene`, whose avatars have `bodies`; relative paths start at `base`.

    `footage`: what its background is; None for a drawn one. Raises BadInputError when a file is unusable.
    """
    motions = [load_motion(spec, base, body.joints) for spec, body in zip(scene.avatars, bodies, strict=True)]
    movers = tuple(
        make_mover(spec, motion, body) for spec, motion, body in zip(scene.avatars, motions, bodies, strict=True)
    )
    output = scene.output.height, scene.output.width
    path, seen = filmed(load_camera(scene.camera, base), footage, output)
    camera = place_camera(path, scene, movers, bodies)
    notes = [f"motion: {note}" for mover in movers for note in (*mover.motion.notes, *mover.notes)]
    notes += [f"camera: {note}" for note in (*path.notes, *((path.course,) if path.recorded else ()), *camera.notes)]
    notes += [f"background: {note}" for note in seen]
    return Staged(movers, camera, tuple(notes))
