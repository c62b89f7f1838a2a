"""Checks a capture: how well the body covers the masks, from which sides the person is seen, and what is never seen.

Rule: the body is drawn as training draws it. Bad fits are reported by frame, and no frame is changed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from trilane.arrays import F32, U8, Mask
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES
from trilane.training.capture.capture import HALF, STEP_DEG, Capture, frames_by_side, widest_gap_deg
from trilane.training.capture.capture_file import Fault, FaultyCaptureError
from trilane.training.capture.capture_samples import BodyRaster
from trilane.training.first_texture import LEAST_WEIGHT, grown, head_on, lay_out
from trilane.training.surface import BodyArrays, body_arrays, vertex_normals

#: Least IoU of a good fit. Below a half, body and mask differ on a larger area than they have in common.
LEAST_IOU = 0.5
#: A fit is bad if its IoU is below the median by more than `OUTLYING` deviations and more than `LEAST_DROP`. The
#: deviation is the median absolute deviation, times `NORMAL_MAD` to estimate a standard deviation. Rough outlines of
#: masks cause drops of up to `LEAST_DROP`.
OUTLYING, NORMAL_MAD = 4.0, 1.4826
LEAST_DROP = 0.05


@dataclass(frozen=True)
class CheckedFrame:
    """The agreement of a frame's body and mask.

    `number`: number of the frame.
    `iou`: intersection over union of the drawn body and the mask.
    `outside`: share (0 to 1) of the drawn body that the mask does not cover; 1 if no body is drawn.

    Clothes and hair make the mask larger than the body. Therefore a good fit has a small `outside`, and an IoU below 1.
    """

    number: int
    iou: float
    outside: float


def check_frames(capture: Capture, raster: BodyRaster, coverage: TexelCoverage) -> Iterator[CheckedFrame]:
    """Yield the check of each frame of `capture`, and add the texels that the frame shows to `coverage`."""
    for number in range(len(capture)):
        frame, uv, mask = checked_frame(capture, raster, number)
        coverage.add(coverage.drawn(uv, mask))
        yield frame


def checked_frame(capture: Capture, raster: BodyRaster, number: int) -> tuple[CheckedFrame, F32, Mask]:
    """Return (check of frame `number`, UV image (h,w,3) of its body, mask (h,w) of the person)."""
    uv = raster.uv_of(capture, number)
    mask = np.asarray(capture.masks.read(capture.mask_of[number]) >= HALF)
    return checked(number, uv[..., 2] > 0, mask), uv, mask


def checked(number: int, drawn: Mask, mask: Mask) -> CheckedFrame:
    """Return the check of frame `number`.

    `drawn`, `mask`: (h,w), whether a pixel shows the drawn body, and whether it shows the person.
    """
    together, both = int((drawn | mask).sum()), int((drawn & mask).sum())
    bodys = int(drawn.sum())
    return CheckedFrame(number, both / max(together, 1), 1 - both / bodys if bodys else 1.0)


def bad_frames(frames: Sequence[CheckedFrame]) -> list[CheckedFrame]:
    """Return the frames with bad fits, worst first. Their IoU is below `LEAST_IOU`, or far below the median IoU."""
    ious = np.array([frame.iou for frame in frames])
    median = float(np.median(ious))
    deviation = NORMAL_MAD * float(np.median(np.abs(ious - median)))
    limit = max(LEAST_IOU, median - max(OUTLYING * deviation, LEAST_DROP))
    return sorted((frame for frame in frames if frame.iou < limit), key=lambda frame: frame.iou)


def coverage_of(capture: Capture) -> TexelCoverage:
    """Return an empty coverage for the body of `capture`."""
    return TexelCoverage(body_arrays(capture.shaped))


# Regions of a body's surface, by name, for reports on what a capture shows.
#
# Rule: every vertex is in exactly one region. Regions follow from joints, skinning weights and normals at rest.

#: For each region, prefixes of the names of the joints that move its vertices most. The first matching region counts.
BY_JOINT = {
    "face and head": ("head", "jaw", "left_eye", "right_eye", "neck"),
    "left hand": ("left_wrist", *(f"left_{finger}" for finger in ("index", "middle", "pinky", "ring", "thumb"))),
    "right hand": ("right_wrist", *(f"right_{finger}" for finger in ("index", "middle", "pinky", "ring", "thumb"))),
    "arms": ("left_shoulder", "right_shoulder", "left_elbow", "right_elbow"),
    "legs": ("left_hip", "right_hip", "left_knee", "right_knee"),
    "feet": ("left_ankle", "right_ankle", "left_foot", "right_foot"),
    "torso": ("pelvis", "spine", "left_collar", "right_collar"),
}
SOLES, ARMPITS, CROWN = "soles", "armpits", "top of head"
REGIONS = (*BY_JOINT, SOLES, ARMPITS, CROWN)
#: A unit normal points up or down if its vertical part exceeds this: within 45 degrees of the vertical.
STEEP = 0.7
#: `CROWN_SHARE`: share of the head's height that counts as its top. `ARMPIT_REACH`: radius of an armpit about the
#: shoulder joint, as a share of the upper arm's length.
CROWN_SHARE, ARMPIT_REACH = 0.25, 0.5


def vertex_regions(body: BodyArrays) -> NDArray[np.int64]:
    """Return the region (V,) of each vertex, as an index into `REGIONS`."""
    by_joint = [
        next(k for k, starts in enumerate(BY_JOINT.values()) if name.startswith(starts)) for name in JOINT_NAMES
    ]
    regions: NDArray[np.int64] = np.array(by_joint)[body.weights.argmax(axis=1)]
    head, low = regions == REGIONS.index("face and head"), body.joints[JOINT_INDEX["head"], 1]
    high = body.vertices[head, 1].max()
    up = vertex_normals(body.vertices, body.faces)[:, 1]
    for name, inside in (
        (SOLES, (regions == REGIONS.index("feet")) & (up < -STEEP)),
        (ARMPITS, _near_armpit(body) & (up < -STEEP)),
        (CROWN, head & (body.vertices[:, 1] > high - CROWN_SHARE * (high - low)) & (up > STEEP)),
    ):
        regions[inside] = REGIONS.index(name)
    return regions


def _near_armpit(body: BodyArrays) -> Mask:
    near = np.zeros(len(body.vertices), bool)
    for side in ("left", "right"):
        shoulder, elbow = (body.joints[JOINT_INDEX[f"{side}_{name}"]] for name in ("shoulder", "elbow"))
        reach = ARMPIT_REACH * float(np.linalg.norm(elbow - shoulder))
        near |= np.linalg.norm(body.vertices - shoulder, axis=1) < reach
    return near


# Which texels of the body a capture shows: each pixel of a UV image that lies on the mask shows its texel.
#
# Rule: a texel does not count as seen if it was seen only at a grazing angle, as at the body's outline. Regions that no
# frame shows are named, because their colours are filled from their surroundings.

#: A region counts as never seen if at most this share of its texels is seen.
HARDLY = 0.05
#: Side of the texture on which coverage is counted, in texels.
SIDE = 256


class TexelCoverage:
    """Collects which texels of one body were seen, frame by frame. `side`: side S of the texture in texels."""

    def __init__(self, body: BodyArrays, side: int = SIDE) -> None:
        regions = np.eye(len(REGIONS))[vertex_regions(body)]
        image, self.used = lay_out(regions, body.faces, body.uv, body.uv_faces, side)
        self.region = image.argmax(axis=2)
        self._drawn: Mask = np.zeros((side, side), bool)
        self._side = side

    def add(self, drawn: Mask) -> None:
        """Add a frame that shows the texels `drawn` (S,S)."""
        self._drawn |= drawn

    def drawn(self, uv: F32, mask: Mask) -> Mask:
        """Return which texels (S,S) a frame shows.

        `uv`: UV image (h,w,3) of the frame. `mask`: (h,w), whether a pixel shows the person.
        """
        shown = (head_on(uv[..., :2].astype(np.float64), uv[..., 2] > 0, self._side) > LEAST_WEIGHT) & mask
        texel = np.minimum((uv[..., :2][shown] * self._side).astype(np.int64), self._side - 1)
        found = np.zeros_like(self._drawn)
        found[texel[:, 1], texel[:, 0]] = True
        return found

    @property
    def seen(self) -> Mask:
        """Texels (S,S) of the body that were seen. Neighbours count too, because a pixel may span two texels."""
        return np.asarray(grown(self._drawn) & self.used)

    @property
    def unseen(self) -> Mask:
        """Texels (S,S) of the body that were not seen."""
        return np.asarray(self.used & ~self.seen)

    def share(self) -> float:
        """Return the share (0 to 1) of the body's texels that were seen."""
        return float(self.seen.sum() / self.used.sum())

    def share_by_region(self) -> dict[str, float]:
        """Return the share (0 to 1) of seen texels in each region, by the region's name; 1 without texels."""
        seen, shares = self.seen, {}
        for number, name in enumerate(REGIONS):
            inside = self.used & (self.region == number)
            shares[name] = float(seen[inside].mean()) if inside.any() else 1.0
        return shares

    def never_seen(self) -> list[str]:
        """Return the names of the regions whose share of seen texels is at most `HARDLY`."""
        return [name for name, share in self.share_by_region().items() if share <= HARDLY]


