"""How much of the avatars a camera shows, and the best place in a recorded camera's world for the scene.

**Shown.** A body is represented by its outline, a set of points. A body is whole in a frame when all these points are
in the picture and between the clip planes. Nobody is seen when all points of each body are beyond one plane of the view
volume.

**Best place.** A place is the position that the scene's origin gets in the world of the recording. An eye is a
position of the camera. At each place, the scene is turned about the vertical so that a heading of 0 faces the first
eye. The best place shows whole bodies at the most moments. Among places with about as many, the best place shows the
bodies larger and nearer to the picture's middle. Candidates are points on rays through the camera's pictures. At the
nearest, bodies fill the picture; the farthest are many path lengths away. The search therefore works at any scale. The
best candidates then climb: each tries random steps, which are shares of its distance from the camera.

In the search, a body is in the picture when no point of it is beyond any of the picture's four sides. A side is a
plane, so only the body's outermost point across that plane counts. How far that point reaches depends only on the
scene's heading. Reaches are computed once for each heading; after that, a place costs one product with each plane.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from trilane.arrays import F32, F64, Shape
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_NAMES, Skeleton
from trilane.scene.camera.path import CameraPath
from trilane.scene.mover import Mover, outline
from trilane.scene.rotations import about
from trilane.scene.schema import BUILT_IN_PREFIX, Scene

#: A person whose median share of the picture's height is below this is hard to find.
SMALL = 0.08
#: Extent of a walk over the floor, metres. A camera that shows the whole of such a walk shows the person small.
FAR_WALK_M = 10.0
#: Most frames that are examined; in a longer run, frames are evenly spread over the run.
MOST_FRAMES = 300


class Camera(Protocol):
    """A camera in the scene, as this module needs it; `PlacedCamera` is one."""

    def sample(self, t_s: float) -> F64:
        """Return the transform (4, 4) from world to camera at `t_s`."""

    def projection(self, t_s: float, output: Shape) -> F64:
        """Return the OpenGL clip matrix (4, 4) at `t_s` for a picture of `output` (height, width)."""


@dataclass(frozen=True)
class Seen:
    """What a camera shows at F moments; booleans are stored as 0 and 1.

    `whole` (F,): whether all bodies are whole in the picture.
    `nobody` (F,): whether no part of any body is in the picture.
    `share` (F,): share of the outline points in the picture, averaged over the bodies.
    `height` (F,): distance from the lowest to the highest visible point, as a share of the picture's height.
    """

    whole: F64
    nobody: F64
    share: F64
    height: F64


def seen_at(
    times_s: F64,
    camera: Camera,
    movers: Sequence[Mover],
    bodies: Sequence[ShapedBody],
    output: Shape,
    joints: Collection[str] = JOINT_NAMES,
) -> Seen:
    """Return what `camera` shows of the `movers` with `bodies` at `times_s` (F,).

    `output`: (height, width) of the picture. `joints`: names of the joints whose vertices are examined.
    """
    actors = [
        (mover, Skeleton(body.joints, body.body.parents), outline(body, joints))
        for mover, body in zip(movers, bodies, strict=True)
    ]
    rows = []
    for t_s in map(float, times_s):
        clip = (camera.projection(t_s, output) @ camera.sample(t_s)).T
        shown = []
        for mover, skeleton, shape in actors:
            pose, translation = mover.sample(t_s)
            points = shape.posed(skeleton.pose(pose, translation, mover.world).matrices)
            shown.append(_shown(np.column_stack([points, np.ones(len(points))]) @ clip))
        rows.append(
            (
                all(share == 1.0 for share, _, _ in shown),
                all(high <= low for _, low, high in shown),
                float(np.mean([share for share, _, _ in shown])),
                max((max(high for _, _, high in shown) - min(low for _, low, _ in shown)) / 2, 0.0),
            )
        )
    return Seen(*np.array(rows, dtype=np.float64).T)


def _shown(clip: F64) -> tuple[float, float, float]:
    """Return (share of the points that are in the view volume, lowest visible y, highest visible y); y in NDC.

    If all points are beyond one plane, the share is 0, the lowest y is 1 and the highest is -1. If only some points are
    behind the near plane, the lowest y is -1 and the highest is 1.
    `clip`: points (K, 4) in clip space.
    """
    w = clip[:, 3]
    beyond = np.concatenate([clip[:, :3] > w[:, None], clip[:, :3] < -w[:, None]], axis=1)
    if beyond.all(axis=0).any():
        return 0.0, 1.0, -1.0
    # Points behind the near plane have no place in the picture; a body that passes through it reaches every border.
    y = np.clip(clip[:, 1] / w, -1, 1) if (clip[:, 2] >= -w).all() else np.array([-1.0, 1.0])
    return 1.0 - float(beyond.any(axis=1).mean()), float(y.min()), float(y.max())


def seen_notes(camera: Camera, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> tuple[str, ...]:
    """Return notes: how often the bodies are whole in the picture, how often nobody is seen, and how large they are.

    If a placed recorded camera shows people very small, a second note gives likely reasons and the keys to set.
    """
    count = min(scene.frames, MOST_FRAMES)
    frames = np.arange(count) * scene.frames // count
    seen = seen_at(frames / scene.fps, camera, movers, bodies, (scene.output.height, scene.output.width))
    of = f"the {count} frames" if count == scene.frames else f"{count} of the {scene.frames} frames, evenly spread"
    whole, nobody = float(seen.whole.mean()), float(seen.nobody.mean())
    height = float(seen.height[seen.nobody == 0].mean()) if nobody < 1 else 0.0
    parts = [f"whole body in the picture in {whole:.0%} of {of}"]
    parts += [f"a part of it in {1 - whole - nobody:.0%}"] if round(1 - whole - nobody, 9) else []
    parts += [f"nobody in {nobody:.0%}"] if nobody else []
    parts += [f"{height:.0%} of its height on average"] if nobody < 1 else []
    return (", ".join(parts), *_hint(scene, seen.height[seen.nobody == 0], movers, frames / scene.fps))


def _hint(scene: Scene, heights: F64, movers: Sequence[Mover], times_s: F64) -> tuple[str, ...]:
    """Return a note when a placed recorded camera shows people very small, with the likely reasons; otherwise ().

    `heights` (F,): people's shares of the picture's height.
    """
    is_placed = scene.camera.place == "auto" and not scene.camera.source.startswith(BUILT_IN_PREFIX)
    if not is_placed or not len(heights) or np.median(heights) >= SMALL:
        return ()
    small = f"the person is only {np.median(heights):.1%} of the picture's height in the median, hard to find"
    ways = [[mover.sample(float(t_s))[1] @ mover.world[:3, :3].T for t_s in times_s] for mover in movers]
    walked_m = max(float(np.hypot(*np.ptp(np.array(way)[:, [0, 2]], axis=0))) for way in ways)
    if walked_m >= FAR_WALK_M:
        return (
            f"{small}: the camera is set down where it sees a walk of {walked_m:.0f} m; start_s and end_s of the "
            "avatar choose a part of the motion, and a built-in camera goes along with the person",
        )
    return (
        f"{small}: if the camera was nearer, its file's unit is smaller than it was taken for (camera.metres_per_unit "
        "states it), or the columns of its places are in another order",
    )


#: Number of moments at which a place is scored, evenly spread over the first SCORED_S seconds of the scene. A shorter
#: motion or recording repeats, as in a run. Anything later does not count.
SCORED_MOMENTS, SCORED_S = 120, 10.0
#: Every SEEDS_EVERY-th moment decides which candidates climb; every RAYS_EVERY-th has rays through its picture.
SEEDS_EVERY, RAYS_EVERY = 3, 10
#: Positions of rays in a picture, as shares of its half width and half height.
RAYS_AT = (-0.8, -0.4, 0.0, 0.4, 0.8)
#: Nearest and farthest distance on a ray, in units of the distance at which the bodies fill the picture. The farthest
#: is increased by FARTHEST_OF_PATH lengths of the path; from there, the path looks like a pan. FARTHER is the factor
#: from one distance to the next.
NEAREST, FARTHEST, FARTHEST_OF_PATH, FARTHER = 0.7, 30.0, 10.0, 1.25
#: Number of places that climb, and their least distance from each other at first, as a share of the distance from the
#: camera.
CLIMBERS, APART = 96, 0.07
#: A climb: the steps as shares of the distance from the camera, and the number of random steps tried from each place.
#: After each step only the share STAY of the places goes on, but at least LAST_CLIMBERS.
STEPS, TRIED, LAST_CLIMBERS, STAY = tuple(0.3 * 0.8**k for k in range(28)), 40, 12, 0.92
#: Least height, metres, of the camera above the floor.
LOWEST_EYE_M = 0.3
#: A body counts as whole within this share of the picture's half width and half height.
MARGIN = 0.98
#: Least depth, metres, at which a body is seen; a near clip plane farther away takes its place.
NEAREST_M = 0.3
#: Weight of how well bodies are shown; whole bodies at all moments score 1. A whole body adds its share of the
#: picture's height, at most ENOUGH_SIZE, times this weight; at the border it loses the share MIDDLE_WEIGHT of that. The
#: largest possible gain is less than a fortieth of the moments.
SIZE_WEIGHT, ENOUGH_SIZE, MIDDLE_WEIGHT = 0.03, 0.75, 0.5
#: Weight, in moments, of bodies that are nearly whole in the picture. It leads a climb towards places with more whole
#: bodies.
NEARLY_MOMENTS = 0.5
#: Number of headings for which reaches are computed. The nearest one is off by at most 0.35 degrees, 4 mm at a hand.
HEADINGS = 512
#: Number of directions in which a body's outermost points are taken to represent the body.
DIRECTIONS = 120
#: Number of places that are scored together; few enough that the arrays stay in the processor's cache.
PLACES_AT_ONCE = 128
#: Number of rows of a moment (see `PlaceJudge`): the picture's four sides, the nearest point's depth, and the depth, x
#: and y of the bodies' middle. NEAR and MIDDLE are the indices of the nearest depth and of the middle's depth.
ROWS, NEAR, MIDDLE = 8, 4, 5


def outermost_points(times_s: F64, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> F64:
    """Return the outermost points (F, P, 3) of all bodies at `times_s` (F,), in the scene's world, metres."""
    directions = _spread(DIRECTIONS).T
    found = []
    for mover, body in zip(movers, bodies, strict=True):
        skeleton, shape = Skeleton(body.joints, body.body.parents), outline(body)
        posed = [shape.posed(skeleton.pose(*mover.sample(float(t_s)), mover.world).matrices) for t_s in times_s]
        # Each body is scaled to equal extents first; otherwise spread arms would hide the back in most directions.
        found.append(
            np.stack([points[((points / np.ptp(points, axis=0)) @ directions).argmax(axis=0)] for points in posed])
        )
    return np.concatenate(found, axis=1)


