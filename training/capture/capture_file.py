"""`capture.toml`: where a capture's frames, masks and fits lie, and the camera that took them.

Rule: only types and ranges are checked here, and every defect of the file is listed; `capture.py` looks at the files
that it names.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from trilane.arrays import F64
from trilane.errors import BadInputError, did_you_mean
from trilane.files import read_text
from trilane.scene.lens import Lens
from trilane.scene.schema import LISTED, Finite, Table
from trilane.shapes import MAX_SIDE, Shape
from trilane.training.capture.faults import Fault, FaultyCaptureError

NAME = "capture.toml"
EXPECTED = "a capture file (TOML): docs/captures.md"
NEAR_M, FAR_M = 0.05, 100.0
Side = Literal["front", "left", "back", "right"]
Row = Annotated[tuple[Finite, Finite, Finite], LISTED]
#: From a camera that looks along +Z with y down, as OpenCV's, to one that looks along -Z with y up.
OPENGL_FROM_OPENCV: F64 = np.diag([1.0, -1.0, -1.0])


class CameraTable(Table):
    """The camera; its lens is that of `scene/lens.py`: pixels are counted from the picture's top left corner.

    `axes`: of the camera that fits are in, or that `rotation` (rows) and `translation`, metres, lead to from the world
    of the fits.
    """

    width: int = Field(ge=64, le=2 * MAX_SIDE)
    height: int = Field(ge=64, le=2 * MAX_SIDE)
    fx: float = Field(gt=0, allow_inf_nan=False)
    fy: float = Field(gt=0, allow_inf_nan=False)
    cx: Finite
    cy: Finite
    axes: Literal["opencv", "opengl"] = "opencv"
    rotation: Annotated[tuple[Row, Row, Row], LISTED] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    translation: Row = (0.0, 0.0, 0.0)

    @property
    def shape(self) -> Shape:
        """(height, width) of a frame."""
        return self.height, self.width

    @property
    def lens(self) -> Lens:
        """That made the frames."""
        return Lens(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def projection(self) -> F64:
        """OpenGL clip matrix (4,4) of a frame."""
        return self.lens.projection(NEAR_M, FAR_M)

    def view(self, rotation: Any = None, translation: Any = None) -> F64:
        """(4,4) from the world of the fits to the OpenGL camera; a frame's own `rotation`, `translation` go before."""
        axes = OPENGL_FROM_OPENCV if self.axes == "opencv" else np.eye(3)
        view = np.eye(4)
        view[:3, :3] = axes @ np.asarray(self.rotation if rotation is None else rotation, np.float64)
        view[:3, 3] = axes @ np.asarray(self.translation if translation is None else translation, np.float64)
        return view


class CaptureFile(Table):
    """A capture. Names of files are relative to its folder.

    `body`: `default` or a body file. `frames`, `masks`: a folder of pictures or a video. `fits`: a folder with a .npz
    for each frame, or one .npz for all. `flat_hand_mean`: false where the body's mean hand has to be added to the fits'
    hands. `missing_views`: sides of the person that no frame has to show.
    """

    schema_: Literal[1] = Field(default=1, alias="schema")
    body: str = Field(default="default", min_length=1)
    frames: str = Field(default="frames", min_length=1)
    masks: str = Field(default="masks", min_length=1)
    fits: str = Field(default="fits", min_length=1)
    flat_hand_mean: bool = True
    missing_views: Annotated[tuple[Side, ...], LISTED] = ()
    camera: CameraTable


def read_capture_file(folder: Path) -> CaptureFile:
    """`capture.toml` of `folder`. Raises BadInputError; FaultyCaptureError with every defect of its keys."""
    path = folder / NAME
    try:
        values = tomllib.loads(read_text(path, EXPECTED))
    except tomllib.TOMLDecodeError as error:
        raise BadInputError(path, f"no valid TOML ({error})", EXPECTED) from None
    try:
        return CaptureFile.model_validate(values)
    except ValidationError as error:
        raise FaultyCaptureError(str(folder), [_fault(dict(each)) for each in error.errors()]) from None


def _fault(details: dict[str, Any]) -> Fault:
    """One of the `errors()` of a ValidationError."""
    where = f"{NAME}: {'.'.join(map(str, details['loc']))}"
    if details["type"] == "missing":
        return Fault(where, "nothing", "a value", "add the key")
    if details["type"] == "extra_forbidden":
        table = CameraTable if details["loc"][0] == "camera" else CaptureFile
        known = [field.alias or name for name, field in table.model_fields.items()]
        return Fault(where, "an unknown key", f"one of {', '.join(known)}", did_you_mean(details["loc"][-1], known))
    return Fault(where, repr(details["input"])[:80], details["msg"].removeprefix("Input should be "))
