"""`capture.toml`: where a capture's frames, masks and fits lie, and the camera that took them.

Rule: this module checks the types and ranges of capture.toml, and lists every defect. `capture.py` checks the content
of the other files.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import av
import numpy as np
from PIL import Image
from pydantic import Field, ValidationError, field_validator

from trilane.arrays import F64, MAX_SIDE, U8, Shape
from trilane.avatars.bundle import CAPTURE
from trilane.errors import BadInputError, did_you_mean, reason
from trilane.files import read_text
from trilane.scene.lens import Lens
from trilane.scene.schema import LISTED, Finite, Table
from trilane.stages.gpu.video_reader import open_video, require_video
from trilane.unexpected_value import UnexpectedValue, expected_in, unexpected_in

# The faults of a capture are listed together, so that a person can fix all of them before the next try.
#
# Rule: a fault names the file, what was found and what was expected. Faults that differ only in the file share a line.

#: Most files that one line names; the number of further files follows.
MOST_NAMED = 12


@dataclass(frozen=True)
class Fault:
    """A fault of a capture.

    `where`: file, with the key or the number of the frame. `found`, `expected`, `remedy`: sentence parts.
    """

    where: str
    found: str
    expected: str
    remedy: str = ""

    @classmethod
    def of(cls, error: BadInputError) -> Fault:
        """Return the fault that `error` reports."""
        return cls(error.where, error.found, error.expected, error.remedy)


class FaultyCaptureError(BadInputError):
    """A capture has faults. Exit code 2. `details` has the lines that list all `faults`."""

    def __init__(self, folder: str, faults: Sequence[Fault]) -> None:
        count = "1 fault" if len(faults) == 1 else f"{len(faults)} faults"
        super().__init__(folder, count, "a capture without any", "fix what is listed")
        self.faults = tuple(faults)
        self.details = tuple(fault_lines(self.faults))

    def __str__(self) -> str:
        return f"{self.where}: {self.found}; nothing was started"


def fault_lines(faults: Sequence[Fault]) -> list[str]:
    """Return a line for each kind of fault, with the files that have it. Kinds and files keep the order of `faults`."""
    kinds: dict[tuple[str, str, str], list[str]] = {}
    for fault in faults:
        kinds.setdefault((fault.found, fault.expected, fault.remedy), []).append(fault.where)
    return [f"  {_names(places)}: {UnexpectedValue(*kind)}" for kind, places in kinds.items()]


def _names(places: list[str]) -> str:
    more = len(places) - MOST_NAMED
    return ", ".join(places[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


EXPECTED = "a capture file (TOML): docs/captures.md"
NEAR_M, FAR_M = 0.05, 100.0
Side = Literal["front", "left", "back", "right"]
Row = Annotated[tuple[Finite, Finite, Finite], LISTED]
#: Rotation from the axes of OpenCV cameras (y down, looks along +Z) to the axes of OpenGL cameras (y up, along -Z).
OPENGL_FROM_OPENCV: F64 = np.diag([1.0, -1.0, -1.0])


#: Most by which the product of a rotation with its transpose may differ from the identity, in any entry.
ROTATION_TOLERANCE = 0.01
NO_ROTATION = "a matrix that is no rotation"
A_ROTATION = f"a rotation: orthogonal rows of length 1 (to within {ROTATION_TOLERANCE}), determinant 1"


def is_rotation(matrix: F64) -> bool:
    """Return whether `matrix` (3,3) rotates, and neither scales nor mirrors."""
    off = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(off <= ROTATION_TOLERANCE and np.linalg.det(matrix) > 0)


class CameraTable(Table):
    """The table of the camera.

    `width`, `height`: size of a frame in pixels.
    `fx`, `fy`, `cx`, `cy`: focal lengths and principal point in pixels, as in `Lens` (`scene/lens.py`).
    `axes`: convention of the camera's axes.
    `rotation` (rows of the matrix), `translation` (metres): transform from the world of the fits to the camera. By
    default, fits are in camera axes.
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

    @field_validator("rotation")
    @classmethod
    def _rotates(cls, rotation: tuple[Row, Row, Row]) -> tuple[Row, Row, Row]:
        if not is_rotation(np.array(rotation)):
            raise UnexpectedValue(NO_ROTATION, A_ROTATION)
        return rotation

    @property
    def shape(self) -> Shape:
        """(height, width) of a frame."""
        return self.height, self.width

    @property
    def lens(self) -> Lens:
        return Lens(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def projection(self) -> F64:
        """Return the OpenGL projection matrix (4,4) of the frames."""
        return self.lens.projection(NEAR_M, FAR_M)

    def view(self, rotation: Any = None, translation: Any = None) -> F64:
        """Return the matrix (4,4) from the world of the fits to the OpenGL camera.

        `rotation` (3,3), `translation` (3,): transform to a frame's own camera; None: the transform in this table.
        """
        axes = OPENGL_FROM_OPENCV if self.axes == "opencv" else np.eye(3)
        view = np.eye(4)
        view[:3, :3] = axes @ np.asarray(self.rotation if rotation is None else rotation, np.float64)
        view[:3, 3] = axes @ np.asarray(self.translation if translation is None else translation, np.float64)
        return view


class CaptureFile(Table):
    """The content of `capture.toml`. File names are relative to the folder of the capture.

    `body`: `default` or a body file.
    `frames`, `masks`: a folder of pictures or a video.
    `fits`: a folder with a .npz for each frame, or one .npz for all frames.
    `flat_hand_mean`: whether the hands of the fits already include the body's mean hand.
    `missing_views`: sides of the person that need no frame.
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
    """Return the content of `capture.toml` in `folder`.

    Raises BadInputError for a file that is missing or no TOML, and FaultyCaptureError with every defect of the keys.
    """
    path = folder / CAPTURE
    try:
        values = tomllib.loads(read_text(path, EXPECTED))
    except tomllib.TOMLDecodeError as error:
        raise BadInputError(path, f"no valid TOML ({error})", EXPECTED) from None
    try:
        return CaptureFile.model_validate(values)
    except ValidationError as error:
        raise FaultyCaptureError(str(folder), [_fault(dict(each)) for each in error.errors()]) from None


def _fault(details: dict[str, Any]) -> Fault:
    """Return the fault for `details`, one of the `errors()` of a pydantic ValidationError."""
    where = f"{CAPTURE}: {'.'.join(map(str, details['loc']))}"
    if details["type"] == "missing":
        return Fault(where, "nothing", "a value", "add the key")
    if details["type"] == "extra_forbidden":
        table = CameraTable if details["loc"][0] == "camera" else CaptureFile
        known = [field.alias or name for name, field in table.model_fields.items()]
        return Fault(where, "an unknown key", f"one of {', '.join(known)}", did_you_mean(details["loc"][-1], known))
    if (cause := unexpected_in(details)) is not None:
        return Fault(where, cause.found, cause.expected, cause.remedy)
    return Fault(where, repr(details["input"])[:80], expected_in(details))


# Pictures of a capture: a folder of files, or a video.
#
# Rule: a file is read as it is stored. A file with other channels than expected is refused, never converted. A video is
# decoded to RGB or grey, and refused only with alpha. If its pictures are read in order, each is decoded once.

ENDINGS = (".png", ".jpg", ".jpeg")
VIDEO_ENDINGS = (".mp4", ".mkv", ".mov", ".avi", ".webm")
#: Descriptions of Pillow's modes (kinds of channels) for people.
MODES = {
    "L": "one channel (grey)",
    "1": "one channel (black and white)",
    "LA": "two channels (grey and alpha)",
    "P": "a palette",
    "RGB": "three channels (RGB)",
    "RGBA": "four channels (RGBA)",
    "CMYK": "four channels (CMYK)",
}
FRAME, MASK = "frame", "mask"
#: For each kind of picture: (allowed modes of Pillow, expected and remedy of the error for another mode, PyAV format
#: into which a video's pictures are decoded).
STORED: dict[str, tuple[tuple[str, ...], str, str, str]] = {
    FRAME: (
        ("RGB",),
        "three channels (RGB), 8 bits each",
        "save frames without alpha; masks are files of their own",
        "rgb24",
    ),
    MASK: (("L", "1"), "one channel of 8 bits: 255 on the person, 0 elsewhere", "save the mask as grey", "gray"),
}


class Pictures(Protocol):
    """Frames or masks of a capture. `names`: name of each picture, in the order of their numbers."""

    names: tuple[str, ...]

    def read(self, number: int) -> U8:
        """Return picture `number`: a frame (h,w,3) or a mask (h,w). Raises UnexpectedValue if it cannot be used."""


def open_pictures(path: Path, kind: str) -> Pictures:
    """Return the pictures at `path`, a folder or a video. Raises BadInputError if there are no pictures.

    `kind`: `FRAME` or `MASK`.
    """
    expected = f"a folder of {kind}s ({', '.join(ENDINGS)}) or a video ({', '.join(VIDEO_ENDINGS)})"
    if path.is_dir():
        names = sorted(each.name for each in path.iterdir() if each.suffix.lower() in ENDINGS)
        if not names:
            raise BadInputError(path, "no pictures", expected)
        return PictureFolder(path, tuple(names), kind)
    if not path.is_file():
        raise BadInputError(path, "no such file or folder", expected)
    if path.suffix.lower() not in VIDEO_ENDINGS:
        raise BadInputError(path, f"the ending {path.suffix!r}", expected)
    require_video(path)
    return PictureVideo(path, kind)


class PictureFolder:
    """Pictures that are the files `names` in `folder`. `kind`: `FRAME` or `MASK`."""

    def __init__(self, folder: Path, names: tuple[str, ...], kind: str) -> None:
        self.folder, self.names, self._kind = folder, names, kind

    def read(self, number: int) -> U8:
        """Return picture `number`, as `Pictures.read` describes."""
        modes, expected, remedy, _ = STORED[self._kind]
        try:
            with Image.open(self.folder / self.names[number]) as image:
                if image.mode not in modes:
                    raise UnexpectedValue(MODES.get(image.mode, f"the mode {image.mode}"), expected, remedy)
                return np.array(image.convert("L") if image.mode == "1" else image)
        except UnexpectedValue:
            raise
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise UnexpectedValue(f"a file that cannot be read ({reason(error)})", f"a {self._kind}") from None


class PictureVideo:
    """Pictures that are frames of a video. `kind`: `FRAME` or `MASK`.

    The constructor decodes the whole video to count the frames. It raises BadInputError for a video without frames.
    Constructor and `read` raise BadInputError for a video that cannot be decoded.
    """

    def __init__(self, path: Path, kind: str) -> None:
        self._path, self._kind = path, kind
        self._stream: Iterator[Any] = iter(())
        self._next = 0
        self.names = tuple(f"{path.name}#{number}" for number, _ in enumerate(self._frames()))
        if not self.names:
            raise BadInputError(path, "a video without frames", f"a video of {kind}s")

    def read(self, number: int) -> U8:
        """Return picture `number`, as `Pictures.read` describes. If it was decoded before, reopen the video."""
        if number < self._next or not self._next:
            self._stream, self._next = self._frames(), 0
        frame = None
        while self._next <= number:
            frame = next(self._stream, None)
            self._next += 1
        _, expected, remedy, form = STORED[self._kind]
        if frame is None:
            raise UnexpectedValue(f"no picture {number}", f"the {len(self.names)} pictures that the video had")
        if len(frame.format.components) > 3:
            raise UnexpectedValue("four channels", expected, remedy)
        return np.asarray(frame.to_ndarray(format=form))

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle, without the open video. A process that unpickles it opens the video itself."""
        return self.__dict__ | {"_stream": iter(()), "_next": 0}

    def _frames(self) -> Iterator[Any]:
        try:
            with open_video(self._path) as container:
                yield from container.decode(video=0)
        except (av.FFmpegError, IndexError) as error:
            found = f"a video that cannot be decoded ({error})"
            raise BadInputError(self._path, found, f"a video of {self._kind}s") from None
