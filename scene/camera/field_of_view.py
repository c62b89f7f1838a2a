"""Fields of view and sizes that are believed of a file's lens. Rule: outside of them a number is wrong, not a lens."""

from __future__ import annotations

from pathlib import Path

from trilane.errors import BadInputError
from trilane.scene.lens import Lens

LEAST_DEG, MOST_DEG = 1.0, 170.0
LEAST_PX, MOST_PX = 1.0, 1e6  # of a side of the picture


def checked(where: str | Path, lens: Lens) -> Lens:
    """`lens`, if its picture has LEAST_PX to MOST_PX a side, and it sees LEAST_DEG to MOST_DEG over each.

    Raises BadInputError about `where`.
    """
    if not LEAST_PX <= min(lens.width_px, lens.height_px) <= max(lens.width_px, lens.height_px) <= MOST_PX:
        found = f"a picture of {lens.width_px:.4g}x{lens.height_px:.4g} pixels"
        raise BadInputError(where, found, f"sides of {LEAST_PX:g} to {MOST_PX:g} pixels")
    for side, angle in (("height", lens.fov_y_deg), ("width", lens.fov_x_deg)):
        if not LEAST_DEG < angle < MOST_DEG:
            expected = f"{LEAST_DEG:g} to {MOST_DEG:g}"
            raise BadInputError(where, f"a field of view of {angle:.4g} degrees over the {side}", expected)
    return lens
