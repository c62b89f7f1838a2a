"""Guesses the unit of length of a BVH file, which the format does not state.

Rule: with `auto` the unit is the one that makes the legs nearest to USUAL_LEG_M; if no unit makes them the length of
human legs, the file is scaled so that they have USUAL_LEG_M.
"""

from __future__ import annotations

import numpy as np

#: Metres in one unit; `cmu` is the unit of the CMU recordings, 1/0.45 inches.
UNITS_M = {"m": 1.0, "cm": 0.01, "in": 0.0254, "cmu": 0.0254 / 0.45}
USUAL_LEG_M = 0.85
#: Length over USUAL_LEG_M, from and to, of legs that are taken for human ones.
HUMAN_LEG = (0.6, 1.6)


def unit_of(leg: float, units: str) -> tuple[str, float]:
    """A note on the unit, and its length in metres.

    `leg`: length of a leg in the file's units. `units`: a key of UNITS_M, or `auto` to guess.
    """
    if units != "auto":
        return f"{units}, as given", UNITS_M[units]
    name = min(UNITS_M, key=lambda unit: abs(np.log(leg * UNITS_M[unit] / USUAL_LEG_M)))
    if HUMAN_LEG[0] < leg * UNITS_M[name] / USUAL_LEG_M < HUMAN_LEG[1]:
        return f"{name}, by the length of the legs", UNITS_M[name]
    return f"unknown, scaled to a leg of {USUAL_LEG_M} m", USUAL_LEG_M / leg
