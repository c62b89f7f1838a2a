"""Error of an avatar's picture against the ground truth: PSNR and SSIM over backgrounds, IoU, and the error of alpha.

Rule: pictures are compared in front of each kind of background, inside the bounding box of the true mask. In front of a
single colour, a person who lets this colour through would have no error. PSNR counts the background in the box too; a
second PSNR counts only pixels of the true mask. PSNR and SSIM are means over the kinds of background.

The error of alpha is measured in three regions. The edge has all pixels within `EDGE_PX` of a change of the true alpha;
an outline that is wrong by a pixel dominates there. Inside the edge alpha should be 1, and outside the edge 0.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from trilane.arrays import F32, F64, U8, Mask, Shape, psnr_db
from trilane.avatars.manifest import BANDS

HALF, OPAQUE = 128, 255
SSIM_WINDOW = 7
EDGE_PX = 2
#: A pixel inside the person whose alpha is below this counts as see-through.
SOLID = 0.9


@dataclass(frozen=True)
class ImageError:
    """The error of a picture against the ground truth.

    `psnr_db`, `ssim`: PSNR in dB and SSIM inside the bounding box of the true mask.
    `body_psnr_db`: PSNR in dB over the true mask's pixels.
    `by_background`: `psnr_db` in front of each kind of background, by the kind's name.
    `background`: share (0 to 1) of the box that the true mask does not cover.
    `iou`: intersection over union of the masks, over the whole tensor.
    `alpha_inside`, `alpha_edge`, `alpha_outside`: mean absolute error of alpha in this region, 0 to 1; 0 if the region
    is empty.
    `see_through`: share (0 to 1) of the inside whose alpha is less than `SOLID`; 0 if there is no inside.
    """

    psnr_db: float
    body_psnr_db: float
    by_background: dict[str, float]
    background: float
    ssim: float
    iou: float
    alpha_inside: float
    alpha_edge: float
    alpha_outside: float
    see_through: float


def image_error(picture: U8, truth: U8) -> ImageError | None:
    """Return the error of `picture` against `truth`, both (h,w,4) uint8, straight alpha; None if `truth` has nobody."""
    mask, true_mask = picture[..., 3] >= HALF, truth[..., 3] >= HALF
    if not true_mask.any():
        return None
    rows, columns = (np.flatnonzero(true_mask.any(axis=axis)) for axis in (1, 0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    before = {kind: (over(picture, behind)[box], over(truth, behind)[box]) for kind, behind in _behind(truth)}
    squares = {kind: (shown - wanted) ** 2 for kind, (shown, wanted) in before.items()}
    by_background = {kind: psnr_db(square.mean()) for kind, square in squares.items()}
    inside, edge, outside = regions(truth[..., 3])
    wrong = np.abs(picture[..., 3].astype(np.float64) - truth[..., 3]) / OPAQUE
    return ImageError(
        psnr_db=float(np.mean(list(by_background.values()))),
        body_psnr_db=float(np.mean([psnr_db(square[true_mask[box]].mean()) for square in squares.values()])),
        by_background=by_background,
        background=1.0 - float(true_mask[box].mean()),
        ssim=float(np.mean([_ssim(shown, wanted) for shown, wanted in before.values()])),
        iou=float((mask & true_mask).sum() / (mask | true_mask).sum()),
        alpha_inside=_mean(wrong[inside]),
        alpha_edge=_mean(wrong[edge]),
        alpha_outside=_mean(wrong[outside]),
        see_through=_mean(picture[..., 3][inside] < SOLID * OPAQUE),
    )


def over(image: U8, behind: NDArray[np.floating]) -> F64:
    """Return the colours (h,w,3), in 0..1, of `image` (h,w,4) uint8 in front of `behind` (h,w,3) in 0..1."""
    alpha = image[..., 3:] / OPAQUE
    return np.asarray(image[..., :3] / OPAQUE * alpha + behind * (1 - alpha))


def regions(alpha: U8) -> tuple[Mask, Mask, Mask]:
    """Return three masks (h,w): (inside, edge, outside) of the person with the true `alpha` (h,w).

    Beyond the picture, alpha is assumed to continue with the values at the border.
    """
    near = [np.pad(alpha, EDGE_PX, mode="edge")]
    for axis in (0, 1):
        size = alpha.shape[axis]
        near = [
            np.take(part, np.arange(start, start + size), axis) for part in near for start in range(2 * EDGE_PX + 1)
        ]
    inside, outside = np.min(near, axis=0) == OPAQUE, np.max(near, axis=0) == 0
    return inside, ~(inside | outside), outside


def _behind(truth: U8) -> Iterator[tuple[str, NDArray[np.floating]]]:
    """Yield (name, background (h,w,3)) for each kind of background. Backgrounds depend only on `truth` (h,w,4)."""
    rng = np.random.default_rng(zlib.crc32(truth.tobytes()))
    for kind in KINDS:
        yield kind, background(kind, (truth.shape[0], truth.shape[1]), rng)


def _ssim(shown: F64, wanted: F64) -> float:
    window = min(SSIM_WINDOW, *(side - 1 + side % 2 for side in shown.shape[:2]))
    if window < 3:
        return 1.0
    return float(structural_similarity(shown, wanted, data_range=1.0, channel_axis=2, win_size=window))


def _mean(values: NDArray[np.generic]) -> float:
    return float(values.mean()) if values.size else 0.0


# Summary of the errors of many samples, as the manifest holds it.
#
# Rule: besides the means, the summary has seed and number of the worst sample, so that this sample can be drawn again.

DB_DIGITS, SHARE_DIGITS = 2, 4
#: Fields of `ImageError` of which the summary has the mean over all samples.
MEANS = (
    *("psnr_db", "body_psnr_db", "see_through", "alpha_inside", "alpha_edge", "alpha_outside"),
    *("background", "iou", "ssim"),
)


@dataclass(frozen=True)
class SampleError:
    """The error of one sample, with the numbers that identify the sample.

    `seed`: seed of the sample's set. `number`: number of the sample in this set. `band`: name of the sample's band.
    """

    seed: int
    number: int
    band: str
    error: ImageError


def summary(errors: Sequence[SampleError]) -> dict[str, Any]:
    """Return the summary of `errors`, which must not be empty. The mean PSNR is a mean of decibels over samples.

    Keys:
    - `psnr_db_by_band`, `body_psnr_db_by_band`, `see_through_by_band`, `iou_by_band`: means by band;
    - `psnr_db_by_background`: means by kind of background;
    - the names in `MEANS`: means of these fields of `ImageError`;
    - `least_psnr_db`, `least_body_psnr_db`: least values;
    - `worst`: `seed`, `number`, `band`, `psnr_db`, `body_psnr_db` of the sample with the least PSNR;
    - `by_seed`: `psnr_db`, `body_psnr_db`, `least_psnr_db` of each seed's samples;
    - `samples`: number of samples.
    """
    bands = [band for band in BANDS if any(sample.band == band for sample in errors)]
    worst = min(errors, key=lambda sample: sample.error.psnr_db)
    seeds = sorted({sample.seed for sample in errors})
    return {
        **{
            f"{key}_by_band": {band: _mean_of([s for s in errors if s.band == band], key) for band in bands}
            for key in ("psnr_db", "body_psnr_db", "see_through", "iou")
        },
        "psnr_db_by_background": {
            kind: _rounded("psnr_db", float(np.mean([sample.error.by_background[kind] for sample in errors])))
            for kind in errors[0].error.by_background
        },
        **{key: _mean_of(errors, key) for key in MEANS},
        "least_psnr_db": _least(errors, "psnr_db"),
        "least_body_psnr_db": _least(errors, "body_psnr_db"),
        "worst": {
            "seed": worst.seed,
            "number": worst.number,
            "band": worst.band,
            **{key: _rounded(key, getattr(worst.error, key)) for key in ("psnr_db", "body_psnr_db")},
        },
        "by_seed": {str(seed): _of_seed([s for s in errors if s.seed == seed]) for seed in seeds},
        "samples": len(errors),
    }


def _of_seed(errors: Sequence[SampleError]) -> dict[str, float]:
    return {
        "psnr_db": _mean_of(errors, "psnr_db"),
        "body_psnr_db": _mean_of(errors, "body_psnr_db"),
        "least_psnr_db": _least(errors, "psnr_db"),
    }


def _mean_of(errors: Sequence[SampleError], key: str) -> float:
    return _rounded(key, float(np.mean([getattr(sample.error, key) for sample in errors])))


def _least(errors: Sequence[SampleError], key: str) -> float:
    return _rounded(key, min(getattr(sample.error, key) for sample in errors))


def _rounded(key: str, value: float) -> float:
    return round(value, DB_DIGITS if key.endswith("_db") else SHARE_DIGITS)


# Backgrounds in front of which an avatar is trained and measured: black, white, noise and scenery.
#
# Rule: a picture is never measured in front of a single background. In front of one colour, an opaque person looks the
# same as a person of other colours who lets this colour through. Backgrounds depend only on the random generator.
#
# Scenery replaces photographs, so that none must be stored or licensed. Discs ("leaves") of random size, place and
# colour cover each other (Lee, Mumford, Huang, Occlusion models for natural images, 2001). Noise shades the scene; its
# amplitude falls with the frequency, as in photographs.

#: Side of a scene in pixels, number of scenes, and number of leaves in each scene.
SIDE, SCENES, LEAVES = 512, 8, 700
#: Radii of leaves in pixels. The number of leaves falls with the third power of the radius: the scene is scale-free.
LEAST_RADIUS, LARGEST_RADIUS = 4.0, 160.0
#: Relative strength of shading, and standard deviation of a leaf's colour from grey.
SHADE, CHROMA = 0.12, 0.12


def background(kind: str, shape: Shape, rng: np.random.Generator) -> F32:
    """Return a background (h,w,3) in 0..1 of `shape` (height, width). `kind`: a name of `KINDS`."""
    return KINDS[kind](shape, rng)


def backgrounds(count: int, shape: Shape, rng: np.random.Generator) -> F32:
    """Return `count` backgrounds (count,h,w,3) in 0..1 of random kinds."""
    return np.stack([background(str(kind), shape, rng) for kind in rng.choice(list(KINDS), count)])


def _scenery(shape: Shape, rng: np.random.Generator) -> F32:
    """Return a random part (h,w,3) of a random scene, mirrored and with its channels in another order at random.

    Scenes wrap at their edges.
    """
    scene = scenes()[int(rng.integers(SCENES))]
    rows, columns = ((int(rng.integers(SIDE)) + np.arange(side)) % SIDE for side in shape)
    part = scene[rows[:, None], columns][..., rng.permutation(3)]
    return part[:, ::-1] if rng.random() < 1 / 2 else part


#: Name of each kind, and the function that draws it.
KINDS: dict[str, Callable[[Shape, np.random.Generator], F32]] = {
    "black": lambda shape, _: np.zeros((*shape, 3), np.float32),
    "white": lambda shape, _: np.ones((*shape, 3), np.float32),
    "noise": lambda shape, rng: rng.random((*shape, 3), np.float32),
    "scenery": _scenery,
}


@cache
def scenes() -> tuple[F32, ...]:
    """Return all images of scenery, each (SIDE,SIDE,3) float32 in 0..1. They are the same in every process."""
    return tuple(_scene(np.random.default_rng((SIDE, number))) for number in range(SCENES))


def _scene(rng: np.random.Generator) -> F32:
    """Return a scene (SIDE,SIDE,3): leaves drawn from back to front over a plain colour."""
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
    """Return noise (SIDE,SIDE) with standard deviation 1. Its amplitude is inversely proportional to the frequency."""
    frequency = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE))
    frequency[0, 0] = np.inf
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((SIDE, SIDE))) / frequency)
    return np.asarray(noise / noise.std(), np.float32)
