"""The camera in the scene: places a recorded one so that it films the avatars, and lets a person steer it.

The recording is moved as one rigid, upright piece: it is turned about the vertical and shifted; its movement from frame
to frame never changes. A fixed grid of places is searched, coarse and then finer. The best place shows whole bodies at
the most moments; among equals the one where they are larger wins. At first the camera is in front of the avatars, in
the direction that a heading of 0 faces. Over a drawn background the camera is also tilted by one constant angle, so
that it does not look down on people. The moments are those of the scene's first seconds, however many frames a run
shows and at whatever rate: a frame of a scene is the same picture in every run.

A person turns the view about the vertical through a pivot, then about the level axis that runs to the camera's right.
The camera stays upright, above the floor and off the pole; where the scene's own camera is beyond that, it is not
turned further out. Coming nearer is a move along the line to the pivot; the lens stays the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from trilane.arrays import F32, F64
from trilane.body.body import ShapedBody
from trilane.body.kinematics import Skeleton
from trilane.scene.camera.path import CameraPath, view_from_pose
from trilane.scene.mover import Mover, outline
from trilane.scene.rotations import about, quat_from_matrix, quat_multiply
from trilane.scene.schema import Scene
from trilane.shapes import Shape


@dataclass(frozen=True)
class PlacedCamera:
    """A camera in the scene.

    `turn` (3, 3), `shift` (3,): transform from the path's world to the scene's. `mount` (3, 3): turn from the camera's
    axes to those of the path. `notes`: what was decided, for people.
    """

    path: CameraPath
    turn: F64
    shift: F64
    mount: F64
    notes: tuple[str, ...]

    def sample(self, t_s: float) -> F64:
        """Return the matrix (4, 4) from world to camera at `t_s`; the world is the scene's."""
        turn, place = self.path.pose(t_s)
        return view_from_pose(self.turn @ turn @ self.mount, self.turn @ place + self.shift)

    def reach(self) -> tuple[F64, F64]:
        """Return the lowest and highest coordinates (3,) of all places of the camera in the scene."""
        places = self.path.places @ self.turn.T + self.shift
        return places.min(axis=0), places.max(axis=0)

    def projection(self, t_s: float, output: Shape) -> F64:
        """Return the OpenGL clip matrix (4, 4) at `t_s` for a picture of `output` (height, width)."""
        return self.path.projection(t_s, output)


LOWEST_DEG, HIGHEST_DEG = -8.0, 85.0
LEAST_LEVEL_M = 1e-6  # least level distance of the camera from the pivot; below it, the camera stands over the pivot


def steered(view: F64, pivot: F64, azimuth_deg: float, elevation_deg: float, zoom: float) -> F64:
    """Return the matrix (4, 4) from world to the camera of `view`, turned about `pivot` (3,) and moved towards it.

    `view`: matrix (4, 4) from world to camera. `azimuth_deg`: turn to the right about the vertical. `elevation_deg`:
    turn upwards. `zoom`: factor by which the camera is nearer, above 0.
    """
    if azimuth_deg == 0.0 and elevation_deg == 0.0 and zoom == 1.0:
        return view
    eye = -view[:3, :3].T @ view[:3, 3]
    turn = _turn(eye - pivot, azimuth_deg, elevation_deg)
    world = np.eye(4)
    world[:3, :3] = turn.T
    world[:3, 3] = pivot - turn.T @ pivot
    moved: F64 = view @ world
    seen = moved[:3, :3] @ pivot + moved[:3, 3]
    moved[:3, 3] += (1.0 / zoom - 1.0) * seen
    return moved


