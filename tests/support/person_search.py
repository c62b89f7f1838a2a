"""A slow search of its own for the place from which a recorded camera shows a person most, to judge the product's.

It shares no code with that search: all vertices are skinned by plain forward kinematics, the hull's own points are
projected through focal lengths in pixels, and places are drawn at random and climb at random. It obeys two rules of the
product, which are no part of a search: a person with heading 0 faces the first eye, and each eye is 0.3 m over the
floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trilane.arrays import F64, Shape
from trilane.body.body import ShapedBody
from trilane.scene.camera.path import CameraPath
from trilane.scene.mover import Mover

LOWEST_EYE_M = 0.3
#: Number of directions in which the outermost vertices are the points of a body.
DIRECTIONS = 150
#: Number of places that climb at once: the worst gives its turns to the others after each round.
CLIMBERS, LAST_CLIMBERS = 40, 8


def rotation(vector: F64) -> F64:
    """The rotation (3, 3) about an axis-angle vector by Rodrigues' formula, as schoolbooks have it."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def skinned(body: ShapedBody, mover: Mover, t_s: float) -> F64:
    """All vertices (V, 3) of a body in the scene, joint by joint, without pose blend shapes."""
    pose, translation = mover.sample(t_s)
    parents, rest = body.body.parents, body.joints
    turns, places = [np.eye(3)] * len(parents), [np.zeros(3)] * len(parents)
    for joint, parent in enumerate(parents):
        own = rotation(np.asarray(pose).reshape(-1, 3)[joint])
        if parent < 0:
            turns[joint], places[joint] = own, rest[joint] + translation
        else:
            turns[joint] = turns[parent] @ own
            places[joint] = places[parent] + turns[parent] @ (rest[joint] - rest[parent])
    moved = np.zeros_like(body.vertices, dtype=np.float64)
    for joint, weights in enumerate(body.body.weights.T):
        used = weights > 0
        moved[used] += weights[used, None] * ((body.vertices[used] - rest[joint]) @ turns[joint].T + places[joint])
    return np.asarray(moved @ mover.world[:3, :3].T + mover.world[:3, 3])


def outermost(points: F64) -> F64:
    """The points (DIRECTIONS, 3) that are outermost in directions spread over the sphere."""
    random = np.random.default_rng(2)
    directions = random.normal(size=(DIRECTIONS, 3))
    return np.asarray(points[(points @ directions.T).argmax(axis=0)])


@dataclass
class PersonSearch:
    """The recording at `times_s` (F,), and the points of the body then, (F, P, 3), in the scene.

    `mount`: turn (3, 3) of the camera on its mount.
    """

    path: CameraPath
    mount: F64
    times_s: F64
    points: F64
    output: Shape

    def __post_init__(self) -> None:
        poses = [self.path.pose(float(t_s)) for t_s in self.times_s]
        self.turns = np.stack([turn @ self.mount for turn, _ in poses])
        self.eyes = np.stack([eye for _, eye in poses])
        self.first_eye = self.path.pose(0.0)[1]
        lenses = [self.path.lens(float(t_s), self.output) for t_s in self.times_s]
        self.focal = np.array([[lens.fx, lens.fy] for lens in lenses])
        self.centre = np.array([[lens.cx, lens.cy] for lens in lenses])
        self.size = np.array([[lens.width_px, lens.height_px] for lens in lenses])
        #: Half pictures from the middle for a metre across at a metre's depth, (F, 2), and where the axis goes through.
        self.halves, self.middle = 2 * self.focal * [1, -1] / self.size, 2 * self.centre / self.size - 1
        self.middles = self.points.mean(axis=1)

    def outside(self, place: F64, points: F64) -> F64:
        """How far (F,) the outermost of `points` (F, P, 3) is out of the picture, in half pictures; below 0 it is in.

        `place` (3,): place of the scene's origin in the recording's world.
        """
        towards = self.first_eye - place
        length = np.hypot(towards[0], towards[2])
        s, c = (towards[0] / length, towards[2] / length) if length else (0.0, 1.0)
        facing = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        # Rows x, y and z of all points, (F, 3, P): the search asks this some 20,000 times.
        moved = ((place - self.eyes)[:, None] @ self.turns).swapaxes(1, 2)
        seen = (facing.T @ self.turns).swapaxes(1, 2) @ points.swapaxes(1, 2) + moved
        depth = -seen[:, 2]
        halves = self.halves[..., None] * seen[:, :2] / np.maximum(depth, 1e-3)[:, None] + self.middle[..., None]
        beyond = np.maximum(np.abs(halves[:, 0]), np.abs(halves[:, 1])) - 1
        return np.asarray(np.where(depth > 0.05, beyond, 9.0).max(axis=1))

    def share(self, place: F64) -> float:
        """The share of the moments at which the whole body is in the picture."""
        return float((self.outside(place, self.points) <= 0).mean())

    def merit(self, place: F64) -> float:
        """The share, and less than a moment more the nearer the others are to it."""
        if place[1] > self.eyes[:, 1].min() - LOWEST_EYE_M:
            return -1.0
        outside = self.outside(place, self.points)
        return float((outside <= 0).mean() + 0.5 / len(outside) * np.clip(1 - outside, 0, 1).mean())

    def drawn(self, random: np.random.Generator) -> F64:
        """A place where the body's middle is somewhere in the picture of some moment, at any distance."""
        k = random.integers(len(self.eyes))
        across = (random.uniform(0, 1, 2) * self.size[k] - self.centre[k]) / self.focal[k] * [1, -1]
        extent = float(np.linalg.norm(np.ptp(self.eyes, axis=0)))
        depth = np.exp(random.uniform(np.log(0.8), np.log(80 + 15 * extent)))
        at = self.eyes[k] + self.turns[k] @ np.append(across * depth, -depth)
        place = at - [0, self.middles[k, 1], 0]
        place[1] = min(place[1], self.eyes[:, 1].min() - LOWEST_EYE_M)
        return np.asarray(place)

    def best(self, draws: int, climbs: int) -> tuple[float, F64]:
        """The largest share that is found, and its place.

        `draws` random places are judged by the body's middle. The best of them climb by random steps, whose length
        grows with each success and shrinks with each failure; `climbs` places are tried in this, or fewer where one has
        all moments.
        """
        random = np.random.default_rng(7)
        middles = self.middles[:, None]
        drawn = [self.drawn(random) for _ in range(draws)]
        shares = np.array([(self.outside(place, middles) <= 0).mean() for place in drawn])
        likely = [drawn[k] for k in np.argsort(-shares, kind="stable")[: 3 * CLIMBERS]]
        climbers = sorted(((self.merit(place), 0.2, place) for place in likely), key=lambda one: -one[0])[:CLIMBERS]
        while climbs > 0 and climbers[0][0] < 1:
            for k, (merit, step, place) in enumerate(climbers):
                reach = step * float(np.linalg.norm(self.eyes.mean(axis=0) - place))
                tried = place + reach * random.normal(size=3)
                risen = self.merit(tried)
                climbers[k] = (risen, 1.5 * step, tried) if risen > merit else (merit, max(0.93 * step, 1e-4), place)
            climbs -= len(climbers)
            climbers = sorted(climbers, key=lambda one: -one[0])[: max(LAST_CLIMBERS, len(climbers) - 1)]
        place = climbers[0][2]
        return self.share(place), place
