"""Numbers that are hard to compute, each with an error and a bound. `hard_rotations.py` has the cases of rotations.

Rule: the body is the default avatar's, so the rows are the same everywhere. A reference sums in extended precision or
float64. A bound counts the roundings of the computation, and never follows from a result.

If a texture has constant channels, every covered pixel of a tensor has known bytes. A byte is clamp(round(x / scale) +
zero point, 0, 255), rounded to even. The values x are FP16 numbers. Some quotients x / scale lie halfway between two
whole numbers. Their scale is a power of two, so every driver divides exactly. All other quotients are at least 0.1 away
from such a half. A driver's division is more exact (2.5 units in the last place, Vulkan 1.3, OpenCL 3.0 for float32).

The tensor of a scene's frame must be the same to the byte, no matter which frames were drawn before. The reference
comes from stages that have drawn no other frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from trilane.apps.experiments.hard_rotations import EXACT, HIGHAM, U32, HardNumber, U, gamma, in_mm, random_pose, worst
from trilane.apps.experiments.scene_pictures import DrawnTensors
from trilane.arrays import F64, U8
from trilane.body.body import Body, ShapedBody, weights_of_one
from trilane.body.joints import JOINTS, POSE_FEATURES, Posed, Skeleton, rodrigues
from trilane.body.skinning import WEIGHT_COUNTS, CpuSkinner, FrameSkinner, weight_error_bound
from trilane.errors import BadInputError
from trilane.scene.camera.path import load_builtin, look_at, projection_matrix
from trilane.scene.crop import Rect, crop_projection
from trilane.scene.motion.builtin import walk_wave_turn
from trilane.scene.motion.motion import Wrap
from trilane.scene.schema import CameraSpec
from trilane.stages.config import Quantisation
from trilane.stages.configure import Checked, configure
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.stages.gpu.raster import PackedAvatar, PackedPass, Placement, check_texture, texture_array
from trilane.stages.gpu.skinned_mesh import SkinnedMesh, mesh_arrays
from trilane.stages.run_options import RunOptions

HOLDS, EXCEEDED = "holds", "FAILS: error above the bound"
#: Number of rows of `hard_numbers`.
COUNT = 92
SIGMAS = 5.0
#: Random shape directions: their number, and how far one sigma of a direction moves a vertex, metres.
DRAWN_DIRECTIONS, DRAWN_M = 10, 0.01
#: Distances of the root joint from the origin, metres.
PLACES = {"0.2 m": 0.2, "20 m": 20.0, "200 m": 200.0}
#: Sums of a vertex's skin weights just within the limits for body files.
SUMS = (0.9991, 1.0009)
POSES = 8
#: Number of random skin weights of a vertex, for joints from all over the body.
DRAWN_WEIGHTS = 16
WEIGHTS_PROOF = "the bound that body/skinning.py proves"
NEAR_M, FAR_M = 0.05, 1000.0
#: Camera -> its field of view in degrees, and its distance from a joint in metres.
VIEWS = {
    "a lens of 1 degree at 60 m": (1.0, 60.0),
    "a lens of 10 degrees at 8 m": (10.0, 8.0),
    "a lens of 120 degrees at 0.8 m": (120.0, 0.8),
    "a lens of 170 degrees at 0.5 m": (170.0, 0.5),
    "0.2 m away": (60.0, 0.2),
    "1 m away": (60.0, 1.0),
    "20 m away": (60.0, 20.0),
    "200 m away": (60.0, 200.0),
    "inside the body": (90.0, 0.02),
    "the near plane through the body": (90.0, 0.12),
}
DRAWN_POSES = 6
SIDE = 512
#: Name of a crop -> its width in NDC; the screen is 2 wide.
CROPS = {"a whole screen": 2.0, "a tenth": 0.2, "a 4096th": 2 / 4096}
BOX_PROOF = "no vertex on the screen may be outside: 0, by the proof in stages/cpu/mesh_bounds.py"
FRAME = 5_000_000
RATES = (24.0, 30.0, 59.94)
SOURCE = "rounding of the frame's time, times the fastest that is shown"
Shown = Callable[[float], F64]


def hard_numbers() -> Iterator[dict[str, Any]]:
    """Yield a row for each hard number.

    Keys:
    `name`: what is computed.
    `error`: error; None if it is not a finite number, which counts as above every bound.
    `bound`: bound on the error.
    `unit`: unit of the error and of the bound.
    `source`: source of the bound.
    `verdict`: verdict as text.
    `passed`: whether the bound holds.

    Raises MissingPartError if no OpenGL context can be made.
    """
    for case in _cases():
        error = case.error if math.isfinite(case.error) else None
        yield {**case._asdict(), "error": error, "verdict": HOLDS if case.holds else EXCEEDED, "passed": case.holds}


def kept_going(kind: str, cases: Iterable[HardNumber]) -> Iterator[HardNumber]:
    """Yield `cases`. After a BadInputError, ArithmeticError or ValueError, a failed row with its text ends the rows.

    `kind`: name of the kind of cases.
    """
    try:
        yield from cases
    except (BadInputError, ArithmeticError, ValueError) as error:
        yield HardNumber(f"{kind}, ended by an error: {error}", math.inf, 0.0, "errors", EXACT)


def _cases() -> Iterator[HardNumber]:
    from trilane.apps.experiments.hard_rotations import chain_cases, rotation_cases
    from trilane.avatars.bundle import load_bundle
    from trilane.stages.avatar_assets import load_avatar
    from trilane.stages.gpu.opengl import open_context

    context = open_context(2)
    shaped = load_avatar(load_bundle("default")).shaped
    yield from kept_going("rotations", rotation_cases())
    yield from kept_going("chains of joints", chain_cases(shaped))
    yield from kept_going("bodies", _body_cases(shaped))
    yield from kept_going("cameras", _camera_cases(shaped))
    yield from kept_going("times", time_cases())
    with context:
        yield from kept_going("tensors", tensor_cases(shaped, context))
    yield from kept_going("scenes", scene_cases())


def _body_cases(shaped: ShapedBody) -> Iterator[HardNumber]:
    """Yield rows about shapes, skinning and weights of the body `shaped`."""
    yield from _shapes(shaped.body)
    yield from _skinning(shaped)
    yield from _left_out(shaped)
    yield from _sums(shaped)


def _shapes(body: Body) -> Iterator[HardNumber]:
    """Yield rows about extreme shapes of `body`, with random shape directions.

    A rest vertex is a sum in float64, rounded to float32. The sum has S + 1 numbers and an offset, where S is the
    number of directions.
    """
    rng = np.random.default_rng(9)
    drawn = rng.normal(0, DRAWN_M, (2, *body.v_template.shape, DRAWN_DIRECTIONS)).astype(np.float32)
    body = replace(body, shape_dirs=drawn[0], expression_dirs=drawn[1])
    offsets = np.zeros_like(body.v_template) if body.offsets is None else body.offsets
    for name, dirs in (("betas", body.shape_dirs), ("expression", body.expression_dirs)):
        count = dirs.shape[2]
        signs = {"+5 sigma": np.ones(count), "-5 sigma": -np.ones(count), "+-5 sigma": (-1.0) ** np.arange(count)}
        for word, sign in signs.items():
            values = SIGMAS * sign
            found = body.shape(**{name: values}).vertices
            terms = dirs.astype(np.longdouble) * values
            wanted = body.v_template + terms.sum(axis=2) + offsets
            size = np.abs(body.v_template) + np.abs(terms).sum(axis=2) + np.abs(offsets)
            bounds = U32 * np.abs(wanted) + 2 * gamma(count + 3) * size
            errors = np.abs(found - wanted)
            yield HardNumber(f"all {count} {name} at {word}", *in_mm(worst(errors, bounds)), "mm", HIGHAM)


def _skinning(shaped: ShapedBody) -> Iterator[HardNumber]:
    skeleton, skinner = Skeleton(shaped.joints, shaped.body.parents), FrameSkinner(shaped)
    pose, found = random_pose(JOINTS), np.empty(shaped.vertices.shape, np.float32)
    for name, metres in PLACES.items():
        posed = skeleton.pose(pose, metres * np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0))
        skinner.skin_into(posed, found)
        wanted, bounds = _skinned(shaped, posed.matrices.astype(np.float64), posed.feature.astype(np.float64))
        errors = np.abs(found - wanted)
        name = f"vertices skinned in float32, a pose never trained, {name} away"
        yield HardNumber(name, *in_mm(worst(errors, bounds)), "mm", HIGHAM)


def _skinned(shaped: ShapedBody, matrices: F64, feature: F64) -> tuple[F64, F64]:
    """Return (vertices, bounds): skinned vertices (V,3) in float64, and bounds on the errors of float32 (V,3), metres.

    `shaped`: body. `matrices` (55,3,4): skinning matrices. `feature` (486,): entries of R - I of joints 1 to 54.

    Let a vertex have n weights other than 0. In float32, the blended matrix M is off by gamma_(n+1) of sum w |matrix|;
    this includes one rounding for the float32 matrices. M [p, 1] is off by four roundings more. Pose blend shapes move
    p by a sum of 486 products, which is off by gamma_488 of the sum of their absolute values.
    """
    body = shaped.body
    rest = shaped.vertices.astype(np.float64)
    moved, unsure = np.zeros(rest.shape), np.zeros(rest.shape)
    if body.posedirs is not None:
        dirs = body.posedirs.astype(np.float64)
        moved = dirs @ feature
        unsure = gamma(POSE_FEATURES + 2, U32) * (np.abs(dirs) @ np.abs(feature))
    rest = np.concatenate([rest + moved, np.ones((len(rest), 1))], axis=1)
    weights = body.weights.astype(np.float64)
    blended = (weights @ matrices.reshape(JOINTS, 12)).reshape(-1, 3, 4)
    sizes = (np.abs(weights) @ np.abs(matrices).reshape(JOINTS, 12)).reshape(-1, 3, 4)
    many = np.count_nonzero(weights, axis=1)[:, None]
    places = np.einsum("vab,vb->va", blended, rest)
    bounds = gamma(many + 6, U32) * np.einsum("vab,vb->va", sizes, np.abs(rest))
    return places, bounds + np.einsum("vab,vb->va", sizes[:, :, :3], unsure)


def _left_out(shaped: ShapedBody) -> Iterator[HardNumber]:
    """Yield rows about skinning with only the largest weights of each vertex.

    One row keeps four weights of the body `shaped`, whose vertices have seven weights at most. The other rows keep each
    count of `WEIGHT_COUNTS` of random weights, with the body 200 m away. At this distance, an error would show if the
    kept weights did not sum to 1.
    """
    rng = np.random.default_rng(5)
    poses = [rng.normal(0, 1.0, (JOINTS, 3)) for _ in range(POSES)]
    yield _fewer(shaped, 4, poses, 0.0, "skin weights alone")
    weights = np.zeros((len(shaped.vertices), JOINTS))
    joints = np.argsort(rng.random(weights.shape), axis=1)[:, :DRAWN_WEIGHTS]
    np.put_along_axis(weights, joints, rng.dirichlet(np.ones(DRAWN_WEIGHTS), len(weights)), axis=1)
    drawn = replace(shaped, body=replace(shaped.body, weights=weights_of_one(weights.astype(np.float32))))
    for count in WEIGHT_COUNTS:
        yield _fewer(drawn, count, poses, 200.0, f"of {DRAWN_WEIGHTS} drawn skin weights, 200 m away")


def _fewer(shaped: ShapedBody, count: int, poses: Sequence[F64], metres: float, what: str) -> HardNumber:
    """Return the row about skinning with the `count` largest weights of each vertex.

    The bound is `weight_error_bound`, plus the rounding of two weighted sums: each gamma_n times how far the body
    reaches from the origin.

    `shaped`: body. `poses`: axis-angle vectors (55,3) of each pose. `metres`: distance of the body from the origin.
    `what`: description of the weights for the row's name.
    """
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    few, whole = CpuSkinner(shaped, count, pose_blend=False), CpuSkinner(shaped, pose_blend=False)
    reach = metres + 1.0 + np.abs(shaped.vertices).max()
    rounding = 2 * gamma(int(np.count_nonzero(shaped.body.weights, axis=1).max()) + 4, U32) * reach
    posed = (skeleton.pose(pose, np.array([0.0, 0.0, metres])) for pose in poses)
    moved = [np.linalg.norm(few.vertices(one) - whole.vertices(one), axis=1) for one in posed]
    found = in_mm(worst(np.max(moved, axis=0), weight_error_bound(shaped, count) + rounding))
    return HardNumber(f"the {count} largest {what}, {POSES} poses never trained", *found, "mm", WEIGHTS_PROOF)


def _sums(shaped: ShapedBody) -> Iterator[HardNumber]:
    """Yield rows about weights of the body `shaped` that do not sum to 1.

    The body is 200 m away. There a sum of 1 + d would move the body by 200 d metres.
    """
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    posed = skeleton.pose(np.zeros((JOINTS, 3)), np.array([200.0, 0.0, 0.0]))
    wanted = CpuSkinner(shaped, pose_blend=False).vertices(posed)
    for total in SUMS:
        weights = weights_of_one(shaped.body.weights * np.float32(total))
        scaled = replace(shaped, body=replace(shaped.body, weights=weights))
        errors = np.abs(CpuSkinner(scaled, pose_blend=False).vertices(posed) - wanted).max(axis=1)
        many = np.count_nonzero(shaped.body.weights, axis=1)
        bounds = (gamma(many + 4, U32) + gamma(many, U)) * (201.0 + np.abs(shaped.vertices).max())
        found = in_mm(worst(errors, bounds))
        yield HardNumber(f"skin weights of a file that sum to {total}, 200 m away", *found, "mm", HIGHAM)
    sums = [np.abs(weights_of_one(shaped.body.weights * np.float32(t)).sum(axis=1, dtype=np.float64) - 1) for t in SUMS]
    many = np.count_nonzero(shaped.body.weights, axis=1)
    yield HardNumber("their sums after loading", *worst(np.max(sums, axis=0), gamma(many + 2, U32)), "of 1", HIGHAM)
    negative = weights_of_one(np.array([[1.0005, -0.0005], [0.0, 1.0]], np.float32))
    error = float(np.abs(negative - np.eye(2)).max())
    yield HardNumber("a weight just below 0 after loading", error, 0.0, "of 1", EXACT)


def _camera_cases(shaped: ShapedBody) -> Iterator[HardNumber]:
    """Yield rows about a body's rectangle on the screen, about crops, and about places of vertices on the screen.

    The rectangle is right if no vertex on the screen lies outside it. `shaped`: body.
    """
    bounds, skinner = MeshBounds(shaped), CpuSkinner(shaped)
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    for name, (fov_deg, metres) in VIEWS.items():
        outside = [
            _outside(bounds, posed, skinner.vertices(posed), clip) for posed, clip in _drawn(skeleton, fov_deg, metres)
        ]
        found = float(np.max(outside))
        yield HardNumber(f"vertices outside the rectangle, {name}, {DRAWN_POSES} poses", found, 0.0, "NDC", BOX_PROOF)
    yield from _behind(bounds, skeleton)
    yield from _crops()
    yield from _on_screen(skinner, skeleton)


def _drawn(skeleton: Skeleton, fov_deg: float, metres: float) -> Iterator[tuple[Posed, F64]]:
    """Yield (pose, clip) for `DRAWN_POSES` random poses. `clip` is the projection @ view (4,4) of a camera.

    `skeleton`: skeleton to pose. `fov_deg`: field of view of the camera, degrees. `metres`: distance of the camera from
    one of the joints.
    """
    rng = np.random.default_rng(round(1e3 * metres + fov_deg))
    for _ in range(DRAWN_POSES):
        posed = skeleton.pose(rng.normal(0, 0.6, (JOINTS, 3)))
        target = posed.joints[rng.integers(JOINTS)].copy()
        towards = rng.normal(size=3)
        eye = target + metres * towards / np.linalg.norm(towards)
        yield posed, projection_matrix(fov_deg, 1.0, min(NEAR_M, metres / 2), FAR_M) @ look_at(eye, target)


def _outside(bounds: MeshBounds, posed: Posed, vertices: F64, clip: F64) -> float:
    """Return how far visible vertices lie outside the body's rectangle, in NDC; 0 if no vertex is visible.

    A vertex is visible if it is on the screen and beyond the near plane. If a vertex is visible but `bounds` finds no
    rectangle, return inf.

    `bounds`: object that computes the rectangle. `posed`: posed skeleton. `vertices` (V,3): metres. `clip`: projection
    @ view (4,4).
    """
    found = bounds.rect(posed, clip)
    x, y, z, w = clip @ np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1).T
    seen = (w > 0) & (z > -w) & (np.abs(x) <= w) & (np.abs(y) <= w)
    if not seen.any():
        return 0.0
    if found is None:
        return float("inf")
    x, y = x[seen] / w[seen], y[seen] / w[seen]
    return float(max(0.0, found.x0 - x.min(), x.max() - found.x1, found.y0 - y.min(), y.max() - found.y1))


def _behind(bounds: MeshBounds, skeleton: Skeleton) -> Iterator[HardNumber]:
    posed = skeleton.pose(np.zeros((JOINTS, 3)))
    eye = posed.joints[0] + np.array([0.0, 0.0, 4.0])
    clip = projection_matrix(60.0, 1.0, NEAR_M, FAR_M) @ look_at(eye, eye + np.array([0.0, 0.0, 4.0]))
    found = 0.0 if bounds.rect(posed, clip) is None else 1.0
    yield HardNumber("rectangles of a body behind the camera", found, 0.0, "rectangles", EXACT)


def _crops() -> Iterator[HardNumber]:
    """Yield rows about points in a crop: the crop's projection in float64 against the screen's in extended precision.

    X' = (2 X - (x0 + x1) W) / (x1 - x0) and W are sums of at most 8 products in float64. The absolute values of the
    products sum to at most 2 (|X| + 2 |W|) / (x1 - x0).
    """
    rng = np.random.default_rng(3)
    points = np.concatenate([rng.uniform(-2, 2, (4000, 2)), rng.uniform(-9, -1, (4000, 1)), np.ones((4000, 1))], axis=1)
    whole = projection_matrix(50.0, 1.5, NEAR_M, FAR_M)
    for name, width in CROPS.items():
        rect = Rect(0.3 - width / 2, -0.1 - width / 2, 0.3 + width / 2, -0.1 + width / 2)
        cropped = points @ crop_projection(whole, rect).T
        x, w = (points.astype(np.longdouble) @ whole.astype(np.longdouble).T).T[[0, 3]]
        wanted = (2 * x / w - (np.longdouble(rect.x0) + np.longdouble(rect.x1))) / np.longdouble(rect.width)
        sizes = 2 * (np.abs(points) @ np.abs(whole).T)[:, [0, 3]] @ np.array([1.0, 2.0]) / width / w
        bounds = (gamma(12) * sizes + gamma(6) * np.abs(wanted)) * SIDE / 2
        errors = np.abs(cropped[:, 0] / cropped[:, 3] - wanted) * SIDE / 2
        yield HardNumber(f"a crop of {name} of the screen", *worst(errors, bounds), "pixels of 512", HIGHAM)


def _on_screen(skinner: CpuSkinner, skeleton: Skeleton) -> Iterator[HardNumber]:
    """Yield rows about places of vertices on the screen: float32, with the shader's roundings, against float64.

    Let C = M [x, 1] be clip coordinates, with M and x in float32. Each coordinate is off by at most gamma_7 of |M| |x|
    in float32: four products, two roundings of the inputs, and one to spare. Let X be off by dX, and W by dW. The
    quotient X / W is off by (dX + |X / W| dW) / (|W| - dW) and by its own rounding. X / W is multiplied by half a
    tensor's side to get pixels.
    """
    posed = skeleton.pose(random_pose(JOINTS))
    vertices = skinner.vertices(posed)
    for metres in (0.2, 2.0, 20.0, 200.0):
        target = vertices.mean(axis=0)
        eye = target + metres * np.array([0.6, 0.0, 0.8])
        fov_deg = float(np.degrees(2 * np.arctan(1.0 / max(metres, 0.5))))
        clip = projection_matrix(fov_deg, 1.0, NEAR_M, FAR_M) @ look_at(eye, target)
        points = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
        seen = points @ clip.T
        points = points[seen[:, 3] > NEAR_M]
        exact = points @ clip.T
        found = points.astype(np.float32) @ clip.astype(np.float32).T
        off = gamma(7, U32) * (np.abs(points) @ np.abs(clip).T)
        place = exact[:, :2] / exact[:, 3:]
        bounds = (off[:, :2] + np.abs(place) * off[:, 3:]) / (np.abs(exact[:, 3:]) - off[:, 3:]) + U32 * np.abs(place)
        errors = np.abs(found[:, :2] / found[:, 3:] - place) * SIDE / 2
        name = f"vertices on the screen in float32, {metres:g} m away"
        yield HardNumber(name, *worst(errors, bounds * SIDE / 2), "pixels of 512", HIGHAM)


def time_cases() -> Iterator[HardNumber]:
    """Yield rows about the built-in walk and camera at each rate of `RATES`, after 23 to 58 hours of media time.

    Frame 5,000,000 must show the same as the same moment in the first period of the motion. The reference reduces the
    frame's time by the period in fractions, which are exact. The tested time t = frame / fps is rounded once, so it is
    off by at most U t (U: unit roundoff of float64). Reducing t by the period is exact. The error of a shown value is a
    few roundings, and the error of t multiplied by the value's largest change in a second.
    """
    motion, camera = walk_wave_turn(), load_builtin("orbit", CameraSpec())
    assert camera is not None
    shown: dict[str, tuple[Shown, F64, Wrap, str]] = {
        "turns of the walk": (lambda t: rodrigues(motion.sample(t)[0]), motion.times_s, motion.wrap, "entry of R"),
        "place of the walk": (lambda t: motion.sample(t)[1], motion.times_s, motion.wrap, "m"),
        "the orbiting camera": (camera.sample, camera.times_s, camera.wrap, "entry of the view"),
    }
    for name, (at, times_s, wrap, unit) in shown.items():
        speed = _fastest(at, times_s)
        for fps in RATES:
            reached = FRAME / fps
            error = float(np.abs(at(reached) - at(_moment(fps, times_s, wrap))).max())
            bound = 2 * U * reached * speed + 64 * U * (1 + np.pi)
            yield HardNumber(f"{name}, frame {FRAME:,} at {fps:g} a second", error, bound, unit, SOURCE)


def _moment(fps: float, times_s: F64, wrap: Wrap) -> float:
    """Return the time of frame `FRAME` at `fps` frames a second, reduced to the length of the motion, in seconds.

    `times_s`: times of the motion's samples. `wrap`: how the motion goes on after its end.
    """
    length = Fraction(float(times_s[-1])) * (1 if wrap is Wrap.LOOP else 2)
    phase = (Fraction(FRAME) / Fraction(fps)) % length
    return float(phase if wrap is Wrap.LOOP or phase <= length / 2 else length - phase)


def _fastest(at: Shown, times_s: F64) -> float:
    """Return the largest change per second of any value of `at`, between neighbouring samples.

    `at`: function of the time in seconds that returns an array. `times_s`: times of the samples.
    """
    values = np.array([at(float(t)).ravel() for t in times_s])
    return float(np.abs(np.diff(values, axis=0) / np.diff(times_s)[:, None]).max())


SHAPE = (64, 64)
CHANNELS = 16
POWER = 2.0**-5
NO_TENSOR = np.empty(0, np.uint8)
#: Name -> scale, zero point, and the values of the channels in steps of the scale.
STEPS: dict[str, tuple[float, int, Sequence[float]]] = {
    "halves above 0": (POWER, 117, [k + 0.5 for k in range(16)]),
    "halves below 0": (POWER, 117, [-k - 0.5 for k in range(16)]),
    "seven tenths of a step": (6 / 255, 117, [k + 0.7 for k in range(16)]),
    "seven tenths below 0": (6 / 255, 117, [-k - 0.7 for k in range(16)]),
    "just over the highest byte": (POWER, 117, [138 + k / 2 for k in range(16)]),
    "just under the lowest byte": (POWER, 117, [-117 - k / 2 for k in range(16)]),
    "a zero point of 0": (POWER, 0, [k - 7.5 for k in range(16)]),
    "a zero point of 255": (POWER, 255, [k - 7.5 for k in range(16)]),
}
LARGEST, LEAST = 65504.0, 2.0**-24
#: Name -> scale, zero point, and the values of the channels.
NUMBERS: dict[str, tuple[float, int, Sequence[float]]] = {
    "the largest FP16 numbers": (6 / 255, 117, [LARGEST, -LARGEST] * 8),
    "FP16 subnormals at a scale of their own": (LEAST, 3, [k * LEAST for k in range(16)]),
    "no contrast: all values 0 or -0": (1e-30, 117, [0.0, -0.0] * 8),
    "a scale so small that all is clamped": (1e-30, 117, [LEAST, -LEAST] * 8),
    "a scale so large that all is 0": (1e30, 117, [LARGEST, -LARGEST] * 8),
}
HALF_ULP = "FP16 rounds to the nearest: 2^-11 of a number, 2^-25 at least"
#: Scene -> frames to draw, in this order. Each differs much from the one drawn before it, such as in camera or pose.
JUMPS = {"walk-past": (0, 180, 30, 299, 0), "leave-and-return": (0, 150, 20, 240), "top-to-floor": (0, 90, 180, 0)}
RUNTIME = "ort"


def tensor_cases(shaped: ShapedBody, ctx: Any) -> Iterator[HardNumber]:
    """Yield rows about packing a tensor to bytes and about texels, drawn in the OpenGL context `ctx`.

    `shaped`: body.
    """
    mesh, view, placement = _scene(shaped, ctx)
    rows = {name: (s, z, [step * s for step in steps]) for name, (s, z, steps) in STEPS.items()} | NUMBERS
    for name, (scale, zero_point, numbers) in rows.items():
        values = np.asarray(numbers, np.float16).astype(np.float64)
        packed = PackedPass(ctx, CHANNELS, Quantisation(scale, zero_point), deferred=True)
        avatar = PackedAvatar(packed, mesh, np.tile(values.astype(np.float32), (8, 8, 1)))
        avatar.draw(packed.begin(SHAPE), view, placement)
        tensor = np.zeros(SHAPE[0] * SHAPE[1] * CHANNELS, np.uint8)
        packed.read_into(SHAPE, tensor)
        error = _steps_off(tensor.reshape(-1, CHANNELS), values, scale, zero_point)
        yield HardNumber(f"packing {name}", error, 0.0, "steps", EXACT)
    yield from _texels(ctx)


def _scene(shaped: ShapedBody, ctx: Any) -> tuple[SkinnedMesh, F64, Placement]:
    """Return (mesh, view, placement): the body's mesh at rest, a camera before it, and its place in the tensor.

    `view` is the view matrix (4,4) of the camera. `shaped`: body. `ctx`: OpenGL context.
    """
    body = shaped.body
    joint = np.zeros((len(shaped.vertices), 4), np.int64)
    weight = np.tile([1.0, 0.0, 0.0, 0.0], (len(joint), 1))
    mesh = SkinnedMesh(ctx, mesh_arrays(shaped.vertices, body.faces, body.uv, body.uv_faces, joint, weight))
    posed = Skeleton(shaped.joints, body.parents).pose(np.zeros((JOINTS, 3)))
    middle = shaped.vertices.astype(np.float64).mean(axis=0)
    view = look_at(middle + np.array([0.0, 0.0, 1.0]), middle)
    return mesh, view, Placement(posed.matrices.copy(), projection_matrix(40.0, 1.0, 0.05, 10.0), (0, 0, *SHAPE))


def _steps_off(pixels: U8, values: F64, scale: float, zero_point: int) -> float:
    """Return the largest difference of a covered pixel's bytes from the formula of this module's docstring, in steps.

    If every pixel equals the background, compare the middle pixel.

    `pixels`: packed tensor (N,C), N = height x width of `SHAPE`. `values` (C,): values of the texture. `scale`,
    `zero_point`: quantisation of the tensor.
    """
    wanted = np.clip(np.rint(values / np.float64(np.float32(scale))) + zero_point, 0, 255)
    middle = pixels.reshape(*SHAPE, -1)[SHAPE[0] // 2, SHAPE[1] // 2]
    background = (pixels == zero_point).all(axis=1)
    covered = pixels[~background] if (~background).any() else middle[None]
    return float(np.abs(covered - wanted).max())


def _texels(ctx: Any) -> Iterator[HardNumber]:
    """Yield rows about a texture's values on the GPU, and a row about values that must be refused.

    `ctx`: OpenGL context.
    """
    rng = np.random.default_rng(11)
    for name, exponents in {"usual numbers": (-6, 6), "subnormals": (-24, -14), "large numbers": (10, 15)}.items():
        sizes = 2.0 ** rng.uniform(*exponents, (8, 8, 4)) * rng.choice([-1.0, 1.0], (8, 8, 4))
        texture = sizes.astype(np.float32)
        stored = np.frombuffer(texture_array(ctx, texture).read(), np.float16).reshape(texture.shape)
        bounds = np.maximum(2.0**-11 * np.abs(texture), 2.0**-25)
        yield HardNumber(f"FP16 texels, {name}", *worst(np.abs(stored - texture), bounds), "as the texture", HALF_ULP)
    taken = sum(_is_taken(value) for value in (65520.0, np.inf, -np.inf, np.nan))
    yield HardNumber("textures that FP16 cannot hold and that are taken", float(taken), 0.0, "textures", EXACT)


def _is_taken(value: float) -> bool:
    try:
        check_texture(np.full((2, 2, 4), value, np.float32), 4)
    except BadInputError:
        return False
    return True


def scene_cases() -> Iterator[HardNumber]:
    """Yield a row for each scene of `JUMPS`.

    The error of a row is the number of tensor bytes that depend on the frames drawn before.
    """
    for scene, frames in JUMPS.items():
        checked = configure(RunOptions(scene=scene, runtime=RUNTIME), Path.cwd())
        last = checked.config.scene.frames - 1
        numbers = [min(frame, last) for frame in frames]
        name = f"{scene}: frames {', '.join(map(str, numbers))} one after the other"
        yield HardNumber(name, float(_differing(checked, numbers)), 0.0, "bytes of the tensor", EXACT)


def _differing(checked: Checked, numbers: list[int]) -> int:
    """Return how many tensor bytes of the frames `numbers` differ if the stages have drawn other frames before.

    `checked`: scene and its avatars.
    """
    used, found = DrawnTensors(checked), 0
    for number in numbers:
        after, fresh = used.tensors(number), DrawnTensors(checked).tensors(number)
        for network in after.keys() | fresh.keys():
            found += _different_bytes(after.get(network, NO_TENSOR), fresh.get(network, NO_TENSOR))
    return found


def _different_bytes(one: U8, other: U8) -> int:
    """Return how many bytes of two tensors differ. If their shapes differ, return the size of the larger tensor."""
    return max(one.size, other.size) if one.shape != other.shape else int(np.count_nonzero(one != other))
