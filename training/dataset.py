"""The data set: the samples that an avatar is trained and evaluated on, rendered to disk by several processes.

Samples show the synthetic person or the person of a capture; this module treats both alike.

Rule: validation poses come from motions that no training sample uses. A sample depends only on its seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

from trilane.arrays import F32, F64, U8, Shape, parse_shape
from trilane.avatars.validation import VALIDATION_SIZE
from trilane.body.body import load_body
from trilane.errors import BadInputError
from trilane.scene.motion.motion import Motion
from trilane.scene.tensor_budget import MOST_DENSITY
from trilane.training.clothing import look_named
from trilane.training.random_views import Crop
from trilane.training.sample_renderer import BAND_NAMES, PoseSource, Sample, SampleRenderer
from trilane.training.training_settings import TrainingSettings
from trilane.units import SIDES

One = TypeVar("One")
#: Share of each band among the training samples. Far samples are the most, because their tensors have many sizes.
TRAINING_SHARE = {"far": 0.30, "full_body": 0.30, "upper_body": 0.17, "face": 0.13, "anywhere": 0.10}
#: Least and greatest density of a training sample's tensor: tensor pixels for one pixel of the picture, along a side.
#: The planner's smallest tensor has the least, its densest tensor has the greatest.
DENSITY = (min(SIDES), MOST_DENSITY)
#: Number of samples in a part; a rendering process gets one part at a time.
PART = 50


def motion_poses(motions: Sequence[Motion]) -> PoseSource:
    """Return a source of poses: each call returns the pose at a random time of a random motion of `motions`."""

    def draw(rng: np.random.Generator) -> F64:
        motion = motions[int(rng.integers(len(motions)))]
        return motion.sample(float(rng.uniform(0, motion.duration_s)))[0]

    return draw


class Planned(Protocol):
    """A planned sample of the synthetic person or of a capture.

    `crop`: crop with the shape of the tensor. `band`: index of the band. `picture`: number of the shown frame.
    """

    @property
    def crop(self) -> Crop: ...

    @property
    def band(self) -> int: ...

    @property
    def picture(self) -> int: ...


class SampleSource(Protocol[One]):
    """A renderer that plans and renders samples. Each rendering process opens its own."""

    def training_sample(self, seed: Sequence[int], band: str, density: float) -> One:
        """Return the planned sample of `seed`, in the band named `band`.

        `density`: approximate number of tensor pixels for one pixel of the picture, along a side.
        """

    def render(self, sample: One) -> tuple[F32, U8]:
        """Return the UV image (h,w,3) float32 (u, v, coverage) and the ground truth (h,w,4) uint8 of `sample`."""


def clothed_source(body: Path, name: str, offsets: F32 | None) -> SampleRenderer:
    """Return a new renderer, on one thread, of a clothed body.

    `body`: body file. `name`: name of the look. `offsets`: offsets (V,3) that the body is drawn with; None for none.
    Raises BadInputError for a wrong body file or an unknown look, MissingPartError without OpenGL.
    """
    look = look_named(name)
    shaped = load_body(body).shape(look.betas)
    return SampleRenderer(shaped if offsets is None else shaped.with_offsets(offsets), threads=1, look=look)


def plan_training(source: SampleSource[One], count: int, seed: int, track: Callable[[Any], Any] = iter) -> list[One]:
    """Return `count` planned samples in random bands, with tensors of random densities.

    `source`: renderer that plans each sample.
    `seed`: seed of all random numbers.
    `track`: wraps the list of bands and densities to show progress.
    """
    rng = np.random.default_rng((seed, 0))
    views = [random_kind(rng) for _ in range(count)]
    return [source.training_sample((seed, 1, number), *view) for number, view in enumerate(track(views))]


def random_kind(rng: np.random.Generator) -> tuple[str, float]:
    """Return the band and the density of a random training sample."""
    band = str(rng.choice(list(TRAINING_SHARE), p=list(TRAINING_SHARE.values())))
    return band, float(np.exp(rng.uniform(*np.log(DENSITY))))


def plan_validation(
    renderer: SampleRenderer, per_band: int, seed: int, motions: Sequence[Motion], size: str = VALIDATION_SIZE
) -> list[Sample]:
    """Return planned samples for validation, all of one tensor size.

    `renderer`: renderer that plans each sample.
    `per_band`: number of samples in each band.
    `seed`: seed of all random numbers.
    `motions`: motions that the poses are taken from; no training sample uses them.
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
    """Render `samples` to disk, in a group for each tensor shape, sorted by frame.

    `source`: picklable function that opens a renderer in each process.
    `folder`: folder of the groups, see `create_group`.
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


#: The renderer of this rendering process, which `_open_source` opens once.
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


# Rendered samples on disk.
#
# Rule: arrays hold the rendered pixels without resampling. Each tensor shape has a folder of memory-mapped arrays.

U16 = 65535
#: Shape after (N, H, W) and dtype of each array. `uv`: u and v in 1/65535. `covered`: 1 on the body, else 0. `rgba`:
#: ground truth, straight alpha.
FIELDS: dict[str, tuple[tuple[int, ...], type]] = {
    "uv": ((2,), np.uint16),
    "covered": ((), np.uint8),
    "rgba": ((4,), np.uint8),
}


@dataclass(frozen=True)
class ShapeGroup:
    """N rendered samples of one tensor shape, in arrays (N, H, W, ...) as in `FIELDS`.

    `band`: index (N,) of each sample's band. `person`: number of the person whom all samples show.
    """

    shape: Shape
    uv: NDArray[np.uint16]
    covered: NDArray[np.uint8]
    rgba: NDArray[np.uint8]
    band: NDArray[np.int8]
    person: int = 0

    def __len__(self) -> int:
        return len(self.band)


def create_group(folder: Path, shape: Shape, bands: NDArray[np.int8]) -> ShapeGroup:
    """Create the arrays of a group on disk under `folder`, for the caller to fill.

    `shape`: tensor shape (height, width). `bands`: index (N,) of each sample's band.
    """
    place = folder / f"{shape[0]}x{shape[1]}"
    place.mkdir(parents=True, exist_ok=True)
    np.save(place / "band.npy", bands)
    arrays: dict[str, Any] = {
        name: open_memmap(place / f"{name}.npy", "w+", dtype, (len(bands), *shape, *tail))
        for name, (tail, dtype) in FIELDS.items()
    }
    return ShapeGroup(shape, band=bands, **arrays)


def open_groups(folder: Path, person: int = 0, writable: bool = False) -> list[ShapeGroup]:
    """Return all groups of the data set in `folder`, sorted by tensor shape.

    `person`: number of the person whom the samples show. `writable`: whether changes go to the files.
    """
    mode: Any = "r+" if writable else "r"
    groups = []
    for place in sorted(folder.iterdir(), key=lambda path: parse_shape(path.name)):
        arrays: dict[str, Any] = {name: np.load(place / f"{name}.npy", mmap_mode=mode) for name in FIELDS}
        groups.append(ShapeGroup(parse_shape(place.name), band=np.load(place / "band.npy"), person=person, **arrays))
    return groups


def batches(
    groups: list[ShapeGroup],
    size: int,
    rng: np.random.Generator,
    repeats: Sequence[int] = (1,) * 5,
    labels: Sequence[NDArray[np.int64]] | None = None,
    person_repeats: Sequence[int] = (),
) -> Iterator[tuple[ShapeGroup, NDArray[np.int64]]]:
    """Yield batches without end. A batch is a group and the indices of the batch's samples in that group.

    `groups`: groups of samples.
    `size`: approximate number of samples in a batch.
    `rng`: generator that shuffles the samples of each epoch.
    `repeats`: how often an epoch has a sample, by the index of the sample's band.
    `labels`: label (N,) of each sample, for each group. All samples of a batch have the same label. Samples with a
    label below 0 are left out.
    `person_repeats`: factor on `repeats`, by the number of the group's person; 1 for all if it is empty.
    """
    kinds = labels if labels is not None else [np.zeros(len(group), np.int64) for group in groups]
    while True:
        epoch: list[tuple[ShapeGroup, NDArray[np.int64]]] = []
        for group, kind in zip(groups, kinds, strict=True):
            times = np.asarray(repeats) * (person_repeats[group.person] if person_repeats else 1)
            for label in np.unique(kind[kind >= 0]):
                alike = np.flatnonzero(kind == label)
                order = rng.permutation(np.repeat(alike, times[group.band[alike]]))
                parts = np.array_split(order, max(1, len(order) // size))
                epoch += [(group, np.sort(part)) for part in parts if len(part)]
        for index in rng.permutation(len(epoch)):
            yield epoch[index]


# Which samples a training reads in each of its steps.
#
# Rule: the samples of a step follow only from the settings, the data set and the number of the step. A resumed training
# thus reads the same batches as one that was not interrupted.
#
# A training has up to three phases: only half-size samples, all samples, and only samples of whole bodies.

#: Tensors with fewer pixels are half-size. Training begins with half-size samples because they are cheap.
SMALL_PIXELS = 160 * 160
#: Bands whose samples show the whole body. Tensors are cropped to the body, so bodies are equally large in both bands.
WHOLE_BANDS = [BAND_NAMES.index(name) for name in ("far", "full_body")]
#: Number of zoom labels per octave, and distance in pixels between the rows on which a zoom is measured.
ZOOMS_PER_OCTAVE, ROW_STEP = 2, 8
LEFT_OUT = -1

Batch = tuple[ShapeGroup, NDArray[np.int64]]


@dataclass(frozen=True)
class Phase:
    """The steps of a phase, from `first` to `end` - 1. `labels`: labels of each group's samples, as in `batches`."""

    first: int
    end: int
    labels: list[NDArray[np.int64]]


