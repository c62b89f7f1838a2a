"""How programs and data sets name the arrays of a motion of the SMPL family, as a table.

Rule: a layout is data; `smpl_file.py` reads all of them in the same way. Sources: AMASS (https://amass.is.tue.mpg.de);
`smplx` (https://github.com/vchoutas/smplx, arguments of `forward`); AIST++
(https://github.com/google/aistplusplus_api: 60 frames per second, Y up, `smpl_trans` in units in which the body is
`smpl_scaling` times as large); GLAMR (https://github.com/NVlabs/GLAMR: `root_trans_world` is the pelvis's place, Z up).
ROMP, which has a dict for each frame, is read by `romp_file.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

from trilane.arrays import F64
from trilane.scene.motion.motion import REST_PELVIS, SMPL_REST_PELVIS
from trilane.scene.motion.recorded import ANY, WORLD
from trilane.scene.motion.smpl_turns import BELOW_PELVIS, BOTH_HANDS, PELVIS, WHOLE, Widths, from_joint


@dataclass(frozen=True)
class PoseArray:
    """An array of axis-angle turns. `needed`: whether the layout cannot be without it."""

    key: str
    widths: Widths
    needed: bool = True


@dataclass(frozen=True)
class Layout:
    """One way to name things.

    `place`: key of the pelvis's places, or, with `rest_pelvis` (3,), of shifts of the whole body, whose pelvis is there
    at rest. `scale`: key of what places are divided by. `mask`: key of the frames that are measured. `rate_hz`:
    assumed, as `rate_why` says, when no key of RATE_KEYS is there; None when one must be. `up`, `ups`: as of RawMotion.
    """

    name: str
    arrays: tuple[PoseArray, ...]
    place: str
    betas: str
    rate_hz: float | None
    rate_why: str
    up: str
    rest_pelvis: F64 | None = None
    ups: tuple[str, ...] = WORLD
    scale: str = ""
    mask: str = ""

    @property
    def needs(self) -> tuple[str, ...]:
        """Keys without which a dict has another layout."""
        return tuple(array.key for array in self.arrays if array.needed)

    @property
    def keys(self) -> tuple[str, ...]:
        """All keys that are read."""
        own = (self.place, self.betas, self.scale, self.mask, *RATE_KEYS)
        return (*(array.key for array in self.arrays), *(key for key in own if key))


RATE_KEYS = ("mocap_framerate", "mocap_frame_rate", "fps", "frame_rate")
_VIDEO = "no rate in the file, 30 frames/s assumed"

#: The first whose needed keys a dict has is its layout.
LAYOUTS = (
    Layout(
        "AMASS", (PoseArray("poses", WHOLE),), "trans", "betas", None, "", "z", REST_PELVIS,
    ),
    Layout(
        "AIST++", (PoseArray("smpl_poses", WHOLE),), "smpl_trans", "", 60.0,
        "60 frames/s, as AIST++ has them", "y", SMPL_REST_PELVIS, scale="smpl_scaling",
    ),
    Layout(
        "GLAMR", (PoseArray("smpl_orient_world", PELVIS), PoseArray("smpl_pose", BELOW_PELVIS)), "root_trans_world",
        "smpl_beta", 30.0, _VIDEO, "z", mask="exist_frames",
    ),
    Layout(
        "AMASS in parts",
        (
            PoseArray("root_orient", PELVIS), PoseArray("pose_body", BELOW_PELVIS),
            PoseArray("pose_hand", BOTH_HANDS, False),
            PoseArray("pose_jaw", from_joint("jaw", 1), False), PoseArray("pose_eye", from_joint("left_eye", 2), False),
        ),
        "trans", "betas", None, "", "z", REST_PELVIS,
    ),
    Layout(
        "smplx",
        (
            PoseArray("global_orient", PELVIS), PoseArray("body_pose", BELOW_PELVIS),
            PoseArray("jaw_pose", from_joint("jaw", 1), False),
            PoseArray("leye_pose", from_joint("left_eye", 1), False),
            PoseArray("reye_pose", from_joint("right_eye", 1), False),
            PoseArray("left_hand_pose", from_joint("left_index1", 15), False),
            PoseArray("right_hand_pose", from_joint("right_index1", 15), False),
        ),
        "transl", "betas", 30.0, _VIDEO, "y", REST_PELVIS, ANY,
    ),
)  # fmt: skip
KEYS = tuple(dict.fromkeys(key for layout in LAYOUTS for key in layout.keys))
EXPECTED = "; or ".join(f"{' and '.join(f'`{key}`' for key in layout.needs)} ({layout.name})" for layout in LAYOUTS)
