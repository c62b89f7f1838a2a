"""How a recorded camera and the avatars meet: the recording is set down in the scene so that it films them.

Rule: the recording is moved as one rigid piece and stays upright: it is turned about the vertical, shifted, and
lifted over the floor; what it does from frame to frame is never changed. Of all such places the one is taken from
which the whole bodies are in the picture in the most frames, then the one where they are largest. The avatars face
the camera at the first frame, as far as their own headings say. Where the background was not filmed by the same
camera, the camera is also tilted on its mount by one constant angle, so that it does not look at people from above.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trilane.arrays import F32, F64
from trilane.body.body import ShapedBody
from trilane.body.kinematics import Skeleton
from trilane.scene.camera.path import CameraPath, view_from_pose
from trilane.scene.floor import outline
from trilane.scene.mover import Mover
from trilane.scene.rotations import about
from trilane.scene.schema import Scene

#: Frames that a placement is judged by.
LOOKS = 48
#: Metres: how far aside of the camera, and how high over the floor, places are tried; first coarse, then finer.
REACH_M, COARSE_M = 7.0, 0.5
EYE_HEIGHTS_M: F64 = np.arange(0.8, 3.61, 0.2)
FINER_M = (0.25, 0.12, 0.06)
#: The camera is never nearer to the floor than this.
LOWEST_EYE_M = 0.3
#: Part of the picture's half height and width that a whole body keeps within.
MARGIN = 0.97
#: Where the camera looks in the median frame, degrees over the horizon: tilted to here when it is outside.
SIGHT_DEG = (-24.0, 0.0)
LARGEST_TILT_DEG = 40.0
SYNTHETIC_BACKGROUNDS = ("room",)
#: Worth of a large picture against a whole one, per share of the picture's height.
SIZE_WORTH, ENOUGH_SIZE = 0.12, 0.75
NEAREST_M = 0.3


@dataclass(frozen=True)
class PlacedCamera:
    """A camera in the scene. `turn` (3, 3) and `shift` (3,) take the path's world to the scene's.

    `mount` (3, 3): from the camera's axes to the recorder's.
    """

    path: CameraPath
    turn: F64
    shift: F64
    mount: F64
    notes: tuple[str, ...]

    def sample(self, t_s: float) -> F64:
        """World to camera (4, 4) at `t_s`, scene world."""
        turn, place = self.path.pose(t_s)
        return view_from_pose(self.turn @ turn @ self.mount, self.turn @ place + self.shift)

    def projection(self, aspect: float) -> F64:
        """OpenGL clip matrix (4, 4)."""
        return self.path.projection(aspect)


@dataclass(frozen=True)
class _Film:
    """What a placement is judged by. `views` (F, 3, 4): path world to camera. `eyes` (F, 3): path world.

    `boxes` (F, 8, 3): corners round the bodies, scene world. `scale` (2,): of x and y to NDC.
    """

    views: F32
    eyes: F64
    boxes: F64
    scale: F64


def place_camera(path: CameraPath, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> PlacedCamera:
    """Set `path` down among the avatars for the frames that `scene` asks for.

    A built-in camera, and one whose spec says `place = "none"`, is left where it is.
    """
    if not path.recorded or scene.camera.place == "none":
        return PlacedCamera(path, np.eye(3), np.zeros(3), np.eye(3), ())
    times = np.linspace(0.0, (scene.frames - 1) / scene.fps, min(scene.frames, LOOKS))
    tilt = _tilt_deg(path, times) if scene.background in SYNTHETIC_BACKGROUNDS else 0.0
    mount = about(0, np.radians(tilt))
    film = _film(path, mount, times, scene, movers, bodies)
    spots = _coarse_spots(film)
    best = _best(film, spots)
    for step in FINER_M:
        best = _best(film, _around(best, step))
    whole, size = _judged(film, best[None])
    turn, shift = _transform(film, best)
    eye = best[1] * -1 + film.eyes[:, 1].mean()
    tilted = (f"camera tilted by {tilt:+.0f} degrees on its mount",) if tilt else ()
    notes = (
        *tilted,
        f"camera set down {_distance(film, best):.1f} m from the avatar, {eye:.1f} m over the floor on average",
        f"whole body in the picture in {whole[0]:.0%} of the frames, {size[0]:.0%} of its height on average",
    )
    return PlacedCamera(path, turn, shift, mount, notes)


def _tilt_deg(path: CameraPath, times: F64) -> float:
    """Degrees to turn the camera up on its mount, so that the median line of sight is within SIGHT_DEG."""
    sight = float(np.median([np.degrees(np.arcsin(np.clip(-path.pose(float(t))[0][1, 2], -1, 1))) for t in times]))
    return float(np.clip(np.clip(sight, *SIGHT_DEG) - sight, -LARGEST_TILT_DEG, LARGEST_TILT_DEG))


def _film(
    path: CameraPath, mount: F64, times: F64, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]
) -> _Film:
    poses = [path.pose(float(t)) for t in times]
    views = np.stack([view_from_pose(turn @ mount, place)[:3] for turn, place in poses]).astype(np.float32)
    lows, highs = _bounds(times, movers, bodies)
    pick = np.array([[(k >> axis) & 1 for axis in range(3)] for k in range(8)], dtype=bool)
    boxes = np.where(pick[None], highs[:, None], lows[:, None])
    projection = path.projection(scene.output.width / scene.output.height)
    return _Film(views, np.stack([place for _, place in poses]), boxes, np.array([projection[0, 0], projection[1, 1]]))


def _bounds(times: F64, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> tuple[F64, F64]:
    """Lowest and highest corners (F, 3) round all bodies."""
    lows, highs = np.full((len(times), 3), np.inf), np.full((len(times), 3), -np.inf)
    for mover, body in zip(movers, bodies, strict=True):
        skeleton, shape = Skeleton(body.joints, body.body.parents), outline(body)
        for k, t_s in enumerate(times):
            pose, translation = mover.sample(float(t_s))
            points = shape.posed(skeleton.pose(pose, translation, mover.world).matrices)
            lows[k], highs[k] = np.minimum(lows[k], points.min(axis=0)), np.maximum(highs[k], points.max(axis=0))
    return lows, highs


def _coarse_spots(film: _Film) -> F64:
    """Places (S, 3) of the scene's origin in the path's world."""
    middle = film.eyes.mean(axis=0)
    level = np.arange(-REACH_M, REACH_M + COARSE_M / 2, COARSE_M)
    x, height, z = np.meshgrid(level, EYE_HEIGHTS_M, level, indexing="ij")
    return np.asarray(middle + np.stack([x.ravel(), -height.ravel(), z.ravel()], axis=1))


def _around(spot: F64, step: float) -> F64:
    offsets = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], dtype=np.float64)
    return np.asarray(np.concatenate([spot[None], spot + step * offsets]))


def _best(film: _Film, spots: F64) -> F64:
    whole, size = _judged(film, spots)
    worth = whole + SIZE_WORTH * np.minimum(size, ENOUGH_SIZE)
    worth = np.where(film.eyes[:, 1].min() - spots[:, 1] >= LOWEST_EYE_M, worth, -1.0)
    return np.asarray(spots[int(worth.argmax())])


def _judged(film: _Film, spots: F64) -> tuple[F64, F64]:
    """Per spot: share of the frames with whole bodies, mean share of the picture's height that they take. Each (S,)."""
    angle = _facing(film, spots)
    cos, sin = (f(angle).astype(np.float32)[:, None, None] for f in (np.cos, np.sin))
    boxes, spots32 = film.boxes.astype(np.float32), spots.astype(np.float32)[:, :, None, None]
    x = cos * boxes[..., 0] + sin * boxes[..., 2] + spots32[:, 0]
    y = boxes[..., 1] + spots32[:, 1]
    z = cos * boxes[..., 2] - sin * boxes[..., 0] + spots32[:, 2]
    right, up, back = (_row(film.views[:, k], x, y, z) for k in range(3))
    depth = np.maximum(-back, NEAREST_M)
    ahead = (-back > NEAREST_M).all(axis=-1)
    across, high = right * np.float32(film.scale[0]) / depth, up * np.float32(film.scale[1]) / depth
    inside = (np.abs(across) < MARGIN).all(axis=-1) & (np.abs(high) < MARGIN).all(axis=-1)
    tall = (np.clip(high.max(axis=-1), -1, 1) - np.clip(high.min(axis=-1), -1, 1)) / 2
    return (ahead & inside).mean(axis=1), np.where(ahead, tall, 0.0).mean(axis=1)


def _row(row: F32, x: F32, y: F32, z: F32) -> F32:
    """One row (F, 4) of the views on points (S, F, 8)."""
    a, b, c, d = (row[None, :, None, k] for k in range(4))
    return np.asarray(a * x + b * y + c * z + d)


def _facing(film: _Film, spots: F64) -> F64:
    """Angle (S,) about +Y from the scene to the path's world, for which +Z at each spot points to the first eye."""
    towards = film.eyes[0] - spots
    return np.asarray(np.arctan2(towards[:, 0], towards[:, 2]))


def _transform(film: _Film, spot: F64) -> tuple[F64, F64]:
    turn = about(1, -_facing(film, spot[None])[0])
    return turn, -turn @ spot


def _distance(film: _Film, spot: F64) -> float:
    return float(np.hypot(film.eyes[:, 0] - spot[0], film.eyes[:, 2] - spot[2]).mean())
