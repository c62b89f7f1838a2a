"""The corner (clock and voltage) of each unit under a performance profile.

Rule: the names are those of `trilane.units.PerformanceProfile`, the corners those of the chip's TOML file under
`performance_profiles`; any other name is refused.
"""

from __future__ import annotations

from trilane.errors import BadInputError
from trilane.hw_profiles.schema import Corner, Profile

Corners = tuple[Corner, Corner, Corner]


def corners_of(profile: Profile, performance_profile: str) -> Corners:
    """Corners of cpu, gpu and dsp. Raises BadInputError for a name that is no performance profile."""
    for name, settings in profile.performance_profiles.items():
        if name == performance_profile:
            return settings.cpu, settings.gpu, settings.dsp
    known = ", ".join(profile.performance_profiles)
    raise BadInputError("performance profile", repr(performance_profile), f"one of {known}")
