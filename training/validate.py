"""Validates an avatar: evaluates the files of its bundle on held-out samples and writes the result into its manifest.

Rule: the figures depend only on bundle, seeds, motions, size and runtimes. The digests belong to the files that were
read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilane import machine
from trilane.arrays import F64, U8, Shape, shapes_within, to_code, to_light
from trilane.avatars.bundle import Bundle, write_manifest
from trilane.avatars.manifest import (
    AT_THE_TOP,
    Band,
    BySize,
    MadeWith,
    Validation,
    digests_of,
    sha256_of,
    with_figures_digest,
)
from trilane.avatars.network_file import reshaped
from trilane.avatars.validation import BUILTIN_HELD_OUT, PER_BAND, SEEDS, VALIDATION_RUNTIMES, VALIDATION_SIZE
from trilane.scene.motion.files import load_motion
from trilane.scene.motion.motion import Motion
from trilane.scene.schema import AvatarSpec
from trilane.stages.config import Quantisation
from trilane.stages.dsp.runtime import RuntimeOptions, Session, load_runtime
from trilane.stages.gpu.composite_painters import taps_of
from trilane.stages.gpu.raster import PackedAvatar, PackedPass, Placement
from trilane.stages.gpu.skinned_mesh import SkinnedMesh
from trilane.stages.machine_facts import package_version
from trilane.training.clothing import look_of
from trilane.training.dataset import plan_validation
from trilane.training.image_error import SIDE, ImageError, SampleError, image_error, over, scenes, summary
from trilane.training.random_views import OUTPUT_ROWS, Crop, View
from trilane.training.sample_renderer import BAND_NAMES, Sample, SampleRenderer

# Evaluates an avatar on held-out samples: compares every painter's picture of a sample with the ground truth.
#
# Rule: the integer network is evaluated as it runs in the pipeline: a runtime runs it on the bytes of the packed pass,
# by which the raster stage draws the network's input.

#: A function that returns the picture (h,w,4) uint8 of a sample, given the sample and its UV image (h,w,3).
Painter = Callable[[Any, NDArray[np.float32]], U8]


class PackedRenderer(Protocol):
    """A renderer whose samples `integer_painter` can draw by the packed pass of the GPU unit.

    `ctx`: OpenGL context. `mesh`: mesh of the body that the samples show.
    """

    ctx: Any
    mesh: SkinnedMesh

    def placed(self, sample: Any) -> tuple[F64, Placement]:
        """Return (view matrix (4,4) of `sample`, placement of its body in the tensor)."""


@dataclass(frozen=True)
class Evaluated:
    """The evaluation of one sample.

    `number`: index of the sample in its list. `band`: name of the sample's band. `truth`: ground truth (h,w,4).
    `pictures`, `errors`: picture and error of each painter, by the painter's name.
    """

    number: int
    band: str
    truth: U8
    pictures: dict[str, U8]
    errors: dict[str, ImageError]


def evaluate(
    renderer: SampleRenderer, samples: Iterable[Sample], painters: Mapping[str, Painter]
) -> Iterator[Evaluated]:
    """Yield the evaluation of each of `samples` by all `painters`; samples that show no person are left out."""
    for number, sample in enumerate(samples):
        uv, truth = renderer.render(sample)
        pictures = {name: paint(sample, uv) for name, paint in painters.items()}
        errors = {name: image_error(picture, truth) for name, picture in pictures.items()}
        known = {name: error for name, error in errors.items() if error is not None}
        if known:
            yield Evaluated(number, BAND_NAMES[sample.band], truth, pictures, known)


def integer_painter(renderer: PackedRenderer, bundle: Bundle, runtime: str, threads: int) -> Painter:
    """Return a painter that runs the GPU unit's packed pass, then the integer network of `bundle` on `runtime`.

    `renderer`: renderer of the samples.
    `bundle`: bundle with the texture and the network.
    `runtime`: name of the runtime.
    `threads`: number of the runtime's threads.
    Raises BadInputError for wrong files of the bundle or an unknown runtime, MissingPartError for a missing runtime.
    """
    network, texture, runs = bundle.read_network(), bundle.read_texture(), load_runtime(runtime)
    quantisation = Quantisation(network.input.scale, network.input.zero_point)
    levels = bundle.read_levels()
    packed = PackedPass(renderer.ctx, texture.shape[2], quantisation, deferred=levels is None)
    drawn = PackedAvatar(packed, renderer.mesh, texture, levels)
    sessions: dict[Shape, Session] = {}

    def paint(sample: Any, _: NDArray[np.float32]) -> U8:
        shape = sample.crop.shape
        tensor = np.empty((1, *shape, packed.channels), np.uint8)
        drawn.draw(packed.begin(shape), *renderer.placed(sample))
        packed.read_into(shape, tensor.reshape(-1))
        if shape not in sessions:
            sessions[shape] = runs.load(reshaped(network, *shape), RuntimeOptions(threads=threads))
        picture = np.empty((1, *shape, 4), np.uint8)
        sessions[shape].bind([tensor], [picture]).run()
        pixels: U8 = picture[0]
        return pixels

    return paint


#: Name of the float network's painter; the other painters have the names of runtimes.
FLOAT = "float"
#: A function that is called with the seed and the evaluation of each sample.
Look = Callable[[int, Evaluated], None]


@dataclass(frozen=True)
class ValidationPlan:
    """The plan of an avatar's evaluation.

    `held_out`: motions that the poses are taken from, `builtin:NAME` or files. `seeds`: seeds of the samples.
    `per_band`: number of samples for each band and seed. `runtimes`: names of runtimes; the avatar's figures come from
    the first one. `size`: tensor size, as `shape_buckets` takes it. `threads`: number of threads of a software OpenGL
    driver and of each runtime. `revision`, `modified`: as in `MadeWith`.
    """

    held_out: tuple[str, ...] = (BUILTIN_HELD_OUT,)
    seeds: tuple[int, ...] = SEEDS
    per_band: int = PER_BAND
    runtimes: tuple[str, ...] = VALIDATION_RUNTIMES[:1]
    size: str = VALIDATION_SIZE
    threads: int = 1
    revision: str | None = None
    modified: bool | None = None


@dataclass(frozen=True)
class FloatNetwork:
    """The network before it was quantised.

    `name`: name of the network in the manifest. `paint`: painter that runs the network.
    """

    name: str
    paint: Painter


def held_out_motions(names: Iterable[str]) -> list[Motion]:
    """Return the motions `names`, each `builtin:NAME` or a file. Raises BadInputError for a missing or wrong motion."""
    return [load_motion(AvatarSpec(motion=name), Path.cwd()) for name in names]


def open_renderer(bundle: Bundle, threads: int) -> SampleRenderer:
    """Return a new renderer of samples of the clothed body of `bundle`.

    `threads`: number of threads of a software OpenGL driver.
    Raises BadInputError for a wrong body file or an unknown look, MissingPartError without OpenGL.
    """
    return SampleRenderer(bundle.shaped_body(), threads, look=look_of(bundle.manifest.provenance))


def validate(
    bundle: Bundle,
    plan: ValidationPlan,
    renderer: SampleRenderer,
    float_network: FloatNetwork | None = None,
    look: Look = lambda _seed, _sample: None,
) -> Validation:
    """Evaluate `bundle` and return its validation.

    `renderer`: renderer from `open_renderer`.
    `float_network`: float network to evaluate too, or None.
    `look`: function that gets the seed and the evaluation of every sample. The keys of an evaluation's pictures are
    the names of runtimes, and `FLOAT`.
    Raises errors as `integer_painter` and `held_out_motions` do.
    """
    digests = digests_of(bundle.folder, bundle.manifest)
    motions = held_out_motions(plan.held_out)
    painters = {name: integer_painter(renderer, bundle, name, plan.threads) for name in plan.runtimes}
    if float_network is not None:
        painters[FLOAT] = float_network.paint
    errors: dict[str, list[SampleError]] = {name: [] for name in painters}
    for seed in plan.seeds:
        samples = plan_validation(renderer, plan.per_band, seed, motions, plan.size)
        for sample in evaluate(renderer, samples, painters):
            look(seed, sample)
            for name, error in sample.errors.items():
                errors[name].append(SampleError(seed, sample.number, sample.band, error))
    figures = {name: summary(found) for name, found in errors.items()}
    validation = Validation.model_validate(
        {
            "date": machine.here.now().date(),
            "digests": digests,
            "made_with": _made_with(plan, renderer),
            "size": plan.size,
            "per_band": plan.per_band,
            "held_out": {
                Path(name).name: ("built in" if name.startswith("builtin:") else f"sha256 {sha256_of([Path(name)])}")
                for name in plan.held_out
            },
            **_arranged(figures, plan.runtimes, float_network.name if float_network is not None else ""),
        }
    )
    return with_figures_digest(validation)


def revalidate(bundle: Bundle, validation: Validation) -> Bundle:
    """Write `validation` into the manifest of `bundle`, and return the changed bundle. Raises BadInputError."""
    manifest = bundle.manifest.model_copy(update={"validation": validation})
    write_manifest(bundle.folder, manifest)
    return Bundle(bundle.folder, manifest)


def _made_with(plan: ValidationPlan, renderer: SampleRenderer) -> MadeWith:
    return MadeWith(
        trilane=package_version("trilane"),
        revision=plan.revision,
        modified=plan.modified,
        renderer=str(renderer.ctx.info["GL_RENDERER"]),
        runtimes={name: load_runtime(name).version() for name in plan.runtimes},
    )


def _arranged(figures: Mapping[str, dict[str, Any]], runtimes: tuple[str, ...], float_network: str) -> dict[str, Any]:
    """Return the figures of the painters under the keys of `Validation`."""
    first, *others = runtimes
    own = figures[first]
    arranged: dict[str, Any] = {
        **{key: own[key] for key in AT_THE_TOP},
        "runtime": first,
        "integer": own,
        "other_runtimes": {name: figures[name] for name in others},
    }
    if FLOAT in figures:
        by_band = figures[FLOAT]["psnr_db_by_band"]
        arranged["float"] = {"network": float_network, **figures[FLOAT]}
        arranged["psnr_loss_db"] = {
            band: round(by_band[band] - psnr, 2) for band, psnr in own["psnr_db_by_band"].items()
        }
    return arranged


# The image error by size of body and tensor: the same views, painted at several tensor sizes.
#
# Rule: a tensor is shown on the picture as the composite stage does it: bilinear reads, averaged over the pixel, in
# linear light, with premultiplied alpha. All tensors are compared with the same ground truth, which has the picture's
# pixels.

DIGITS = 2
#: Sides of squares with as many pixels as the tensor may have. The largest is 7/4 of a network's usual 256.
TENSOR_SIDES = (48, 64, 96, 128, 160, 192, 256, 320, 384, 448)
#: Sizes of bodies, as sides of squares with as many picture pixels as the body covers, and the band of the views. In
#: pictures of 480 to 720 rows, most bodies of a size are seen in this band.
PICTURE_SIDES: dict[int, Band] = {
    64: "far",
    96: "far",
    128: "far",
    192: "full_body",
    256: "full_body",
    384: "upper_body",
}
#: The integer network's painter draws its input itself.
NO_UV = np.empty((0, 0, 3), np.float32)


def measure_sizes(
    bundle: Bundle, plan: ValidationPlan, renderer: SampleRenderer, look: Callable[[], None] = lambda: None
) -> BySize:
    """Measure the image error of `bundle` by size of body and tensor.

    `plan`: plan of the validation. The views of its first seed are painted on its first runtime.
    `renderer`: renderer from `open_renderer`.
    `look`: called after every view.
    Raises errors as `integer_painter` and `held_out_motions` do.
    """
    runtime, seed = plan.runtimes[0], plan.seeds[0]
    paint = integer_painter(renderer, bundle, runtime, plan.threads)
    found: dict[int, dict[int, list[float]]] = {side: {tensor: [] for tensor in TENSOR_SIDES} for side in PICTURE_SIDES}
    for sample in plan_validation(renderer, plan.per_band, seed, held_out_motions(plan.held_out)):
        sides = [side for side, band in PICTURE_SIDES.items() if band == BAND_NAMES[sample.band]]
        seen = [replace(sample, crop=on_picture(sample.crop, sample.view, side)) for side in sides]
        truths = [renderer.render(each)[1] for each in seen]
        for tensor in TENSOR_SIDES if sides else ():
            crop = renderer.crop(sample, shapes_within(tensor * tensor))
            image = paint(replace(sample, crop=crop), NO_UV)
            for side, each, truth in zip(sides, seen, truths, strict=True):
                error = image_error(shown(image, crop, each.crop), truth)
                if error is not None:
                    found[side][tensor].append(error.psnr_db)
        look()
    return BySize(
        date=machine.here.now().date(),
        runtime=runtime,
        seed=seed,
        per_band=plan.per_band,
        held_out=tuple(Path(name).name for name in plan.held_out),
        psnr_db_by_picture={
            side: {tensor: round(float(np.mean(errors)), DIGITS) for tensor, errors in row.items()}
            for side, row in found.items()
        },
    )


def on_picture(crop: Crop, view: View, side: int) -> Crop:
    """Return `crop` with its shape in a picture of another size, in which the body's rectangle has `side`² pixels.

    `view`: view to which `crop` belongs.
    """
    wide, high = (view.projection[axis, axis] / crop.projection[axis, axis] for axis in (0, 1))
    pixels = wide * high * OUTPUT_ROWS * round(OUTPUT_ROWS * view.aspect)  # of the crop, where the body has crop.pixels
    scale = side * math.sqrt(pixels / crop.pixels / math.prod(crop.shape))
    return replace(crop, shape=(round(crop.shape[0] * scale), round(crop.shape[1] * scale)))


def with_sizes(validation: Validation, by_size: BySize) -> Validation:
    """Return `validation` with the newly measured figures `by_size`, and a new digest."""
    return with_figures_digest(validation.model_copy(update={"by_size": by_size}))


def shown(image: U8, painted: Crop, seen: Crop) -> U8:
    """Return the tensor's `image` (h,w,4) uint8, sRGB with straight alpha, as the pixels of the crop `seen`.

    `painted`: crop of the tensor, of the same view.
    """
    alpha = image[..., 3:] / 255.0
    planes = np.dstack([to_light(image[..., :3] / 255.0) * alpha, alpha])
    for axis, element in ((0, 1), (1, 0)):
        planes = np.moveaxis(_read(np.moveaxis(planes, axis, 0), painted, seen, element), 0, axis)
    colour = to_code(planes[..., :3] / np.maximum(planes[..., 3:], 1e-6))
    return np.asarray(np.round(np.clip(np.dstack([colour, planes[..., 3:]]), 0, 1) * 255), np.uint8)


def _read(rows: F64, painted: Crop, seen: Crop, element: int) -> F64:
    """Return the lines of the crop `seen`, read from the lines `rows` of the crop `painted`.

    `element`: 0 for columns, 1 for rows.
    """
    old, new = painted.projection, seen.projection
    scale = old[element, element] / new[element, element]
    shift = (old[element, 2] - scale * new[element, 2]) / old[3, 2] * (1 if element == 0 else -1)
    count, lines = seen.shape[1 - element], len(rows)
    density = scale * lines / count
    taps = taps_of((lines, lines), (lines / density, lines / density))
    at = (np.arange(count * taps) + 0.5) / (count * taps)  # 0..1 of `seen`, from the left or from the top
    place = np.clip((scale * (2 * at - 1) + shift + 1) / 2 * lines - 0.5, 0, lines - 1)
    low = np.floor(place).astype(int)
    part = (place - low).reshape(-1, 1, 1)
    read = rows[low] * (1 - part) + rows[np.minimum(low + 1, lines - 1)] * part
    return np.asarray(read.reshape(count, taps, *rows.shape[1:]).mean(axis=1))


# Sheets that compare pictures: the ground truth and each painter's picture, side by side.
#
# Rule: all pictures are in front of the same scenery, which shows through a transparent person. No picture is enlarged.

SHEET_CELL = (256, 192)


def worst_sheet(samples: Sequence[Evaluated], painters: Sequence[str]) -> NDArray[np.uint8]:
    """Return an image (height, width, 3) uint8 with a row for each of `samples`: truth, then picture of each painter.

    `painters`: names of the painters.
    """
    rows = [(sample.truth, *(sample.pictures[name] for name in painters)) for sample in samples]
    return np.vstack([side_by_side(row) for row in rows])


def side_by_side(pictures: Iterable[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return an image (height, width, 3) uint8 of `pictures` (h,w,4), side by side in cells of `SHEET_CELL`."""
    return np.hstack([_cell(picture) for picture in pictures])


def _cell(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    behind = scenes()[0][np.arange(picture.shape[0])[:, None] % SIDE, np.arange(picture.shape[1]) % SIDE]
    image = Image.fromarray((over(picture, behind) * 255).round().astype(np.uint8))
    image.thumbnail(SHEET_CELL[::-1], Image.Resampling.LANCZOS)
    cell = np.full((*SHEET_CELL, 3), 128, np.uint8)
    top, left = (SHEET_CELL[0] - image.height) // 2, (SHEET_CELL[1] - image.width) // 2
    cell[top : top + image.height, left : left + image.width] = np.asarray(image)
    return cell