def _turn(arm: F64, azimuth_deg: float, elevation_deg: float) -> F64:
    """Return the turn (3, 3) of a camera at `arm` (3,) from the pivot."""
    level = float(np.hypot(arm[0], arm[2]))
    if level < LEAST_LEVEL_M:
        return about(1, np.radians(azimuth_deg))
    heading = np.arctan2(arm[0], arm[2])
    now_deg = float(np.degrees(np.arctan2(arm[1], level)))
    low, high = min(LOWEST_DEG, now_deg), max(HIGHEST_DEG, now_deg)
    raised = np.radians(np.clip(now_deg + elevation_deg, low, high) - now_deg)
    return about(1, heading + np.radians(azimuth_deg)) @ about(0, -raised) @ about(1, -heading)


#: Number of moments at which a place is scored, evenly spread over the first SCORED_S seconds of the scene. A shorter
#: motion or recording is repeated as in a run; what a longer one shows later does not count.
SCORED_MOMENTS, SCORED_S = 48, 10.0
#: The grid of places, metres: level up to REACH_M each way from the camera and EYE_HEIGHTS_M below it, first in steps
#: of COARSE_M, then in those of FINER_M around the best place so far.
REACH_M, COARSE_M = 7.0, 0.5
EYE_HEIGHTS_M: F64 = np.arange(0.8, 3.61, 0.2)
FINER_M = (0.25, 0.12, 0.06)
#: Least height of the camera above the floor.
LOWEST_EYE_M = 0.3
#: Share of the picture's half width and half height within which a body counts as whole in the picture.
MARGIN = 0.97
#: Share of the moments with whole bodies below which the run warns.
ENOUGH_WHOLE = 0.5
#: Range of the camera's median line of sight, degrees above the horizon; beyond it the camera is tilted to its end.
SIGHT_DEG = (-24.0, 0.0)
LARGEST_TILT_DEG = 40.0
SYNTHETIC_BACKGROUNDS = ("room",)
#: Score of the bodies' share of the picture's height, up to ENOUGH_SIZE; whole bodies at all moments score 1.
SIZE_WEIGHT, ENOUGH_SIZE = 0.12, 0.75
NEAREST_M = 0.3
#: Number of places that are scored together: so few that the arrays stay in the processor's cache.
PLACES_AT_ONCE = 256


@dataclass(frozen=True)
class _Footage:
    """The recording and the bodies at the F moments at which places are scored.

    `views` (F, 3, 4): matrices from the path's world to the camera. `eyes` (F, 3): places of the camera in the path's
    world. `boxes` (F, 8, 3): corners of a box around the bodies in the scene's world. `lenses` (F, 2, 2): factor and
    addend of x and of y, where ndc = factor * x / depth + addend.
    """

    views: F32
    eyes: F64
    boxes: F64
    lenses: F64


