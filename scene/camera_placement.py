"""The camera in the scene: places a recorded one so that it films the avatars, and lets a person steer it.

The recording is moved as one rigid, upright piece: it is turned about the vertical and shifted; its movement from frame
to frame never changes. The best place shows whole bodies at the most moments; among equals the one where they are
larger wins. Places are searched where the camera looks: along rays through its pictures, at distances from one that
fills the picture with a body to many times the length of the path. So the search has no scale of its own. The best of
them climb from there, in steps that are shares of the distance. At first the camera is in front of the avatars, in the
direction that a heading of 0 faces. Over a drawn background the camera is also tilted by one constant angle, so that it
does not look down on people, unless that hides them. The moments are those of the scene's first seconds, however many
frames a run shows and at whatever rate: a frame of a scene is the same picture in every run.

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
from trilane.scene.follow import Way, way_cycle_s, way_of
from trilane.scene.mover import Mover, outline
from trilane.scene.rotations import about, quat_from_matrix, quat_multiply
from trilane.scene.schema import MAX_DEPTH_RATIO, CameraSpec, Scene
from trilane.scene.visibility import seen_at
from trilane.shapes import Shape


@dataclass(frozen=True)
class PlacedCamera:
    """A camera in the scene.

    `turn` (3, 3), `shift` (3,): transform from the path's world to the scene's. `mount` (3, 3): turn from the camera's
    axes to those of the path. `notes`: what was decided, for people. `ways`: ways that the camera goes along with, by
    their mean; none for a camera that goes its own way.
    """

    path: CameraPath
    turn: F64
    shift: F64
    mount: F64
    notes: tuple[str, ...]
    ways: tuple[Way, ...] = ()

    def sample(self, t_s: float) -> F64:
        """Return the matrix (4, 4) from world to camera at `t_s`; the world is the scene's."""
        turn, place = self.path.pose(t_s)
        at = self.turn @ place + self.shift
        if self.ways:
            at = at + np.mean([way.at(t_s) for way in self.ways], axis=0)
        return view_from_pose(self.turn @ turn @ self.mount, at)

    def reach(self) -> tuple[F64, F64]:
        """Return the lowest and highest coordinates (3,) of all places of the camera in the scene, and of its ways."""
        places = self.path.places @ self.turn.T + self.shift
        low, high = places.min(axis=0), places.max(axis=0)
        if self.ways:
            own = np.concatenate([way.places for way in self.ways])
            low, high = np.minimum(low, 0) + own.min(axis=0), np.maximum(high, 0) + own.max(axis=0)
        return low, high

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
#: Moments whose pictures rays go through: one of RAYS_EVERY. Where they go through a picture, as shares of its
#: half width and half height.
RAYS_EVERY, RAYS_AT = 4, (-0.8, -0.4, 0.0, 0.4, 0.8)
#: Nearest distance on a ray, in distances at which the tallest box of the bodies fills the picture; the farthest, in
#: these distances and in lengths of the path added; factor from one distance to the next. Far off a path of any length
#: is a pan.
NEAREST, FARTHEST, FARTHEST_OF_PATH, FARTHER = 0.7, 30.0, 10.0, 1.25
#: Number of places that climb, and least distance between them in the beginning, as a share of that from the camera.
CLIMBERS, APART = 24, 0.15
#: Steps of a climb, as shares of the distance from the camera.
STEPS = tuple(0.3 * 0.7**k for k in range(15))
#: Least height of the camera above the floor.
LOWEST_EYE_M = 0.3
#: Share of the picture's half width and half height within which a body counts as whole in the picture.
MARGIN = 0.97
#: Range of the camera's median line of sight, degrees above the horizon; beyond it the camera is tilted to its end.
SIGHT_DEG = (-24.0, 0.0)
LARGEST_TILT_DEG = 40.0
SYNTHETIC_BACKGROUNDS = ("room",)
#: Score of the bodies' share of the picture's height, up to ENOUGH_SIZE; whole bodies at all moments score 1. No gain
#: in size is worth a twentieth of the moments.
SIZE_WEIGHT, ENOUGH_SIZE = 0.05, 0.75
#: Score of bodies that are nearly in the picture: less than a moment's, it leads a climb to the next moment.
NEARLY_WEIGHT = 0.01
NEAREST_M = 0.3
#: Share by which the far clip plane is beyond the farthest that a body can be from the camera.
BEYOND = 1.1
#: A built-in camera is judged at moments so far apart, over so long at most.
JUDGED_EVERY_S, JUDGED_S = 0.25, 120.0
#: Least gain in the share of the bodies in the picture, on average, for which a built-in camera goes along with them.
LEAST_GAIN = 0.02
#: Number of places that are scored together: so few that the arrays stay in the processor's cache.
PLACES_AT_ONCE = 256


