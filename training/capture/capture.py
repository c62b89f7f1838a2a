"""A capture: frames of one person, each with its mask and the fit of the body, and the camera that took them.

Rule: a `Capture` has no faults. All faults of a capture's files are found before anything starts, and are listed
together. docs/captures.md describes the files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64, U8, Shape
from trilane.avatars.bundle import CAPTURE, bundle_folder
from trilane.body.body import Body, ShapedBody, load_body
from trilane.body.joints import JOINTS, LEFT_HAND, MAX_VALUE, POSE_SIZE, RIGHT_HAND, rodrigues
from trilane.errors import BadInputError
from trilane.files import read_npz
from trilane.scene.motion.smpl_files import WHOLE as WIDTHS
from trilane.training.capture.capture_file import (
    A_ROTATION,
    FRAME,
    MASK,
    NO_ROTATION,
    CaptureFile,
    Fault,
    FaultyCaptureError,
    PictureFolder,
    Pictures,
    is_rotation,
    open_pictures,
    read_capture_file,
)
from trilane.unexpected_value import UnexpectedValue

#: Least number of frames: one for each side of a person.
LEAST_FRAMES = 4
#: Least value of a mask's pixel that shows the person.
HALF = 128
ONE_MASK = "one mask for each frame"
EXPECTED_FITS = "a folder of .npz files named like the frames, or one .npz"
BODY = "body.npz"
Read = TypeVar("Read")
Track = Callable[[Sequence[int]], Iterable[int]]


@dataclass(frozen=True)
class Capture:
    """A capture without faults.

    `folder`: folder of the capture. `file`: content of capture.toml.
    `body_file`: file from which the body was read.
    `betas`, `expression`: coefficients of shape and of expression, means over the fits.
    `shaped`: body with these coefficients.
    `fits`: fit of each frame. `views`: view matrix (4,4) of each frame's camera.
    `frames`, `masks`: pictures. `mask_of`: for each frame, the number of its mask in `masks`.
    """

    folder: Path
    file: CaptureFile
    body_file: Path
    shaped: ShapedBody
    betas: F64
    expression: F64
    fits: tuple[Fit, ...]
    views: tuple[F64, ...]
    frames: Pictures
    masks: Pictures
    mask_of: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.fits)

    @property
    def shape(self) -> Shape:
        """(height, width) of the frames."""
        return self.file.camera.shape

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the frames."""
        return self.frames.names

    def picture(self, number: int) -> U8:
        """Return frame `number` (h,w,4), with its mask as straight alpha.

        Raises UnexpectedValue for a picture, and BadInputError for a video, that has become unreadable meanwhile.
        """
        return np.dstack([self.frames.read(number), self.masks.read(self.mask_of[number])])

    def directions(self) -> list[tuple[float, float]]:
        """Return (yaw, height) in degrees of each frame's camera, as `camera_direction` defines them."""
        return directions(self.shaped, self.fits, self.views)


def directions(shaped: ShapedBody, fits: Sequence[Fit], views: Sequence[F64]) -> list[tuple[float, float]]:
    """Return (yaw, height) in degrees of each frame's camera, as `camera_direction` defines them.

    `shaped`: body that was fitted. `fits`: fit of each frame. `views`: view matrix (4,4) of each frame's camera.
    """
    root = shaped.joints[0]
    return [camera_direction(fit.pose, root + fit.place, view) for fit, view in zip(fits, views, strict=True)]


def open_capture(folder: Path, track: Track = iter) -> Capture:
    """Open the capture in `folder` and check every picture and fit.

    `track`: function that gets the numbers of the frames, and yields them again while it shows progress.

    Raises BadInputError for a capture.toml that cannot be read. Raises FaultyCaptureError with all faults of its keys;
    if there are none, with all faults of the other files.
    """
    return _Opening(folder, read_capture_file(folder)).opened(track)


