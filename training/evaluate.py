"""Evaluates an avatar on held-out samples, with its float network and with its integer network.

Rule: the integer network is evaluated as it runs in the pipeline: bytes of the packed pass, through a runtime.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from trilane.arrays import U8
from trilane.avatars.integer_network import NetworkFile
from trilane.avatars.network_reshape import reshaped
from trilane.shapes import Shape
from trilane.stages.dsp.ort import load
from trilane.stages.dsp.runtime import RuntimeOptions, Session
from trilane.stages.gpu.packed_pass import PackedAvatar, PackedPass, Placement, Quantisation
from trilane.training.image_error import ImageError, image_error
from trilane.training.neural_texture import read_texture
from trilane.training.sample_renderer import BAND_NAMES, Sample, SampleRenderer
from trilane.training.trainable_avatar import TrainableAvatar

Painter = Callable[[Sample, NDArray[np.float32]], U8]


@dataclass(frozen=True)
class Evaluated:
    """One sample: the name of its band, the ground truth, the picture, and the picture's error."""

    band: str
    truth: U8
    picture: U8
    error: ImageError


def evaluate(renderer: SampleRenderer, samples: list[Sample], paint: Painter) -> list[Evaluated]:
    """Pictures and errors of `samples`, painted by `paint`; samples that show no person are left out."""
    evaluated = []
    for sample in samples:
        uv, truth = renderer.render(sample)
        picture = paint(sample, uv)
        error = image_error(picture, truth)
        if error is not None:
            evaluated.append(Evaluated(BAND_NAMES[sample.band], truth, picture, error))
    return evaluated


def float_painter(avatar: TrainableAvatar) -> Painter:
    """A painter that runs the float network on the float texture."""
    avatar.eval()

    def paint(_: Sample, uv: NDArray[np.float32]) -> U8:
        image = torch.from_numpy(np.ascontiguousarray(uv))[None]
        with torch.no_grad():
            output = avatar.network(read_texture(avatar.texture.image(), image[..., :2], image[..., 2] > 0))
        pixels: U8 = (output[0].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
        return pixels

    return paint


def integer_painter(
    renderer: SampleRenderer, network: NetworkFile, texture: NDArray[np.float32], threads: int
) -> Painter:
    """A painter that runs the GPU unit's packed pass, then the integer network in ONNX Runtime.

    `renderer`: the body and its OpenGL context.
    `network`: in integers.
    `texture`: (S,S,C) float32.
    `threads`: of ONNX Runtime.
    """
    quantisation = Quantisation(network.input.scale, network.input.zero_point)
    packed = PackedPass(renderer.ctx, texture.shape[2], quantisation, deferred=True)
    drawn = PackedAvatar(packed, renderer.mesh, texture)
    sessions: dict[Shape, Session] = {}

    def paint(sample: Sample, _: NDArray[np.float32]) -> U8:
        shape = sample.crop.shape
        tensor = np.empty((1, *shape, packed.channels), np.uint8)
        joints = renderer.skeleton.pose(sample.pose).matrices
        target = packed.begin(shape)
        drawn.draw(target, sample.view.view, Placement(joints, sample.crop.projection, (0, 0, *shape)))
        packed.read_into(shape, tensor.reshape(-1))
        if shape not in sessions:
            sessions[shape] = load(reshaped(network, *shape), RuntimeOptions(threads=threads))
        picture = np.empty((1, *shape, 4), np.uint8)
        sessions[shape].bind([tensor], [picture]).run()
        pixels: U8 = picture[0]
        return pixels

    return paint


def summary(evaluated: list[Evaluated]) -> dict[str, Any]:
    """Mean PSNR by band, and over all samples the mean and the least PSNR, mean IoU and mean SSIM."""
    errors = [sample.error for sample in evaluated]
    return {
        "psnr_db_by_band": {
            band: round(float(np.mean([sample.error.psnr_db for sample in evaluated if sample.band == band])), 2)
            for band in BAND_NAMES
        },
        "psnr_db": round(float(np.mean([error.psnr_db for error in errors])), 2),
        "least_psnr_db": round(min(error.psnr_db for error in errors), 2),
        "iou": round(float(np.mean([error.iou for error in errors])), 4),
        "ssim": round(float(np.mean([error.ssim for error in errors])), 4),
        "samples": len(errors),
    }
