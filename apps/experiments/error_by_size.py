"""How fast is each tensor size on each runtime, and how large is its image error?

Rule: all rows use the same frames and the same part of the picture, where the avatars are. The pictures are made
first, which also warms up. After that, each round times every frame in the scene's order: once for each row, before the
next frame. Time without a core does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from statistics import fmean, median
from typing import Any

from trilane.apps.experiments.picture_errors import ErrorFigures, figures, require_metrics
from trilane.apps.experiments.scene_pictures import ScenePictures, around, spread, wanted_pictures
from trilane.bench.lib.cast import Cast
from trilane.bench.lib.picture_error import psnr_of_frames
from trilane.errors import BadInputError
from trilane.scheduler.stats import median_interval
from trilane.stages.configure import Checked, configure
from trilane.stages.run_options import RunOptions
from trilane.units import MEASURED

#: Number of jobs that a 95 % interval needs. The median lies between the extremes of n jobs with probability 1 - 2/2^n.
LEAST_JOBS = 6


@dataclass(frozen=True)
class SizeRow:
    """The results of one tensor size on one runtime.

    `size`: size as given by the user. `runtime`: name of the runtime. `pictures`: object that makes the frames.
    `threads`: number of the runtime's threads. `infer_ms`: time of the infer stages for each timed frame. `frame_ms`:
    time of all stages except present, for each timed frame. `errors`: errors of each frame's picture.
    """

    size: str
    runtime: str
    pictures: ScenePictures
    threads: int
    infer_ms: list[float] = field(default_factory=list)
    frame_ms: list[float] = field(default_factory=list)
    errors: list[ErrorFigures] = field(default_factory=list)

    def time(self, number: int) -> None:
        """Make frame `number`, and append its times to `infer_ms` and `frame_ms`."""
        _, times = self.pictures.frame(number)
        self.infer_ms.append(sum(ms for stage, ms in times.items() if stage.startswith("infer")))
        self.frame_ms.append(sum(times.values()))

    def as_json(self) -> dict[str, Any]:
        """Return the results as one of the `rows` of `measure`."""
        low, high = median_interval(self.infer_ms) if len(self.infer_ms) >= LEAST_JOBS else (None, None)
        ssim = [error.ssim for error in self.errors if error.ssim is not None]
        return {
            "size": self.size,
            "runtime": self.runtime,
            "threads": self.threads,
            "infer_ms": median(self.infer_ms),
            "infer_low_ms": low,
            "infer_high_ms": high,
            "frame_ms": median(self.frame_ms),
            **psnr_of_frames([error.psnr_db for error in self.errors]),
            "mae": fmean(error.mae for error in self.errors),
            "ssim": fmean(ssim) if ssim else None,
            "flip": fmean(error.flip for error in self.errors),
        }


def measure(
    scene: str = "default",
    size: tuple[str, ...] = ("128", "256", "512"),
    runtime: tuple[str, ...] = ("ort", "openvino"),
    frames: int = 8,
    rounds: int = 3,
) -> dict[str, Any]:
    """Return image error and time of `frames` frames, evenly spread over the scene, for each tensor size and runtime.

    Each frame is made once for its error, then `rounds` times to measure times.

    Keys of a row in `rows`: `size`, `runtime`, `threads`. `infer_ms`: median time of the infer stage, with its 95 %
    interval `infer_low_ms`, `infer_high_ms` (null for fewer than 6 jobs). `frame_ms`: median time of all stages except
    present. Errors cover the part of the picture with avatars. Means over the frames: `psnr_db`, `mae` (steps of
    1/255), `ssim`, `flip`. `worst_psnr_db`: PSNR of the worst frame. `p1_psnr_db`: 1st percentile of the PSNR.

    Other keys: `against`: name of the reference. `frames`: numbers of the frames. `empty_frames`: frames with nobody in
    view, which do not count. `sources`: source of the rows. `config`: scene, plan, filter of the texture, rounds.

    Raises BadInputError for an option out of range, an unknown name, a value given twice, or nobody in view. Raises
    MissingPartError if the libraries of the metrics, a runtime or OpenGL are missing.
    """
    require_metrics()
    refuse_twice("--size", size)
    refuse_twice("--runtime", runtime)
    if rounds < 1:
        raise BadInputError("--rounds", str(rounds), "at least 1")
    asked = [RunOptions(scene=scene, size=one, runtime=name, hud=False) for one, name in product(size, runtime)]
    checked = [configure(one, Path.cwd()) for one in asked]
    first, shown = checked[0], checked[0].config.scene
    numbers, cast, rows = spread(shown.frames, frames), Cast(first), _rows(asked, checked)
    wanted, against = wanted_pictures(cast, rows[0].pictures.gl)
    empty = []
    for number in numbers:
        boxes = cast.boxes(number)
        if not boxes:
            empty.append(number)
            continue
        part = around(boxes, rows[0].pictures.output)
        true = wanted(number, rows[0].pictures.background(number))[part] / 255.0
        for row in rows:
            row.errors.append(figures(row.pictures.frame(number)[0][part] / 255.0, true))
    seen = [number for number in numbers if number not in empty]
    if not seen:
        raise BadInputError(f"scene {shown.name}", "nobody in view in any of the frames", "an avatar in the picture")
    for _, number, row in product(range(rounds), seen, rows):
        row.time(number)
    return {
        "rows": [row.as_json() for row in rows],
        "against": against,
        "frames": numbers,
        "empty_frames": empty,
        "sources": {"rows": MEASURED},
        "config": {"scene": shown.name, "plan": shown.plan, "texture_filter": shown.texture_filter, "rounds": rounds},
    }


def refuse_twice(option: str, values: Sequence[str]) -> None:
    """Raise BadInputError if `values` is empty, or if a value occurs twice.

    `option`: name of the option for the message.
    """
    if not values or len(set(values)) < len(values):
        raise BadInputError(option, ", ".join(values) or "none", "one or more, each once")


def _rows(asked: Sequence[RunOptions], checked: Sequence[Checked]) -> list[SizeRow]:
    rows: list[SizeRow] = []
    for request, one in zip(asked, checked, strict=True):
        pictures = ScenePictures(one, rows[0].pictures.gpu if rows else None)
        rows.append(SizeRow(str(request.size), one.config.runtime, pictures, one.config.units["dsp"].threads))
    return rows