class _Opening:
    """Reads a capture, and collects its faults. `file`: content of capture.toml."""

    def __init__(self, folder: Path, file: CaptureFile) -> None:
        self.folder, self.file = folder, file
        self.faults: list[Fault] = []

    def opened(self, track: Track) -> Capture:
        place = self.folder / self.file.body
        body_file = bundle_folder("default") / BODY if self.file.body == "default" else place
        body = self._try(lambda: load_body(body_file))
        frames = self._try(lambda: open_pictures(self.folder / self.file.frames, FRAME))
        masks = self._try(lambda: open_pictures(self.folder / self.file.masks, MASK))
        mask_of: list[int] = []
        if frames is not None:
            if len(frames.names) < LEAST_FRAMES:
                count = f"{len(frames.names)} frame" + "s" * (len(frames.names) > 1)
                expected = f"at least {LEAST_FRAMES}, one for each side of the person"
                self.faults.append(Fault(self.file.frames, count, expected))
            mask_of = self._matched(frames, masks) if masks is not None else []
            self._look(frames, masks, mask_of, track)
        fits = self._fits(frames.names, body) if frames is not None and body is not None else []
        if body is None or frames is None or not fits:
            raise FaultyCaptureError(str(self.folder), self.faults)
        betas, expression = (_mean([getattr(fit, name) for fit in fits]) for name in SHAPE)
        views = tuple(self.file.camera.view(fit.rotation, fit.translation) for fit in fits)
        shaped = body.shape(betas, expression)
        self._require_sides(directions(shaped, fits, views), len(frames.names))
        if masks is None or self.faults:
            raise FaultyCaptureError(str(self.folder), self.faults)
        return Capture(
            *(self.folder, self.file, body_file, shaped, betas, expression),
            *(tuple(fits), views, frames, masks, tuple(mask_of)),
        )

    def _try(self, read: Callable[[], Read]) -> Read | None:
        try:
            return read()
        except BadInputError as error:
            self.faults.append(Fault.of(error))
            return None

    def _matched(self, frames: Pictures, masks: Pictures) -> list[int]:
        """Return, for each frame, the number of its mask. A frame without a mask gets -1 and a fault.

        Two folders are matched by the names of their files. If one of the two is a video, numbers are matched.
        """
        if isinstance(frames, PictureFolder) and isinstance(masks, PictureFolder):
            by_stem = {Path(name).stem: number for number, name in enumerate(masks.names)}
            found = [by_stem.get(Path(name).stem, -1) for name in frames.names]
            wanted = [f"{self.file.masks}/{Path(name).stem}.png" for name in frames.names]
            for number, name in enumerate(masks.names):
                if by_stem[Path(name).stem] != number:
                    self.faults.append(Fault(f"{self.file.masks}/{name}", "a second mask", ONE_MASK, "remove one"))
        else:
            found = [number if number < len(masks.names) else -1 for number in range(len(frames.names))]
            wanted = [f"{self.file.masks}#{number}" for number in range(len(frames.names))]
            if len(masks.names) > len(frames.names):
                count = f"{len(masks.names)} masks for {len(frames.names)} frames"
                self.faults.append(Fault(self.file.masks, count, ONE_MASK))
        missing = [name for name, number in zip(wanted, found, strict=True) if number < 0]
        self.faults += [Fault(name, "no mask", "a mask for every frame") for name in missing]
        return found

    def _look(self, frames: Pictures, masks: Pictures | None, mask_of: Sequence[int], track: Track) -> None:
        """Read every frame and its mask, and add a fault for each that cannot be used."""
        shape = self.file.camera.shape
        for number in track(range(len(frames.names))):
            frame = self._read(frames, number, f"{self.file.frames}/{frames.names[number]}", shape)
            if masks is None or mask_of[number] < 0:
                continue
            where = f"{self.file.masks}/{masks.names[mask_of[number]]}"
            mask = self._read(masks, mask_of[number], where, shape if frame is None else frame.shape[:2])
            if mask is not None and not (mask >= HALF).any():
                found = f"an all-black mask (its greatest value is {mask.max()})"
                self.faults.append(Fault(where, found, "a mask that is 255 on the person"))

    def _read(self, pictures: Pictures, number: int, where: str, shape: Shape) -> U8 | None:
        try:
            picture = pictures.read(number)
        except UnexpectedValue as error:
            self.faults.append(Fault(where, error.found, error.expected, error.remedy))
            return None
        if picture.shape[:2] != shape:
            size, wanted = (f"{side[1]}x{side[0]} pixels" for side in (picture.shape, shape))
            self.faults.append(Fault(where, size, f"{wanted}, as the camera and the other pictures have"))
        return picture

    def _fits(self, names: Sequence[str], body: Body) -> list[Fit]:
        """Return the fits that can be read, and add a fault for every other fit. `names`: names of the frames."""
        path, fits = self.folder / self.file.fits, []
        one = self._try(lambda: _fits_of_file(path, len(names))) if path.is_file() else None
        if not path.is_dir() and one is None:
            if not path.exists():
                self.faults.append(Fault(self.file.fits, "no such file or folder", EXPECTED_FITS))
            return []
        for number, name in enumerate(names):
            where = f"{self.file.fits}#{number}" if one is not None else f"{self.file.fits}/{Path(name).stem}.npz"
            arrays = one[number] if one is not None else self._fit_arrays(where)
            if arrays is None:
                continue
            fit, faults = read_fit(where, arrays, body, self.file.flat_hand_mean)
            self.faults += faults
            fits += [] if fit is None else [fit]
        return fits

    def _fit_arrays(self, where: str) -> dict[str, NDArray[Any]] | None:
        try:
            return read_npz(self.folder / where, NAMES, "the fit of a frame (.npz)")
        except BadInputError as error:
            self.faults.append(Fault(where, error.found, error.expected, error.remedy))
            return None

    def _require_sides(self, seen: Sequence[tuple[float, float]], frames: int) -> None:
        """Add a fault for the sides of the person that no frame shows."""
        shown = frames_by_side([yaw for yaw, _ in seen])
        missing = [side for side, count in shown.items() if not count and side not in self.file.missing_views]
        if missing:
            among = f" among the {len(seen)} with fits that could be read" if len(seen) < frames else ""
            found = f"no frame that shows the {', the '.join(missing)}{among}"
            remedy = f"film it too; or, if it will never be seen, write missing_views = {missing} in {CAPTURE}"
            self.faults.append(Fault(self.file.fits, found, "frames of all four sides", remedy))


