"""Measurements of this machine. Each module answers one question by a function `measure`; `lib/` has shared parts.

This folder may import from every folder except apps/. The parameters of `measure` are options of `trilane bench`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from trilane import machine
from trilane.errors import BadInputError
from trilane.units import MAX_CHANNELS

#: Least and greatest value of each option, for all benches. A bench may check a narrower range.
LIMITS: dict[str, tuple[float, float]] = {
    "repeats": (1, 100_000),
    "threads": (0, 4 * machine.here.core_count()),
    "rounds": (1, 10_000),
    "views": (1, 1_000_000),
    "finalists": (1, 1000),
    "frames": (1, 10_000_000),
    "pictures": (1, 10_000),
    "seeds": (1, 1000),
    "width": (1, 8192),
    "channels": (1, MAX_CHANNELS),
    "sizes": (1, 4096),
    "avatars": (1, 8),
    "batch": (1, 64),
    "minutes": (0.01, 1440),
    "seconds": (0.05, 86_400),
    "period": (0.01, 86_400),
}


def check_limits(asked: Mapping[str, Any]) -> None:
    """Raise BadInputError if a value is outside of its option's range.

    `asked`: value of each option, or a list of values, by the option's name. Texts have no range.
    """
    for option, values in asked.items():
        low, high = LIMITS.get(option, (None, None))
        if low is None or high is None:
            continue
        for value in values if isinstance(values, list | tuple) else (values,):
            if not isinstance(value, str) and not low <= value <= high:
                raise BadInputError(f"--{option}", f"{value:g}", f"{low:g} to {high:g}")
