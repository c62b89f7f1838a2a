"""Makes an avatar's bundle from trained weights: quantises network and texture, and writes the files.

Rule: this module does not measure the avatar's error; `validate` measures it from the written files.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from trilane.arrays import F32, F64, Mask
from trilane.avatars.bundle import Bundle, load_bundle, pack_levels, write_bundle
from trilane.avatars.manifest import Manifest, network_entry
from trilane.avatars.network_file import reshaped
from trilane.avatars.validation import BUILTIN_HELD_OUT, VALIDATION_SIZE
from trilane.body.body import ShapedBody
from trilane.training.dataset import U16, ShapeGroup, motion_poses, random_kind
from trilane.training.first_texture import fill_along_surface, grown, used_texels
from trilane.training.network import export_onnx
from trilane.training.quantising.quantise import ByteRanges, Quantised, byte_ranges, quantise
from trilane.training.sample_renderer import BAND_NAMES, Sample, SampleRenderer
from trilane.training.subject import Person
from trilane.training.surface import BodyArrays, body_arrays
from trilane.training.trainable_avatar import ByteGrid, TrainableAvatar, float_network_of, levels_of, read_levels
from trilane.training.validate import held_out_motions
from trilane.writing import write_atomically, write_bytes

INT8_MAX = 127
#: Tensor shapes (height, width): the network is calibrated at the most frequent shape of standing bodies, and stored
#: for a square shape.
CALIBRATION_SHAPE = (320, 192)
STORED_SHAPE = (256, 256)
CALIBRATION_FRAMES = 96
#: Names of two files from which a person can quantise the avatar again, and the number of inputs in `FRAMES`: 20 inputs
#: of the calibration's shape take 40 MB.
FLOAT_NETWORK, FRAMES, WRITTEN_FRAMES = "network.onnx", "frames.npy", 20
TEXEL_MARGIN = 3


@dataclass(frozen=True)
class QuantisedAvatar:
    """A quantised avatar.

    `network`: quantised network. `texture`: (S,S,C) int8. `scale`: scale (C,) float32 of each channel. `norm`: kind of
    the network's norms. `levels`: smaller levels of the texture, packed by `pack_levels`, or None.
    """

    network: Quantised
    texture: NDArray[np.int8]
    scale: NDArray[np.float32]
    norm: str = "batch"
    levels: NDArray[np.int8] | None = None


def byte_texture(
    avatar: TrainableAvatar, shaped: ShapedBody, unseen: Mask | None = None, person: int = 0
) -> tuple[NDArray[np.int8], NDArray[np.float32], NDArray[np.int8] | None]:
    """Return (texture (S,S,C) int8, scale (C,) of each channel, smaller levels).

    The smaller levels are packed by `pack_levels`; None if the avatar has none. They use the same scale. Texels farther
    than TEXEL_MARGIN from those that the body uses are 0.

    `unseen`: bool image (h,h) of any side. True marks texels of the body that were never trained. They are filled from
    trained texels.
    `person`: number of the person in `avatar`.
    """
    body = body_arrays(shaped)
    images = []
    for level in avatar.levels(person):
        image = level.detach()[0].permute(1, 2, 0).numpy()
        if unseen is not None and unseen.any():
            image = _without_holes(image, unseen, body)
        images.append(image * used_texels(body, image.shape[0], TEXEL_MARGIN)[..., None])
    largest = np.max([np.abs(image).max(axis=(0, 1)) for image in images], axis=0)
    scale = np.maximum(largest, 1e-6) / INT8_MAX
    texture, *smaller = (np.round(image / scale).astype(np.int8) for image in images)
    return texture, scale.astype(np.float32), pack_levels(smaller) if smaller else None


def _without_holes(image: NDArray[Any], unseen: Mask, body: BodyArrays) -> F64:
    """Return `image` (S,S,C) with `unseen` texels filled. Texels beside them that are on no face are filled too."""
    side = image.shape[0]
    nearest = np.arange(side) * len(unseen) // side
    hole = margin = unseen[np.ix_(nearest, nearest)]
    for _ in range(TEXEL_MARGIN):
        margin = grown(margin)
    return fill_along_surface(image, hole | (margin & ~used_texels(body, side, 0)), body)


def integer_network(avatar: TrainableAvatar, groups: list[ShapeGroup], seed: int) -> Quantised:
    """Return the quantised network of `avatar`, at `STORED_SHAPE`.

    It is calibrated on random samples of `CALIBRATION_SHAPE`; if `groups` has none, of the most frequent shape.

    `groups`: training samples. `seed`: seed of the choice of samples.
    """
    quantised = quantise(*_calibration(avatar, groups, seed, CALIBRATION_FRAMES))
    return replace(quantised, network=reshaped(quantised.network, *STORED_SHAPE))


def kept_network(avatar: str) -> Quantised:
    """Return the quantised network of `avatar`, a bundle's name or folder. Raises BadInputError for a wrong bundle."""
    bundle = load_bundle(avatar)
    return Quantised(bundle.read_network(), bundle.manifest.quantisation, {})


