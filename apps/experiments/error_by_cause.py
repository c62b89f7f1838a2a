"""How far is a run's picture from the reference, and which cause costs how much?

Rule: two counts, and what each of them leaves. One at a time: each cause alone in the reference (with what it needs),
whose sum need not be the whole. In order: each added to those before; the picture then goes from the reference's to
the run's in steps, so differences of MAE, differences of mean squares and the products of each step with the whole add
up to the whole by construction, but for float64's rounding. Figures are of the region that holds the avatars.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from trilane.apps.experiments.causes import BODY, NOTHING, WHAT, Cause, needs, up_to
from trilane.apps.experiments.heat_maps import write_heat_map
from trilane.apps.experiments.picture_errors import LEAST_MS_SSIM_PX, ErrorFigures, Perceived, figures, require_metrics
from trilane.apps.experiments.reference_path import HALF, Moment, ReferenceFrame, ReferencePath
from trilane.arrays import F64
from trilane.bench.lib.layers import Box, Layer, laid_over
from trilane.bench.lib.picture_error import psnr_db
from trilane.errors import BadInputError
from trilane.figure_sources import MEASURED
from trilane.shapes import Shape
from trilane.stages.configure import Checked

MAX_FRAMES = 10_000
STEPS = 255
#: Pairs of a picture and the one that it is compared with, besides the causes.
WHOLE, REMAINDER = "whole", "remainder"
Frames = Callable[[Sequence[int]], Iterable[int]]


def error_by_cause(
    checked: Checked,
    frames: int,
    out: Path | None = None,
    shown: Frames = lambda numbers: numbers,
    lpips: Perceived | None = None,
) -> dict[str, Any]:
    """The error of `frames` frames, evenly spread over the scene in `checked`, split by cause.

    `out`: a folder for heat maps; None for none. `shown`: what the frames' numbers go through, such as a progress bar.
    `lpips`: says LPIPS; None: it is not said.
    Keys: `causes`, a row of each: `cause`, `what`, `needs`, `alone` and `step` (figures against the picture without
    the cause: in the reference, and in the sequence), `so_far` (against the reference), `adds` (`mae`, `square`,
    `product`), `moved` of causes of the body; `whole`; `sums`; `remainder` of the run's own frames against the
    sequence's end; `truth`; `frames`, `empty_frames` (nobody in view), `network`, `sources`, `config`.
    Raises BadInputError, MissingPartError.
    """
    if not 1 <= frames <= MAX_FRAMES:
        raise BadInputError("--frames", str(frames), f"1 to {MAX_FRAMES}")
    require_metrics()
    path = ReferencePath(checked)
    truth = _truth(path)
    split, empty, numbers = _Split(path.output, out, lpips), [], _spread(checked.config.scene.frames, frames)
    for number in shown(numbers):
        moment = path.moment(number)
        if not moment.boxes:
            empty.append(number)
            continue
        split.add(moment)
        if truth is not None:
            split.add_truth(moment, truth.layers(number))
    scene = checked.config.scene
    if len(empty) == len(numbers):
        raise BadInputError(f"scene {scene.name}", "nobody in view in any of the frames", "an avatar in the picture")
    return {
        **split.document(),
        "frames": numbers,
        "empty_frames": empty,
        "network": "; ".join(path.networks),
        "sources": dict.fromkeys(("causes", "whole", "sums", "remainder", "truth"), MEASURED),
        "config": {"scene": scene.name, "plan": scene.plan, "size": scene.size, "runtime": checked.config.runtime},
    }


def region(boxes: Sequence[Box], output: Shape) -> Box:
    """The smallest rectangle of a picture of `output` that holds `boxes`, with room for MS-SSIM where there is any."""
    top, left = min(box.top for box in boxes), min(box.left for box in boxes)
    bottom, right = max(box.bottom for box in boxes), max(box.right for box in boxes)
    rows, columns = _with_room(top, bottom, output[0]), _with_room(left, right, output[1])
    return Box(rows[0], columns[0], rows[1], columns[1])


def _with_room(first: int, last: int, side: int) -> tuple[int, int]:
    length = min(max(last - first, LEAST_MS_SSIM_PX), side)
    begin = min(max((first + last - length) // 2, 0), side - length)
    return begin, begin + length


def _spread(total: int, frames: int) -> list[int]:
    count = min(frames, total)
    return [index * total // count for index in range(count)]


def _truth(path: ReferencePath) -> Any:
    """The clothed bodies of the scene, where they are known; else None."""
    from trilane.bench.lib.true_picture import true_pictures

    return true_pictures(path.cast, path.gl)


@dataclass
class _Pooled:
    """Figures of pairs of pictures: MAE and mean square over all pixels, of the others the mean over the frames."""

    lpips: Perceived | None = None
    values: int = 0
    absolute: float = 0.0
    square: float = 0.0
    each: list[ErrorFigures] = field(default_factory=list)

    def add(self, picture: ReferenceFrame, reference: ReferenceFrame) -> None:
        difference = picture.picture - reference.picture
        self.values += difference.size
        self.absolute += float(np.abs(difference).sum())
        self.square += float((difference**2).sum())
        self.each.append(figures(picture.picture, reference.picture, picture.mask, reference.mask, self.lpips))

    @property
    def mae(self) -> float:
        """In steps of 1/255."""
        return STEPS * self.absolute / self.values if self.values else 0.0

    @property
    def mean_square(self) -> float:
        """In squares of steps of 1/255."""
        return STEPS**2 * self.square / self.values if self.values else 0.0

    def as_json(self) -> dict[str, float | None]:
        means = {name: _mean([one.as_json()[name] for one in self.each]) for name in ErrorFigures.__annotations__}
        return {**means, "mae": self.mae, "square": self.mean_square, "psnr_db": psnr_db(self.mean_square / STEPS**2)}


@dataclass
class _Moved:
    """How far a cause moves the vertices of the avatars that are seen."""

    largest_mm: float = 0.0
    largest_px: float = 0.0
    sum_mm: float = 0.0
    count: int = 0

    def add(self, with_cause: F64, reference: F64, clip: F64, output: Shape) -> None:
        moved = np.linalg.norm(with_cause - reference, axis=1) * 1000
        self.largest_mm = max(self.largest_mm, float(moved.max()))
        self.sum_mm, self.count = self.sum_mm + float(moved.sum()), self.count + len(moved)
        pixels, on_screen = _pixels(reference, clip, output)
        if on_screen.any():
            apart = np.linalg.norm(_pixels(with_cause, clip, output)[0] - pixels, axis=1)
            self.largest_px = max(self.largest_px, float(apart[on_screen].max()))

    def as_json(self) -> dict[str, float]:
        mean = self.sum_mm / self.count if self.count else 0.0
        return {"largest_mm": self.largest_mm, "mean_mm": mean, "largest_px": self.largest_px}


def _pixels(vertices: F64, clip: F64, output: Shape) -> tuple[F64, Any]:
    """Where `vertices` (V,3) are on the picture, (V,2) pixels, and which are on it, (V,)."""
    x, y, _, w = (np.c_[vertices, np.ones(len(vertices))] @ clip.T).T
    in_front = w > 0
    place = np.stack([x, y], axis=1) / np.where(in_front, w, 1.0)[:, None]
    return place * [output[1] / 2, output[0] / 2], in_front & (np.abs(place) <= 1).all(axis=1)


class _Split:
    """What was counted of the frames that were added."""

    def __init__(self, output: Shape, out: Path | None, lpips: Perceived | None = None) -> None:
        self._output, self._out = output, out
        self._alone, self._step, self._so_far = ({cause: _Pooled(lpips) for cause in Cause} for _ in range(3))
        self._products = dict.fromkeys(Cause, 0.0)
        self._moved = {cause: _Moved() for cause in Cause if cause in BODY}
        self._remainder = _Pooled(lpips)
        self._truth = {"reference": _Pooled(lpips), "run": _Pooled(lpips)}

    def add(self, moment: Moment) -> None:
        """Count a frame in which somebody is seen."""
        box = region(moment.boxes, self._output)
        reference = _cut(moment.frame(NOTHING), box)
        end = _cut(moment.frame(frozenset(Cause)), box)
        whole, before = end.picture - reference.picture, reference
        for cause in Cause:
            without = _cut(moment.frame(needs(cause)), box)
            alone = _cut(moment.frame(needs(cause) | {cause}), box)
            self._alone[cause].add(alone, without)
            now = _cut(moment.frame(up_to(cause)), box)
            self._step[cause].add(now, before)
            self._so_far[cause].add(now, reference)
            self._products[cause] += float(((now.picture - before.picture) * whole).sum())
            before = now
            self._show(moment.number, cause, alone, without)
        for cause, moved in self._moved.items():
            for index in moment.seen:
                with_cause, reference_body = (moment.vertices(index, one) for one in (frozenset({cause}), NOTHING))
                moved.add(with_cause, reference_body, moment.clip(index), self._output)
        own = _cut(_run(moment), box)
        self._remainder.add(own, end)
        self._show(moment.number, WHOLE, own, reference)

    def add_truth(self, moment: Moment, true: Sequence[Layer]) -> None:
        """Count a frame against its ground truth, which is laid over the frame's background."""
        box = region(moment.boxes, self._output)
        picture, cover = laid_over(moment.background, true)
        wanted = _cut(ReferenceFrame(moment.number, picture, cover >= HALF, moment.boxes), box)
        for name, frame in (("reference", moment.frame(NOTHING)), ("run", _run(moment))):
            shown = _cut(frame, box)
            self._truth[name].add(shown, wanted)
            self._show(moment.number, f"{name} against truth", shown, wanted)

    def document(self) -> dict[str, Any]:
        """The figures, under the keys of `error_by_cause`."""
        rows = [self._row(cause, before) for before, cause in zip([None, *Cause], Cause, strict=False)]
        last = list(Cause)[-1]
        whole = self._so_far[last]
        alone = {"mae": sum(x.mae for x in self._alone.values()), "square": _sum(self._alone, "mean_square")}
        in_order = {key: sum(row["adds"][key] for row in rows) for key in ("mae", "square", "product")}
        return {
            "causes": rows,
            "whole": whole.as_json(),
            "sums": {
                "in_order": in_order,
                "alone": alone,
                "left_in_order": {
                    "mae": whole.mae - in_order["mae"],
                    "square": whole.mean_square - in_order["square"],
                    "product": whole.mean_square - in_order["product"],
                },
                "left_alone": {"mae": whole.mae - alone["mae"], "square": whole.mean_square - alone["square"]},
            },
            "remainder": self._remainder.as_json(),
            "truth": {name: one.as_json() for name, one in self._truth.items()} if self._truth["run"].values else None,
        }

    def _row(self, cause: Cause, before: Cause | None) -> dict[str, Any]:
        now = self._so_far[cause]
        then = _Pooled() if before is None else self._so_far[before]
        product = STEPS**2 * self._products[cause] / now.values if now.values else 0.0
        return {
            "cause": str(cause),
            "what": WHAT[cause],
            "needs": [str(one) for one in Cause if one in needs(cause)],
            "alone": self._alone[cause].as_json(),
            "step": self._step[cause].as_json(),
            "so_far": now.as_json(),
            "adds": {"mae": now.mae - then.mae, "square": now.mean_square - then.mean_square, "product": product},
            "moved": self._moved[cause].as_json() if cause in self._moved else None,
        }

    def _show(self, number: int, what: str, picture: ReferenceFrame, reference: ReferenceFrame) -> None:
        if self._out is not None:
            name = f"frame-{number:05d}-{what.replace(' ', '-').lower()}.png"
            write_heat_map(self._out / name, f"frame {number}, {what}", picture.picture, reference.picture)


def _run(moment: Moment) -> ReferenceFrame:
    """The run's own frame; its mask is that of the sequence's end."""
    return ReferenceFrame(moment.number, moment.own, moment.frame(frozenset(Cause)).mask, moment.boxes)


def _cut(frame: ReferenceFrame, box: Box) -> ReferenceFrame:
    part = np.s_[box.top : box.bottom, box.left : box.right]
    return ReferenceFrame(frame.number, frame.picture[part], frame.mask[part], frame.boxes)


def _sum(pooled: Mapping[Cause, _Pooled], name: str) -> float:
    return sum(float(getattr(one, name)) for one in pooled.values())


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
