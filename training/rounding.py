"""The rounding of an avatar to the bytes of its bundle while it is trained, and what is left of it at the end.

Rule: the grid is measured once, on a copy in the form in which the avatar is exported; at the end the float network has
the rounded weights, because those that they were rounded from paint a worse picture.
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


def keep_rounded_weights(avatar: TrainableAvatar, groups: list[ShapeGroup], seed: int) -> None:
    """Put the weights of `avatar`, which was trained rounded, on the grid. `groups`, `seed`: as of `ranges_of`."""
    grid = ByteGrid(copy.deepcopy(avatar.network))
    grid.measure(ranges_of(copy.deepcopy(avatar).cpu(), groups, seed))
    avatar.network.load_state_dict(grid.weights(avatar.network), strict=False)
