"""One hard case of plain numbers: what, its error, its bound and where the bound comes from.

Rule: an error that is not a number is above every bound. U and U32 are the unit roundoffs of float64 and float32; the
bounds are those of N. Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed. 2002, sections 2.2 and 3.1: a
sum of n products is off by at most gamma_n times the sum of their absolute values, gamma_n = n U / (1 - n U).
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

U: Final = 2.0**-53
U32: Final = 2.0**-24
HIGHAM = "forward error analysis (Higham 2002, 3.1)"
EXACT = "exact: the definition leaves no room"


class HardNumber(NamedTuple):
    """`error` and `bound` in `unit`; `source`: of the bound."""

    name: str
    error: float
    bound: float
    unit: str
    source: str

    @property
    def holds(self) -> bool:
        return bool(self.error <= self.bound)


def gamma(n: float, unit: float = U) -> float:
    """By which share a sum of `n` products is off at most, in numbers of unit roundoff `unit`."""
    return n * unit / (1 - n * unit)


def worst(errors: ArrayLike, bounds: ArrayLike) -> tuple[float, float]:
    """The error that is nearest to its bound, or furthest above it, and that bound; NaN where any error is NaN."""
    found: Any = np.broadcast_arrays(np.asarray(errors, np.float64), np.asarray(bounds, np.float64))
    error, bound = (each.ravel() for each in found)
    if np.isnan(error).any():
        return float("nan"), float(bound[np.isnan(error)][0])
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(error > 0, error / bound, 0.0)
    place = int(share.argmax()) if share.max() > 0 else int(bound.argmax())
    return float(error[place]), float(bound[place])