def _spread(count: int) -> F64:
    """Return `count` unit vectors (count, 3), evenly spread over the sphere in a Fibonacci spiral."""
    k = np.arange(count)
    height, angle = 1 - (2 * k + 1) / count, np.pi * (1 + 5**0.5) * k
    level = np.sqrt(1 - height**2)
    return np.stack([level * np.cos(angle), height, level * np.sin(angle)], axis=1)


@dataclass(frozen=True)
class Filming:
    """The recorded camera and the bodies at the F moments at which places are scored.

    `eyes` (F, 3): positions of the camera in the world of the recording, metres.
    `turns` (F, 3, 3): the camera's axes (x right, y up, z back) in that world, as columns.
    `lenses` (F, 2, 2): for x and for y, (factor, addend): ndc = factor * x / depth + addend, in the camera's axes.
    `points` (F, P, 3): outermost points of the bodies in the scene, metres.
    `nearest_m`: least depth at which a body is seen, metres.
    """

    eyes: F64
    turns: F64
    lenses: F64
    points: F64
    nearest_m: float = NEAREST_M

    def every(self, step: int) -> Filming:
        """Return the `Filming` of every `step`-th moment, beginning with the first."""
        return Filming(self.eyes[::step], self.turns[::step], self.lenses[::step], self.points[::step], self.nearest_m)


