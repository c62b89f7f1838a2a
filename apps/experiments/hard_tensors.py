"""Tensors: values that quantising, packing and FP16 texels find hard, and scenes whose frames are all unlike.

Rule: a texture with constant channels makes every covered pixel of a tensor a known byte: q = clamp(round(x / scale) +
zero point, 0, 255), rounded to even. Values are FP16 numbers. For halves the scale is a power of two, so that x / scale
is exact however a driver divides. Else x / scale is at least a tenth of a step from a half, which no driver's division
crosses (2.5 units in the last place, Vulkan 1.3 and OpenCL 3.0 for float32). A frame of a scene is the same to the byte
whatever was drawn before it; its reference comes from stages that draw nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trilane.apps.experiments.accuracy import DrawnTensors
from trilane.apps.experiments.hard_rotations import EXACT, HardNumber, worst
from trilane.arrays import F64, U8
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINTS, Skeleton
from trilane.errors import BadInputError
from trilane.scene.camera.path import look_at, projection_matrix
from trilane.stages.config import Quantisation
from trilane.stages.configure import Checked, configure
from trilane.stages.gpu.raster import PackedAvatar, PackedPass, Placement, check_texture, texture_array
from trilane.stages.gpu.skinned_mesh import SkinnedMesh, mesh_arrays
from trilane.stages.run_options import RunOptions

SHAPE = (64, 64)
CHANNELS = 16
POWER = 2.0**-5
NO_TENSOR = np.empty(0, np.uint8)
#: Name -> scale, zero point, and the channels' values: in steps here (halves are exact), as they are in `NUMBERS`.
STEPS: dict[str, tuple[float, int, Sequence[float]]] = {
    "halves above 0": (POWER, 117, [k + 0.5 for k in range(16)]),
    "halves below 0": (POWER, 117, [-k - 0.5 for k in range(16)]),
    "seven tenths of a step": (6 / 255, 117, [k + 0.7 for k in range(16)]),
    "seven tenths below 0": (6 / 255, 117, [-k - 0.7 for k in range(16)]),
    "just over the highest byte": (POWER, 117, [138 + k / 2 for k in range(16)]),
    "just under the lowest byte": (POWER, 117, [-117 - k / 2 for k in range(16)]),
    "a zero point of 0": (POWER, 0, [k - 7.5 for k in range(16)]),
    "a zero point of 255": (POWER, 255, [k - 7.5 for k in range(16)]),
}
LARGEST, LEAST_NORMAL, LEAST = 65504.0, 2.0**-14, 2.0**-24
NUMBERS: dict[str, tuple[float, int, Sequence[float]]] = {
    "the largest FP16 numbers": (6 / 255, 117, [LARGEST, -LARGEST] * 8),
    "FP16 subnormals at a scale of their own": (LEAST, 3, [k * LEAST for k in range(16)]),
    "no contrast: all values 0 or -0": (1e-30, 117, [0.0, -0.0] * 8),
    "a scale so small that all is clamped": (1e-30, 117, [LEAST, -LEAST] * 8),
    "a scale so large that all is 0": (1e30, 117, [LARGEST, -LARGEST] * 8),
}
HALF_ULP = "FP16 rounds to the nearest: 2^-11 of a number, 2^-25 at least"
#: Scene -> frames, each as unlike the one before as possible: camera, pose, rectangle, tensor shape, who is in view.
JUMPS = {"walk-past": (0, 180, 30, 299, 0), "leave-and-return": (0, 150, 20, 240), "top-to-floor": (0, 90, 180, 0)}
RUNTIME = "ort"


def tensor_cases(shaped: ShapedBody, ctx: Any) -> Iterator[HardNumber]:
    """Yield rows of packing and of texels, drawn in the OpenGL context `ctx`."""
    mesh, view, placement = _scene(shaped, ctx)
    rows = {name: (s, z, [step * s for step in steps]) for name, (s, z, steps) in STEPS.items()} | NUMBERS
    for name, (scale, zero_point, numbers) in rows.items():
        values = np.asarray(numbers, np.float16).astype(np.float64)
        packed = PackedPass(ctx, CHANNELS, Quantisation(scale, zero_point), deferred=True)
        avatar = PackedAvatar(packed, mesh, np.tile(values.astype(np.float32), (8, 8, 1)))
        avatar.draw(packed.begin(SHAPE), view, placement)
        tensor = np.zeros(SHAPE[0] * SHAPE[1] * CHANNELS, np.uint8)
        packed.read_into(SHAPE, tensor)
        error = _steps_off(tensor.reshape(-1, CHANNELS), values, scale, zero_point)
        yield HardNumber(f"packing {name}", error, 0.0, "steps", EXACT)
    yield from _texels(ctx)


def _scene(shaped: ShapedBody, ctx: Any) -> tuple[SkinnedMesh, F64, Placement]:
    """Return the body at rest before a camera, in the middle of the tensor."""
    body = shaped.body
    joint = np.zeros((len(shaped.vertices), 4), np.int64)
    weight = np.tile([1.0, 0.0, 0.0, 0.0], (len(joint), 1))
    mesh = SkinnedMesh(ctx, mesh_arrays(shaped.vertices, body.faces, body.uv, body.uv_faces, joint, weight))
    posed = Skeleton(shaped.joints, body.parents).pose(np.zeros((JOINTS, 3)))
    middle = shaped.vertices.astype(np.float64).mean(axis=0)
    view = look_at(middle + np.array([0.0, 0.0, 1.0]), middle)
    return mesh, view, Placement(posed.matrices.copy(), projection_matrix(40.0, 1.0, 0.05, 10.0), (0, 0, *SHAPE))


def _steps_off(pixels: U8, values: F64, scale: float, zero_point: int) -> float:
    """Return the largest difference, in steps, of a covered pixel of `pixels` (N, C) from the formula."""
    wanted = np.clip(np.rint(values / np.float64(np.float32(scale))) + zero_point, 0, 255)
    middle = pixels.reshape(*SHAPE, -1)[SHAPE[0] // 2, SHAPE[1] // 2]
    background = (pixels == zero_point).all(axis=1)
    covered = pixels[~background] if (~background).any() else middle[None]
    return float(np.abs(covered - wanted).max())


def _texels(ctx: Any) -> Iterator[HardNumber]:
    """Yield rows of the texture's values on the GPU, and of values that it refuses."""
    rng = np.random.default_rng(11)
    for name, exponents in {"usual numbers": (-6, 6), "subnormals": (-24, -14), "large numbers": (10, 15)}.items():
        sizes = 2.0 ** rng.uniform(*exponents, (8, 8, 4)) * rng.choice([-1.0, 1.0], (8, 8, 4))
        texture = sizes.astype(np.float32)
        stored = np.frombuffer(texture_array(ctx, texture).read(), np.float16).reshape(texture.shape)
        bounds = np.maximum(2.0**-11 * np.abs(texture), 2.0**-25)
        yield HardNumber(f"FP16 texels, {name}", *worst(np.abs(stored - texture), bounds), "as the texture", HALF_ULP)
    taken = sum(_is_taken(value) for value in (65520.0, np.inf, -np.inf, np.nan))
    yield HardNumber("textures that FP16 cannot hold and that are taken", float(taken), 0.0, "textures", EXACT)


