"""Every hard number, as rows. Rule: the body is the default avatar's, so that the rows are the same everywhere."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

from trilane.apps.experiments.hard_numbers.hard_number import EXACT, HardNumber
from trilane.errors import BadInputError

HOLDS, EXCEEDED = "holds", "FAILS: error above the bound"
#: How many rows `hard_numbers` has.
COUNT = 92


def hard_numbers() -> Iterator[dict[str, Any]]:
    """Rows with `name`, `error`, `bound`, `unit`, `source` (of the bound), `verdict`, `passed`.

    `error` is None where it is no number, which is above every bound.
    Raises MissingPartError where no OpenGL context can be made.
    """
    for case in _cases():
        error = case.error if math.isfinite(case.error) else None
        yield {**case._asdict(), "error": error, "verdict": HOLDS if case.holds else EXCEEDED, "passed": case.holds}


def kept_going(kind: str, cases: Iterable[HardNumber]) -> Iterator[HardNumber]:
    """`cases` of one kind; when code that is tested refuses its input, a row that says so and fails, and no more."""
    try:
        yield from cases
    except (BadInputError, ArithmeticError, ValueError) as error:
        yield HardNumber(f"{kind}, ended by an error: {error}", math.inf, 0.0, "errors", EXACT)


def _cases() -> Iterator[HardNumber]:
    from trilane.apps.experiments.hard_numbers.bodies import body_cases
    from trilane.apps.experiments.hard_numbers.cameras import camera_cases, time_cases
    from trilane.apps.experiments.hard_numbers.rotations import chain_cases, rotation_cases
    from trilane.apps.experiments.hard_numbers.tensors import scene_cases, tensor_cases
    from trilane.avatars.bundle import load_bundle
    from trilane.stages.avatar_assets import load_avatar
    from trilane.stages.gpu.opengl import open_context

    context = open_context(2)
    shaped = load_avatar(load_bundle("default")).shaped
    yield from kept_going("rotations", rotation_cases())
    yield from kept_going("chains of joints", chain_cases(shaped))
    yield from kept_going("bodies", body_cases(shaped))
    yield from kept_going("cameras", camera_cases(shaped))
    yield from kept_going("times", time_cases())
    with context:
        yield from kept_going("tensors", tensor_cases(shaped, context))
    yield from kept_going("scenes", scene_cases())
