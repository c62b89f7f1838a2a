"""How far is a run's picture from the reference, and how much does each cause contribute?

Rule: causes are counted in two ways, and each way states its remainder. Alone: each cause is switched on in the
reference, with only the causes that it needs. The errors need not sum to the whole error. In order: causes are switched
on one after the other, so the picture changes in steps from the reference to the run's picture. Three figures of the
steps each sum to the whole error, up to float64's rounding: the change of the MAE, the change of the mean square, and
the product of the step's difference with the whole difference. All figures cover the region with the avatars.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from trilane.apps.experiments.picture_errors import ErrorFigures, Perceived, figures, require_metrics
from trilane.apps.experiments.reference_path import (
    BODY,
    HALF,
    NOTHING,
    WHAT,
    Cause,
    ReferenceFrame,
    ReferenceMoment,
    ReferencePath,
    needs,
    up_to,
)
from trilane.apps.experiments.scene_pictures import region, spread
from trilane.arrays import F64, U8, Shape, psnr_db
from trilane.bench.lib.cast import Box, RasterLayer, laid_over
from trilane.errors import BadInputError
from trilane.stages.configure import Checked
from trilane.units import MEASURED
from trilane.writing import write_bytes

STEPS = 255
#: Name of the heat map of the run against the reference.
WHOLE = "whole"
Frames = Callable[[Sequence[int]], Iterable[int]]
#: Colours of the colour bar, from no difference to the largest: black, violet, red, orange, pale yellow.
COLOURS = np.array([(0, 0, 4), (87, 16, 110), (188, 55, 84), (249, 142, 9), (252, 255, 164)], np.float64)
LARGEST_FACTOR = 1024
#: Share of the pixels whose differences must lie within the range of the colour bar.
ON_THE_BAR = 0.999
#: Least length of a panel's longer side, pixels. A smaller panel is enlarged by a whole factor.
LEAST_SIDE_PX = 320
BORDER_PX, LINE_PX, BAR_PX, FONT_PX, SCALE_WIDTH_PX = 8, 18, 16, 13, 56


def error_by_cause(
    checked: Checked,
    frames: int,
    out: Path | None = None,
    shown: Frames = lambda numbers: numbers,
    lpips: Perceived | None = None,
) -> dict[str, Any]:
    """Return the error of `frames` frames, evenly spread over the scene in `checked`, split by cause.

    `out`: folder for heat maps; None for no maps. `shown`: function that iterates over the frames' numbers, such as a
    progress bar. `lpips`: function that computes LPIPS; None leaves LPIPS out.

    Keys of the result:
    `causes`: a row for each cause, in the order of `Cause`.
    `whole`: error of the frame with all causes against the reference.
    `sums`: `in_order` and `alone` are sums over the causes; `left_in_order` and `left_alone` are `whole` minus them.
    `remainder`: error of the run's own frame against the frame with all causes.
    `truth`: errors of the reference and of the run against the ground truth; None if the scene has no ground truth.
    `frames`: numbers of the frames. `empty_frames`: frames with nobody in view, which do not count.
    `network`: names of the networks that paint the reference, as one text. `sources`: source of each key.
    `config`: name, plan, size and runtime of the scene.

    Keys of a row:
    `cause`, `what`: name and description of the cause. `needs`: names of the causes that the cause needs.
    `alone`: error of the picture with the cause and its needs against the picture with the needs.
    `step`: error of the picture with all causes up to this cause against the picture without this cause.
    `so_far`: error of the picture with all causes up to this cause against the reference.
    `adds`: what the step adds to the whole error, as `mae`, `square` and `product`.
    `moved`: how far the cause moves vertices; None for a cause that moves none.

    Raises BadInputError for a number of frames out of range, nobody in view, or a folder that cannot be written. Raises
    MissingPartError if the libraries of the metrics or OpenGL are missing.
    """
    numbers = spread(checked.config.scene.frames, frames)
    require_metrics()
    path = ReferencePath(checked)
    truth = _truth(path)
    split, empty = _Split(path.output, out, lpips), []
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


def _truth(path: ReferencePath) -> Any:
    """Return the object that makes the pictures of the ground truth; None if the scene has no ground truth.

    The ground truth is the clothed bodies of the scene. They are known for bundled avatars only.
    """
    from trilane.bench.lib.full_picture import true_pictures

    return true_pictures(path.cast, path.gl)


@dataclass
class _Pooled:
    """The errors of the added frames.

    MAE, mean square and PSNR are over the pixels of all frames; other figures are means over the frames.
    `lpips`: function that computes LPIPS; None leaves LPIPS out.
    `values`: number of the compared values. `absolute`, `square`: sums of their absolute and squared differences.
    `each`: figures of each frame.
    """

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
        """The mean absolute error, in steps of 1/255."""
        return STEPS * self.absolute / self.values if self.values else 0.0

    @property
    def mean_square(self) -> float:
        """The mean square error, in squares of steps of 1/255."""
        return STEPS**2 * self.square / self.values if self.values else 0.0

    def as_json(self) -> dict[str, float | None]:
        means = {name: _mean([one.as_json()[name] for one in self.each]) for name in ErrorFigures.__annotations__}
        return {**means, "mae": self.mae, "square": self.mean_square, "psnr_db": psnr_db(self.mean_square / STEPS**2)}


@dataclass
class _Moved:
    """How far a cause moves the vertices of visible avatars.

    `largest_mm`: largest distance in the world. `largest_px`: largest distance in the picture.
    `sum_mm`, `count`: sum of the distances in the world, and number of the vertices, over all frames.
    """

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
    """Return (places, on screen): the places (V,2) of `vertices` in the picture, and which of them are in it (V,) bool.

    A place is (x, y) in pixels from the middle of the picture, x to the right and y up. `vertices` (V,3): metres, in
    the world. `clip`: projection @ view (4,4). `output`: (height, width) of the picture.
    """
    x, y, _, w = (np.c_[vertices, np.ones(len(vertices))] @ clip.T).T
    in_front = w > 0
    place = np.stack([x, y], axis=1) / np.where(in_front, w, 1.0)[:, None]
    return place * [output[1] / 2, output[0] / 2], in_front & (np.abs(place) <= 1).all(axis=1)


class _Split:
    """The figures of the added frames, by cause.

    `output`: (height, width) of the picture. `out`: folder for heat maps; None for no maps. `lpips`: function that
    computes LPIPS; None leaves LPIPS out.
    """

    def __init__(self, output: Shape, out: Path | None, lpips: Perceived | None = None) -> None:
        self._output, self._out = output, out
        self._alone, self._step, self._so_far = ({cause: _Pooled(lpips) for cause in Cause} for _ in range(3))
        self._products = dict.fromkeys(Cause, 0.0)
        self._moved = {cause: _Moved() for cause in Cause if cause in BODY}
        self._remainder = _Pooled(lpips)
        self._truth = {"reference": _Pooled(lpips), "run": _Pooled(lpips)}

    def add(self, moment: ReferenceMoment) -> None:
        """Count `moment`, a frame with a visible avatar. If there is a folder for heat maps, write its heat maps."""
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

    def add_truth(self, moment: ReferenceMoment, true: Sequence[RasterLayer]) -> None:
        """Count the errors of the reference and of the run's picture against the ground truth of `moment`.

        If there is a folder for heat maps, write both heat maps. `true`: layers of the clothed bodies. The ground truth
        shows these layers over the run's background.
        """
        box = region(moment.boxes, self._output)
        picture, cover = laid_over(moment.background, true)
        wanted = _cut(ReferenceFrame(moment.number, picture, cover >= HALF, moment.boxes), box)
        for name, frame in (("reference", moment.frame(NOTHING)), ("run", _run(moment))):
            shown = _cut(frame, box)
            self._truth[name].add(shown, wanted)
            self._show(moment.number, f"{name} against truth", shown, wanted)

    def document(self) -> dict[str, Any]:
        """Return the figures: the keys `causes`, `whole`, `sums`, `remainder` and `truth` of `error_by_cause`."""
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


def _run(moment: ReferenceMoment) -> ReferenceFrame:
    """Return the run's own frame, with the mask of the frame with all causes."""
    return ReferenceFrame(moment.number, moment.own, moment.frame(frozenset(Cause)).mask, moment.boxes)