def _mean(rows: Sequence[F64]) -> F64:
    """Return the mean (K,) of rows of coefficients, where K is the longest row; missing coefficients count as 0."""
    longest = max(len(row) for row in rows)
    return np.asarray(np.mean([np.pad(row, (0, longest - len(row))) for row in rows], axis=0))


def _fits_of_file(path: Path, count: int) -> list[Mapping[str, NDArray[Any]]]:
    """Return, for each frame, the arrays of its fit by name, from one file for all frames. Raises BadInputError.

    A one-dimensional array of shape or expression coefficients holds for all frames.
    """
    arrays = read_npz(path, NAMES, EXPECTED_FITS)
    shared = {name: arrays.pop(name) for name in SHAPE if name in arrays and arrays[name].ndim < 2}
    for name, array in arrays.items():
        if array.ndim < 2 or len(array) != count:
            raise BadInputError(f"{path}[{name}]", f"shape {array.shape}", f"({count}, ...), a row for each frame")
    return [shared | {name: array[number] for name, array in arrays.items()} for number in range(count)]


# The sides from which a capture shows the person: the direction of the camera in the body's own axes.
#
# Rule: directions are relative to the root joint; the body faces +Z, and its left side is +X.

#: Yaw in degrees of a camera that looks straight at each side.
SIDES = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0}
#: Width of a bin in the histogram of the cameras' yaws, degrees.
STEP_DEG = 30


def camera_direction(pose: F64, root: F64, view: F64) -> tuple[float, float]:
    """Return (yaw, height) of a camera in the body's own axes, in degrees.

    The yaw is 0 in front of the body and 90 on its left, in -180..180. The height is the angle above the body's own
    horizontal plane.

    `pose`: pose of the body, axis-angle (55,3) in radians.
    `root`: place (3,) of the posed root joint in the world, in metres.
    `view`: matrix (4,4) from the world to the camera.
    """
    eye = np.linalg.inv(view)[:3, 3]
    x, y, z = rodrigues(pose[0]).T @ (eye - root)
    return float(np.degrees(np.arctan2(x, z))), float(np.degrees(np.arctan2(y, np.hypot(x, z))))


