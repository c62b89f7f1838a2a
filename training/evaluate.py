"""Evaluates an avatar on held-out samples: every painter's picture of a sample beside the sample's ground truth.

Rule: the integer network is evaluated as it runs in the pipeline: bytes of the packed pass, through a runtime.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64, U8
from trilane.avatars.bundle import Bundle
from trilane.avatars.network_file import reshaped
from trilane.shapes import Shape
from trilane.stages.dsp.runtime import RuntimeOptions, Session, load_runtime
from trilane.stages.gpu.packed_pass import PackedAvatar, PackedPass, Placement, Quantisation
from trilane.stages.gpu.skinned_mesh import SkinnedMesh
from trilane.training.image_error import ImageError, image_error
from trilane.training.sample_renderer import BAND_NAMES, Sample, SampleRenderer

#: Paints the picture (h,w,4) of a sample and its UV image (h,w,3).
Painter = Callable[[Any, NDArray[np.float32]], U8]


class Drawn(Protocol):
    """A renderer whose samples the packed pass can draw."""

    ctx: Any
    mesh: SkinnedMesh

    def placed(self, sample: Any) -> tuple[F64, Placement]:
        """The camera (4,4) of `sample`, and its body's pose, crop and place in the tensor."""


@dataclass(frozen=True)
class Evaluated:
    """One sample.

    `number`: of the sample among those that were given. `band`: its name. `truth`: the ground truth (h,w,4).
    `pictures`, `errors`: of each painter, by its name.
    """

    number: int
    band: str
    truth: U8
    pictures: dict[str, U8]
    errors: dict[str, ImageError]


def evaluate(
    renderer: SampleRenderer, samples: Iterable[Sample], painters: Mapping[str, Painter]
) -> Iterator[Evaluated]:
    """Pictures and errors of `samples` by each of `painters`; samples that show no person are left out."""
    for number, sample in enumerate(samples):
        uv, truth = renderer.render(sample)
        pictures = {name: paint(sample, uv) for name, paint in painters.items()}
        errors = {name: image_error(picture, truth) for name, picture in pictures.items()}
        known = {name: error for name, error in errors.items() if error is not None}
        if known:
            yield Evaluated(number, BAND_NAMES[sample.band], truth, pictures, known)


def integer_painter(renderer: Drawn, bundle: Bundle, runtime: str, threads: int) -> Painter:
    """A painter that runs the GPU unit's packed pass, then the integer network of `bundle` on `runtime`.

    `renderer`: the body and its OpenGL context.
    `bundle`: whose texture and network are read.
    `runtime`: its name.
    `threads`: of the runtime.
    Raises BadInputError, MissingPartError.
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
