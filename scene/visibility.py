"""How much of the avatars a camera shows, and from which place in its world a recorded camera films them best.

**Shown.** A body is given by its outline. It is whole in a frame when all points of the outline are in the picture and
between the clip planes. Nobody is seen when all points of every body are beyond one side of the picture.

**Best place.** A place is where the scene's origin comes to in the recording's world. The bodies turn about the
vertical there, so that a heading of 0 faces the first eye. The best place shows whole bodies at the most moments. Among
places with about as many, the place with larger bodies, nearer to the middle of the picture, wins. Places are proposed
where the camera looks: along rays through its pictures, at distances from one that fills the picture with the bodies to
many times the length of the path. So the search has no scale of its own. The best of them climb, in steps that are
shares of the distance.

In the search, a body is in the picture while no point of it is beyond one of the picture's four sides. A side is a
plane, so only the point that is outermost across it counts. Which one that is depends on the bodies' heading alone:
these reaches are computed once for each heading, and a place then costs one product with each plane.
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

#: Share of the picture's height below which a person is hard to find, in the median over the frames.
SMALL = 0.08
#: Walk over the floor, metres, from which on a small person is small because the camera sees all of it.
FAR_WALK_M = 10.0
#: Number of frames that are looked at; of a longer run as many, evenly spread.
MOST_FRAMES = 300


class Camera(Protocol):
    """A camera in the scene."""

    def sample(self, t_s: float) -> F64:
        """Return the matrix (4, 4) from world to camera at `t_s`."""

    def projection(self, t_s: float, output: Shape) -> F64:
        """Return the OpenGL clip matrix (4, 4) at `t_s` for a picture of `output` (height, width)."""


@dataclass(frozen=True)
class Seen:
    """What a camera shows at F moments.

    `whole` (F,): whether all bodies are whole in the picture. `nobody` (F,): whether nothing of any body is in it.
    `share` (F,): share of all outlines' points that are in it. `height` (F,): share of the picture's height between the
    lowest and the highest visible point.
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

    `output`: (height, width) of the picture. `joints`: names of the joints whose part of a body is looked at.
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
    """Return the share of points (K, 4) in clip space that are in the picture, and the lowest and highest visible y.

    With nothing in the picture the lowest is 1 and the highest -1.
    """
    w = clip[:, 3]
    beyond = np.concatenate([clip[:, :3] > w[:, None], clip[:, :3] < -w[:, None]], axis=1)
    if beyond.all(axis=0).any():
        return 0.0, 1.0, -1.0
    # Points behind the near plane have no place in the picture; a body that passes through it reaches every border.
    y = np.clip(clip[:, 1] / w, -1, 1) if (clip[:, 2] >= -w).all() else np.array([-1.0, 1.0])
    return 1.0 - float(beyond.any(axis=1).mean()), float(y.min()), float(y.max())