@dataclass(frozen=True)
class _Footage:
    """The recording and the bodies at the F moments at which places are scored.

    `views` (F, 3, 4): matrices from the path's world to the camera. `eyes` (F, 3): places of the camera in the path's
    world. `boxes` (F, 8, 3): corners of a box around the bodies in the scene's world. `lenses` (F, 2, 2): factor and
    addend of x and of y, where ndc = factor * x / depth + addend. `nearest_m`: depth from which on a body is seen.
    """

    views: F32
    eyes: F64
    boxes: F64
    lenses: F64
    nearest_m: float = NEAREST_M


def place_camera(path: CameraPath, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> PlacedCamera:
    """Place the camera of a scene: a recorded one where it films the avatars, a built-in one along with them.

    One whose spec has `place = "none"` stays where it is.

    `path`: path of the camera.
    `scene`: scene, which states the background, the picture's size, and whether the camera is placed.
    `movers`: avatars of the scene.
    `bodies`: bodies of these avatars, in the same order.
    """
    camera = PlacedCamera(path, np.eye(3), np.zeros(3), np.eye(3), ())
    if scene.camera.place == "none":
        return camera
    if path.recorded:
        return _placed(path, scene, movers, bodies)
    return _going_along(camera, scene, movers, bodies)


def _going_along(
    camera: PlacedCamera, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]
) -> PlacedCamera:
    """Return the built-in `camera`, going along with people who would leave its picture otherwise.

    It is judged over one cycle of camera and motions. It stays as it is where the bodies are whole throughout, or where
    going along shows hardly more of them: a close-up never shows a whole body.
    """
    cycles = (way_cycle_s(mover) for mover in movers)
    times = np.arange(0.0, min(max(camera.path.duration_s, JUDGED_EVERY_S, *cycles), JUDGED_S), JUDGED_EVERY_S)
    output = (scene.output.height, scene.output.width)
    stays = seen_at(times, camera, movers, bodies, output)
    if stays.whole.all():
        return camera
    ways = tuple(way_of(mover, body) for mover, body in zip(movers, bodies, strict=True))
    along = replace(camera, ways=ways)
    goes = seen_at(times, along, movers, bodies, output)
    if goes.share.mean() - stays.share.mean() < LEAST_GAIN:
        return camera
    whole = f"whole body in the picture in {goes.whole.mean():.0%} of a cycle in place of {stays.whole.mean():.0%}"
    return replace(along, notes=(f"goes along with the person over the floor: {whole}",))