def filming(path: CameraPath, mount: F64, times_s: F64, output: Shape, points: F64, near_m: float) -> Filming:
    """Return the recorded camera and the bodies at F moments, in the form in which places are scored.

    `path`: recorded camera path.
    `mount` (3, 3): rotation from the camera's axes to the path's axes.
    `times_s` (F,): the moments, in seconds of the path.
    `output`: (height, width) of the picture.
    `points` (F, P, 3): outermost points of the bodies at the moments, in the scene.
    `near_m`: distance of the near clip plane, metres. Bodies nearer than that or than NEAREST_M are not seen.
    """
    poses = [path.pose(float(t_s)) for t_s in times_s]
    clips = np.stack([path.projection(float(t_s), output) for t_s in times_s])
    lenses = np.stack([[clips[:, k, k], -clips[:, k, 2]] for k in range(2)]).transpose(2, 0, 1)
    turns, eyes = np.stack([turn @ mount for turn, _ in poses]), np.stack([place for _, place in poses])
    return Filming(eyes, turns, lenses, points, max(NEAREST_M, near_m))


@dataclass(frozen=True)
class PlaceMerits:
    """How S places show the bodies; all arrays (S,).

    `whole`: share of the moments with whole bodies.
    `well`: size of whole bodies, reduced near the border, averaged over all moments: 0 to ENOUGH_SIZE.
    `nearly`: how nearly the bodies are whole at the other moments, averaged over all moments: 0 to 1.
    """

    whole: F64
    well: F64
    nearly: F64

    @property
    def score(self) -> F64:
        """Score of each place (S,); the place with the highest score is the best."""
        return np.asarray(self.whole + SIZE_WEIGHT * self.well)


