"""What a COLMAP model says of a camera and of an image, whichever way it is written.

Rule: the table of models is COLMAP's, by number (https://colmap.github.io/cameras.html and its `sensor/models.h`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from trilane.errors import BadInputError
from trilane.scene.camera.distortion import Bent
from trilane.scene.camera.field_of_view import checked
from trilane.scene.lens import Lens


class Model(NamedTuple):
    """`parameters`: their names, in order; `f` is both focal lengths, `k` the first of radial distortion."""

    name: str
    parameters: tuple[str, ...]
    is_fisheye: bool = False


_F, _FXY = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")
#: By COLMAP's number.
MODELS = {
    0: Model("SIMPLE_PINHOLE", _F),
    1: Model("PINHOLE", _FXY),
    2: Model("SIMPLE_RADIAL", (*_F, "k1")),
    3: Model("RADIAL", (*_F, "k1", "k2")),
    4: Model("OPENCV", (*_FXY, "k1", "k2", "p1", "p2")),
    5: Model("OPENCV_FISHEYE", (*_FXY, "k1", "k2", "k3", "k4"), is_fisheye=True),
    6: Model("FULL_OPENCV", (*_FXY, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    7: Model("FOV", (*_FXY, "omega"), is_fisheye=True),
    8: Model("SIMPLE_RADIAL_FISHEYE", (*_F, "k1"), is_fisheye=True),
    9: Model("RADIAL_FISHEYE", (*_F, "k1", "k2"), is_fisheye=True),
    10: Model("THIN_PRISM_FISHEYE", (*_FXY, "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"), is_fisheye=True),
}
BY_NAME = {model.name: model for model in MODELS.values()}
#: Sides of pictures, in pixels, that are believed; letters of a photo's name.
MAX_SIDE_PX, MAX_NAME = 1e6, 256


@dataclass(frozen=True)
class ColmapCamera:
    """`model`: its name. `values`: its parameters, by name."""

    model: str
    width_px: float
    height_px: float
    values: dict[str, float]

    def lens(self) -> Lens:
        """Without distortion."""
        v = self.values
        fx, fy = v.get("fx", v.get("f", 0.0)), v.get("fy", v.get("f", 0.0))
        return Lens(self.width_px, self.height_px, fx, fy, v["cx"], v["cy"])

    def bent(self) -> Bent:
        """With distortion."""
        parameters = {key: value for key, value in self.values.items() if key[0] in "kp"}
        return Bent(self.lens(), parameters, BY_NAME[self.model].is_fisheye)


class ColmapImage(NamedTuple):
    """`quat`: w, x, y, z, and `shift`: world to camera. `camera`: its number."""

    name: str
    quat: tuple[float, ...]
    shift: tuple[float, ...]
    camera: int


def checked_camera(where: str | Path, model: Model, size: tuple[float, float], values: Sequence[float]) -> ColmapCamera:
    """A camera whose numbers make sense. Raises BadInputError."""
    if len(values) != len(model.parameters):
        raise BadInputError(where, f"{len(values)} parameters", f"{len(model.parameters)} of {model.name}")
    if not all(1 <= side <= MAX_SIDE_PX for side in size):
        raise BadInputError(where, f"a picture of {size[0]:g}x{size[1]:g}", f"sides of 1 to {MAX_SIDE_PX:g} pixels")
    named = dict(zip(model.parameters, values, strict=True))
    focal = [named[key] for key in ("f", "fx", "fy") if key in named]
    if not all(math.isfinite(value) for value in values) or min(focal) <= 0:
        raise BadInputError(where, "parameters that are not finite or a focal length below 0", "those of a camera")
    camera = ColmapCamera(model.name, *size, named)
    checked(where, camera.lens())
    return camera
