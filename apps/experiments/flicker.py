"""Flicker: how much does the error change between successive frames?

Rule: the flicker of a pair of frames is the mean change of the error, |(P_t - G_t) - (P_t-1 - G_t-1)|. P is the
picture, and G is its reference. Therefore neither the motion of the scene nor an error that stays in place is flicker.
An error that moves with a surface counts as flicker, because surfaces are not followed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from trilane.apps.avatar_files import Calibrations
from trilane.apps.experiments.error_by_size import refuse_twice
from trilane.apps.experiments.scene_pictures import ScenePictures, around, wanted_pictures
from trilane.arrays import F64, U8
from trilane.bench.lib.cast import Cast
from trilane.errors import BadInputError, did_you_mean
from trilane.stages.configure import Checked, configure
from trilane.stages.gpu.raster import FILTERS
from trilane.stages.run_options import AS_IT_IS, RunOptions
from trilane.units import CALIBRATION_METHODS, MEASURED

STEPS = 255


def flicker(before: F64, now: F64) -> float:
    """Return the mean change of the error from one frame to the next, in steps of 1/255.

    `before`, `now`: errors (h,w,3) of two successive frames: picture minus reference, both in 0..1.
    """
    return float(np.abs(now - before).mean() * STEPS)


class FlickerRow:
    """The results of one variant: a runtime, a calibration and a filter of the neural texture.

    `pictures`: object that makes the variant's pictures. `changes`: flicker of each pair of successive frames, in
    order.
    """

    def __init__(self, runtime: str, calibration: str, texture_filter: str, pictures: ScenePictures) -> None:
        self.pictures = pictures
        self.changes: list[float] = []
        self._variant = {"runtime": runtime, "calibration": calibration, "texture_filter": texture_filter}
        self._before: F64 | None = None
        self._errors: list[float] = []

    def add(self, error: F64, part: tuple[slice, slice]) -> None:
        """Count the next frame.

        `error` (h,w,3): picture minus reference. `part`: rows and columns that contain the avatars in this frame and in
        the frame before.
        """
        if self._before is not None:
            self.changes.append(flicker(self._before[part], error[part]))
        self._errors.append(float(np.abs(error[part]).mean() * STEPS))
        self._before = error

    def as_json(self) -> dict[str, Any]:
        """Return the variant's results as one of the `rows` of `measure`. Call it after two or more frames."""
        return {
            **self._variant,
            "flicker": fmean(self.changes),
            "worst": max(self.changes),
            "worst_frame": 1 + self.changes.index(max(self.changes)),
            "mae": fmean(self._errors),
        }


def measure(
    scene: str = "default",
    size: str = "256",
    frames: int = 12,
    runtime: tuple[str, ...] = ("ort", "openvino"),
    calibration: tuple[str, ...] = (AS_IT_IS,),
    texture_filter: tuple[str, ...] = ("linear",),
) -> dict[str, Any]:
    """Return the flicker of the first `frames` frames of a scene, by runtime, calibration and texture filter.

    Figures cover the part of the picture with avatars, in steps of 1/255.

    Keys of a row in `rows`: `runtime`, `calibration`, `texture_filter`. `flicker`: mean over the pairs of frames.
    `worst`: largest flicker of a pair. `worst_frame`: number of the later frame of this pair. `mae`: mean absolute
    error of the frames.

    Other keys: `scene_change`: mean change of the reference between successive frames. `against`: name of the
    reference. `frames`: numbers of the frames. `sources`: source of the figures. `config`: scene, plan, size, frames a
    second.

    Raises BadInputError for an option out of range, an unknown name, a value given twice, or a frame with nobody in
    view. Raises MissingPartError if a runtime or OpenGL is missing.
    """
    refuse_twice("--runtime", runtime)
    refuse_twice("--texture-filter", texture_filter)
    refuse_twice("--calibration", calibration)
    _refuse_unknown("--texture-filter", texture_filter, FILTERS)
    _refuse_unknown("--calibration", calibration, (AS_IT_IS, *CALIBRATION_METHODS))
    checked = {
        name: configure(RunOptions(scene=scene, size=size, runtime=name, hud=False), Path.cwd()) for name in runtime
    }
    first = next(iter(checked.values()))
    shown = first.config.scene
    if not 2 <= frames <= shown.frames:
        raise BadInputError("--frames", str(frames), f"2 to {shown.frames}, the scene's frames")
    cast, made = Cast(first), Calibrations(first)
    # Calibration views are drawn in an OpenGL context of their own, before the stages make theirs.
    variants = [
        (engine, method, name, _filtered(made.changed(one, method), name))
        for (engine, one), method, name in product(checked.items(), calibration, texture_filter)
    ]
    rows: list[FlickerRow] = []
    for engine, method, name, one in variants:
        rows.append(FlickerRow(engine, method, name, ScenePictures(one, rows[0].pictures.gpu if rows else None)))
    wanted, against = wanted_pictures(cast, rows[0].pictures.gl)
    numbers = list(range(frames))
    scene_change = _follow(cast, rows, wanted, numbers)
    return {
        "rows": [row.as_json() for row in rows],
        "scene_change": scene_change,
        "against": against,
        "frames": numbers,
        "sources": dict.fromkeys(("rows", "scene_change"), MEASURED),
        "config": {"scene": shown.name, "plan": shown.plan, "size": shown.size, "fps": shown.fps},
    }


def _refuse_unknown(option: str, names: Sequence[str], known: Iterable[str]) -> None:
    possible = list(known)
    if unknown := next((name for name in names if name not in possible), None):
        raise BadInputError(option, repr(unknown), f"one of {', '.join(possible)}", did_you_mean(unknown, possible))


def _filtered(checked: Checked, name: str) -> Checked:
    return checked.changed(scene=checked.config.scene.model_copy(update={"texture_filter": name}))


def _follow(cast: Cast, rows: Sequence[FlickerRow], wanted: Callable[[int, U8], U8], numbers: Iterable[int]) -> float:
    """Count the frames `numbers` for each of `rows`, and return the mean change of the reference, in steps of 1/255.

    `cast`: avatars of the scene. `wanted`: function that makes the reference from a frame's number and background.
    Raises BadInputError for a frame with nobody in view.
    """
    last: F64 | None = None
    boxes_before, changes = cast.boxes(0), []
    for number in numbers:
        boxes = cast.boxes(number)
        if not boxes:
            raise BadInputError("--frames", f"nobody in view in frame {number}", "frames that show an avatar")
        part = around([*boxes_before, *boxes], rows[0].pictures.output)
        true = wanted(number, rows[0].pictures.background(number)) / 255.0
        if last is not None:
            changes.append(flicker(last[part], true[part]))
        for row in rows:
            row.add(row.pictures.frame(number)[0] / 255.0 - true, part)
        last, boxes_before = true, boxes
    return fmean(changes)