# The result of a capture's check, as plain data for people and for JSON.
#
# Rule: every figure was measured by the check.


def require_fits(capture: Capture, frames: Sequence[CheckedFrame], sheet: object) -> None:
    """Raise FaultyCaptureError if the median IoU of `frames` is below `LEAST_IOU`.

    `sheet`: file of the sheet that shows the fits, or words for it; the remedy names it.
    """
    median = float(np.median([frame.iou for frame in frames]))
    if median < LEAST_IOU:
        found = f"bodies that overlap the masks by a median IoU of {median:.2f}"
        expected = f"at least {LEAST_IOU}; clothed people have 0.7 to 0.9"
        remedy = f"look at {sheet}: are `axes`, the lens, `flat_hand_mean` and the order of frames right?"
        raise FaultyCaptureError(str(capture.folder), [Fault(capture.file.fits, found, expected, remedy)])


def capture_facts(
    capture: Capture, frames: Sequence[CheckedFrame], bad: Sequence[CheckedFrame], coverage: TexelCoverage
) -> dict[str, Any]:
    """Return the result of a check as JSON values.

    Keys: `capture`, `frames`, `size`, `betas`, `fit`, `bad`, `views`, `texels` (docs/captures.md explains them).

    `frames`: checks of all frames. `bad`: checks of the frames with bad fits.
    """
    ious, outside = ([getattr(frame, name) for frame in frames] for name in ("iou", "outside"))
    return {
        "capture": str(capture.folder),
        "frames": len(capture),
        "size": [*capture.shape[::-1]],
        "betas": [round(float(value), 4) for value in capture.betas],
        "fit": {
            "iou_median": float(np.median(ious)),
            "iou_least": float(np.min(ious)),
            "outside_median": float(np.median(outside)),
        },
        "bad": [{"name": capture.names[each.number], "iou": each.iou, "outside": each.outside} for each in bad],
        "views": view_facts(capture.directions()),
        "texels": texel_facts(coverage),
    }


