"""Rendered samples on disk: one folder of memory-mapped arrays per tensor shape.

Rule: arrays hold the pixels that were rendered, none resampled.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

from trilane.shapes import Shape, parse_shape

U16 = 65535
#: Array to its trailing shape and type. `uv`: u and v in 1/65535. `covered`: 1 on the body. `rgba`: the ground truth.
FIELDS: dict[str, tuple[tuple[int, ...], type]] = {
    "uv": ((2,), np.uint16),
    "covered": ((), np.uint8),
    "rgba": ((4,), np.uint8),
}


@dataclass(frozen=True)
class ShapeGroup:
    """Samples of one tensor shape. Arrays (N, H, W, ...) as in `FIELDS`; `band` (N,): the index of each one's band."""

    shape: Shape
    uv: NDArray[np.uint16]
    covered: NDArray[np.uint8]
    rgba: NDArray[np.uint8]
    band: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.band)


def create_group(folder: Path, shape: Shape, bands: NDArray[np.int8]) -> ShapeGroup:
    """New arrays on disk under `folder`, for the caller to fill, one sample for each of `bands`."""
    place = folder / f"{shape[0]}x{shape[1]}"
    place.mkdir(parents=True, exist_ok=True)
    np.save(place / "band.npy", bands)
    arrays: dict[str, Any] = {
        name: open_memmap(place / f"{name}.npy", "w+", dtype, (len(bands), *shape, *tail))
        for name, (tail, dtype) in FIELDS.items()
    }
    return ShapeGroup(shape, band=bands, **arrays)


def open_groups(folder: Path, writable: bool = False) -> list[ShapeGroup]:
    """All groups of the data set in `folder`, in order of their shapes."""
    mode: Any = "r+" if writable else "r"
    groups = []
    for place in sorted(folder.iterdir(), key=lambda path: parse_shape(path.name)):
        arrays: dict[str, Any] = {name: np.load(place / f"{name}.npy", mmap_mode=mode) for name in FIELDS}
        groups.append(ShapeGroup(parse_shape(place.name), band=np.load(place / "band.npy"), **arrays))
    return groups


def batches(
    groups: list[ShapeGroup],
    size: int,
    rng: np.random.Generator,
    repeats: Sequence[int] = (1,) * 5,
    labels: Sequence[NDArray[np.int64]] | None = None,
) -> Iterator[tuple[ShapeGroup, NDArray[np.int64]]]:
    """Batches without end, each of one tensor shape: a group and the indices of the samples in it.

    `groups`: the samples.
    `size`: samples of a batch, roughly.
    `rng`: shuffles the samples of each epoch.
    `repeats`: how often an epoch has a sample, by its band.
    `labels`: of each group (N,); the samples of a batch have one label, and those below 0 are left out.
    """
    kinds = labels if labels is not None else [np.zeros(len(group), np.int64) for group in groups]
    while True:
        epoch: list[tuple[ShapeGroup, NDArray[np.int64]]] = []
        for group, kind in zip(groups, kinds, strict=True):
            for label in np.unique(kind[kind >= 0]):
                alike = np.flatnonzero(kind == label)
                order = rng.permutation(np.repeat(alike, np.asarray(repeats)[group.band[alike]]))
                parts = np.array_split(order, max(1, len(order) // size))
                epoch += [(group, np.sort(part)) for part in parts if len(part)]
        for index in rng.permutation(len(epoch)):
            yield epoch[index]
