"""How much of the avatars a camera shows: over the frames of a run, or at moments.

A body is given by its outline. It is whole in a frame when all points of the outline are in the picture and between the
clip planes. Nobody is seen when all points of every body are beyond one side of the picture.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from trilane.arrays import F64, Shape
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_NAMES, Skeleton
from trilane.scene.mover import Mover, outline
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