def batch_stream(groups: list[ShapeGroup], settings: TrainingSettings, count: int, step: int = 0) -> Iterator[Batch]:
    """Yield the batches of a training of `count` steps, from step `step` on; each step has `batches_per_step` batches.

    Raises BadInputError when a phase with steps has no sample.
    """
    per_step = settings.optimiser.batches_per_step
    for number, phase in enumerate(phases(groups, settings, count)):
        rng = np.random.default_rng((settings.seed, 2, number))
        shares = settings.batches
        stream = batches(groups, settings.batch, rng, shares.repeats, phase.labels, shares.look_repeats)
        done = min(max(step - phase.first, 0), phase.end - phase.first)
        yield from islice(stream, done * per_step, (phase.end - phase.first) * per_step)


def phases(groups: list[ShapeGroup], settings: TrainingSettings, count: int) -> list[Phase]:
    """Return the three phases of a training of `count` steps; a phase may have no steps.

    If no sample is half-size, the first phase reads all samples.

    Raises BadInputError when a phase with steps has no sample.
    """
    labels = _labels(groups, settings)
    small = [math.prod(group.shape) < SMALL_PIXELS for group in groups]
    whole_from = math.ceil(settings.batches.full_body_from * count)
    switch = min(math.ceil(settings.small_until * count), whole_from)
    of_small = [
        label if each or not any(small) else np.full_like(label, LEFT_OUT)
        for label, each in zip(labels, small, strict=True)
    ]
    of_whole = [np.where(_whole(group), label, LEFT_OUT) for group, label in zip(groups, labels, strict=True)]
    found = [Phase(0, switch, of_small), Phase(switch, whole_from, labels), Phase(whole_from, count, of_whole)]
    for phase in found:
        if phase.first < phase.end and not any((label >= 0).any() for label in phase.labels):
            shown = "shows a whole body" if phase is found[2] else "is used"
            raise BadInputError("samples", f"none that {shown}", "some for every step", "draw more samples")
    return found