class PlaceJudge:
    """Judges places for one `Filming`.

    Each moment has ROWS row vectors in the recording's world. The dot product of a row vector and a place is a number,
    such as the distance of the place from a side of the picture.
    """

    def __init__(self, film: Filming) -> None:
        """Compute how far the bodies reach along each row, for each heading."""
        self._film = film
        rows = _rows(film)
        self._along = rows.reshape(-1, 3).T.astype(np.float32)
        self._added = -(rows * film.eyes).sum(axis=2).astype(np.float32)
        self._reaches, self._heights = _reaches(film, rows)

    def shown(self, places: F64) -> PlaceMerits:
        """Return how each of the `places` (S, 3) shows the bodies."""
        parts = [self._shown(part) for part in np.split(places, range(PLACES_AT_ONCE, len(places), PLACES_AT_ONCE))]
        return PlaceMerits(*np.concatenate(parts, axis=1))

    def _shown(self, places: F64) -> F64:
        """Return an array (3, S) whose rows are the fields `whole`, `well` and `nearly` of `PlaceMerits`."""
        film = self._film
        turned = np.rint(facing(film, places) * (HEADINGS / (2 * np.pi))).astype(np.intp) % HEADINGS
        values = (places.astype(np.float32) @ self._along).reshape(len(places), ROWS, -1)
        values += self._added
        values += self._reaches[turned]
        inside = values[:, 0]
        for side in range(1, NEAR):
            inside = np.minimum(inside, values[:, side])
        depth, ahead = np.maximum(values[:, MIDDLE], film.nearest_m), values[:, NEAR] > film.nearest_m
        whole = ahead & (inside >= 0)
        size = np.minimum(self._heights[turned] / depth, ENOUGH_SIZE)
        off = np.maximum(np.abs(values[:, MIDDLE + 1]), np.abs(values[:, MIDDLE + 2])) / depth
        well = np.where(whole, size * (1 - MIDDLE_WEIGHT * np.minimum(off, 1) ** 2), 0)
        nearly = np.where(ahead & ~whole, np.clip(1 + inside / depth, 0, 1), 0)
        return np.stack([one.mean(axis=1, dtype=np.float64) for one in (whole, well, nearly)])