def _placed(path: CameraPath, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> PlacedCamera:
    """Return the recorded camera of `path` at its best place."""
    times = np.linspace(0.0, SCORED_S, SCORED_MOMENTS)
    levelled, level, middle = _from_the_middle(path)
    bounds = _bounds(times, movers, bodies)
    tilts = [_tilt_deg(path, times), 0.0] if scene.background in SYNTHETIC_BACKGROUNDS else [0.0]
    found = []
    for tilt in dict.fromkeys(tilts):
        mount = about(0, np.radians(tilt))
        footage = _footage(levelled, mount, times, scene, bounds)
        best = _climbed(footage, _seeds(footage))
        found.append((_score(*_visibility(footage, best[None]))[0], tilt, mount, footage, best))
    _, tilt, mount, footage, best = max(found, key=lambda one: one[0])
    turn, shift = _transform(footage, best)
    eye = best[1] * -1 + footage.eyes[:, 1].mean()
    far_m, far_notes = _far(levelled.places, footage.boxes @ turn + best, scene.camera)
    notes = (
        *((f"camera tilted by {tilt:+.0f} degrees on its mount",) if tilt else ()),
        f"camera set down {_distance(footage, best):.1f} m from the avatar, {eye:.1f} m over the floor on average",
        *far_notes,
    )
    seeing = replace(path, optics=replace(path.optics, far_m=far_m))
    return PlacedCamera(seeing, turn @ level, shift - turn @ level @ middle, mount, notes)


def _far(places: F64, boxes: F64, spec: CameraSpec) -> tuple[float, tuple[str, ...]]:
    """Return the distance of the far clip plane, at which no body in `boxes` is cut off, and a note where it grows.

    `places` (N, 3): places of the camera, in the world of `boxes` (F, 8, 3).
    """
    corners = boxes.reshape(-1, 3)
    low, high = np.minimum(places.min(axis=0), corners.min(axis=0)), np.maximum(places.max(axis=0), corners.max(axis=0))
    needed = min(BEYOND * float(np.linalg.norm(high - low)), MAX_DEPTH_RATIO * spec.near_m)
    if needed <= spec.far_m:
        return spec.far_m, ()
    return needed, (f"far clip plane at {needed:.0f} m in place of {spec.far_m:g} m, beyond the body",)


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


def _footage(path: CameraPath, mount: F64, times: F64, scene: Scene, bounds: tuple[F64, F64]) -> _Footage:
    """Return the recording at `times` (F,); `bounds`: result of `_bounds`."""
    poses = [path.pose(float(t)) for t in times]
    views = np.stack([view_from_pose(turn @ mount, place)[:3] for turn, place in poses]).astype(np.float32)
    lows, highs = bounds
    pick = np.array([[(k >> axis) & 1 for axis in range(3)] for k in range(8)], dtype=bool)
    boxes = np.where(pick[None], highs[:, None], lows[:, None])
    clips = np.stack([path.projection(float(t), (scene.output.height, scene.output.width)) for t in times])
    lenses = np.stack([[clips[:, k, k], -clips[:, k, 2]] for k in range(2)]).transpose(2, 0, 1)
    nearest = max(NEAREST_M, scene.camera.near_m)
    return _Footage(views, np.stack([place for _, place in poses]), boxes, lenses, nearest)


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


def _seeds(footage: _Footage) -> F64:
    """Return places (S, 3) to try for the scene's origin, in the path's world: where the camera looks."""
    picked = slice(None, None, RAYS_EVERY)
    x, y = (axis.ravel() for axis in np.meshgrid(RAYS_AT, RAYS_AT))
    lenses, turns, eyes = footage.lenses[picked], footage.views[picked, :, :3].astype(np.float64), footage.eyes[picked]
    across = [(at - lenses[:, k, 1, None]) / lenses[:, k, 0, None] for k, at in enumerate((x, y))]
    rays = np.stack([*across, -np.ones_like(across[0])], axis=-1) @ turns  # view to world is the transpose
    heights = np.ptp(footage.boxes[:, :, 1], axis=1)
    fills = float((heights * footage.lenses[:, 1, 0] / 2).max())
    far = FARTHEST * fills + FARTHEST_OF_PATH * float(np.linalg.norm(np.ptp(footage.eyes, axis=0)))
    depths = NEAREST * fills * FARTHER ** np.arange(np.log(far / (NEAREST * fills)) / np.log(FARTHER) + 1)
    points = (eyes[:, None, None] + rays[:, :, None] * depths[:, None]).reshape(-1, 3)
    points = np.concatenate([points, _looked_at(footage)[None]])
    # The middle of the bodies comes to each point; they face the camera as they would with the origin there.
    middles = footage.boxes.mean(axis=1)
    middle = np.repeat(middles[picked], len(RAYS_AT) ** 2 * len(depths), axis=0)
    middle = np.concatenate([middle, middles.mean(axis=0)[None]])
    angle = _facing(footage, points)
    cos, sin = np.cos(angle), np.sin(angle)
    offsets = np.stack(
        [cos * middle[:, 0] + sin * middle[:, 2], middle[:, 1], cos * middle[:, 2] - sin * middle[:, 0]], axis=1
    )
    places = points - offsets
    places[:, 1] = np.minimum(places[:, 1], _highest_floor(footage))
    return np.asarray(places)


def _looked_at(footage: _Footage) -> F64:
    """Return the point (3,) nearest to all lines of sight; of several, the one nearest to the middle of the eyes.

    The point solves the normal equations of the distances: sum (1 - d d') (x - p) = 0 for places p and directions d.
    """
    ahead = -footage.views[:, 2, :3].astype(np.float64)
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    offsets = footage.eyes - footage.eyes.mean(axis=0)
    point = np.linalg.lstsq(across.sum(axis=0), (across @ offsets[:, :, None]).sum(axis=0)[:, 0], rcond=1e-6)[0]
    return np.asarray(point + footage.eyes.mean(axis=0))


def _highest_floor(footage: _Footage) -> float:
    return float(footage.eyes[:, 1].min()) - LOWEST_EYE_M


def _climbed(footage: _Footage, seeds: F64) -> F64:
    """Return the best place (3,) to which the best of `seeds` (S, 3) climb."""
    scores = _in_parts(footage, seeds)
    climbers = _apart(footage, seeds[np.argsort(-scores, kind="stable")])
    offsets = np.array([(x, y, z) for x in (0, -1, 1) for y in (0, -1, 1) for z in (0, -1, 1)], dtype=np.float64)
    for step in STEPS:
        lengths = step * _distances(footage, climbers)
        tried = climbers[:, None] + lengths[:, None, None] * offsets
        scores = _in_parts(footage, tried.reshape(-1, 3)).reshape(len(climbers), -1)
        climbers = tried[np.arange(len(climbers)), scores.argmax(axis=1)]
    return _best(footage, climbers)


def _apart(footage: _Footage, places: F64) -> F64:
    """Return the first CLIMBERS of `places` (S, 3) that are not near an earlier one."""
    apart = APART * _distances(footage, places)
    kept: list[int] = []
    for k in range(len(places)):
        if not kept or np.linalg.norm(places[kept] - places[k], axis=1).min() > apart[k]:
            kept.append(k)
        if len(kept) == CLIMBERS:
            break
    return np.asarray(places[kept])


def _distances(footage: _Footage, places: F64) -> F64:
    """Return the median distance of the eyes from each of `places` (S, 3)."""
    return np.asarray(np.median(np.linalg.norm(footage.eyes[None] - places[:, None], axis=2), axis=1))


def _in_parts(footage: _Footage, places: F64) -> F64:
    """Return the scores (S,) of places for a climb."""
    parts = np.split(places, range(PLACES_AT_ONCE, len(places), PLACES_AT_ONCE))
    scores = []
    for part in parts:
        whole, size, nearly = _seen(footage, part)
        scores.append(_score(whole, size) + NEARLY_WEIGHT * nearly)
    return np.where(places[:, 1] <= _highest_floor(footage), np.concatenate(scores), -1.0)


def _score(whole: F64, size: F64) -> F64:
    return np.asarray(whole + SIZE_WEIGHT * np.minimum(size, ENOUGH_SIZE))


def _best(footage: _Footage, places: F64) -> F64:
    score = np.where(places[:, 1] <= _highest_floor(footage), _score(*_visibility(footage, places)), -1.0)
    return np.asarray(places[int(score.argmax())])


def _visibility(footage: _Footage, places: F64) -> tuple[F64, F64]:
    """Return the share of moments with whole bodies, and their mean share of the picture's height; both (S,).

    A body that is not whole counts for nothing.
    """
    whole, size, _ = _seen(footage, places)
    return whole, size


def _seen(footage: _Footage, places: F64) -> tuple[F64, F64, F64]:
    """Return the result of `_visibility`, and how nearly bodies are in the picture, 0 to 1 on average; all (S,)."""
    angle = _facing(footage, places)
    cos, sin = (f(angle).astype(np.float32)[:, None] for f in (np.cos, np.sin))
    by_axis = footage.boxes.astype(np.float32).transpose(2, 1, 0)  # the corners' axis comes first: faster to reduce
    corners = np.ascontiguousarray(by_axis)[:, :, None]
    places32 = places.astype(np.float32)[:, :, None]
    x = cos * corners[0] + sin * corners[2] + places32[:, 0]
    y = corners[1] + places32[:, 1]
    z = cos * corners[2] - sin * corners[0] + places32[:, 2]
    right, up, back = (_row(footage.views[:, k], x, y, z) for k in range(3))
    depth = np.maximum(-back, footage.nearest_m)
    in_front = (-back > footage.nearest_m).all(axis=0)
    (x_scale, x_add), (y_scale, y_add) = footage.lenses.astype(np.float32).transpose(1, 2, 0)
    x_ndc, y_ndc = right * x_scale / depth + x_add, up * y_scale / depth + y_add
    outermost = np.maximum(np.abs(x_ndc).max(axis=0), np.abs(y_ndc).max(axis=0))
    is_whole = in_front & (outermost < MARGIN)
    tall = (y_ndc.max(axis=0) - y_ndc.min(axis=0)) / 2
    nearly = np.where(in_front, np.clip(1 + MARGIN - outermost, 0, 1), 0.0)
    return is_whole.mean(axis=1), np.where(is_whole, tall, 0.0).mean(axis=1), nearly.mean(axis=1)


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
