"""From trained weights to an avatar's bundle: quantise, judge both networks on held-out samples, write, draw.

Rule: figures in the manifest are measured here, on the files' own content, or are not there.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from trilane.avatars.bundle import Manifest, Validation, network_entry, write_bundle
from trilane.avatars.reshape import reshaped
from trilane.body.body import ShapedBody
from trilane.training.data import U16, ShapeGroup
from trilane.training.dataset import BAND_NAMES, Sample, Studio, body_arrays
from trilane.training.evaluate import Judged, float_painter, integer_painter, judge, summary
from trilane.training.export import export_onnx
from trilane.training.fit import Avatar
from trilane.training.metrics import over_grey
from trilane.training.quantising.quantise import Quantised, quantise
from trilane.training.start import used_texels
from trilane.training.texture import sample

INT8_MAX = 127
#: The network is calibrated on the shape that standing bodies get most, and stored for the square one.
CALIBRATION_SHAPE = (320, 192)
STORED_SHAPE = (256, 256)
CALIBRATION_FRAMES = 96
METHOD = "minmax"
TEXEL_MARGIN = 3
SHEET_CELL = (256, 192)


@dataclass(frozen=True)
class Finished:
    """`float_figures` and `integer_figures`: `summary` of each; `sheet`: truth, float, integer side by side."""

    float_figures: dict[str, Any]
    integer_figures: dict[str, Any]
    sheet: NDArray[np.uint8]


def byte_texture(avatar: Avatar, shaped: ShapedBody) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """The texture as int8 (S,S,C) and the scale (C,) of each channel; texels that the body never shows are 0."""
    image = avatar.texture.image().detach()[0].permute(1, 2, 0).numpy()
    image = image * used_texels(body_arrays(shaped), image.shape[0], TEXEL_MARGIN)[..., None]
    scale = np.maximum(np.abs(image).max(axis=(0, 1)), 1e-6) / INT8_MAX
    return np.round(image / scale).astype(np.int8), scale.astype(np.float32)


def integer_network(avatar: Avatar, groups: list[ShapeGroup], seed: int) -> Quantised:
    """The network in integers, calibrated on training samples of one shape."""
    group = next(group for group in groups if group.shape == CALIBRATION_SHAPE)
    chosen = np.random.default_rng(seed).permutation(len(group))[:CALIBRATION_FRAMES]
    made = quantise(export_onnx(avatar.network, *CALIBRATION_SHAPE), _inputs(avatar, group, np.sort(chosen)), METHOD)
    return Quantised(reshaped(made.network, *STORED_SHAPE), made.facts)


def finish(
    avatar: Avatar,
    studio: Studio,
    shaped: ShapedBody,
    groups: list[ShapeGroup],
    held_out: list[Sample],
    seed: int,
    threads: int,
) -> tuple[Finished, Quantised, NDArray[np.int8], NDArray[np.float32]]:
    """Quantise `avatar` and judge it on `held_out`; with it the integer network, the texture and its scale."""
    texture, scale = byte_texture(avatar, shaped)
    made = integer_network(avatar, groups, seed)
    decoded = texture.astype(np.float32) * scale
    floats = judge(studio, held_out, float_painter(avatar))
    integers = judge(studio, held_out, integer_painter(studio, made.network, decoded, threads))
    done = Finished(summary(floats), summary(integers), _sheet(floats, integers))
    return done, made, texture, scale


def write_avatar(
    folder: Path,
    body: Path,
    done: Finished,
    made: Quantised,
    texture: NDArray[np.int8],
    scale: NDArray[np.float32],
    width: int,
    facts: dict[str, Any],
    names: dict[str, str],
) -> None:
    """Write the bundle. `facts`: provenance. `names`: `name` and `training_command`."""
    shown = {key: done.integer_figures[key] for key in ("psnr_db_by_band", "iou", "ssim")}
    loss = {
        band: round(done.float_figures["psnr_db_by_band"][band] - done.integer_figures["psnr_db_by_band"][band], 2)
        for band in BAND_NAMES
    }
    manifest = Manifest(
        name=names["name"],
        network=network_entry(made.network, "resnet18", "batch", width),
        provenance=facts,
        training_command=names["training_command"],
        quantisation=made.facts,
        validation=Validation.model_validate(
            shown | {"float": done.float_figures, "integer": done.integer_figures, "psnr_loss_db": loss}
        ),
    )
    write_bundle(folder, manifest, body, texture, made.network, scale)


def _inputs(avatar: Avatar, group: ShapeGroup, index: NDArray[np.int64]) -> list[NDArray[np.float32]]:
    image = avatar.texture.image().detach()
    frames = []
    for one in index:
        uv = torch.from_numpy(group.uv[one].astype(np.float32) / U16)[None]
        covered = torch.from_numpy(group.covered[one] > 0)[None]
        frames.append(sample(image, uv, covered)[0].permute(1, 2, 0).numpy())
    return frames


def _sheet(floats: list[Judged], integers: list[Judged]) -> NDArray[np.uint8]:
    """Per band a row of two samples, the first and the one of median error: truth, float, integer."""
    rows = []
    for band in BAND_NAMES:
        places = [place for place, one in enumerate(integers) if one.band == band]
        by_error = sorted(places, key=lambda place: integers[place].error.psnr_db)
        cells = []
        for place in (by_error[len(by_error) // 2], by_error[-len(by_error) // 4]):
            cells += [floats[place].truth, floats[place].picture, integers[place].picture]
        rows.append(np.hstack([_cell(picture) for picture in cells]))
    return np.vstack(rows)


def _cell(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    image = Image.fromarray((over_grey(picture) * 255).round().astype(np.uint8))
    image.thumbnail(SHEET_CELL[::-1], Image.Resampling.LANCZOS)
    cell = np.full((*SHEET_CELL, 3), 128, np.uint8)
    top, left = (SHEET_CELL[0] - image.height) // 2, (SHEET_CELL[1] - image.width) // 2
    cell[top : top + image.height, left : left + image.width] = np.asarray(image)
    return cell
