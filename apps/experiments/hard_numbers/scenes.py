"""Scenes that change everything from one frame to the next: camera, pose, rectangle, tensor shape, who is in view.

Rule: a frame is the same to the byte whatever was drawn before it, so the bound is 0; the reference is what stages
draw that were made for this frame alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from trilane.apps.experiments.drawn_tensors import DrawnTensors
from trilane.apps.experiments.hard_numbers.hard_number import EXACT, HardNumber
from trilane.stages.configure import Checked, configure
from trilane.stages.run_options import RunOptions

#: Scene -> frames, each as unlike the one before as the scene has them.
JUMPS = {"walk-past": (0, 180, 30, 299, 0), "leave-and-return": (0, 150, 20, 240), "top-to-floor": (0, 90, 180, 0)}
RUNTIME = "ort"


def scene_cases() -> Iterator[HardNumber]:
    """A row for each scene of `JUMPS`."""
    for scene, frames in JUMPS.items():
        checked = configure(RunOptions(scene=scene, runtime=RUNTIME), Path.cwd())
        last = checked.config.scene.frames - 1
        numbers = [min(frame, last) for frame in frames]
        name = f"{scene}: frames {', '.join(map(str, numbers))} one after the other"
        yield HardNumber(name, float(_differing(checked, numbers)), 0.0, "bytes of the tensor", EXACT)


def _differing(checked: Checked, numbers: list[int]) -> int:
    """How many bytes of the tensors differ from those of stages that drew no other frame."""
    used, found = DrawnTensors(checked), 0
    for number in numbers:
        after, fresh = used.tensor(number), DrawnTensors(checked).tensor(number)
        found += after.size if after.shape != fresh.shape else int(np.count_nonzero(after != fresh))
    return found