def _rows(film: Filming) -> F64:
    """Return the rows (ROWS, F, 3) of all moments.

    Rows of sides point inwards. Divided by the depth, the values of sides, x and y count in halves of the picture.
    """
    right, up, ahead = film.turns[:, :, 0], film.turns[:, :, 1], -film.turns[:, :, 2]
    x, y = (film.lenses[:, k, :1] * axis + film.lenses[:, k, 1:] * ahead for k, axis in enumerate((right, up)))
    sides = [MARGIN * ahead + x, MARGIN * ahead - x, MARGIN * ahead + y, MARGIN * ahead - y]
    return np.stack([*sides, ahead, ahead, x, y])


def _reaches(film: Filming, rows: F64) -> tuple[F32, F32]:
    """Return the reaches (HEADINGS, ROWS, F) and the heights (HEADINGS, F) of the bodies.

    A reach is what the bodies add to a row's value. For rows of sides and of the nearest depth, their outermost point
    counts; for other rows, their middle. Heights are shares of the picture's height at a depth of 1.
    """
    headings = about(1, np.arange(HEADINGS) * (2 * np.pi / HEADINGS))
    reaches = np.empty((HEADINGS, ROWS, rows.shape[1]), np.float32)
    heights = np.empty((HEADINGS, rows.shape[1]), np.float32)
    middles = (film.points.min(axis=1) + film.points.max(axis=1)) / 2
    for k, (points, middle) in enumerate(zip(film.points, middles, strict=True)):
        turned = (rows[:, k] @ headings).astype(np.float32)  # turning the rows, not the points, gives the same products
        across = turned[:, :MIDDLE].reshape(-1, 3) @ points.T.astype(np.float32)
        reaches[:, :MIDDLE, k] = across.min(axis=1).reshape(HEADINGS, MIDDLE)
        reaches[:, MIDDLE:, k] = turned[:, MIDDLE:] @ middle.astype(np.float32)
        up = ((film.lenses[k, 1, 0] * film.turns[k, :, 1]) @ headings) @ points.T
        heights[:, k] = np.ptp(up, axis=1) / 2
    return reaches, heights


def facing(film: Filming, places: F64) -> F64:
    """Return the angles (S,), radians about +Y, at which +Z of a scene at `places` (S, 3) points to the first eye."""
    towards = film.eyes[0] - places
    return np.asarray(np.arctan2(towards[:, 0], towards[:, 2]))


def best_place(film: Filming) -> tuple[F64, float]:
    """Return (best place (3,) for the scene's origin, in the recording's world; its score)."""
    judge = PlaceJudge(film)
    climbers = _apart(film, _seeds(film))
    random = np.random.default_rng(0)
    for step in STEPS:
        lengths = step * _distances(film, climbers)[:, None, None]
        tried = np.repeat(climbers[:, None], TRIED + 1, axis=1)
        tried[:, 1:] += lengths * random.normal(size=(len(climbers), TRIED, 3))
        merits = _merits(film, judge, tried.reshape(-1, 3)).reshape(len(climbers), -1)
        climbers = tried[np.arange(len(climbers)), merits.argmax(axis=1)]
        kept = max(int(STAY * len(climbers)), min(LAST_CLIMBERS, len(climbers)))
        climbers = climbers[np.argsort(-merits.max(axis=1), kind="stable")[:kept]]
    scores = judge.shown(climbers).score
    return climbers[int(scores.argmax())], float(scores.max())


def _merits(film: Filming, judge: PlaceJudge, places: F64) -> F64:
    """Return the scores (S,) by which the search for the best place compares `places` (S, 3), in the recording's world.

    A score is `PlaceMerits.score` plus a small bonus for bodies that are nearly whole in the picture. It is -1 if the
    floor at the place is higher than `highest_floor`.
    """
    shown = judge.shown(places)
    merits = shown.score + NEARLY_MOMENTS / len(film.eyes) * shown.nearly
    return np.where(places[:, 1] <= highest_floor(film), merits, -1.0)


