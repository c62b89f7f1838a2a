"""Validation: held-out samples through the float network, and through the pipeline's packed pass and integer network.

Rule: the integer figures come from the path that runs: bytes from the GPU, bytes through the runtime.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from trilane.arrays import U8
from trilane.avatars.network_file import NetworkFile
from trilane.avatars.reshape import reshaped
from trilane.shapes import Shape
from trilane.stages.dsp.ort import load
from trilane.stages.dsp.runtime import RuntimeOptions, Session
from trilane.stages.gpu.packed import PackedAvatar, PackedPass, Placement, Quantisation
from trilane.training.dataset import BAND_NAMES, Sample, Studio
from trilane.training.fit import Avatar
from trilane.training.metrics import ImageError, image_error
from trilane.training.texture import sample

Painter = Callable[[Sample, NDArray[np.float32]], U8]


@dataclass(frozen=True)
class Judged:
    """One sample: its band, the truth, the picture, the error."""

    band: str
    truth: U8
    picture: U8
    error: ImageError


def judge(studio: Studio, samples: list[Sample], paint: Painter) -> list[Judged]:
    """Pictures and errors of `samples`; those that show no one are left out."""
    judged = []
    for one in samples:
        uv, truth = studio.render(one)
        picture = paint(one, uv)
        error = image_error(picture, truth)
        if error is not None:
            judged.append(Judged(BAND_NAMES[one.band], truth, picture, error))
    return judged


def float_painter(avatar: Avatar) -> Painter:
    """The float network on the float texture."""
    avatar.eval()

    def paint(_: Sample, uv: NDArray[np.float32]) -> U8:
        image = torch.from_numpy(np.ascontiguousarray(uv))[None]
        with torch.no_grad():
            output = avatar.network(sample(avatar.texture.image(), image[..., :2], image[..., 2] > 0))
        pixels: U8 = (output[0].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
        return pixels

    return paint


def integer_painter(studio: Studio, network: NetworkFile, texture: NDArray[np.float32], threads: int) -> Painter:
    """The packed pass of the GPU unit, then the integer network in ONNX Runtime."""
    quantisation = Quantisation(network.input.scale, network.input.zero_point)
    packed = PackedPass(studio.ctx, texture.shape[2], quantisation, deferred=True)
    drawn = PackedAvatar(packed, studio.mesh, texture)
    sessions: dict[Shape, Session] = {}

    def paint(one: Sample, _: NDArray[np.float32]) -> U8:
        shape = one.crop.shape
        tensor = np.empty((1, *shape, packed.channels), np.uint8)
        joints = studio.skeleton.pose(one.pose).matrices
        target = packed.begin(shape)
        drawn.draw(target, one.view.view, Placement(joints, one.crop.projection, (0, 0, *shape)))
        packed.read_into(shape, tensor.reshape(-1))
        if shape not in sessions:
            sessions[shape] = load(reshaped(network, *shape), RuntimeOptions(threads=threads))
        picture = np.empty((1, *shape, 4), np.uint8)
        sessions[shape].bind([tensor], [picture]).run()
        found: U8 = picture[0]
        return found

    return paint


def summary(judged: list[Judged]) -> dict[str, Any]:
    """Means over samples: PSNR by band, least PSNR, IoU and SSIM over all."""
    errors = [one.error for one in judged]
    return {
        "psnr_db_by_band": {
            band: round(float(np.mean([one.error.psnr_db for one in judged if one.band == band])), 2)
            for band in BAND_NAMES
        },
        "psnr_db": round(float(np.mean([error.psnr_db for error in errors])), 2),
        "least_psnr_db": round(min(error.psnr_db for error in errors), 2),
        "iou": round(float(np.mean([error.iou for error in errors])), 4),
        "ssim": round(float(np.mean([error.ssim for error in errors])), 4),
        "samples": len(errors),
    }
