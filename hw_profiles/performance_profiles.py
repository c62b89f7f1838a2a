"""The operating points that a performance profile asks for. Rule: a name that a profile does not have is refused."""

from __future__ import annotations

from trilane.errors import BadInputError
from trilane.hw_profiles.schema import Corner, Profile

Corners = tuple[Corner, Corner, Corner]


def corners_of(profile: Profile, performance_profile: str) -> Corners:
    """Corners of cpu, gpu and dsp. Raises BadInputError for a name that is no performance profile."""
    for name, found in profile.performance_profiles.items():
        if name == performance_profile:
            return found.cpu, found.gpu, found.dsp
    known = ", ".join(profile.performance_profiles)
    raise BadInputError("performance profile", repr(performance_profile), f"one of {known}")
