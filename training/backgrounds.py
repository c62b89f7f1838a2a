"""Pictures that stand behind a person while an avatar is trained and judged: black, white, noise and scenery.

Rule: no single background judges alpha, because a person over one colour looks like a paler person who lets that colour
through. Every picture depends on the random generator alone.

Scenery stands for photographs, because none can be had here. Leaves of random size, place and colour lie over each
other (Lee, Mumford, Huang, Occlusion models for natural images, 2001). Noise shades each leaf; its amplitude falls with
the frequency, as in photographs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from trilane.arrays import F32, Shape

#: Side of a scene in pixels, number of scenes, and leaves in each scene.
SIDE, SCENES, LEAVES = 512, 8, 700
#: Radii of leaves in pixels. Their number falls with the third power of the radius, so no size is special.
LEAST_RADIUS, LARGEST_RADIUS = 4.0, 160.0
#: Shades of a leaf, and how far its colour is from grey.
SHADE, CHROMA = 0.12, 0.12


def background(kind: str, shape: Shape, rng: np.random.Generator) -> F32:
    """Return one background (h,w,3) in 0..1 of `shape` (height, width).

    `kind`: a name of `KINDS`.
    """
    return KINDS[kind](shape, rng)


def backgrounds(count: int, shape: Shape, rng: np.random.Generator) -> F32:
    """Return `count` backgrounds (count,h,w,3), whose kinds are drawn at random too."""
    return np.stack([background(str(kind), shape, rng) for kind in rng.choice(list(KINDS), count)])


def _noise(shape: Shape, rng: np.random.Generator) -> F32:
    return rng.random((*shape, 3), np.float32)


def _scenery(shape: Shape, rng: np.random.Generator) -> F32:
    """Return a part of a scene, possibly mirrored, with its colours in any order; the scene wraps at its edges."""
    scene = scenes()[int(rng.integers(SCENES))]
    rows, columns = ((int(rng.integers(SIDE)) + np.arange(side)) % SIDE for side in shape)
    part = scene[rows[:, None], columns][..., rng.permutation(3)]
    return part[:, ::-1] if rng.random() < 1 / 2 else part


#: Name of each kind, and the function that draws it.
KINDS: dict[str, Callable[[Shape, np.random.Generator], F32]] = {
    "black": lambda shape, _: np.zeros((*shape, 3), np.float32),
    "white": lambda shape, _: np.ones((*shape, 3), np.float32),
    "noise": _noise,
    "scenery": _scenery,
}


@cache
def scenes() -> tuple[F32, ...]:
    """Return the scenes, (SIDE,SIDE,3) in 0..1 each; they are always the same."""
    return tuple(_scene(np.random.default_rng((SIDE, number))) for number in range(SCENES))


def _scene(rng: np.random.Generator) -> F32:
    """Draw leaves from the back to the front; one more leaf fills what they leave free."""
    scene = np.broadcast_to(_leaf_colour(rng), (SIDE, SIDE, 3)).astype(np.float32)
    least, most = LARGEST_RADIUS**-2, LEAST_RADIUS**-2
    radii = rng.uniform(least, most, LEAVES) ** -0.5
    radii[:: LEAVES // 20] = rng.uniform(LARGEST_RADIUS / 4, LARGEST_RADIUS, len(radii[:: LEAVES // 20]))
    for radius in radii:
        reach = np.arange(-int(radius), int(radius) + 1)
        y, x = int(rng.integers(SIDE)) + reach, int(rng.integers(SIDE)) + reach
        slope = rng.uniform(-1, 1, 2) / radius
        inside = (reach[:, None] / radius) ** 2 + (reach / radius) ** 2 <= 1
        shade = 1 + SHADE * (slope[0] * reach[:, None] + slope[1] * reach)
        rows, columns = np.nonzero(inside)
        scene[y[rows] % SIDE, x[columns] % SIDE] = _leaf_colour(rng) * shade[rows, columns, None]
    return np.clip(scene * (1 + SHADE * _falling_noise(rng)[..., None]), 0, 1)


def _leaf_colour(rng: np.random.Generator) -> F32:
    return np.asarray(rng.beta(1.2, 1.2) + rng.normal(0, CHROMA, 3), np.float32)


def _falling_noise(rng: np.random.Generator) -> F32:
    """Return noise (SIDE,SIDE) of standard deviation 1 whose amplitude is inversely proportional to the frequency."""
    frequency = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE))
    frequency[0, 0] = np.inf
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((SIDE, SIDE))) / frequency)
    return np.asarray(noise / noise.std(), np.float32)
