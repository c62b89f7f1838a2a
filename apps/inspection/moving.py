"""What a motion or a camera is, by the reader that a run would use.

Rule: nothing is placed in a scene here, so that what is said is of the file alone.
"""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path

import numpy as np
from PIL import Image

from trilane.apps.inspection.drawn_paths import cameras, skeletons
from trilane.apps.inspection.inspection import Inspection, Length, used
from trilane.avatars.bundle import DEFAULT, bundle_folder
from trilane.body.body import ShapedBody, load_body
from trilane.body.kinematics import Skeleton
from trilane.scene.camera.files import load_camera
from trilane.scene.camera.path import CameraPath
from trilane.scene.motion.files import load_motion
from trilane.scene.motion.motion import Motion
from trilane.scene.rotations import matrix_from_quat
from trilane.scene.schema import AvatarSpec, CameraSpec

MOMENTS = 6
MOST_PATH_POINTS = 2000


def inspect_motion(path: Path) -> Inspection:
    """Raises BadInputError when the motion is not usable."""
    motion = load_motion(AvatarSpec(motion=str(path.absolute())), Path(), _body().joints)
    places = motion.translation
    facts = {
        "travels": motion.travels,
        "ground_m": [round(float(side), 3) for side in np.ptp(places, axis=0)[[0, 2]]],
        "leg_m": None if motion.leg_m is None else round(motion.leg_m, 3),
        "betas": 0 if motion.betas is None else len(motion.betas),
    }
    return Inspection(
        "motion",
        f"a motion: {motion.detected.format or 'a recording'}",
        "",
        used("--motion", path),
        motion.detected,
        Length.of(motion.times_s),
        facts,
        motion.notes,
        partial(_drawn_motion, motion),
    )


def inspect_camera(path: Path) -> Inspection:
    """Raises BadInputError when the camera is not usable."""
    camera = load_camera(CameraSpec(source=str(path.absolute())), Path())
    low, high = camera.places.min(axis=0), camera.places.max(axis=0)
    steps = np.linalg.norm(np.diff(camera.places, axis=0), axis=1)
    angles = [lens.fov_y_deg for lens in camera.optics.lenses]
    facts = {
        "fov_y_deg": [round(min(angles), 3), round(max(angles), 3)],
        "lenses": len(angles),
        "pictures": len(camera.pictures),
        "extent_m": [round(float(side), 3) for side in high - low],
        "path_m": round(float(steps.sum()), 3),
    }
    return Inspection(
        "camera",
        f"a camera path: {camera.detected.format or 'a recording'}",
        "",
        used("--camera", path),
        camera.detected,
        Length.of(camera.times_s),
        facts,
        camera.notes,
        partial(_drawn_camera, camera),
    )


@cache
def _body() -> ShapedBody:
    """On which motions are shown: the default avatar's."""
    return load_body(bundle_folder(DEFAULT) / "body.npz").shape()


def _drawn_motion(motion: Motion) -> Image.Image:
    body = _body()
    skeleton = Skeleton(body.joints, body.body.parents)
    times = np.linspace(0.0, motion.duration_s, MOMENTS if motion.duration_s else 1)
    joints = []
    for time_s in times:
        pose, place = motion.sample(float(time_s))
        joints.append(skeleton.pose(pose, place - body.joints[0]).joints.copy())
    return skeletons(np.stack(joints), times, _thinned(motion.translation))


def _drawn_camera(camera: CameraPath) -> Image.Image:
    return cameras(_thinned(matrix_from_quat(camera.quats)), _thinned(camera.places))


def _thinned(samples: np.ndarray) -> np.ndarray:
    """`samples` (N, ...), or MOST_PATH_POINTS of them, evenly spread, first and last among them."""
    if len(samples) <= MOST_PATH_POINTS:
        return samples
    return np.asarray(samples[np.linspace(0, len(samples) - 1, MOST_PATH_POINTS).round().astype(int)])
