"""How much faster is one packed pass than a pass for every four channels and a permute?

Rule: both ways draw the same subject in the same process, turn about, and must give the same bytes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from trilane.bench.fixture import ENCODING, Subject, standing
from trilane.bench.split_pass import SplitPass
from trilane.body.skinning import FrameSkinner
from trilane.errors import BadInputError, TrilaneError
from trilane.stages.gpu.opengl_context import describe, open_context
from trilane.stages.gpu.packed_pass import CHANNELS, PackedAvatar, PackedPass, Placement
from trilane.stages.gpu.skinned_mesh import PosedMesh, SkinnedMesh
from trilane.training.uv_image import UvBytes

MAX_SIDE = 4096
WARM_UP = 5
UNEQUAL = 1e-3  # share of bytes that may differ by one step: UVs are interpolated at other places of other targets


def measure(size: int = 512, channels: int = 16, repeats: int = 40, threads: int = 1) -> dict[str, Any]:
    """Milliseconds of one raster, readback to host memory included; medians of `repeats` turns.

    Keys: `raster_ms` (the raster stage as a run on this driver does it: where it is software, the CPU unit skins),
    `packed_ms`, `split_ms`, `ratios.split_over_packed`, `rows` (one per way: median, minimum, p90), `covered`
    (share of the pixels), `driver`, `config`. Raises BadInputError, MissingPartError; TrilaneError when bytes differ.
    """
    if not 1 <= size <= MAX_SIDE:
        raise BadInputError("--size", str(size), f"1 to {MAX_SIDE}")
    if channels not in CHANNELS:
        raise BadInputError("--channels", str(channels), "4, 8, 12 or 16")
    ctx = open_context(threads)
    subject = standing(channels)
    deferred = not describe(ctx).hardware
    ways = {
        "packed": packed_way(ctx, subject, (size, size), deferred),
        "packed, other way": packed_way(ctx, subject, (size, size), not deferred),
        "split": split_way(ctx, subject, (size, size)),
    }
    tensors = {name: np.zeros(size * size * channels, np.uint8) for name in ways}
    turns: dict[str, Callable[[], object]] = {name: partial(way, tensors[name]) for name, way in ways.items()}
    skinned = np.zeros_like(tensors["packed"])
    skin, draw = posed_ways(ctx, subject, (size, size), deferred)
    turns["CPU unit skins: packed"] = partial(draw, skinned)
    turns["CPU unit skins: skinning"] = skin
    turns["UV bytes alone"] = partial(uv_way(ctx, subject, (size, size)), np.zeros(size * size * 2, np.uint8))
    times = interleaved(turns, repeats)
    _check_equal(tensors)
    rows = {name: summary(taken) for name, taken in times.items()}
    packed_ms, split_ms = rows["packed"]["median_ms"], rows["split"]["median_ms"]
    as_in_a_run = "CPU unit skins: packed" if deferred else "packed"
    return {
        "raster_ms": rows[as_in_a_run]["median_ms"],
        "packed_ms": packed_ms,
        "split_ms": split_ms,
        "ratios": {"split_over_packed": split_ms / packed_ms},
        "rows": [{"way": name, **row} for name, row in rows.items()],
        "covered": float((tensors["packed"].reshape(-1, channels) != ENCODING.zero_point).any(axis=1).mean()),
        "driver": asdict(describe(ctx)),
        "config": {"size": size, "channels": channels, "repeats": repeats, "threads": threads, "deferred": deferred},
    }


def packed_way(ctx: Any, subject: Subject, shape: tuple[int, int], deferred: bool) -> Callable[[Any], None]:
    """A function that draws `subject` by the packed pass and reads it into a tensor."""
    packed = PackedPass(ctx, subject.texture.shape[2], ENCODING, deferred)
    avatar = PackedAvatar(packed, SkinnedMesh(ctx, subject.arrays), subject.texture)
    placement = Placement(subject.joints, subject.projection, (0, 0, *shape))

    def turn(tensor: Any) -> None:
        avatar.draw(packed.begin(shape), subject.view, placement)
        packed.read_into(shape, tensor)

    return turn


def posed_ways(
    ctx: Any, subject: Subject, shape: tuple[int, int], deferred: bool
) -> tuple[Callable[[], None], Callable[[Any], None]]:
    """A function that skins `subject` as the CPU unit does, and one that draws what was skinned, packed."""
    packed = PackedPass(ctx, subject.texture.shape[2], ENCODING, deferred)
    avatar = PackedAvatar(packed, PosedMesh(ctx, subject.arrays), subject.texture)
    skinner = FrameSkinner(subject.shaped)
    vertices = np.empty((len(subject.shaped.vertices), 3), np.float32)
    placement = Placement(subject.joints, subject.projection, (0, 0, *shape), vertices=vertices)

    def skin() -> None:
        skinner.skin_into(subject.posed, vertices)

    def draw(tensor: Any) -> None:
        avatar.draw(packed.begin(shape), subject.view, placement)
        packed.read_into(shape, tensor)

    skin()
    return skin, draw


def split_way(ctx: Any, subject: Subject, shape: tuple[int, int]) -> Callable[[Any], None]:
    """A function that draws `subject` by the split passes, reads them and permutes."""
    split = SplitPass(ctx, SkinnedMesh(ctx, subject.arrays), subject.texture, ENCODING, shape)
    placement = Placement(subject.joints, subject.projection, (0, 0, *shape))

    def turn(tensor: Any) -> None:
        split.draw(subject.view, placement)
        split.read_into(tensor)

    return turn


def uv_way(ctx: Any, subject: Subject, shape: tuple[int, int]) -> Callable[[Any], None]:
    """A function that draws the UV coordinates of `subject` as two bytes a pixel."""
    image = UvBytes(ctx, SkinnedMesh(ctx, subject.arrays))

    def turn(tensor: Any) -> None:
        image.render_into(tensor, subject.joints, subject.view, subject.projection, shape)

    return turn


def interleaved(ways: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Milliseconds of each way, `repeats` times turn about after a warm-up, so that a busy machine hits all alike."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(-WARM_UP, repeats):
        for name, way in ways.items():
            start = time.perf_counter_ns()
            way()
            if turn >= 0:
                times[name].append((time.perf_counter_ns() - start) / 1e6)
    return times


def summary(times_ms: list[float]) -> dict[str, float]:
    """Median, minimum and 90th percentile in milliseconds."""
    return {
        "median_ms": float(np.median(times_ms)),
        "min_ms": float(np.min(times_ms)),
        "p90_ms": float(np.percentile(times_ms, 90)),
    }


def _check_equal(tensors: dict[str, Any]) -> None:
    for name, tensor in tensors.items():
        steps = np.abs(tensor.astype(np.int16) - tensors["packed"])
        if steps.max() > 1 or (steps > 0).mean() > UNEQUAL:
            raise TrilaneError(f"{name} gave other bytes than packed: {steps.max()} steps at most")
