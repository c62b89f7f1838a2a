"""How good an avatar is on frames of a capture that training never read.

Rule: what is measured lies in the bundle and runs as in the pipeline; frames are taken whole, nothing is random.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from trilane.avatars.bundle import Bundle, write_manifest
from trilane.training.capture.capture_samples import CaptureRenderer
from trilane.training.dataset import VALIDATION_SIZE
from trilane.training.error_summary import MEANS
from trilane.training.evaluate import integer_painter
from trilane.training.image_error import ImageError, image_error

RUNTIME = "ort"


def frame_errors(bundle: Bundle, renderer: CaptureRenderer, numbers: Sequence[int], threads: int) -> list[ImageError]:
    """The error of `bundle` on each of the frames `numbers` that shows the person, against the frame and its mask.

    `threads`: of the runtime. Raises BadInputError, MissingPartError.
    """
    paint = integer_painter(renderer, bundle, RUNTIME, threads)
    errors = []
    for number in numbers:
        sample = renderer.whole_sample(number, VALIDATION_SIZE)
        if sample is None:
            continue
        uv, truth = renderer.render(sample)
        errors.append(image_error(paint(sample, uv), truth))
    return [error for error in errors if error is not None]


def error_facts(errors: Sequence[ImageError]) -> dict[str, Any]:
    """Means of `errors`, and how they were measured: keys `runtime`, `size`, `frames`, and those of an error."""
    names = [name for name in MEANS if name != "background"]
    means = (
        {name: round(float(np.mean([getattr(error, name) for error in errors])), 4) for name in names} if errors else {}
    )
    return {"runtime": RUNTIME, "size": VALIDATION_SIZE, "frames": len(errors), **means}


def write_held_out_error(bundle: Bundle, facts: dict[str, Any]) -> None:
    """Put `facts` of held-out frames into the provenance of the manifest of `bundle`."""
    provenance = bundle.manifest.provenance | {"held_out_error": facts}
    write_manifest(bundle.folder, bundle.manifest.model_copy(update={"provenance": provenance}))
