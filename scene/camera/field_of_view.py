"""Fields of view that are believed of a file's lens. Rule: outside of them a number is wrong, not the lens."""

from __future__ import annotations

from pathlib import Path

from trilane.errors import BadInputError
from trilane.scene.lens import Lens

LEAST_DEG, MOST_DEG = 1.0, 170.0


def checked(where: str | Path, lens: Lens) -> Lens:
    """`lens`, if it sees LEAST_DEG to MOST_DEG over height and width. Raises BadInputError about `where`."""
    for side, angle in (("height", lens.fov_y_deg), ("width", lens.fov_x_deg)):
        if not LEAST_DEG < angle < MOST_DEG:
            expected = f"{LEAST_DEG:g} to {MOST_DEG:g}"
            raise BadInputError(where, f"a field of view of {angle:.4g} degrees over the {side}", expected)
    return lens