def ranges_of(avatar: TrainableAvatar, groups: list[ShapeGroup], seed: int) -> ByteRanges:
    """Return the byte ranges that `integer_network` would give the network's tensors, from the same arguments."""
    return byte_ranges(*_calibration(avatar, groups, seed, CALIBRATION_FRAMES))


def write_float_network(folder: Path, avatar: TrainableAvatar, groups: list[ShapeGroup], seed: int) -> dict[str, str]:
    """Write the input of `trilane avatar quantise` to `folder`: the float network, and inputs to calibrate on.

    Return the paths of both files under the keys `float_network` and `frames`. With the same arguments,
    `integer_network` uses these inputs and further ones.
    """
    model, frames = _calibration(avatar, groups, seed, WRITTEN_FRAMES)
    files = {"float_network": folder / FLOAT_NETWORK, "frames": folder / FRAMES}
    write_bytes(files["float_network"], model.SerializeToString())
    with write_atomically(files["frames"]) as draft:
        np.save(draft, np.stack(frames).astype(np.float16))
    return {key: str(file) for key, file in files.items()}


def _calibration(
    avatar: TrainableAvatar, groups: list[ShapeGroup], seed: int, count: int
) -> tuple[onnx.ModelProto, list[NDArray[np.float32]]]:
    """Return the float network of `avatar`, and at most `count` random inputs (H, W, C) for it, of any person."""
    shape = max(groups, key=lambda group: (group.shape == CALIBRATION_SHAPE, len(group))).shape
    places = [(group, number) for group in groups if group.shape == shape for number in range(len(group))]
    chosen = np.sort(np.random.default_rng(seed).permutation(len(places))[:count])
    return export_onnx(avatar.network, *shape), [_input(avatar, *places[index]) for index in chosen]


def quantise_avatar(
    avatar: TrainableAvatar, network: Quantised, shaped: ShapedBody, unseen: Mask | None = None, person: int = 0
) -> QuantisedAvatar:
    """Return `network` with the quantised texture of `person`, a number, in `avatar`.

    `network`: quantised network that paints all persons of `avatar`.
    `shaped`: body whose texels are stored.
    `unseen`: texels of the body that were never trained, see `byte_texture`.
    """
    texture, scale, levels = byte_texture(avatar, shaped, unseen, person)
    return QuantisedAvatar(network, texture, scale, avatar.network.norm, levels)


def write_avatar(
    folder: Path,
    person: Person,
    quantised: QuantisedAvatar,
    width: int,
    provenance: dict[str, Any],
    names: dict[str, str],
) -> None:
    """Write the bundle of an avatar. Raises BadInputError if its parts do not fit together; then nothing is written.

    `folder`: folder of the bundle.
    `person`: person whom the avatar shows.
    `quantised`: network and texture.
    `width`: width of the network; 64 is the full network.
    `provenance`: facts about the training.
    `names`: `name` and `training_command` of the manifest.
    """
    manifest = Manifest(
        name=names["name"],
        network=network_entry(quantised.network.network, "resnet18", quantised.norm, width),
        provenance=provenance,
        training_command=names["training_command"],
        quantisation=quantised.network.facts,
        betas=person.betas,
        expression=person.expression,
    )
    network, scale = quantised.network.network, quantised.scale
    write_bundle(folder, manifest, person.body, quantised.texture, network, scale, person.offsets, quantised.levels)