def side_of(yaw_deg: float) -> str:
    """Return the side of the body, a name of `SIDES`, that a camera at `yaw_deg` shows best."""
    return min(SIDES, key=lambda side: abs((yaw_deg - SIDES[side] + 180) % 360 - 180))


def frames_by_side(yaws_deg: Sequence[float]) -> dict[str, int]:
    """Return the number of frames that show each side, by the side's name. `yaws_deg`: yaw of each frame's camera."""
    sides = [side_of(yaw) for yaw in yaws_deg]
    return {side: sides.count(side) for side in SIDES}


def widest_gap_deg(yaws_deg: Sequence[float]) -> float:
    """Return the widest angle, in degrees of yaw, between neighbouring cameras about the body; 360 for one camera."""
    turns = np.sort(np.asarray(yaws_deg) % 360)
    return float(np.diff(turns, append=turns[0] + 360).max())


# Fits: pose, place and shape of the body in each frame, from .npz files with the names of SMPL-X or AMASS.
#
# Rule: a file of fits holds arguments of the `smplx` library. Every array is checked, and each defect is one fault.

#: For each part of the pose, its range (start, stop) among the 165 numbers, and the names that files have for it.
PARTS: dict[tuple[int, int], tuple[str, ...]] = {
    (0, 3): ("global_orient", "root_orient"),
    (3, 66): ("body_pose", "pose_body"),
    (66, 69): ("jaw_pose", "pose_jaw"),
    (69, 72): ("leye_pose",),
    (72, 75): ("reye_pose",),
    (69, 75): ("pose_eye",),
    (LEFT_HAND.start, LEFT_HAND.stop): ("left_hand_pose",),
    (RIGHT_HAND.start, RIGHT_HAND.stop): ("right_hand_pose",),
    (LEFT_HAND.start, RIGHT_HAND.stop): ("pose_hand",),
}
WHOLE = ("poses", "full_pose", "pose")
PLACE = ("transl", "trans")
CAMERA = {"camera_rotation": 9, "camera_translation": 3}
SHAPE = ("betas", "expression")
NAMES = (*WHOLE, *(name for names in PARTS.values() for name in names), *PLACE, *SHAPE, *CAMERA)
#: Descriptions of pose arrays of other body models for people, by the number of values.
OTHER_BODIES = {69: "23 joints: the SMPL layout", 72: "24 joints: the SMPL layout", 66: "22 joints", 63: "21 joints"}
#: For whole poses of 156 numbers (SMPL-H) and 165 numbers (SMPL-X): the joints, in the order of the numbers.
COLUMNS = {width: WIDTHS[width][0] for width in (156, 165)}
REMEDY = "convert the fits to SMPL-X"

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Fit:
    """The fit of one frame.

    `pose`: axis-angle (55,3), in radians. `place`: translation (3,) that is added to the root joint, in metres.
    `betas`, `expression`: coefficients of shape and expression.
    `rotation` (3,3), `translation` (3,), metres: transform from the world to the frame's own camera; None if the frame
    has the camera of capture.toml.
    """

    pose: F64
    place: F64
    betas: F64
    expression: F64
    rotation: F64 | None = None
    translation: F64 | None = None


