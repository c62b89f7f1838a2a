"""Every hard number, as rows. Rule: the body is the default avatar's, so that the rows are the same everywhere."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from trilane.apps.experiments.hard_numbers.hard_number import HardNumber

HOLDS, EXCEEDED = "holds", "FAILS: error above the bound"
#: How many rows `hard_numbers` has.
COUNT = 91


def hard_numbers() -> Iterator[dict[str, Any]]:
    """Rows with `name`, `error`, `bound`, `unit`, `source` (of the bound), `verdict`, `passed`.

    Raises MissingPartError where no OpenGL context can be made.
    """
    for case in _cases():
        yield {**case._asdict(), "verdict": HOLDS if case.holds else EXCEEDED, "passed": case.holds}


def _cases() -> Iterator[HardNumber]:
    from trilane.apps.experiments.hard_numbers.bodies import body_cases
    from trilane.apps.experiments.hard_numbers.cameras import camera_cases
    from trilane.apps.experiments.hard_numbers.chains import chain_cases
    from trilane.apps.experiments.hard_numbers.rotations import rotation_cases
    from trilane.apps.experiments.hard_numbers.scenes import scene_cases
    from trilane.apps.experiments.hard_numbers.tensors import tensor_cases
    from trilane.apps.experiments.hard_numbers.times import time_cases
    from trilane.avatars.bundle import load_bundle
    from trilane.stages.avatar_assets import load_avatar
    from trilane.stages.gpu.opengl_context import open_context

    context = open_context(2)
    shaped = load_avatar(load_bundle("default")).shaped
    yield from rotation_cases()
    yield from chain_cases(shaped)
    yield from body_cases(shaped)
    yield from camera_cases(shaped)
    yield from time_cases()
    with context:
        yield from tensor_cases(shaped, context)
    yield from scene_cases()