def _input(avatar: TrainableAvatar, group: ShapeGroup, number: int) -> NDArray[np.float32]:
    """Return the network's input (H, W, C) for the sample `number` of `group`."""
    uv = torch.from_numpy(group.uv[number].astype(np.float32) / U16)[None]
    covered = torch.from_numpy(group.covered[number] > 0)[None]
    levels = [level.detach() for level in avatar.levels(group.person)]
    pixels: NDArray[np.float32] = read_levels(levels, uv, covered)[0].permute(1, 2, 0).numpy()
    return pixels


# Rounds an avatar to the bytes of its bundle during training, and keeps the rounded weights at the end.
#
# Rule: the grid is measured once, by a trial export of a copy of the avatar. At the end the float network keeps the
# rounded weights: the weights before rounding give a worse picture.


def round_to_bytes(avatar: TrainableAvatar, grid: ByteGrid, groups: list[ShapeGroup], seed: int) -> None:
    """Activate `grid`, the byte grid of `avatar`; measure it first if necessary.

    `groups`, `seed`: as in `integer_network`.
    """
    if not grid.measured:
        grid.measure(ranges_of(copy.deepcopy(avatar).cpu(), groups, seed))
    grid.active = True


def keep_rounded_weights(avatar: TrainableAvatar, groups: list[ShapeGroup], seed: int) -> None:
    """Replace the weights of `avatar`, which was trained with rounding, by their rounded values.

    `groups`, `seed`: as in `integer_network`.
    """
    grid = ByteGrid(copy.deepcopy(avatar.network))
    grid.measure(ranges_of(copy.deepcopy(avatar).cpu(), groups, seed))
    avatar.network.load_state_dict(grid.weights(avatar.network), strict=False)


# Inputs of a network for its calibration, with random views as in training, and inputs to evaluate the result.
#
# Rule: calibration inputs have every kind of training view, in the training's shares. Inputs for evaluation show poses
# of motions that no training uses. All have the tensor shape `CALIBRATION_SHAPE`.

#: Seed of the views; it differs from the seed of the default avatar's training.
SEED = 17


def float_model(bundle: Bundle, weights: Path) -> onnx.ModelProto:
    """Return the float network of `bundle` for inputs of `CALIBRATION_SHAPE`.

    `weights`: file that `save_network` wrote. Raises BadInputError for another file.
    """
    return export_onnx(float_network_of(bundle, weights), *CALIBRATION_SHAPE)


def training_views(renderer: SampleRenderer, bundle: Bundle, views: int) -> list[F32]:
    """Return `views` inputs (H,W,C) of the network of `bundle`, in random poses and bands, drawn as for training."""
    rng = np.random.default_rng((SEED, 0))

    def sample(number: int) -> Sample:
        return renderer.training_sample((SEED, 1, number), *random_kind(rng))

    return list(_tensors(renderer, bundle, sample, views))


def held_out_views(renderer: SampleRenderer, bundle: Bundle, views: int) -> list[F32]:
    """Return `views` inputs (H,W,C) of the network of `bundle`, of all bands in turn, in poses of a held-out motion."""
    poses = motion_poses(held_out_motions([BUILTIN_HELD_OUT]))

    def sample(number: int) -> Sample:
        band = number % len(BAND_NAMES)
        return renderer.plan((SEED, 2, number, band), poses, BAND_NAMES[band], VALIDATION_SIZE)

    return list(_tensors(renderer, bundle, sample, views))


def _tensors(renderer: SampleRenderer, bundle: Bundle, sample: Callable[[int], Sample], wanted: int) -> Iterator[F32]:
    """Yield `wanted` float inputs (H,W,C) of the network of `bundle`, with (H,W) = `CALIBRATION_SHAPE`.

    `sample`: function that returns the sample of a number. It is called with 0, 1, 2 and so on; samples of another
    tensor shape are passed over. At least `wanted` samples must have `CALIBRATION_SHAPE`.
    """
    levels = levels_of(bundle)
    found = (one for one in map(sample, count()) if one.crop.shape == CALIBRATION_SHAPE)
    for _, one in zip(range(wanted), found, strict=False):
        uv = torch.from_numpy(np.ascontiguousarray(renderer.render(one)[0]))[None]
        yield read_levels(levels, uv[..., :2], uv[..., 2] > 0)[0].permute(1, 2, 0).contiguous().numpy()
