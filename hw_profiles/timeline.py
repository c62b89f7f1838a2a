"""What a report says of minutes on a chip: rates, temperatures, throttling, and the moments themselves.

Rule: figures of given moments; nothing is modelled here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from trilane.hw_profiles.over_time import Moment
from trilane.hw_profiles.performance_profiles import Corners
from trilane.units import UNITS

MOST_SHOWN = 360


def ends_of(moments: Sequence[Moment]) -> dict[str, float]:
    """Frames a second at the start, and those to which it settles: the mean of the last fifth of the time."""
    last = moments[-max(1, len(moments) // 5) :]
    return {"fps_start": 1e3 / moments[0].frame_ms, "fps_settled": 1e3 / (sum(m.frame_ms for m in last) / len(last))}


def settled_corners(moments: Sequence[Moment]) -> Corners:
    """The corners at which the units mostly are in the last fifth of the time."""
    last = moments[-max(1, len(moments) // 5) :]
    return Counter(moment.corners for moment in last).most_common(1)[0][0]


def temperatures_of(moments: Sequence[Moment]) -> dict[str, float]:
    """Degrees Celsius of the device and of its hottest junction; empty without moments."""
    if not moments:
        return {}
    return {
        "device_end": moments[-1].device_c,
        "device_max": max(m.device_c for m in moments),
        "junction_max": max(m.junction_c for m in moments),
    }


def caps_of(moments: Sequence[Moment]) -> dict[str, Any]:
    """Share of the time in which a unit was lowered for heat, and the first second of it."""
    throttled_s = [m.t_s for m in moments if m.throttled]
    return {
        "throttled_share": len(throttled_s) / len(moments) if moments else 0.0,
        "first_throttled_s": throttled_s[0] if throttled_s else None,
    }


def timeline_of(moments: Sequence[Moment]) -> list[dict[str, Any]]:
    """The moments as plain data, thinned."""
    return [_shown(m) for m in moments[:: max(1, len(moments) // MOST_SHOWN)]]


def _shown(moment: Moment) -> dict[str, Any]:
    return {
        "t_s": moment.t_s,
        "fps": 1e3 / moment.frame_ms,
        "device_c": moment.device_c,
        "junction_c": moment.junction_c,
        "power_w": moment.power_w,
        "corners": dict(zip(UNITS, moment.corners, strict=True)),
    }
