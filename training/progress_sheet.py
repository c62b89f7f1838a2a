"""Sheets of a training on a capture: held-out frames beside what the avatar paints of them so far.

Rule: frames are taken whole, as they are measured at the end, and painting changes nothing of the training.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from trilane.training.comparison_sheet import side_by_side
from trilane.training.dataset import VALIDATION_SIZE
from trilane.training.float_painter import float_painter
from trilane.training.subject import Subject
from trilane.training.trainable_avatar import TrainableAvatar
from trilane.writing import write_atomically

#: Held-out frames on a sheet.
MOST_FRAMES = 6


def write_sheet(path: Path, avatar: TrainableAvatar, subject: Subject) -> None:
    """Write as PNG: a row for each of some held-out frames, the frame on the left. Without such frames, nothing.

    Raises BadInputError when it cannot be written.
    """
    paint, rows = float_painter(avatar.network, *(level.detach() for level in avatar.texture.levels())), []
    for number in subject.held_out[:: max(1, len(subject.held_out) // MOST_FRAMES)][:MOST_FRAMES]:
        sample = subject.frames.whole_sample(number, VALIDATION_SIZE) if subject.frames is not None else None
        if sample is not None and subject.frames is not None:
            uv, truth = subject.frames.render(sample)
            rows.append(side_by_side((truth, paint(sample, uv))))
    if rows:
        path.parent.mkdir(exist_ok=True)
        with write_atomically(path) as draft:
            Image.fromarray(np.vstack(rows)).save(draft, format="png")