def read_fit(where: str, arrays: Arrays, body: Body, flat_hand_mean: bool) -> tuple[Fit | None, list[Fault]]:
    """Return (fit of a frame, faults); the fit is None if there are faults.

    `where`: name of the file, for faults.
    `arrays`: arrays of the frame by their names in the file.
    `body`: body with the hand components and the mean hand.
    `flat_hand_mean`: whether the hands in the file already include the mean hand.
    """
    faults: list[Fault] = []
    values = {name: _numbers(f"{where}[{name}]", arrays[name], faults) for name in NAMES if name in arrays}
    pose = _pose(where, values, body, faults)
    place = next((values[name] for name in PLACE if name in values), None)
    if place is None:
        faults.append(Fault(where, "no place of the body", f"an array `{PLACE[0]}` or `{PLACE[1]}`"))
    else:
        _require_size(f"{where}[{PLACE[0] if PLACE[0] in values else PLACE[1]}]", place, 3, faults)
    for name, size in CAMERA.items():
        if name in values:
            _require_size(f"{where}[{name}]", values[name], size, faults)
    rotation, translation = (values.get(name) for name in CAMERA)
    if not faults and rotation is not None and not is_rotation(rotation.reshape(3, 3)):
        faults.append(Fault(f"{where}[camera_rotation]", NO_ROTATION, A_ROTATION))
    betas, expression = (_coefficients(where, name, values, body, faults) for name in SHAPE)
    if faults or place is None:
        return None, faults
    full = body.full_pose(pose, flat_hand_mean).reshape(JOINTS, 3)
    return Fit(full, place, betas, expression, None if rotation is None else rotation.reshape(3, 3), translation), []


def _numbers(where: str, array: NDArray[Any], faults: list[Fault]) -> F64:
    """Return `array` as a flat row of float64.

    If it has no numbers, or a number that is not finite or larger than `MAX_VALUE`, add to `faults` and return zeros.
    """
    if array.dtype.kind not in "fiu":
        faults.append(Fault(where, f"dtype {array.dtype}", "numbers"))
        return np.zeros(array.size)
    row = array.astype(np.float64).reshape(-1)
    if not (np.abs(row) <= MAX_VALUE).all():  # `not` includes NaN, which no comparison holds for
        faults.append(Fault(where, "NaN, infinity or a huge number", "finite numbers", "fit the frame again"))
        return np.zeros(array.size)
    return row


def _require_size(where: str, row: F64, size: int, faults: list[Fault]) -> bool:
    if len(row) != size:
        what = f"{len(row)} numbers" + (f" ({OTHER_BODIES[len(row)]})" if len(row) in OTHER_BODIES else "")
        faults.append(Fault(where, what, f"{size}", REMEDY if len(row) in OTHER_BODIES else ""))
    return len(row) == size


def _pose(where: str, values: Mapping[str, F64], body: Body, faults: list[Fault]) -> F64:
    """Return the pose (165,) from an array of the whole pose, or from arrays of its parts.

    Add to `faults` if an array has a wrong size, or if the part of the root or the body is missing.
    """
    for name in WHOLE:
        if name in values:
            return _whole(f"{where}[{name}]", values[name], faults)
    pose = np.zeros(POSE_SIZE)
    for (start, stop), names in PARTS.items():
        found = [name for name in names if name in values]
        if not found and stop <= 66:
            expected = f"`{names[0]}` or `{names[1]}`, or the whole pose as `poses`"
            faults.append(Fault(where, f"no `{names[0]}`", expected))
        for name in found:
            row = values[name]
            if name.endswith("hand_pose") and 0 < len(row) < 45:
                components = body.hand_components[name.startswith("right")]
                row = row @ components[: len(row)] if len(row) <= len(components) else row
            if _require_size(f"{where}[{name}]", row, stop - start, faults):
                pose[start:stop] = row
    return pose


def _whole(where: str, row: F64, faults: list[Fault]) -> F64:
    pose = np.zeros((JOINTS, 3))
    if len(row) in COLUMNS:
        pose[list(COLUMNS[len(row)])] = row.reshape(-1, 3)
    else:
        _require_size(where, row, POSE_SIZE, faults)
    return pose.reshape(-1)


def _coefficients(where: str, name: str, values: Mapping[str, F64], body: Body, faults: list[Fault]) -> F64:
    most = (body.shape_dirs if name == "betas" else body.expression_dirs).shape[2]
    row = values.get(name, np.zeros(0))
    if len(row) > most:
        faults.append(Fault(f"{where}[{name}]", f"{len(row)} coefficients", f"at most {most}, which the body has"))
    return row
