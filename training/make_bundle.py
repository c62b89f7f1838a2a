"""From trained weights to an avatar's bundle: quantise network and texture, write the files.

Rule: this module validates nothing that it writes; `validate` measures the files themselves.
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
from trilane.avatars.bundle import Bundle, pack_levels, write_bundle
from trilane.avatars.manifest import Manifest, network_entry
from trilane.avatars.network_file import reshaped
from trilane.body.body import ShapedBody
from trilane.training.dataset import SIZES, TRAINING_SHARE, U16, VALIDATION_SIZE, ShapeGroup, motion_poses
from trilane.training.first_texture import fill_along_surface, grown, used_texels
from trilane.training.network import export_onnx
from trilane.training.quantising.quantise import ByteRanges, Quantised, byte_ranges, quantise
from trilane.training.random_views import random_pose
from trilane.training.sample_renderer import BAND_NAMES, Sample, SampleRenderer
from trilane.training.subject import Person
from trilane.training.surface import BodyArrays, body_arrays
from trilane.training.trainable_avatar import ByteGrid, TrainableAvatar, float_network_of, levels_of, read_levels
from trilane.training.validate import BUILTIN_HELD_OUT, held_out_motions
from trilane.writing import write_atomically, write_bytes

INT8_MAX = 127
#: The network is calibrated at the tensor shape that standing bodies get most often, and stored for the square one.
CALIBRATION_SHAPE = (320, 192)
STORED_SHAPE = (256, 256)
CALIBRATION_FRAMES = 96
METHOD = "minmax"
#: Files from which a person can quantise the avatar again; 20 inputs of the calibration's shape take 40 MB.
FLOAT_NETWORK, FRAMES, WRITTEN_FRAMES = "network.onnx", "frames.npy", 20
TEXEL_MARGIN = 3


@dataclass(frozen=True)
class QuantisedAvatar:
    """An avatar in integers.

    `network`: quantised network, with its `norm`. `texture`: (S,S,C) int8. `scale`: (C,) float32, scale of each
    channel.
    `levels`: smaller levels of the texture, as `pack_levels` packs them, or None.
    """

    network: Quantised
    texture: NDArray[np.int8]
    scale: NDArray[np.float32]
    norm: str = "batch"
    levels: NDArray[np.int8] | None = None


def byte_texture(
    avatar: TrainableAvatar, shaped: ShapedBody, unseen: Mask | None = None
) -> tuple[NDArray[np.int8], NDArray[np.float32], NDArray[np.int8] | None]:
    """Return the texture (S,S,C) int8, the scale (C,) of each channel, and the packed smaller levels, if any.

    Texels that the body does not use are 0. `unseen`, an image of any side, marks texels of the body that were never
    trained; they are filled from trained ones.
    """
    body = body_arrays(shaped)
    images = [_finished(level.detach()[0].permute(1, 2, 0).numpy(), unseen, body) for level in avatar.texture.levels()]
    largest = np.max([np.abs(image).max(axis=(0, 1)) for image in images], axis=0)
    scale = np.maximum(largest, 1e-6) / INT8_MAX
    texture, *smaller = (np.round(image / scale).astype(np.int8) for image in images)
    return texture, scale.astype(np.float32), pack_levels(smaller) if smaller else None


def _finished(image: NDArray[Any], unseen: Mask | None, body: BodyArrays) -> NDArray[Any]:
    """Return `image` (S,S,C) with `unseen` texels filled, and 0 where the body uses none."""
    if unseen is not None and unseen.any():
        image = _without_holes(image, unseen, body)
    finished: NDArray[Any] = image * used_texels(body, image.shape[0], TEXEL_MARGIN)[..., None]
    return finished


def _without_holes(image: NDArray[Any], unseen: Mask, body: BodyArrays) -> F64:
    """Fill the `unseen` texels of `image` (S,S,C), and those beside the body's faces that lie next to them."""
    side = image.shape[0]
    nearest = np.arange(side) * len(unseen) // side
    hole = margin = unseen[np.ix_(nearest, nearest)]
    for _ in range(TEXEL_MARGIN):
        margin = grown(margin)
    return fill_along_surface(image, hole | (margin & ~used_texels(body, side, 0)), body)


def integer_network(avatar: TrainableAvatar, groups: list[ShapeGroup], seed: int) -> Quantised:
    """Return the network in integers, calibrated on samples of `CALIBRATION_SHAPE`, else of the commonest shape."""
    quantised = quantise(*_calibration(avatar, groups, seed, CALIBRATION_FRAMES), METHOD)
    return replace(quantised, network=reshaped(quantised.network, *STORED_SHAPE))


def ranges_of(avatar: TrainableAvatar, groups: list[ShapeGroup], seed: int) -> ByteRanges:
    """Return the ranges that the tensors of `integer_network` would have."""
    return byte_ranges(*_calibration(avatar, groups, seed, CALIBRATION_FRAMES), METHOD)


