"""Times of views that have none. Rule: the scene's rate, else views that turn little are a film, others are stills."""

from __future__ import annotations

import numpy as np

from trilane.arrays import F64

FILM_RATE_HZ = 30.0
FILM_STEP_DEG = 6.0


def times_without(turns: F64, rate_hz: float | None) -> tuple[F64, str]:
    """Seconds (N,) of views with camera axes `turns` (N, 3, 3), and how they were decided.

    `rate_hz`: of the scene, if it says one. Views less than FILM_STEP_DEG apart are a film, others are stills.
    """
    rate, how = _rate(turns) if rate_hz is None else (rate_hz, f"{rate_hz:g} a second as given")
    return np.arange(len(turns)) / rate, how


def _rate(turns: F64) -> tuple[float, str]:
    ahead = turns[:, :, 2]
    cosine = np.clip((ahead[1:] * ahead[:-1]).sum(axis=1), -1, 1)
    finite = cosine[np.isfinite(cosine)]
    step = float(np.degrees(np.median(np.arccos(finite)))) if len(finite) else 0.0
    if step > FILM_STEP_DEG:
        return 1.0, f"stills {step:.0f} degrees apart, 1 a second"
    return FILM_RATE_HZ, f"{FILM_RATE_HZ:g} a second assumed"