def _is_taken(value: float) -> bool:
    try:
        check_texture(np.full((2, 2, 4), value, np.float32), 4)
    except BadInputError:
        return False
    return True


def scene_cases() -> Iterator[HardNumber]:
    """Yield a row for each scene of `JUMPS`."""
    for scene, frames in JUMPS.items():
        checked = configure(RunOptions(scene=scene, runtime=RUNTIME), Path.cwd())
        last = checked.config.scene.frames - 1
        numbers = [min(frame, last) for frame in frames]
        name = f"{scene}: frames {', '.join(map(str, numbers))} one after the other"
        yield HardNumber(name, float(_differing(checked, numbers)), 0.0, "bytes of the tensor", EXACT)


def _differing(checked: Checked, numbers: list[int]) -> int:
    """Return how many bytes of the tensors differ from those of stages that drew no other frame."""
    used, found = DrawnTensors(checked), 0
    for number in numbers:
        after, fresh = used.tensors(number), DrawnTensors(checked).tensors(number)
        for network in after.keys() | fresh.keys():
            found += _different_bytes(after.get(network, NO_TENSOR), fresh.get(network, NO_TENSOR))
    return found


def _different_bytes(one: U8, other: U8) -> int:
    """Return how many bytes differ; all of the larger tensor for two of different shapes."""
    return max(one.size, other.size) if one.shape != other.shape else int(np.count_nonzero(one != other))
