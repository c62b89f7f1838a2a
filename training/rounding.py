"""Begins the rounding of an avatar to the bytes of its bundle while it is trained.

Rule: the grid is measured once, on a copy in the form in which it is exported.
"""

from __future__ import annotations

import copy

from trilane.training.byte_grid import ByteGrid
from trilane.training.make_bundle import ranges_of
from trilane.training.sample_files import ShapeGroup
from trilane.training.trainable_avatar import TrainableAvatar


def round_to_bytes(avatar: TrainableAvatar, grid: ByteGrid, groups: list[ShapeGroup], seed: int) -> None:
    """Round `avatar` on `grid` from now on. `groups`, `seed`: as of `ranges_of`."""
    if not grid.measured:
        grid.measure(ranges_of(copy.deepcopy(avatar).cpu(), groups, seed))
    grid.active = True
