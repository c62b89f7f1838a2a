"""The data set: the samples that an avatar is trained and evaluated on, rendered to disk by several processes.

Samples come from the synthetic person or from a capture; everything after that is the same for both.

Rule: validation poses come from motions that no training sample uses; a sample depends only on its seed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from trilane.arrays import F32, F64, U8, Shape
from trilane.body.body import load_body
from trilane.scene.motion.motion import Motion
from trilane.training.clothing.looks import look_named
from trilane.training.random_views import Crop
from trilane.training.sample_files import U16, create_group, open_groups
from trilane.training.sample_renderer import BAND_NAMES, PoseSource, Sample, SampleRenderer

One = TypeVar("One")
#: Share of each band among the training samples; `anywhere` is last.
TRAINING_SHARE = {"far": 0.16, "full_body": 0.34, "upper_body": 0.22, "face": 0.16, "anywhere": 0.12}
#: Share of each tensor size among the training samples: the default size, and half its side for avatars far away.
SIZES = {"256": 0.85, "128": 0.15}
#: Tensor size of validation samples.
VALIDATION_SIZE = "256"
#: Number of samples that a process renders as one part.
PART = 50


def motion_poses(motions: Sequence[Motion]) -> PoseSource:
    """Return a source of poses that takes each one at a random time of a random one of `motions`."""

    def draw(rng: np.random.Generator) -> F64:
        motion = motions[int(rng.integers(len(motions)))]
        return motion.sample(float(rng.uniform(0, motion.duration_s)))[0]

    return draw


class Planned(Protocol):
    """A sample that was planned, of the synthetic person or of a capture.

    `crop`: crop whose shape is the tensor's. `band`: index of the band. `picture`: number of the frame that it is cut
    from.
    """

    @property
    def crop(self) -> Crop: ...

    @property
    def band(self) -> int: ...

    @property
    def picture(self) -> int: ...


class SampleSource(Protocol[One]):
    """Something that plans and renders samples; each rendering process opens one."""

    def training_sample(self, seed: Sequence[int], band: str, size: str) -> One:
        """Plan the sample of `seed`, in `band` and of tensor size `size`."""

    def render(self, sample: One) -> tuple[F32, U8]:
        """Return the UV image (h,w,3) and the ground truth (h,w,4) of `sample`."""


def clothed_source(body: Path, name: str, offsets: F32 | None) -> SampleRenderer:
    """Open the default source: the body in the file `body`, in the look `name`, on one thread.

    The body is drawn with `offsets` (V,3). Raises BadInputError.
    """
    look = look_named(name)
    shaped = load_body(body).shape(look.betas)
    return SampleRenderer(shaped if offsets is None else shaped.with_offsets(offsets), threads=1, look=look)


def plan_training(source: SampleSource[One], count: int, seed: int, track: Callable[[Any], Any] = iter) -> list[One]:
    """Plan samples in random bands and sizes.

    `source`: plans each sample.
    `count`: number of samples.
    `seed`: seed of all random numbers.
    `track`: wraps the list of samples to show progress.
    """
    rng = np.random.default_rng((seed, 0))
    bands = rng.choice(list(TRAINING_SHARE), count, p=list(TRAINING_SHARE.values()))
    sizes = rng.choice(list(SIZES), count, p=list(SIZES.values()))
    return [
        source.training_sample((seed, 1, number), str(band), str(size))
        for number, (band, size) in enumerate(track(list(zip(bands, sizes, strict=True))))
    ]


def plan_validation(
    renderer: SampleRenderer, per_band: int, seed: int, motions: Sequence[Motion], size: str = VALIDATION_SIZE
) -> list[Sample]:
    """Plan samples for validation, all of one tensor size.

    `renderer`: plans each sample.
    `per_band`: number of samples in each band.
    `seed`: seed of all random numbers.
    `motions`: source of the poses; no training sample uses them.
    `size`: tensor size, as `shape_buckets` takes it.
    """
    source = motion_poses(motions)
    return [
        renderer.plan((seed, 2, number, index), source, band, size)
        for index, band in enumerate(BAND_NAMES)
        for number in range(per_band)
    ]


def write_dataset(
    source: Callable[[], SampleSource[Any]],
    samples: Sequence[Planned],
    folder: Path,
    processes: int,
    track: Callable[[Any], Any] = iter,
) -> None:
    """Render samples to disk, grouped by tensor shape; samples of the same frame follow each other.

    `source`: opens the renderer in each process; it is sent there.
    `samples`: samples to render.
    `folder`: folder of the arrays, see `sample_files`.
    `processes`: number of rendering processes.
    `track`: wraps the list of parts to show progress.
    """
    by_shape: dict[Shape, list[Planned]] = {}
    for sample in sorted(samples, key=lambda each: each.picture):
        by_shape.setdefault(sample.crop.shape, []).append(sample)
    for shape, group in by_shape.items():
        create_group(folder, shape, np.array([sample.band for sample in group], np.int8))
    places = [(shape, place, sample) for shape, group in by_shape.items() for place, sample in enumerate(group)]
    parts = [places[start : start + PART] for start in range(0, len(places), PART)]
    with ProcessPoolExecutor(processes, get_context("spawn"), _open_source, (source,)) as pool:
        waiting = [pool.submit(_render_part, folder, part) for part in parts]
        for done in track(waiting):
            done.result()


#: The source of a rendering process, opened once by `_open_source`.
_source: list[SampleSource[Any]] = []


def _open_source(source: Callable[[], SampleSource[Any]]) -> None:
    _source.append(source())


def _render_part(folder: Path, part: list[tuple[Shape, int, Planned]]) -> None:
    groups = {group.shape: group for group in open_groups(folder, writable=True)}
    for shape, place, sample in part:
        uv, rgba = _source[0].render(sample)
        group = groups[shape]
        group.uv[place] = np.round(np.clip(uv[..., :2], 0, 1) * U16)
        group.covered[place] = uv[..., 2] > 0
        group.rgba[place] = rgba