def _cut(frame: ReferenceFrame, box: Box) -> ReferenceFrame:
    part = np.s_[box.top : box.bottom, box.left : box.right]
    return ReferenceFrame(frame.number, frame.picture[part], frame.mask[part], frame.boxes)


def _sum(pooled: Mapping[Cause, _Pooled], name: str) -> float:
    return sum(float(getattr(one, name)) for one in pooled.values())


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def write_heat_map(file: Path, title: str, picture: F64, reference: F64) -> None:
    """Write the `heat_map` of a picture and its reference as the PNG `file`.

    Parameters: see `heat_map`. Raises BadInputError if `file` cannot be written.
    """
    content = io.BytesIO()
    Image.fromarray(heat_map(title, picture, reference)).save(content, "PNG")
    write_bytes(file, content.getvalue())


def heat_map(title: str, picture: F64, reference: F64) -> U8:
    """Return a sheet (H,W,3) uint8 with the picture, the reference, a heat map of their difference, and its colour bar.

    The map shows the mean absolute difference of the three channels, multiplied by a power of two. The sheet states
    this factor. A product above 1 gets the bar's last colour.

    `title`: beginning of the sheet's first line; the mean and the largest difference follow it.
    `picture`, `reference`: (h,w,3) sRGB in 0..1.
    """
    difference = np.abs(picture - reference).mean(axis=2)
    factor = shown_factor(difference)
    times = max(1, -(-LEAST_SIDE_PX // max(difference.shape)))
    panels = [np.rint(picture * 255), np.rint(reference * 255), coloured(difference * factor)]
    high, wide = (side * times for side in difference.shape)
    sheet = Image.new("RGB", (3 * wide + 5 * BORDER_PX + SCALE_WIDTH_PX + BAR_PX, high + 3 * LINE_PX + BORDER_PX))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(FONT_PX)
    top = 2 * LINE_PX
    for number, panel in enumerate(panels):
        left = BORDER_PX + number * (wide + BORDER_PX)
        enlarged = panel.astype(np.uint8).repeat(times, axis=0).repeat(times, axis=1)
        sheet.paste(Image.fromarray(enlarged), (left, top))
        name = ("picture", "reference", f"difference x {factor}")[number]
        draw.text((left, LINE_PX), name, font=font)
    mean, largest = difference.mean() * 255, difference.max() * 255
    draw.text((BORDER_PX, 0), f"{title}: mean {mean:.3g}, largest {largest:.3g} of 255", font=font)
    _draw_bar(sheet, draw, (BORDER_PX + 3 * (wide + BORDER_PX), top, high), 255 / factor, font)
    return np.asarray(sheet)


def shown_factor(difference: F64) -> int:
    """Return the largest power of two, 1 to `LARGEST_FACTOR`, that scales nearly all of `difference` to at most 1.

    `difference` (h,w): values in 0..1. If nearly all values are 0, return 1. "Nearly all" is the share `ON_THE_BAR`.
    """
    most = float(np.quantile(difference, ON_THE_BAR))
    if most == 0.0:
        return 1
    return int(2 ** np.floor(np.log2(np.clip(1 / most, 1, LARGEST_FACTOR))))


def coloured(values: F64) -> U8:
    """Return the colours (..., 3) uint8 of `values` (...).

    Values above 1 have the colour of 1, values below 0 the colour of 0.
    """
    place = np.clip(values, 0, 1) * (len(COLOURS) - 1)
    channels = [np.interp(place, np.arange(len(COLOURS)), COLOURS[:, channel]) for channel in range(3)]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)


def _draw_bar(sheet: Image.Image, draw: Any, place: tuple[int, int, int], most: float, font: Any) -> None:
    """Draw the colour bar on `sheet`, with the values at its two ends and its middle.

    `draw`: Pillow's drawing object of `sheet`. `place`: (left, top, height) of the bar, pixels. `most`: value at the
    bar's upper end, in steps of 1/255. `font`: font of the values.
    """
    left, top, height = place
    bar = coloured(np.linspace(1, 0, height))[:, None].repeat(BAR_PX, axis=1)
    sheet.paste(Image.fromarray(bar), (left, top))
    for share in (0.0, 0.5, 1.0):
        row = top + round((1 - share) * (height - FONT_PX))
        draw.text((left + BAR_PX + BORDER_PX // 2, row), f"{most * share:.3g}", font=font)