def texel_facts(coverage: TexelCoverage) -> dict[str, Any]:
    """Return a coverage as JSON values.

    Keys:
    `seen`: share of the body's texels that were seen.
    `regions`: share of each region's texels that were seen.
    `never_seen`: names of the regions whose share is at most `HARDLY`.
    """
    names = coverage.never_seen()
    return {"seen": coverage.share(), "regions": coverage.share_by_region(), "never_seen": names}


def view_facts(directions: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Return figures of the frames' cameras as JSON values.

    Keys:
    `by_side`: number of frames that show each side.
    `by_yaw`: number of frames in each bin of `STEP_DEG` degrees. The bins go from yaw -180 (behind the body) over its
    right, front and left.
    `widest_gap_deg`: widest angle between neighbouring cameras.
    `height_deg`: least and greatest height.

    `directions`: (yaw, height) of each frame's camera, in degrees.
    """
    yaws = [yaw for yaw, _ in directions]
    heights = [height for _, height in directions]
    counts, _ = np.histogram(yaws, bins=np.arange(-180, 181, STEP_DEG))
    return {
        "by_side": frames_by_side(yaws),
        "by_yaw": [int(count) for count in counts],
        "widest_gap_deg": widest_gap_deg(yaws),
        "height_deg": [min(heights), max(heights)],
    }


# A sheet that shows the fits of a capture over its frames.
#
# Rule: the drawn body is tinted red, and the part of the mask without body blue. Each cell states its frame and IoU.

COLUMNS, MOST_CELLS = 4, 16
CELL_WIDTH = 320
BODY_COLOUR, MASK_COLOUR = (255.0, 0.0, 0.0), (0.0, 64.0, 255.0)


def chosen(frames: Sequence[CheckedFrame], bad: Sequence[CheckedFrame]) -> list[CheckedFrame]:
    """Return the frames for the sheet: first the worst of `bad`, for at most half of the cells; then other frames.

    The other frames are spread evenly over the capture.
    """
    worst = list(bad[: MOST_CELLS // 2])
    others = [frame for frame in frames if frame not in bad]
    room = min(MOST_CELLS - len(worst), len(others))
    return worst + [others[round(place)] for place in np.linspace(0, len(others) - 1, room)]


def overlaid(picture: U8, uv: F32) -> U8:
    """Return a frame (h,w,3) uint8 on which the drawn body and the mask are tinted.

    `picture`: frame (h,w,4) with its mask as alpha. `uv`: UV image (h,w,3) of the frame's body.
    """
    result = picture[..., :3].astype(np.float64)
    drawn, mask = uv[..., 2] > 0, picture[..., 3] >= HALF
    for where, colour in ((drawn, BODY_COLOUR), (mask & ~drawn, MASK_COLOUR)):
        result[where] = (result[where] + colour) / 2
    return np.round(result).astype(np.uint8)


def sheet(cells: Sequence[tuple[str, U8]]) -> Image.Image:
    """Return one image of all cells in rows. `cells`: (line of text, picture (h,w,3)); all pictures have one size."""
    height, width = cells[0][1].shape[:2]
    size = (CELL_WIDTH, max(1, round(CELL_WIDTH * height / width)))
    columns = min(COLUMNS, len(cells))
    result = Image.new("RGB", (columns * size[0], -(-len(cells) // columns) * size[1]))
    draw = ImageDraw.Draw(result)
    for number, (text, picture) in enumerate(cells):
        row, column = divmod(number, columns)
        corner = (column * size[0], row * size[1])
        result.paste(Image.fromarray(picture).resize(size, Image.Resampling.BOX), corner)
        draw.text((corner[0] + 4, corner[1] + 2), text, fill="white", stroke_width=1, stroke_fill="black")
    return result