def place_camera(path: CameraPath, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> PlacedCamera:
    """Place the camera of a scene; a built-in one, and one whose spec has `place = "none"`, stays where it is.

    `path`: path of the camera.
    `scene`: scene, which states the background, the picture's size, and whether the camera is placed.
    `movers`: avatars of the scene.
    `bodies`: bodies of these avatars, in the same order.
    """
    times = np.linspace(0.0, SCORED_S, SCORED_MOMENTS)
    if not path.recorded:
        return PlacedCamera(path, np.eye(3), np.zeros(3), np.eye(3), ())
    if scene.camera.place == "none":
        footage = _footage(path, np.eye(3), times, scene, movers, bodies)
        whole, size = _filmed(footage, footage.boxes.astype(np.float32).transpose(2, 1, 0)[:, :, None])
        return PlacedCamera(path, np.eye(3), np.zeros(3), np.eye(3), _seen_notes(whole[0], size[0]))
    levelled, level, middle = _from_the_middle(path)
    tilt = _tilt_deg(path, times) if scene.background in SYNTHETIC_BACKGROUNDS else 0.0
    mount = about(0, np.radians(tilt))
    footage = _footage(levelled, mount, times, scene, movers, bodies)
    places = _coarse_grid(footage)
    best = _best(footage, places)
    for step in FINER_M:
        best = _best(footage, _finer_grid(best, step))
    whole, size = _visibility(footage, best[None])
    turn, shift = _transform(footage, best)
    eye = best[1] * -1 + footage.eyes[:, 1].mean()
    tilted = (f"camera tilted by {tilt:+.0f} degrees on its mount",) if tilt else ()
    notes = (
        *tilted,
        f"camera set down {_distance(footage, best):.1f} m from the avatar, {eye:.1f} m over the floor on average",
        *_seen_notes(whole[0], size[0]),
    )
    return PlacedCamera(path, turn @ level, shift - turn @ level @ middle, mount, notes)


def _seen_notes(whole: float, size: float) -> tuple[str, ...]:
    """Say how much of the bodies is filmed, with a warning where it is little."""
    seen = f"whole body in the picture in {whole:.0%} of the first {SCORED_S:g} s, {size:.0%} of its height on average"
    if whole >= ENOUGH_WHOLE:
        return (seen,)
    return seen, (
        f"warning: the body is whole in less than {ENOUGH_WHOLE:.0%} of them; if the picture lies on its side or looks "
        "past the body, state camera.up_axis or another camera.place"
    )


def _from_the_middle(path: CameraPath) -> tuple[CameraPath, F64, F64]:
    """Return `path` about its middle, first looking along -Z, and the turn (3, 3) and middle (3,) taken off it.

    So the grid of places is the same however the file's world is turned, and wherever it has its origin.
    """
    ahead = path.pose(0.0)[0][:, 2]
    level = about(1, -np.arctan2(ahead[0], ahead[2]))
    middle = path.places.mean(axis=0)
    turned = quat_multiply(quat_from_matrix(level), path.quats)
    return replace(path, quats=turned, places=(path.places - middle) @ level.T), level, middle


def _tilt_deg(path: CameraPath, times: F64) -> float:
    """Return the degrees by which the camera is tilted up so that its median line of sight is within SIGHT_DEG."""
    sight = float(np.median([np.degrees(np.arcsin(np.clip(-path.pose(float(t))[0][1, 2], -1, 1))) for t in times]))
    return float(np.clip(np.clip(sight, *SIGHT_DEG) - sight, -LARGEST_TILT_DEG, LARGEST_TILT_DEG))


def _footage(
    path: CameraPath, mount: F64, times: F64, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]
) -> _Footage:
    poses = [path.pose(float(t)) for t in times]
    views = np.stack([view_from_pose(turn @ mount, place)[:3] for turn, place in poses]).astype(np.float32)
    lows, highs = _bounds(times, movers, bodies)
    pick = np.array([[(k >> axis) & 1 for axis in range(3)] for k in range(8)], dtype=bool)
    boxes = np.where(pick[None], highs[:, None], lows[:, None])
    clips = np.stack([path.projection(float(t), (scene.output.height, scene.output.width)) for t in times])
    lenses = np.stack([[clips[:, k, k], -clips[:, k, 2]] for k in range(2)]).transpose(2, 0, 1)
    return _Footage(views, np.stack([place for _, place in poses]), boxes, lenses)


def _bounds(times: F64, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> tuple[F64, F64]:
    """Return the lowest and highest coordinates (F, 3) of all bodies at `times`."""
    lows, highs = np.full((len(times), 3), np.inf), np.full((len(times), 3), -np.inf)
    for mover, body in zip(movers, bodies, strict=True):
        skeleton, shape = Skeleton(body.joints, body.body.parents), outline(body)
        for k, t_s in enumerate(times):
            pose, translation = mover.sample(float(t_s))
            points = shape.posed(skeleton.pose(pose, translation, mover.world).matrices)
            lows[k], highs[k] = np.minimum(lows[k], points.min(axis=0)), np.maximum(highs[k], points.max(axis=0))
    return lows, highs


def _coarse_grid(footage: _Footage) -> F64:
    """Return places (S, 3) to try for the scene's origin, in the path's world."""
    middle = footage.eyes.mean(axis=0)
    level = np.arange(-REACH_M, REACH_M + COARSE_M / 2, COARSE_M)
    x, height, z = np.meshgrid(level, EYE_HEIGHTS_M, level, indexing="ij")
    return np.asarray(middle + np.stack([x.ravel(), -height.ravel(), z.ravel()], axis=1))


def _finer_grid(place: F64, step: float) -> F64:
    offsets = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], dtype=np.float64)
    return np.asarray(np.concatenate([place[None], place + step * offsets]))


