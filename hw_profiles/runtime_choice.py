"""Which runtime is the fastest here. Rule: the host profile decides among those that are installed, and says why."""

from __future__ import annotations

from collections.abc import Sequence

from trilane.errors import MissingPartError
from trilane.hw_profiles.schema import Profile
from trilane.install import package_line


def fastest_runtime(profile: Profile, installed: Sequence[str]) -> tuple[str, str]:
    """The runtime of `installed` that the profile's DSP unit knows as the fastest, and why.

    Raises MissingPartError when it knows none of them.
    """
    speeds = {name: profile.units["dsp"].runtimes[name] for name in installed if name in profile.units["dsp"].runtimes}
    if not speeds:
        raise MissingPartError("no runtime that the host profile knows is installed", package_line("onnxruntime"))
    name = max(speeds, key=lambda one: speeds[one].or_else(0.0))
    times = ", ".join(f"{one} {speed.or_else(0.0):g}" for one, speed in speeds.items())
    return name, f"times the speed of FP32, by the host profile: {times}; {speeds[name].source}"
