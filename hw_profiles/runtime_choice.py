"""Chooses the fastest runtime for the network on this machine.

Rule: the host profile decides among the installed ones; nothing is measured.
"""

from __future__ import annotations

from collections.abc import Sequence

from trilane.errors import MissingPartError, package_line
from trilane.hw_profiles.schema import Profile


def fastest_runtime(profile: Profile, installed: Sequence[str]) -> tuple[str, str]:
    """The fastest of the `installed` runtimes by the numbers of the profile's DSP unit, and the reason as text.

    Raises MissingPartError when the profile has a number for none of them.
    """
    speeds = {name: profile.units["dsp"].runtimes[name] for name in installed if name in profile.units["dsp"].runtimes}
    if not speeds:
        raise MissingPartError("no runtime that the host profile knows is installed", package_line("onnxruntime"))
    name = max(speeds, key=lambda runtime: speeds[runtime].or_else(0.0))
    times = ", ".join(f"{runtime} {speed.or_else(0.0):g}" for runtime, speed in speeds.items())
    return name, f"times the speed of FP32, by the host profile: {times}; {speeds[name].source}"