def write_float_network(folder: Path, avatar: TrainableAvatar, groups: list[ShapeGroup], seed: int) -> dict[str, str]:
    """Write the input of `trilane avatar quantise` to `folder`: the float network, and inputs from training samples.

    Returns the names of both files, by `float_network` and `frames`. The inputs are those of `integer_network`, but
    fewer.
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
    """Return the float network of `avatar`, and at most `count` inputs of its shape."""
    group = max(groups, key=lambda group: (group.shape == CALIBRATION_SHAPE, len(group)))
    chosen = np.random.default_rng(seed).permutation(len(group))[:count]
    return export_onnx(avatar.network, *group.shape), _inputs(avatar, group, np.sort(chosen))


def quantise_avatar(
    avatar: TrainableAvatar, shaped: ShapedBody, groups: list[ShapeGroup], seed: int, unseen: Mask | None = None
) -> QuantisedAvatar:
    """Quantise network and texture.

    `avatar`: trained weights.
    `shaped`: body whose texels are stored.
    `groups`: training samples, from which calibration frames are chosen.
    `seed`: seed of that choice.
    `unseen`: texels of the body that no sample can show, see `byte_texture`.
    """
    texture, scale, levels = byte_texture(avatar, shaped, unseen)
    network = integer_network(avatar, groups, seed)
    return QuantisedAvatar(network, texture, scale, avatar.network.norm, levels)


def write_avatar(
    folder: Path,
    person: Person,
    quantised: QuantisedAvatar,
    width: int,
    provenance: dict[str, Any],
    names: dict[str, str],
) -> None:
    """Write the bundle.

    `folder`: folder of the bundle.
    `person`: person whose avatar it is.
    `quantised`: network and texture in integers.
    `width`: width of the network; 64 is full.
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


def _inputs(avatar: TrainableAvatar, group: ShapeGroup, index: NDArray[np.int64]) -> list[NDArray[np.float32]]:
    """Return the network's inputs (H, W, C) for samples `index` of `group`."""
    levels = [level.detach() for level in avatar.texture.levels()]
    frames = []
    for number in index:
        uv = torch.from_numpy(group.uv[number].astype(np.float32) / U16)[None]
        covered = torch.from_numpy(group.covered[number] > 0)[None]
        frames.append(read_levels(levels, uv, covered)[0].permute(1, 2, 0).numpy())
    return frames


# Rounds an avatar to the bytes of its bundle while it is trained, and keeps the rounded weights at the end.
#
# Rule: the grid is measured once, on a copy in the form in which the avatar is exported. At the end the float network
# keeps the rounded weights: the weights before rounding paint a worse picture.


def round_to_bytes(avatar: TrainableAvatar, grid: ByteGrid, groups: list[ShapeGroup], seed: int) -> None:
    """Round `avatar` on `grid` from now on.

    `groups`, `seed`: as in `ranges_of`.
    """
    if not grid.measured:
        grid.measure(ranges_of(copy.deepcopy(avatar).cpu(), groups, seed))
    grid.active = True


def keep_rounded_weights(avatar: TrainableAvatar, groups: list[ShapeGroup], seed: int) -> None:
    """Replace the weights of `avatar`, which was trained with rounding, by their rounded values on the grid.

    `groups`, `seed`: as in `ranges_of`.
    """
    grid = ByteGrid(copy.deepcopy(avatar.network))
    grid.measure(ranges_of(copy.deepcopy(avatar).cpu(), groups, seed))
    avatar.network.load_state_dict(grid.weights(avatar.network), strict=False)


# Inputs of a network for its calibration, drawn as the training draws its views, and others to inspect the result.
#
# Rule: calibration inputs have every kind of training view, in the training's shares. Inputs to inspect come from
# motions that no training uses. All have the one tensor shape at which networks are calibrated.

#: Seed of the views; the training of the default avatar had another one.
SEED = 17


def float_model(bundle: Bundle, weights: Any) -> onnx.ModelProto:
    """Return the float network in file `weights`, for `bundle`, at the calibration's shape. Raises BadInputError."""
    return export_onnx(float_network_of(bundle, weights), *CALIBRATION_SHAPE)


def training_views(renderer: SampleRenderer, bundle: Bundle, views: int) -> list[F32]:
    """Return `views` inputs (H,W,C) in random poses, with views in the training's shares."""
    rng = np.random.default_rng((SEED, 0))
    bands, sizes = list(TRAINING_SHARE), list(SIZES)

    def sample(number: int) -> Sample:
        band = str(rng.choice(bands, p=list(TRAINING_SHARE.values())))
        size = str(rng.choice(sizes, p=list(SIZES.values())))
        return renderer.plan((SEED, 1, number), random_pose, band, size)

    return list(_tensors(renderer, bundle, sample, views))


def held_out_views(renderer: SampleRenderer, bundle: Bundle, views: int) -> list[F32]:
    """Return `views` inputs (H,W,C) of all bands in turn, in poses of a motion that no training uses."""
    poses = motion_poses(held_out_motions([BUILTIN_HELD_OUT]))

    def sample(number: int) -> Sample:
        band = number % len(BAND_NAMES)
        return renderer.plan((SEED, 2, number, band), poses, BAND_NAMES[band], VALIDATION_SIZE)

    return list(_tensors(renderer, bundle, sample, views))


def _tensors(renderer: SampleRenderer, bundle: Bundle, sample: Callable[[int], Sample], wanted: int) -> Iterator[F32]:
    """Yield the network's inputs for the first `wanted` of samples 0, 1, 2, ... that have the calibration's shape."""
    levels = levels_of(bundle)
    found = (one for one in map(sample, count()) if one.crop.shape == CALIBRATION_SHAPE)
    for _, one in zip(range(wanted), found, strict=False):
        uv = torch.from_numpy(np.ascontiguousarray(renderer.render(one)[0]))[None]
        yield read_levels(levels, uv[..., :2], uv[..., 2] > 0)[0].permute(1, 2, 0).contiguous().numpy()