def is_whole(batch: Batch) -> bool:
    """Return whether all samples of `batch` show the whole body."""
    group, index = batch
    return bool(np.isin(group.band[index], WHOLE_BANDS).all())


def zoom(group: ShapeGroup) -> NDArray[np.float64]:
    """Return the zoom (N,) of each sample: the number of tensor pixels over which u or v would change by 1.

    The zoom is 1 / the median distance in UV between neighbouring pixels of a row; 1 for a sample without such pixels.
    """
    rows = group.uv[:, ::ROW_STEP].astype(np.int64)
    shown = group.covered[:, ::ROW_STEP] > 0
    steps = np.sqrt(np.square(np.diff(rows, axis=2)).sum(axis=-1)) / U16
    pairs = (shown[:, :, 1:] & shown[:, :, :-1]) & (steps > 0)
    return np.array([1 / np.median(step[pair]) if pair.any() else 1.0 for step, pair in zip(steps, pairs, strict=True)])


def _labels(groups: list[ShapeGroup], settings: TrainingSettings) -> list[NDArray[np.int64]]:
    """Return the labels (N,) of each group's samples, as `batches` takes them, by the settings in `[batches]`."""
    options = settings.batches
    rng = np.random.default_rng((settings.seed, 3))
    found = []
    for group in groups:
        label = np.zeros(len(group), np.int64)
        if options.same_zoom:
            label += 2 * np.maximum(0, np.round(ZOOMS_PER_OCTAVE * np.log2(zoom(group)))).astype(np.int64)
        if options.full_body_statistics:
            label += _whole(group)
        left_out = rng.permutation(len(group))[math.ceil(options.sample_share * len(group)) :]
        label[left_out] = LEFT_OUT
        found.append(label)
    return found


def _whole(group: ShapeGroup) -> NDArray[np.bool_]:
    return np.isin(group.band, WHOLE_BANDS)
