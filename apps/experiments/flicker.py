"""How restless is the error of successive frames: what a person sees as flicker.

Rule: flicker of a pair of frames is the mean change of the error, |(P_t - G_t) - (P_t-1 - G_t-1)|, with P the picture
and G what it should be; so what moves because the scene moves is none, and an error that stays where it is is none.
An error that moves with the surface counts where it passes over a pixel: surfaces are not followed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from trilane.apps.experiments.calibrated_network import AS_IT_IS, Calibrations
from trilane.apps.experiments.error_by_size import refuse_twice
from trilane.apps.experiments.scene_pictures import MAX_FRAMES, ScenePictures, around, wanted_pictures
from trilane.arrays import F64, U8
from trilane.bench.lib.cast import Cast
from trilane.errors import BadInputError
from trilane.figure_sources import MEASURED
from trilane.near_miss import did_you_mean
from trilane.stages.configure import Checked, Request, configure
from trilane.stages.gpu.texture_array import FILTERS

STEPS = 255
Shown = Callable[[Sequence[int]], Iterable[int]]


def flicker(before: F64, now: F64) -> float:
    """Mean change of the error of two successive frames, in steps of 1/255.

    `before`, `now`: picture minus what it should be, of the same shape, in 0..1.
    """
    return float(np.abs(now - before).mean() * STEPS)


@dataclass
class Row:
    """What was found for one way to make pictures. `changes`: the flicker of each pair of frames."""

    runtime: str
    calibration: str
    texture_filter: str
    pictures: ScenePictures
    before: F64 | None = None
    changes: list[float] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)

    def add(self, error: F64, part: tuple[slice, slice]) -> None:
        """Count a frame whose error (h,w,3) is looked at in `part`, where the avatars of it and the last one are."""
        if self.before is not None:
            self.changes.append(flicker(self.before[part], error[part]))
        self.errors.append(float(np.abs(error[part]).mean() * STEPS))
        self.before = error

    def as_json(self) -> dict[str, Any]:
        """The row of `flicker_by_way`."""
        return {
            "runtime": self.runtime,
            "calibration": self.calibration,
            "texture_filter": self.texture_filter,
            "flicker": fmean(self.changes),
            "worst": max(self.changes),
            "worst_frame": 1 + self.changes.index(max(self.changes)),
            "mae": fmean(self.errors),
        }


def flicker_by_way(
    request: Request,
    frames: int = 12,
    runtimes: Sequence[str] = ("ort",),
    filters: Sequence[str] = ("linear",),
    calibrations: Sequence[str] = (AS_IT_IS,),
    shown: Shown = lambda numbers: numbers,
) -> dict[str, Any]:
    """The flicker of the first `frames` frames of the scene of `request`, by runtime, calibration and texture filter.

    `filters`: names of FILTERS. `calibrations`: `AS_IT_IS` or names of METHODS. `shown`: as of `errors_by_size`.
    Keys: `rows`: `runtime`, `calibration`, `texture_filter`, `flicker` (mean over the pairs of frames), `worst` with
    the later frame of its pair, `worst_frame`, and `mae` of the frames, all in steps of 1/255 where the avatars are;
    `scene_change`: mean change of what the frames should be, there; `against`; `frames`; `sources`; `config`.
    Raises BadInputError, MissingPartError.
    """
    refuse_twice("--runtime", runtimes)
    refuse_twice("--texture-filter", filters)
    refuse_twice("--calibration", calibrations)
    if unknown := next((name for name in filters if name not in FILTERS), None):
        expected = f"one of {', '.join(FILTERS)}"
        raise BadInputError("--texture-filter", repr(unknown), expected, did_you_mean(unknown, FILTERS))
    checked = {runtime: configure(replace(request, runtime=runtime), Path.cwd()) for runtime in runtimes}
    first = next(iter(checked.values()))
    scene = first.config.scene
    if not 2 <= frames <= min(MAX_FRAMES, scene.frames):
        raise BadInputError("--frames", str(frames), f"2 to {min(MAX_FRAMES, scene.frames)}, the scene's frames")
    cast, made = Cast(first), Calibrations(first)
    rows: list[Row] = []
    for (runtime, one), calibration, name in product(checked.items(), calibrations, filters):
        gpu = rows[0].pictures.gpu if rows else None
        pictures = ScenePictures(_filtered(made.changed(one, calibration), name), gpu)
        rows.append(Row(runtime, calibration, name, pictures))
    wanted, against = wanted_pictures(cast, rows[0].pictures.gl)
    numbers = list(range(frames))
    scene_change = _follow(cast, rows, wanted, shown(numbers))
    return {
        "rows": [row.as_json() for row in rows],
        "scene_change": scene_change,
        "against": against,
        "frames": numbers,
        "sources": dict.fromkeys(("rows", "scene_change"), MEASURED),
        "config": {"scene": scene.name, "plan": scene.plan, "size": scene.size, "fps": scene.fps},
    }


def _filtered(checked: Checked, name: str) -> Checked:
    return checked.changed(scene=checked.config.scene.model_copy(update={"texture_filter": name}))


def _follow(cast: Cast, rows: Sequence[Row], wanted: Callable[[int, U8], U8], numbers: Iterable[int]) -> float:
    """Count the frames `numbers` for each of `rows`; how much the scene itself changes, in steps of 1/255."""
    last: F64 | None = None
    boxes_before, changes = cast.boxes(0), []
    for number in numbers:
        boxes = cast.boxes(number)
        if not boxes:
            raise BadInputError("--frames", f"nobody in view in frame {number}", "frames that show an avatar")
        part = around([*boxes_before, *boxes])
        true = wanted(number, rows[0].pictures.background(number)) / 255.0
        if last is not None:
            changes.append(flicker(last[part], true[part]))
        for row in rows:
            row.add(row.pictures.frame(number)[0] / 255.0 - true, part)
        last, boxes_before = true, boxes
    return fmean(changes)
