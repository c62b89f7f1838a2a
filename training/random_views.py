"""Random cameras around a posed body, and random poses. A camera's band tells how much of the body fills the screen.

Rule: the camera of a close-up is near or has a long lens; pixels are never enlarged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64, Shape, shape_buckets, shapes_within
from trilane.avatars.bundle import CLOTHES_STANDOFF_M
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX, JOINTS, Posed
from trilane.body.skinning import blend_matrices
from trilane.scene.crop import choose_bucket, crop_projection
from trilane.scene.rotations import about, rotvec_from_matrix
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.training.clothing import Layer

NEAR_M, FAR_M = 0.05, 100.0
#: Least distance of a camera from the joint that it aims at.
NEAREST_M = 0.45
#: For each band: joints that a camera may aim at, and least and greatest height that fills the screen. Heights are in
#: metres, at the distance of the joint.
BANDS: dict[str, tuple[tuple[str, ...], float, float]] = {
    "far": (("pelvis", "spine1"), 4.5, 10.0),
    "full_body": (("pelvis", "spine1"), 1.9, 3.4),
    "upper_body": (("spine2", "spine3", "neck"), 0.75, 1.25),
    "face": (("head",), 0.34, 0.60),
}
#: Least and greatest height in metres that fills the screen in band `anywhere`.
ANYWHERE_M = (0.4, 2.5)
#: Joints that a camera may aim at in band `anywhere`, which only training has.
ANYWHERE = (
    "left_wrist",
    "right_wrist",
    "left_elbow",
    "left_knee",
    "right_knee",
    "left_foot",
    "right_foot",
    "spine1",
    "head",
)
SCREENS = (4 / 3, 4 / 3, 16 / 9, 3 / 4)
PITCH_DEG = (-20.0, 40.0)
FOV_DEG = (24.0, 60.0)


@dataclass(frozen=True)
class View:
    """A camera and its screen.

    `view`, `projection`: OpenGL matrices (4,4). `aspect`: width of the screen over its height.
    """

    view: F64
    projection: F64
    aspect: float

    @property
    def near_reach_m(self) -> float:
        """Distance in metres from the camera to a corner of its near plane: farther points are never cut."""
        half_height = 1 / self.projection[1, 1]
        return NEAR_M * float(np.sqrt(1 + half_height**2 * (1 + self.aspect**2)))


def random_view(rng: np.random.Generator, band: str, joints: F64) -> View:
    """Return a random camera of `band` that aims near a joint of a body with `joints` (55,3), in world metres.

    `band`: a name of `BANDS`, or `anywhere`.
    """
    names, least, most = BANDS.get(band, (ANYWHERE, *ANYWHERE_M))
    aim = joints[JOINT_INDEX[names[rng.integers(len(names))]]]
    if band == "face":
        aim = aim + 0.04 * (joints[JOINT_INDEX["left_eye"]] - joints[JOINT_INDEX["head"]]) / 0.1
    framed = np.exp(rng.uniform(np.log(least), np.log(most)))
    fov = np.radians(rng.uniform(*FOV_DEG))
    distance = max(framed / (2 * np.tan(fov / 2)), NEAREST_M)
    fov = 2 * np.arctan(framed / (2 * distance))
    low, high = PITCH_DEG
    yaw, pitch = rng.uniform(-np.pi, np.pi), np.radians(rng.triangular(low, 5.0, high))
    back = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    aspect = SCREENS[rng.integers(len(SCREENS))]
    off = 0.18 * framed * np.clip(rng.standard_normal(3), -1.5, 1.5)
    roll = np.radians(4.0) * rng.standard_normal()
    return View(look_at(aim + distance * back + off, aim + off, roll), perspective(fov, aspect), aspect)


def look_at(eye: F64, at: F64, roll: float = 0.0) -> F64:
    """Return the matrix (4,4) from the world to an OpenGL camera at `eye` (3,) that looks at `at` (3,).

    The two points must differ, and must not lie above each other. Without roll, world +Y points up in the picture.

    `roll`: turn of the camera about the viewing direction, radians. If it is positive, the picture turns clockwise.
    """
    z = (eye - at) / np.linalg.norm(eye - at)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    view = np.eye(4)
    view[:3, :3] = [c * x + s * y, c * y - s * x, z]
    view[:3, 3] = -view[:3, :3] @ eye
    return view


def perspective(fov_y: float, aspect: float, near: float = NEAR_M, far: float = FAR_M) -> F64:
    """Return an OpenGL projection matrix (4,4).

    `fov_y`: vertical field of view, radians.
    `aspect`: width over height.
    `near`, `far`: distances of the clip planes, metres.
    """
    f = 1 / np.tan(fov_y / 2)
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1], matrix[3, 2] = f / aspect, f, -1.0
    matrix[2, 2], matrix[2, 3] = (far + near) / (near - far), 2 * far * near / (near - far)
    return matrix


# The crop of a sample: the pipeline's crop rectangle, shape bucket and projection for one body in one view.
#
# Rule: crops are computed by the functions that the pose stage calls, so training sees what the pipeline draws.

#: Height in pixels of the picture that samples are cropped from.
OUTPUT_ROWS = 480
#: Sides of the training tensors: a tensor has at most the pixels of a square of one of these sides.
TENSOR_SIDES = (64, 96, 128, 192, 256)


@dataclass(frozen=True)
class Crop:
    """The crop of a sample.

    `shape`: (height, width) of the tensor. `projection`: projection matrix (4,4) of the crop. `pixels`: number of
    screen pixels in the body's rectangle.
    """

    shape: Shape
    projection: NDArray[np.float64]
    pixels: float


class Cropper:
    """Computes crops of one shaped body."""

    def __init__(self, shaped: ShapedBody, pose_blend: bool = False) -> None:
        """Prepare crops of `shaped`. `pose_blend`: whether the pose blend shapes of the body, if any, are drawn."""
        self._bounds = MeshBounds(shaped, standoff_m=CLOTHES_STANDOFF_M, pose_blend=pose_blend)

    def crop_of(self, posed: Posed, view: View, size: str | float) -> Crop | None:
        """Return the crop of the body, as `crop` does, with a tensor of `size`.

        `size`: text that `shape_buckets` takes, or density: tensor pixels for one pixel of the picture, along a side.
        The side of `TENSOR_SIDES` that fits a density best is chosen.
        """
        if isinstance(size, str):
            return self.crop(posed, view, shape_buckets(size))
        asked = self.crop(posed, view, shapes_within(TENSOR_SIDES[-1] ** 2))
        if asked is None:
            return None
        side = size * np.sqrt(asked.pixels)
        nearest = min(TENSOR_SIDES, key=lambda each: abs(np.log(each / side)))
        return self.crop(posed, view, shapes_within(nearest**2))

    def crop(self, posed: Posed, view: View, buckets: Sequence[Shape]) -> Crop | None:
        """Return the crop of the body in the pose `posed`, as seen from `view`; None if the body is not seen.

        `buckets`: tensor shapes to choose from.
        """
        rect = self._bounds.rect(posed, view.projection @ view.view)
        if rect is None:
            return None
        output = (OUTPUT_ROWS, round(OUTPUT_ROWS * view.aspect))
        shape, grown = choose_bucket(rect, output, buckets)
        pixels = rect.width * rect.height * output[0] * output[1] / 4
        return Crop(shape, crop_projection(view.projection, grown), pixels)


# Finds cameras that are clear of a clothed body: the near plane cannot cut the body.
#
# Rule: a cut body has no ground truth, because its picture shows the inside of clothes and limbs. The limit on the
# distance follows from the triangles, so that no more close views than necessary are rejected.


class ClothedSurface:
    """The surface of all `layers` of a clothed body. Balls around its vertices cover all its triangles."""

    def __init__(self, layers: Sequence[Layer]) -> None:
        self._rest = np.concatenate([layer.vertices for layer in layers])
        self._weights = np.concatenate([layer.weights for layer in layers]).astype(np.float64)
        self._reach = np.concatenate([vertex_reach(layer.vertices, layer.faces) for layer in layers])

    def posed(self, posed: Posed) -> F64:
        """Return the vertices (N,3) of all layers, world metres, in the pose `posed`."""
        matrices = posed.matrices.reshape(JOINTS, 12).astype(np.float64)
        moved = blend_matrices(self._weights, matrices).reshape(-1, 3, 4)
        return np.asarray(np.einsum("vab,vb->va", moved[:, :, :3], self._rest) + moved[:, :, 3])

    def is_clear_of(self, view: View, points: F64) -> bool:
        """Return whether the near plane of `view` cannot cut the surface. `points`: vertices (N,3) from `posed`."""
        eye = np.linalg.inv(view.view)[:3, 3]
        distance = np.linalg.norm(points - eye, axis=1)
        return bool((distance - self._reach).min() > view.near_reach_m)


def vertex_reach(vertices: F64, faces: NDArray[np.int64]) -> F64:
    """Return the radius (N,), metres, of a ball around each vertex, so that the balls cover all triangles.

    A point of a triangle is at most the longest edge / √3 away from the nearest corner. In an equilateral triangle, the
    middle is exactly that far away.

    `vertices`: (N,3), metres. `faces`: (F,3).
    """
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    reach = np.zeros(len(vertices))
    np.maximum.at(reach, faces.reshape(-1), np.repeat(longest / np.sqrt(3), 3))
    return reach


# Random natural poses: a random attitude of a table (stand, walk, reach, ...) with random joint angles.
#
# Rule: a pose depends only on the random generator. Recorded and built-in motions are not used, so they can be held
# out.

#: Standard deviation, in degrees about x, y, z, of the random angles that are added to every pose. Fingers have
#: `_curl_hand` instead.
JITTER_DEG = {
    "spine1": (5, 5, 3),
    "spine2": (4, 5, 3),
    "spine3": (4, 5, 3),
    "neck": (8, 12, 5),
    "head": (8, 16, 6),
    "left_collar": (3, 5, 6),
    "right_collar": (3, 5, 6),
    "left_shoulder": (18, 12, 10),
    "right_shoulder": (18, 12, 10),
    "left_elbow": (10, 10, 4),
    "right_elbow": (10, 10, 4),
    "left_wrist": (18, 14, 14),
    "right_wrist": (18, 14, 14),
    "left_hip": (7, 8, 6),
    "right_hip": (7, 8, 6),
    "left_knee": (6, 2, 2),
    "right_knee": (6, 2, 2),
    "left_ankle": (8, 5, 4),
    "right_ankle": (8, 5, 4),
    "left_foot": (6, 2, 2),
    "right_foot": (6, 2, 2),
    "left_eye": (3, 5, 0),
    "jaw": (0.5, 0, 0),
}
SIDES = {"left": 1.0, "right": -1.0}


def random_pose(rng: np.random.Generator) -> F64:
    """Return a random pose: axis-angle rotations (55,3), radians, in SMPL-X joint order.

    The root leans but does not turn about Y, because random cameras turn about the body.
    """
    pose = np.zeros((JOINTS, 3))
    share = np.array(list(WEIGHTS.values()))
    attitude = list(WEIGHTS)[int(rng.choice(len(WEIGHTS), p=share / share.sum()))]
    ATTITUDES[attitude](pose, rng)
    for name, deviation in JITTER_DEG.items():
        pose[JOINT_INDEX[name]] += np.radians(deviation) * np.clip(rng.standard_normal(3), -2.0, 2.0)
    pose[JOINT_INDEX["right_eye"]] = pose[JOINT_INDEX["left_eye"]]
    pose[0] += np.radians((6, 0, 4)) * rng.standard_normal(3)
    for side in SIDES:
        _curl_hand(pose, side, rng)
        knee, elbow = JOINT_INDEX[f"{side}_knee"], JOINT_INDEX[f"{side}_elbow"]
        pose[knee, 0] = np.clip(pose[knee, 0], 0.0, np.radians(135))
        pose[elbow, 1] = -SIDES[side] * np.clip(-SIDES[side] * pose[elbow, 1], 0.0, np.radians(140))
    return pose


def _stand(pose: F64, rng: np.random.Generator) -> None:
    for side in SIDES:
        _arm(pose, side, rng.uniform(-88, -60), rng.uniform(-25, 25), rng.uniform(5, 35))
        _leg(pose, side, rng.uniform(-8, 4), rng.uniform(0, 12), rng.uniform(0, 12))


def _walk(pose: F64, rng: np.random.Generator) -> None:
    phase, stride = rng.uniform(0, 2 * np.pi), rng.uniform(12, 42)
    for side, sign in SIDES.items():
        swing = sign * np.sin(phase)
        lift = max(0.0, np.cos(phase) * sign)
        _leg(pose, side, -stride * swing - 12 * lift, 8 + 55 * lift * rng.uniform(0.5, 1.2), rng.uniform(-3, 6))
        _arm(pose, side, rng.uniform(-86, -66), 0.9 * stride * swing, rng.uniform(10, 60))
    pose[JOINT_INDEX["spine2"], 1] += np.radians(0.2 * stride * np.sin(phase))


def _reach(pose: F64, rng: np.random.Generator) -> None:
    _stand(pose, rng)
    for side in SIDES:
        if rng.random() < 0.6:
            _arm(pose, side, rng.uniform(-60, 55), rng.uniform(-55, 35), rng.uniform(0, 125), rng.uniform(-110, 40))


def _overhead(pose: F64, rng: np.random.Generator) -> None:
    spread, up, bend = rng.uniform(0, 38), rng.uniform(-30, 78), rng.uniform(0, 50)
    for side in SIDES:
        _arm(pose, side, up + rng.uniform(-8, 8), rng.uniform(-25, 25), bend)
        _leg(pose, side, rng.uniform(-15, 5), rng.uniform(0, 35), spread)
        pose[JOINT_INDEX[f"{side}_collar"], 2] += SIDES[side] * np.radians(0.25 * max(up, 0.0))


def _sit(pose: F64, rng: np.random.Generator) -> None:
    fold = rng.uniform(25, 95)
    for side in SIDES:
        _leg(pose, side, -fold + rng.uniform(-10, 10), fold * rng.uniform(0.8, 1.15), rng.uniform(0, 18))
        _arm(pose, side, rng.uniform(-85, -40), rng.uniform(-60, 10), rng.uniform(10, 100))
    pose[JOINT_INDEX["spine1"], 0] += np.radians(rng.uniform(0, 25))


def _free(pose: F64, rng: np.random.Generator) -> None:
    for side in SIDES:
        _arm(pose, side, rng.uniform(-85, 70), rng.uniform(-60, 45), rng.uniform(0, 130), rng.uniform(-90, 60))
        _leg(pose, side, rng.uniform(-80, 25), rng.uniform(0, 90), rng.uniform(-5, 40))
    pose[JOINT_INDEX["spine1"]] += np.radians((10, 10, 6)) * rng.standard_normal(3)


def _rest(pose: F64, rng: np.random.Generator) -> None:
    pose[JOINT_INDEX["head"], 1] += np.radians(rng.uniform(-20, 20))


ATTITUDES: dict[str, Callable[[F64, np.random.Generator], None]] = {
    "stand": _stand,
    "walk": _walk,
    "reach": _reach,
    "overhead": _overhead,
    "sit": _sit,
    "free": _free,
    "rest": _rest,
}
WEIGHTS = {"stand": 0.20, "walk": 0.26, "reach": 0.20, "overhead": 0.15, "sit": 0.07, "free": 0.09, "rest": 0.03}


def _arm(pose: F64, side: str, raised: float, swung: float, bent: float, twisted: float = 0.0) -> None:
    """Set the shoulder and the elbow of one arm in `pose`, axis-angle by joint. `side`: key of `SIDES`.

    The other parameters are degrees from the T pose. `raised`: 90 is overhead, -90 is hanging. `swung`: positive is
    backwards; the effect falls above level, to none overhead. `bent`: angle of the elbow. `twisted`: turn about the
    upper arm; negative turns a bent forearm upwards.
    """
    sign = SIDES[side]
    hanging, level = max(0.0, -np.sin(np.radians(raised))), np.cos(np.radians(raised))
    turn = about(0, np.radians(swung * hanging)) @ about(1, np.radians(sign * swung * level))
    turn = turn @ about(2, np.radians(sign * raised)) @ about(0, np.radians(twisted))
    pose[JOINT_INDEX[f"{side}_shoulder"]] = rotvec_from_matrix(turn)
    pose[JOINT_INDEX[f"{side}_elbow"]] = np.radians((0.0, -sign * bent, 0.0))


def _leg(pose: F64, side: str, flexed: float, bent: float, spread: float) -> None:
    """Set one leg of `pose`. All angles are degrees from standing upright.

    `flexed`: negative lifts the thigh forwards. `bent`: angle of the knee. `spread`: turn of the leg to its side.
    """
    sign = SIDES[side]
    turn = about(2, np.radians(sign * spread)) @ about(0, np.radians(flexed))
    pose[JOINT_INDEX[f"{side}_hip"]] = rotvec_from_matrix(turn)
    pose[JOINT_INDEX[f"{side}_knee"]] = np.radians((bent, 0.0, 0.0))
    pose[JOINT_INDEX[f"{side}_ankle"]] = np.radians((-0.35 * (flexed + bent), 0.0, -0.6 * sign * spread))


def _curl_hand(pose: F64, side: str, rng: np.random.Generator) -> None:
    sign, grip, spread = SIDES[side], rng.uniform(-5, 75) * rng.random(), rng.uniform(-3, 8)
    for finger, outwards in (("index", 1.0), ("middle", 0.2), ("ring", -0.5), ("pinky", -1.0)):
        for part in (1, 2, 3):
            curl = grip * rng.uniform(0.6, 1.2) + 6.0
            turn = (0.0, -sign * spread * outwards * (part == 1), -sign * curl)
            pose[JOINT_INDEX[f"{side}_{finger}{part}"]] = np.radians(turn)
    for part in (1, 2, 3):
        pose[JOINT_INDEX[f"{side}_thumb{part}"]] = np.radians((6.0, -sign * 8.0, 0.0)) * rng.standard_normal()