def _best(footage: _Footage, places: F64) -> F64:
    parts = np.split(places, range(PLACES_AT_ONCE, len(places), PLACES_AT_ONCE))
    whole, size = (np.concatenate(values) for values in zip(*(_visibility(footage, p) for p in parts), strict=True))
    score = whole + SIZE_WEIGHT * np.minimum(size, ENOUGH_SIZE)
    score = np.where(footage.eyes[:, 1].min() - places[:, 1] >= LOWEST_EYE_M, score, -1.0)
    return np.asarray(places[int(score.argmax())])


def _visibility(footage: _Footage, places: F64) -> tuple[F64, F64]:
    """Return the share of moments with whole bodies, and their mean share of the picture's height; both (S,)."""
    angle = _facing(footage, places)
    cos, sin = (f(angle).astype(np.float32)[:, None] for f in (np.cos, np.sin))
    by_axis = footage.boxes.astype(np.float32).transpose(2, 1, 0)  # the corners' axis comes first: faster to reduce
    corners = np.ascontiguousarray(by_axis)[:, :, None]
    places32 = places.astype(np.float32)[:, :, None]
    x = cos * corners[0] + sin * corners[2] + places32[:, 0]
    y = corners[1] + places32[:, 1]
    z = cos * corners[2] - sin * corners[0] + places32[:, 2]
    return _filmed(footage, (x, y, z))


def _filmed(footage: _Footage, corners: Sequence[F32] | F32) -> tuple[F64, F64]:
    """Return the result of `_visibility` for boxes with `corners` x, y, z, each (8, S, F), in the path's world."""
    x, y, z = corners
    right, up, back = (_row(footage.views[:, k], x, y, z) for k in range(3))
    depth = np.maximum(-back, NEAREST_M)
    in_front = (-back > NEAREST_M).all(axis=0)
    (x_scale, x_add), (y_scale, y_add) = footage.lenses.astype(np.float32).transpose(1, 2, 0)
    x_ndc, y_ndc = right * x_scale / depth + x_add, up * y_scale / depth + y_add
    inside = (np.abs(x_ndc) < MARGIN).all(axis=0) & (np.abs(y_ndc) < MARGIN).all(axis=0)
    tall = (np.clip(y_ndc.max(axis=0), -1, 1) - np.clip(y_ndc.min(axis=0), -1, 1)) / 2
    return (in_front & inside).mean(axis=1), np.where(in_front, tall, 0.0).mean(axis=1)


def _row(row: F32, x: F32, y: F32, z: F32) -> F32:
    """Return one coordinate (8, S, F) of the points x, y, z, each (8, S, F), by a row (F, 4) of the views."""
    a, b, c, d = row.T
    return np.asarray(a * x + b * y + c * z + d)


def _facing(footage: _Footage, places: F64) -> F64:
    """Return angles (S,) about +Y from the scene to the path's world, with which +Z points to the first eye.

    There is one for each of `places`.
    """
    towards = footage.eyes[0] - places
    return np.asarray(np.arctan2(towards[:, 0], towards[:, 2]))


def _transform(footage: _Footage, place: F64) -> tuple[F64, F64]:
    turn = about(1, -_facing(footage, place[None])[0])
    return turn, -turn @ place


def _distance(footage: _Footage, place: F64) -> float:
    return float(np.hypot(footage.eyes[:, 0] - place[0], footage.eyes[:, 2] - place[2]).mean())
