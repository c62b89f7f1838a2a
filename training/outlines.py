"""Finds the offsets of a subject: views of it are drawn, measured, and drawn again with what was found.

Rule: only views that training may read are used, and the same seed finds the same offsets.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trilane.arrays import F32
from trilane.avatars.bundle import as_kept, read_offsets, save_offsets
from trilane.training.dataset import plan_training
from trilane.training.stand_off import Outline, measured_heights, smooth_normals, stand_off
from trilane.training.subject import Subject
from trilane.writing import write_atomically

#: Views that are measured, and rounds: the second draws the body with what the first has found, the third corrects it.
VIEWS, ROUNDS = 300, 3
#: Beside the seeds of samples.
SEED = 7
#: Views that are measured before all of them are, for what they will take.
TRIED = 4


def subject_with_offsets(
    subject: Subject, path: Path, seed: int, report: Callable[[str], None], track: Callable[[Any], Any] = iter
) -> Subject:
    """`subject`, drawn with the offsets in the file `path`, which are measured and written where it is missing.

    `seed`: of the views. `report`: takes a line that says what measuring takes. `track`: wraps the views of each round
    to show progress.
    """
    if not path.exists():
        offsets = measured_offsets(subject, seed, report, track)
        with write_atomically(path) as draft, draft.open("wb") as file:
            save_offsets(file, offsets)
    return subject.with_offsets(read_offsets(path, len(subject.shaped.vertices)))


def measured_offsets(
    subject: Subject, seed: int, report: Callable[[str], None], track: Callable[[Any], Any] = iter
) -> F32:
    """(V,3) metres: how far what the masks show stands off the skin of `subject`."""
    samples = plan_training(subject.renderer, VIEWS, seed + SEED)
    report(_cost(subject, samples))
    for _ in range(ROUNDS):
        found = stand_off(subject.shaped, outlines(subject, track(samples)))
        subject = subject.with_offsets(as_kept(found.offsets))
    assert subject.person.offsets is not None
    return subject.person.offsets


def _cost(subject: Subject, samples: Sequence[Any]) -> str:
    """What measuring `samples` in all rounds will take, by some that are measured."""
    tried = samples[:: max(1, len(samples) // TRIED)][:TRIED]
    normals = smooth_normals(subject.shaped.vertices.astype(np.float64), subject.shaped.body.faces.astype(np.int64))
    start = time.monotonic()
    for outline in outlines(subject, tried):
        measured_heights(subject.shaped, normals, outline)
    seconds = (time.monotonic() - start) / len(tried) * len(samples) * ROUNDS
    return (
        f"how far clothes and hair stand off: {len(samples)} views, {ROUNDS} times: about {seconds:.0f} s"
        f" (by {len(tried)} that were measured)"
    )


def outlines(subject: Subject, samples: Sequence[Any]) -> Iterator[Outline]:
    """What `samples` show of the outline of `subject`."""
    renderer: Any = subject.renderer
    for sample in samples:
        uv, rgba = renderer.render(sample)
        view, placed = renderer.placed(sample)
        joints, feature = np.array(placed.joints), placed.feature
        mask = rgba[..., 3].astype(np.float32) / 255
        yield Outline(joints, feature, view, np.asarray(placed.clip_projection), uv[..., 2] > 0, mask)
