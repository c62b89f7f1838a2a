"""Rendered samples on disk: one folder of memory-mapped arrays per tensor shape.

Rule: what is stored is what the pipeline's raster gave; nothing is resampled.
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
#: Array to its trailing shape and type. `uv`: u, v in 1/65535. `covered`: 1 on the body. `rgba`: the ground truth.
FIELDS: dict[str, tuple[tuple[int, ...], type]] = {
    "uv": ((2,), np.uint16),
    "covered": ((), np.uint8),
    "rgba": ((4,), np.uint8),
}


@dataclass(frozen=True)
class ShapeGroup:
    """Samples of one tensor shape. Arrays (N, H, W, ...) as in `FIELDS`; `band` (N,) index into the bands."""

    shape: Shape
    uv: NDArray[np.uint16]
    covered: NDArray[np.uint8]
    rgba: NDArray[np.uint8]
    band: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.band)


def create_group(folder: Path, shape: Shape, bands: NDArray[np.int8]) -> ShapeGroup:
    """Arrays on disk for `len(bands)` samples, to be written."""
    place = folder / f"{shape[0]}x{shape[1]}"
    place.mkdir(parents=True, exist_ok=True)
    np.save(place / "band.npy", bands)
    arrays: dict[str, Any] = {
        name: open_memmap(place / f"{name}.npy", "w+", dtype, (len(bands), *shape, *tail))
        for name, (tail, dtype) in FIELDS.items()
    }
    return ShapeGroup(shape, band=bands, **arrays)


def open_groups(folder: Path, writable: bool = False) -> list[ShapeGroup]:
    """All groups of a data set, by shape."""
    mode: Any = "r+" if writable else "r"
    groups = []
    for place in sorted(folder.iterdir(), key=lambda path: parse_shape(path.name)):
        arrays: dict[str, Any] = {name: np.load(place / f"{name}.npy", mmap_mode=mode) for name in FIELDS}
        groups.append(ShapeGroup(parse_shape(place.name), band=np.load(place / "band.npy"), **arrays))
    return groups


def batches(
    groups: list[ShapeGroup], size: int, rng: np.random.Generator, repeats: Sequence[int] = (1,) * 5
) -> Iterator[tuple[ShapeGroup, NDArray[np.int64]]]:
    """Endless batches of one shape each; an epoch has every sample as often as `repeats` says of its band."""
    while True:
        epoch: list[tuple[ShapeGroup, NDArray[np.int64]]] = []
        for group in groups:
            order = rng.permutation(np.repeat(np.arange(len(group)), np.asarray(repeats)[group.band]))
            parts = np.array_split(order, max(1, len(order) // size))
            epoch += [(group, np.sort(part)) for part in parts if len(part)]
        for index in rng.permutation(len(epoch)):
            yield epoch[index]
