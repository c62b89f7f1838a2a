"""Random views of a frame of a capture: which part of it becomes the screen, by the bands of zoom of `random_views`.

Rule: a view is a map of the frame's pixels, applied to its camera as well (`image_map`). Bands say how many metres fill
the screen's height, so they mean the same as for the synthetic person; a frame is enlarged by a stated amount at most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trilane.arrays import F64
from trilane.body.kinematics import Posed
from trilane.scene.lens import Lens
from trilane.shapes import Shape
from trilane.training.capture.centres import Centres
from trilane.training.capture.image_map import Augmentation, image_map, projected
from trilane.training.random_views import BANDS, SCREENS
from trilane.training.sample_crop import OUTPUT_ROWS

#: Metres over the screen's height in band `anywhere`, as `random_view` has them.
ANYWHERE_M = (0.4, 2.5)


@dataclass(frozen=True)
class ViewRule:
    """How views are drawn.

    `turn_deg`: they are turned by up to so much. `squeeze`: rows are scaled by up to so much more or less than columns.
    `flip_share`: share of views whose left and right are exchanged. `shift`: the centre lies up to so much of the
    screen's height beside its middle. `most_enlarged`: pixels of the screen for a pixel of the frame, along a side.
    """

    turn_deg: float = 8.0
    squeeze: float = 0.0
    flip_share: float = 0.0
    shift: float = 0.2
    most_enlarged: float = 3.0


@dataclass(frozen=True)
class Camera:
    """A frame's camera. `view` and `projection` (4,4)."""

    view: F64
    projection: F64
    lens: Lens

    @property
    def shape(self) -> Shape:
        """(height, width) of the frame."""
        return round(self.lens.height_px), round(self.lens.width_px)


def screen_shape(rng: np.random.Generator) -> Shape:
    """(height, width) of a random screen of `OUTPUT_ROWS` rows."""
    return OUTPUT_ROWS, round(OUTPUT_ROWS * SCREENS[rng.integers(len(SCREENS))])


def zoomed_view(
    rng: np.random.Generator, band: str, posed: Posed, camera: Camera, centres: Centres, rule: ViewRule, screen: Shape
) -> F64 | None:
    """(3,3): a random map of `band` from the frame to a screen; None when its centre is not in the frame.

    `band`: a name of `BANDS`, or `anywhere`. `posed`: the body in the frame. `screen`: (height, width).
    """
    least, most = BANDS[band][1:] if band in BANDS else ANYWHERE_M
    point = centres.draw(rng, band, posed)
    framed = float(np.exp(rng.uniform(np.log(least), np.log(most))))
    depth = -float(camera.view[2, :3] @ point + camera.view[2, 3])
    pixel = projected(point, camera.projection @ camera.view, camera.shape)
    turn = np.radians(rng.uniform(-rule.turn_deg, rule.turn_deg))
    squeeze = float(np.exp(rng.uniform(-1, 1) * np.log1p(rule.squeeze) / 2))
    flip = bool(rng.random() < rule.flip_share)
    shift = rng.uniform(-rule.shift, rule.shift, 2) * screen[0]
    if depth <= 0 or not (0 <= pixel[0] < camera.shape[1] and 0 <= pixel[1] < camera.shape[0]):
        return None
    scale = np.array([screen[0] * depth / (framed * focal) for focal in (camera.lens.fx, camera.lens.fy)])
    scale *= np.array([squeeze, 1 / squeeze]) * min(1.0, rule.most_enlarged / scale.max())
    centre, beside = (float(pixel[0]), float(pixel[1])), (float(shift[0]), float(shift[1]))
    return image_map(Augmentation(centre, turn, (float(scale[0]), float(scale[1])), (flip, False), beside), screen)