def highest_floor(film: Filming) -> float:
    """Return the greatest height of the floor, metres, at which every eye is at least LOWEST_EYE_M above it."""
    return float(film.eyes[:, 1].min()) - LOWEST_EYE_M


def _seeds(film: Filming) -> F64:
    """Return candidate places (S, 3) on rays through the camera's pictures, best first."""
    picked = slice(None, None, RAYS_EVERY)
    x, y = (axis.ravel() for axis in np.meshgrid(RAYS_AT, RAYS_AT))
    lenses, turns, eyes = film.lenses[picked], film.turns[picked], film.eyes[picked]
    across = [(at - lenses[:, k, 1, None]) / lenses[:, k, 0, None] for k, at in enumerate((x, y))]
    rays = np.stack([*across, -np.ones_like(across[0])], axis=-1) @ turns.transpose(0, 2, 1)
    fills = _filling_depth(film)
    far = FARTHEST * fills + FARTHEST_OF_PATH * float(np.linalg.norm(np.ptp(film.eyes, axis=0)))
    depths = NEAREST * fills * FARTHER ** np.arange(np.log(far / (NEAREST * fills)) / np.log(FARTHER) + 1)
    points = (eyes[:, None, None] + rays[:, :, None] * depths[:, None]).reshape(-1, 3)
    points = np.concatenate([points, _looked_at(film)[None]])
    # The middle of the bodies is put at each point; they face the camera as if the origin were there.
    middles = (film.points.min(axis=1) + film.points.max(axis=1)) / 2
    middle = np.concatenate([np.repeat(middles[picked], len(x) * len(depths), axis=0), middles.mean(axis=0)[None]])
    places = np.asarray(points - (about(1, facing(film, points)) @ middle[:, :, None])[:, :, 0])
    places[:, 1] = np.minimum(places[:, 1], highest_floor(film))
    some = film.every(SEEDS_EVERY)
    return places[np.argsort(-_merits(some, PlaceJudge(some), places), kind="stable")]


def _filling_depth(film: Filming) -> float:
    """Return the depth, metres, at which the bodies fill the picture in height or width when they are largest."""
    extents = np.ptp(film.points, axis=1)
    sizes = np.stack([np.hypot(extents[:, 0], extents[:, 2]), extents[:, 1]], axis=1)
    return float((sizes * film.lenses[:, :, 0]).max() / 2)


def _looked_at(film: Filming) -> F64:
    """Return the point (3,) nearest to all lines of sight; if several are, the one nearest to the middle of the eyes.

    The point x solves the normal equations of the distances: sum (1 - d d') (x - p) = 0 for eyes p and directions d.
    """
    ahead = -film.turns[:, :, 2]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    offsets = film.eyes - film.eyes.mean(axis=0)
    point = np.linalg.lstsq(across.sum(axis=0), (across @ offsets[:, :, None]).sum(axis=0)[:, 0], rcond=1e-6)[0]
    return np.asarray(point + film.eyes.mean(axis=0))


def _apart(film: Filming, places: F64) -> F64:
    """Return up to CLIMBERS of `places` (S, 3), in order, and skip places near one that is already returned."""
    apart = APART * _distances(film, places)
    kept: list[int] = []
    for k in range(len(places)):
        if not kept or np.linalg.norm(places[kept] - places[k], axis=1).min() > apart[k]:
            kept.append(k)
        if len(kept) == CLIMBERS:
            break
    return np.asarray(places[kept])


def _distances(film: Filming, places: F64) -> F64:
    """Return the median distance (S,) of each of `places` (S, 3) from the eyes."""
    some = film.eyes[::RAYS_EVERY]
    return np.asarray(np.median(np.linalg.norm(some[None] - places[:, None], axis=2), axis=1))