def seen_notes(camera: Camera, scene: Scene, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> tuple[str, ...]:
    """Say in how many of the run's frames the bodies are whole in the picture, in how many nobody is, and how large.

    A recorded camera that was placed and shows them very small gets a hint at the key that may be wrong.
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


def _walked(movers: Sequence[Mover], times_s: F64) -> float:
    """Return how far apart over the floor the places are where one of the `movers` is at `times_s` (F,), metres."""
    ways = [[mover.sample(float(t_s))[1] @ mover.world[:3, :3].T for t_s in times_s] for mover in movers]
    return max(float(np.hypot(*np.ptp(np.array(way)[:, [0, 2]], axis=0))) for way in ways)


def _hint(scene: Scene, heights: F64, movers: Sequence[Mover], times_s: F64) -> tuple[str, ...]:
    """Return a note where `heights` (F,), shares of the picture's height, are small: a long walk, or another unit."""
    is_placed = scene.camera.place == "auto" and not scene.camera.source.startswith(BUILT_IN_PREFIX)
    if not is_placed or not len(heights) or np.median(heights) >= SMALL:
        return ()
    small = f"the person is only {np.median(heights):.1%} of the picture's height in the median, hard to find"
    walked_m = _walked(movers, times_s)
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
#: motion or recording is repeated as in a run; what a longer one shows later does not count.
SCORED_MOMENTS, SCORED_S = 120, 10.0
#: One moment of so many decides which of the proposed places climb, and has rays through its picture.
SEEDS_EVERY, RAYS_EVERY = 3, 10
#: Where rays go through a picture, as shares of its half width and half height.
RAYS_AT = (-0.8, -0.4, 0.0, 0.4, 0.8)
#: Nearest distance on a ray, in distances at which the bodies fill the picture; the farthest, in these distances and in
#: lengths of the path added; factor from one distance to the next. Far off a path of any length is a pan.
NEAREST, FARTHEST, FARTHEST_OF_PATH, FARTHER = 0.7, 30.0, 10.0, 1.25
#: Number of places that climb, and least distance between them in the beginning, as a share of that from the camera.
CLIMBERS, APART = 96, 0.07
#: Steps of a climb, as shares of the distance from the camera, and number of random ones from each place at each step.
#: Of the places that climb the worst stop after each step, as long as there are more than LAST_CLIMBERS.
STEPS, TRIED, LAST_CLIMBERS, STAY = tuple(0.3 * 0.8**k for k in range(28)), 40, 12, 0.92
#: Least height of the camera above the floor.
LOWEST_EYE_M = 0.3
#: Share of the picture's half width and half height within which a body counts as whole in the picture.
MARGIN = 0.98
#: Depth from which on a body is seen, unless the near clip plane is farther.
NEAREST_M = 0.3
#: Score of how well bodies are shown: their share of the picture's height, up to ENOUGH_SIZE, less MIDDLE_WEIGHT of it
#: for a body at the border. Whole bodies at all moments score 1. Nothing gained in this is worth a fortieth of the
#: moments.
SIZE_WEIGHT, ENOUGH_SIZE, MIDDLE_WEIGHT = 0.03, 0.75, 0.5
#: Score of bodies that are nearly in the picture, in moments: it leads a climb to the next moment.
NEARLY_MOMENTS = 0.5
#: Number of headings for which reaches are computed. The nearest is off by 0.35 degrees at most, 4 mm at a hand.
HEADINGS = 512
#: Number of directions in which the outermost points of a body stand for all of them.
DIRECTIONS = 120
#: Number of places that are scored together: so few that the arrays stay in the processor's cache.
PLACES_AT_ONCE = 128
#: Rows of a moment: the picture's four sides, the depth of the nearest point, and of the bodies' middle the depth and
#: its x and y in the picture.
ROWS, NEAR, MIDDLE = 8, 4, 5


def outermost_points(times_s: F64, movers: Sequence[Mover], bodies: Sequence[ShapedBody]) -> F64:
    """Return the points (F, P, 3) of each of the bodies at `times_s` (F,) that are outermost, in the scene."""
    directions = _spread(DIRECTIONS).T
    found = []
    for mover, body in zip(movers, bodies, strict=True):
        skeleton, shape = Skeleton(body.joints, body.body.parents), outline(body)
        posed = [shape.posed(skeleton.pose(*mover.sample(float(t_s)), mover.world).matrices) for t_s in times_s]
        # Made as wide and deep as high: arms that are spread hide a back from most directions.
        found.append(
            np.stack([points[((points / np.ptp(points, axis=0)) @ directions).argmax(axis=0)] for points in posed])
        )
    return np.concatenate(found, axis=1)


def _spread(count: int) -> F64:
    """Return unit vectors (count, 3) spread evenly over the sphere, in a Fibonacci spiral."""
    k = np.arange(count)
    height, angle = 1 - (2 * k + 1) / count, np.pi * (1 + 5**0.5) * k
    level = np.sqrt(1 - height**2)
    return np.stack([level * np.cos(angle), height, level * np.sin(angle)], axis=1)


@dataclass(frozen=True)
class Filming:
    """The recording and the bodies at the F moments at which places are scored.

    `eyes`, (F, 3), `turns`, (F, 3, 3): places and axes (columns) of the camera in the recording's world. `lenses`
    (F, 2, 2): factor and addend of x and of y, where ndc = factor * x / depth + addend. `points` (F, P, 3): outermost
    points of the bodies in the scene. `nearest_m`: depth from which on a body is seen.
    """

    eyes: F64
    turns: F64
    lenses: F64
    points: F64
    nearest_m: float = NEAREST_M

    def every(self, step: int) -> Filming:
        """Return the first of every `step` moments."""
        return Filming(self.eyes[::step], self.turns[::step], self.lenses[::step], self.points[::step], self.nearest_m)


def filming(path: CameraPath, mount: F64, times_s: F64, output: Shape, points: F64, near_m: float) -> Filming:
    """Return the recording `path` on `mount` (3, 3) at `times_s` (F,), with a picture of `output` (height, width)."""
    poses = [path.pose(float(t_s)) for t_s in times_s]
    clips = np.stack([path.projection(float(t_s), output) for t_s in times_s])
    lenses = np.stack([[clips[:, k, k], -clips[:, k, 2]] for k in range(2)]).transpose(2, 0, 1)
    turns, eyes = np.stack([turn @ mount for turn, _ in poses]), np.stack([place for _, place in poses])
    return Filming(eyes, turns, lenses, points, max(NEAREST_M, near_m))


@dataclass(frozen=True)
class PlaceMerits:
    """How S places show the bodies, each (S,).

    `whole`: share of the moments with whole bodies. `well`: how well bodies are shown when they are whole, 0 to
    ENOUGH_SIZE, on average. `nearly`: how nearly bodies that are not whole are in the picture, 0 to 1 on average.
    """

    whole: F64
    well: F64
    nearly: F64

    @property
    def score(self) -> F64:
        """What decides between places."""
        return np.asarray(self.whole + SIZE_WEIGHT * self.well)


class PlaceJudge:
    """Judges places for one `Filming`.

    A row of a moment is a direction in the recording's world that is multiplied with a place: ROWS in all.
    """

    def __init__(self, film: Filming) -> None:
        """Compute how far the bodies reach along each row, for each heading."""
        self._film = film
        rows = _rows(film)
        self._along = rows.reshape(-1, 3).T.astype(np.float32)
        self._added = -(rows * film.eyes).sum(axis=2).astype(np.float32)
        self._reaches, self._heights = _reaches(film, rows)

    def shown(self, places: F64) -> PlaceMerits:
        """Return how each of `places` (S, 3) shows the bodies."""
        parts = [self._shown(part) for part in np.split(places, range(PLACES_AT_ONCE, len(places), PLACES_AT_ONCE))]
        return PlaceMerits(*np.concatenate(parts, axis=1))

    def _shown(self, places: F64) -> F64:
        """Return `whole`, `well` and `nearly` (3, S) of a few places."""
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
    """Return the rows (ROWS, F, 3): those of sides point inwards, and a value over the depth is in half pictures."""
    right, up, ahead = film.turns[:, :, 0], film.turns[:, :, 1], -film.turns[:, :, 2]
    x, y = (film.lenses[:, k, :1] * axis + film.lenses[:, k, 1:] * ahead for k, axis in enumerate((right, up)))
    sides = [MARGIN * ahead + x, MARGIN * ahead - x, MARGIN * ahead + y, MARGIN * ahead - y]
    return np.stack([*sides, ahead, ahead, x, y])


def _reaches(film: Filming, rows: F64) -> tuple[F32, F32]:
    """Return what the bodies add to each row, (HEADINGS, ROWS, F), and their heights (HEADINGS, F) in half pictures.

    The outermost point counts towards a side and for the depth. Heights are those at a depth of 1.
    """
    headings = about(1, np.arange(HEADINGS) * (2 * np.pi / HEADINGS))
    reaches = np.empty((HEADINGS, ROWS, rows.shape[1]), np.float32)
    heights = np.empty((HEADINGS, rows.shape[1]), np.float32)
    middles = (film.points.min(axis=1) + film.points.max(axis=1)) / 2
    for k, (points, middle) in enumerate(zip(film.points, middles, strict=True)):
        turned = (rows[:, k] @ headings).astype(np.float32)  # a row times the turned point is the turned row times it
        across = turned[:, :MIDDLE].reshape(-1, 3) @ points.T.astype(np.float32)
        reaches[:, :MIDDLE, k] = across.min(axis=1).reshape(HEADINGS, MIDDLE)
        reaches[:, MIDDLE:, k] = turned[:, MIDDLE:] @ middle.astype(np.float32)
        up = ((film.lenses[k, 1, 0] * film.turns[k, :, 1]) @ headings) @ points.T
        heights[:, k] = np.ptp(up, axis=1) / 2
    return reaches, heights


def facing(film: Filming, places: F64) -> F64:
    """Return angles (S,) about +Y from the scene to the recording's world, with which +Z points to the first eye."""
    towards = film.eyes[0] - places
    return np.asarray(np.arctan2(towards[:, 0], towards[:, 2]))


def best_place(film: Filming) -> tuple[F64, float]:
    """Return the best place (3,) for the scene's origin, in the recording's world, and its score."""
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
    """Return the scores (S,) of places for a climb; below 0 where the floor is too near to an eye."""
    shown = judge.shown(places)
    merits = shown.score + NEARLY_MOMENTS / len(film.eyes) * shown.nearly
    return np.where(places[:, 1] <= highest_floor(film), merits, -1.0)


def highest_floor(film: Filming) -> float:
    """Return the greatest height of the floor at which no eye is too near to it."""
    return float(film.eyes[:, 1].min()) - LOWEST_EYE_M


def _seeds(film: Filming) -> F64:
    """Return places (S, 3) where the camera looks, those that show most first."""
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
    # The middle of the bodies comes to each point; they face the camera as they would with the origin there.
    middles = (film.points.min(axis=1) + film.points.max(axis=1)) / 2
    middle = np.repeat(middles[picked], len(x) * len(depths), axis=0)
    middle = np.concatenate([middle, middles.mean(axis=0)[None]])
    turned = (about(1, facing(film, points)) @ middle[:, :, None])[:, :, 0]
    places = np.asarray(points - turned)
    places[:, 1] = np.minimum(places[:, 1], highest_floor(film))
    some = film.every(SEEDS_EVERY)
    return places[np.argsort(-_merits(some, PlaceJudge(some), places), kind="stable")]


def _filling_depth(film: Filming) -> float:
    """Return the depth at which the bodies fill the picture, upright or across, at the moment when they are largest."""
    extents = np.ptp(film.points, axis=1)
    sizes = np.stack([np.hypot(extents[:, 0], extents[:, 2]), extents[:, 1]], axis=1)
    return float((sizes * film.lenses[:, :, 0]).max() / 2)


def _looked_at(film: Filming) -> F64:
    """Return the point (3,) nearest to all lines of sight; of several, the one nearest to the middle of the eyes.

    The point solves the normal equations of the distances: sum (1 - d d') (x - p) = 0 for places p and directions d.
    """
    ahead = -film.turns[:, :, 2]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    offsets = film.eyes - film.eyes.mean(axis=0)
    point = np.linalg.lstsq(across.sum(axis=0), (across @ offsets[:, :, None]).sum(axis=0)[:, 0], rcond=1e-6)[0]
    return np.asarray(point + film.eyes.mean(axis=0))


def _apart(film: Filming, places: F64) -> F64:
    """Return the first CLIMBERS of `places` (S, 3) that are not near an earlier one."""
    apart = APART * _distances(film, places)
    kept: list[int] = []
    for k in range(len(places)):
        if not kept or np.linalg.norm(places[kept] - places[k], axis=1).min() > apart[k]:
            kept.append(k)
        if len(kept) == CLIMBERS:
            break
    return np.asarray(places[kept])


def _distances(film: Filming, places: F64) -> F64:
    """Return the median distance of the eyes from each of `places` (S, 3)."""
    some = film.eyes[::RAYS_EVERY]
    return np.asarray(np.median(np.linalg.norm(some[None] - places[:, None], axis=2), axis=1))
