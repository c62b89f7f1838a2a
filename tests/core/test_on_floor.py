"""One who lies or stands on the hands throughout is not stood up: the floor of the file, at 0, tells it from standing.

Heights are worked out by hand from the plain body: its toes are 0.908 m below the pelvis, its head 0.670 m above.
"""

from __future__ import annotations

import numpy as np
import pytest

from trilane.scene.motion.bvh_retarget import UPS
from trilane.scene.motion.recorded import ANY, WORLD, RawMotion, lowest, motion_from_recording
from trilane.scene.rotations import matrix_from_rotvec

#: Turns of the pelvis in a world with Y up: on the back, on the belly, head down; and who stands with -Y, Z or -Z up.
ON_BACK, ON_BELLY, HEAD_DOWN = [-np.pi / 2, 0, 0], [np.pi / 2, 0, 0], [np.pi, 0, 0]
FRAMES = 20


def raw(root: list[float], pelvis: list[float], **changes: object) -> RawMotion:
    """A stiff body that sways by 3 cm along all axes."""
    poses = np.zeros((FRAMES, 55, 3))
    poses[:, 0] = root
    sway = 0.03 * np.sin(np.linspace(0, 6, FRAMES))[:, None]
    values = {"times_s": np.arange(FRAMES) / 30, "poses": poses, "translation": np.array(pelvis) + sway, "betas": None}
    return RawMotion(**{**values, "up": "y", "notes": (), "ups": UPS, **changes})  # type: ignore[arg-type]


def notes(motion: RawMotion) -> tuple[str, ...]:
    return motion_from_recording(motion, "here", "auto").notes


@pytest.mark.parametrize(
    ("root", "height", "other"), [(ON_BACK, 0.12, "-Z"), (ON_BELLY, 0.2, "Z"), (HEAD_DOWN, 0.72, "-Y")]
)
@pytest.mark.parametrize("away", [0.0, 1.7])
def test_one_who_lies_or_is_upside_down_stays_so(root: list[float], height: float, other: str, away: float) -> None:
    """Toes of one on the belly are 0.146 m below the pelvis."""
    motion = motion_from_recording(raw(root, [away, height, away]), "here", "auto")
    said = f"Y up, as the body lies, or is upside down, on the file's floor: `up_axis` {other} if it stands there"
    assert said in motion.notes
    up = matrix_from_rotvec(motion.poses[:, 0])[:, 1, 1]
    assert up == pytest.approx(np.full(FRAMES, np.cos(root[0])), abs=1e-12)
    assert motion.translation[:, 1].mean() == pytest.approx(height, abs=0.03)


@pytest.mark.parametrize(
    ("root", "pelvis", "axis"),
    [(ON_BACK, [1, 0.1, -0.95], "-Z"), (ON_BELLY, [1, 0.1, 0.95], "Z"), (HEAD_DOWN, [1, -0.95, 3], "-Y")],
)
def test_one_who_stands_on_the_floor_of_another_axis_stands(root: list[float], pelvis: list[float], axis: str) -> None:
    """Also where the places along Y would do for one who lies."""
    assert notes(raw(root, pelvis)) == (f"{axis} up, as the body stands",)


def test_without_a_floor_the_other_axis_is_named() -> None:
    said = ("Z up, as the body stands", "up: one who lies, or is upside down, throughout needs `up_axis` Y")
    assert notes(raw(ON_BELLY, [0, 0, 0])) == said
    assert notes(raw(ON_BELLY, [0, 0.45, 0])) == said  # a floor is not 0.3 m below the toes of one who lies
    assert notes(raw(ON_BELLY, [0, 0, 0], ups=ANY)) == said[:1]  # coordinates of a camera have no floor
    assert notes(raw(ON_BELLY, [0, 0, 0], translation=None)) == said[:1]


def test_who_goes_up_and_down_does_not_lie() -> None:
    """By 0.12 m between a tenth and nine tenths of the frames."""
    places = np.outer(np.linspace(0.13, 0.29, FRAMES), [0, 1, 0])
    assert "Z up, as the body stands" in notes(raw(ON_BELLY, [0, 0, 0], translation=places))


def test_one_who_lies_in_a_z_up_world_stays_so() -> None:
    lying = raw([0, 0, 0], [0, 1.5, 0.15], up="z", ups=WORLD)
    assert notes(lying)[0].startswith("Z up, as the body lies")
    assert notes(raw([0, 0, 0], [0, 0.95, 0.15], up="z", ups=WORLD)) == ("Y up, as the body stands",)


def test_the_lowest_joint_is_that_of_a_body_with_such_legs() -> None:
    """Legs of a plain body are 0.8681 m; half as long ones bring its toes to half of 0.908 m below the pelvis."""
    poses, places = np.zeros((300, 55, 3)), np.tile([0.0, 1.0, 0.0], (300, 1))
    up = np.array([0.0, 1.0, 0.0])
    assert lowest(poses, places, None, up) == pytest.approx(np.full(200, 0.092))
    thigh, shin = np.hypot(np.hypot(14, 408), 34), np.hypot(443, 25)
    assert lowest(poses[:3], places[:3], (thigh + shin) / 2000, up) == pytest.approx(np.full(3, 1 - 0.454))
