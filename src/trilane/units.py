"""Words and numbers that all folders share, about avatars, units, profiles, the host, stages and sources of figures.

Rule: no other file repeats one of these lists or phrases.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from enum import StrEnum
from typing import Literal, get_args


def either(words: Iterable[object]) -> str:
    """Return `words` as a phrase, such as "a, b or c"."""
    return " or ".join(", ".join(map(str, words)).rsplit(", ", 1))


#: Nanoseconds in a millisecond and in a second.
NS_PER_MS, NS_PER_S = 1e6, 1e9
#: Rate that a run must hold, in frames a second, if no option, scene or file states a rate.
TARGET_FPS = 30.0
#: Longest virtual time of a prediction, minutes.
MAX_MINUTES = 24 * 60

#: Names of the bundled avatars.
AvatarName = Literal["default", "hiker", "dancer"]
AVATARS: tuple[AvatarName, ...] = get_args(AvatarName)
#: Help text for an option that names an avatar.
AVATARS_HELP = f"{', '.join(f'`{name}`' for name in AVATARS)}, or the folder of an avatar."

#: Name of the background that Trilane draws itself, without a file.
ROOM = "room"

#: Numbers of channels of the neural texture that the GPU packs in one pass, ascending; the largest of them.
CHANNELS = (4, 8, 12, 16)
MAX_CHANNELS = CHANNELS[-1]
#: Largest number of smaller levels of the neural texture. The fifth level of a usual texture of 512x512 has 16 texels
#: along a side; a sixth would have too few for a body.
MOST_TEXTURE_LEVELS = 5
#: Sides of a tensor, as shares of the sides for which its network was trained. The smaller ones are for frames that
#: would be late, and for error budgets.
SIDES = (1.0, 0.75, 0.5)
#: All the work of a stage in thousandths, such as all pixels of a tensor.
ALL_WORK = 1000


def work_of_side(side: float) -> int:
    """Return the work of a scaled tensor: its pixels in thousandths of all pixels, rounded up.

    `side`: factor by which each side of the tensor is scaled.
    """
    return math.ceil(ALL_WORK * side * side)


#: Names of the runtimes, as a tuple and in words.
RUNTIMES = ("ort", "openvino", "qnn", "cuda")
RUNTIME_WORDS = either(RUNTIMES)
#: Methods by which a network is calibrated, and the usual method.
CALIBRATION_METHODS = ("minmax", "percentile", "entropy")
CALIBRATION_METHOD = CALIBRATION_METHODS[0]

UnitName = Literal["cpu", "gpu", "dsp"]
UNITS: tuple[UnitName, ...] = get_args(UnitName)


class PerformanceProfile(StrEnum):
    """Names of SNPE's and QNN's performance profiles, from the highest power to the lowest."""

    BURST = "burst"
    SUSTAINED_HIGH_PERFORMANCE = "sustained_high_performance"
    HIGH_PERFORMANCE = "high_performance"
    BALANCED = "balanced"
    LOW_BALANCED = "low_balanced"
    POWER_SAVER = "power_saver"
    LOW_POWER_SAVER = "low_power_saver"


PERFORMANCE_PROFILES = tuple(profile.value for profile in PerformanceProfile)
BURST = PerformanceProfile.BURST.value
SUSTAINED = PerformanceProfile.SUSTAINED_HIGH_PERFORMANCE.value

#: Name of this machine's hardware profile, and name of this machine's clock.
HOST = "host"
HOST_CLOCK = "host"

#: Stages of the avatar's pipeline, each with its unit: before the network's stage, the network's stage, and after it.
BEFORE_INFER: tuple[tuple[str, UnitName], ...] = (("pose", "cpu"), ("raster", "gpu"))
INFER: tuple[str, UnitName] = ("infer", "dsp")
AFTER_INFER: tuple[tuple[str, UnitName], ...] = (("composite", "gpu"), ("present", "cpu"))
#: The stage at whose end a frame's latency ends.
LATENCY_TO = "composite"
#: Frames that need no new picture of the avatars skip the stages between these two stages.
BYPASS = ("pose", "composite")


MEASURED = "measured in this run"
COMPUTED = "computed"
#: Source of a ratio of a measured figure to a computed one.
COMPARED = "measured in this run, over computed"
#: Text in place of a source, if there is no figure for this avatar.
NO_FIGURES = "no figures"
