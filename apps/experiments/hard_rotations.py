"""Hard cases of rotations: angles at which formulas break, a million random rotations, and chains of joints.

Rule: a bound follows from the tested formulas and the precision of the numbers, never from a result. An error that is
not a number is above every bound. The references share no code with the tested body/joints.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from decimal import Decimal, localcontext
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.joints import Skeleton, rodrigues, turn
from trilane.scene.rotations import quat_from_rotvec, rotvec_from_quat

#: The unit roundoffs of float64 and float32.
U: Final = 2.0**-53
U32: Final = 2.0**-24
HIGHAM = "forward error analysis (Higham 2002, 3.1)"
EXACT = "exact: the definition leaves no room"
ANGLES = {
    "0": 0.0,
    "5e-324, the least number": 5e-324,
    "1e-160": 1e-160,
    "1e-12": 1e-12,
    "1e-9": 1e-9,
    "1e-6": 1e-6,
    "1e-3": 1e-3,
    "pi - 1e-7": np.pi - 1e-7,
    "pi": np.pi,
    "pi + 1e-7": np.pi + 1e-7,
    "2 pi - 1e-7": 2 * np.pi - 1e-7,
    "2 pi": 2 * np.pi,
    "100 pi": 100 * np.pi,
    "1e6": 1e6,
}
#: Angles whose vectors are converted to a quaternion and back. Vectors beyond half a turn would not come back.
RETURNED = ("1e-12", "1e-6", "1e-3", "pi - 1e-7")
RANDOM, CHUNK, SEED = 1_000_000, 100_000, 17
LEAST = 2.0**-1074
DIGITS = 80
PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459230781640628620899862803482534211706798")
#: Angle t below which two terms of the series of sin(t) / t and (1 - cos(t)) / t^2 give all `DIGITS` digits.
TINY = Decimal("1e-30")
MM = 1e3
Wide = NDArray[np.longdouble]
#: Name of a pose -> angle by which every joint turns about the axis (1, 2, 3) / sqrt(14).
TURNS = {
    "all turned by 1e-7": 1e-7,
    "all turned by pi - 1e-7": np.pi - 1e-7,
    "all turned by pi": np.pi,
    "all turned by 100 pi + 1": 100 * np.pi + 1,
}
#: Distances of the root joint from the origin, metres.
PLACES = {"at the origin": 0.0, "200 m away": 200.0, "10 km away": 1e4}
CHAIN_SEED = 23


class HardNumber(NamedTuple):
    """One hard case.

    `name`: what is computed. `error`, `bound`: both in `unit`. `source`: source of the bound.
    """

    name: str
    error: float
    bound: float
    unit: str
    source: str

    @property
    def holds(self) -> bool:
        return bool(self.error <= self.bound)


def gamma(n: float, unit: float = U) -> float:
    """Return gamma_n = n u / (1 - n u), where u = `unit` is the unit roundoff of the numbers.

    A sum of n products is off by at most gamma_n times the sum of their absolute values: N. Higham, Accuracy and
    Stability of Numerical Algorithms, 2nd ed. 2002, sections 2.2 and 3.1.
    """
    return n * unit / (1 - n * unit)


def worst(errors: ArrayLike, bounds: ArrayLike) -> tuple[float, float]:
    """Return (error, bound): the error with the largest ratio to its bound, and this bound.

    If an error is NaN, return NaN and its bound. If all errors are 0, return 0 and the largest bound. `errors`,
    `bounds`: arrays that can be broadcast to the same shape.
    """
    found: Any = np.broadcast_arrays(np.asarray(errors, np.float64), np.asarray(bounds, np.float64))
    error, bound = (each.ravel() for each in found)
    if np.isnan(error).any():
        return float("nan"), float(bound[np.isnan(error)][0])
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(error > 0, error / bound, 0.0)
    place = int(share.argmax()) if share.max() > 0 else int(bound.argmax())
    return float(error[place]), float(bound[place])


def rotation_cases() -> Iterator[HardNumber]:
    """Yield rows about rotations by each of `ANGLES`, random rotations, and conversions to quaternions and back."""
    axes = _axes()
    for name, angle in ANGLES.items():
        vectors = axes * angle
        errors = [turn_error(turn(vector), exact_turn(vector.tolist())) for vector in vectors]
        bounds = turn_bound(np.full(len(axes), angle))
        yield HardNumber(f"rotation by {name}, {len(axes)} axes", *worst(errors, bounds), "entry of R - I", HIGHAM)
    yield from _random_cases()
    for name in RETURNED:
        vectors = axes * ANGLES[name]
        back = rotvec_from_quat(quat_from_rotvec(vectors))
        errors = np.abs(back - vectors).max(axis=1)
        bounds = return_bound(np.full(len(axes), ANGLES[name]))
        yield HardNumber(f"rotation by {name} to a quaternion and back", *worst(errors, bounds), "rad", HIGHAM)


def turn_bound(angle: F64) -> F64:
    """Return the bound on the error of an entry of R - I (...), for rotations by `angle` (...), radians.

    Let v be the axis-angle vector, and U the unit roundoff of float64. h = |v| / 2 is off by at most 2.5 U of itself,
    because it is the root of a sum of three squares. Let s = min(1, h). The first part of the quaternion is off by at
    most f = U (2.5 h + 2). Each other part is off by at most e = U (2.5 h + 7.5 s). An entry of R - I is a sum of at
    most two products of parts, doubled. Therefore the entry is off by at most

        (4 s + 2) e + 2 s f + 6 s U

    The factor 1.01 covers terms of U^2 and smaller. Below the least normal number, each of the eight roundings may add
    the least subnormal number.
    """
    s, e, f = _parts(np.asarray(angle, np.float64))
    return np.asarray(1.01 * ((4 * s + 2) * e + 2 * s * f + 6 * s * U) + np.where(angle > 0, 8 * LEAST, 0.0))


def return_bound(angle: F64) -> F64:
    """Return the bound on the error of an entry of the axis-angle vector from a quaternion (...), radians.

    `angle` (...): angle of the rotation, radians, up to pi. Let w be the quaternion's first part, and sine the length
    of the vector of its other parts. With e and f as in `turn_bound`, the angle 2 atan2(sine, w) is off by
    2 (f sine + sqrt(3) e) and four roundings. The axis is this vector divided by sine.
    """
    _, e, f = _parts(np.asarray(angle, np.float64))
    sine = np.sin(np.minimum(angle / 2, np.pi / 2))
    axis = (1 + np.sqrt(3)) * e / np.maximum(sine, LEAST) + 3 * U
    return np.asarray(1.01 * (2 * (f * sine + np.sqrt(3) * e) + 4 * U * angle + angle * axis) + 8 * LEAST)


def _parts(angle: F64) -> tuple[F64, F64, F64]:
    """Return (s, e, f) of `turn_bound`, each of the shape of `angle`, radians."""
    h = angle / 2
    s = np.minimum(1.0, h)
    return s, U * (2.5 * h + 7.5 * s), U * (2.5 * h + 2)


def _axes() -> F64:
    """Return unit vectors (26, 3) from the centre of a cube to its faces, edges and corners."""
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    directions = grid[np.abs(grid).any(axis=1)]
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def _random_cases() -> Iterator[HardNumber]:
    """Yield rows about R^T R = I and det R = 1 for random rotations by 0 to 2 pi.

    Let each entry of R be off by at most b. An entry of R^T R is off by at most 2 sqrt(3) b, because columns have
    length 1, and by four roundings. The determinant is off by b times the sum of all cofactors, at most 3 sqrt(3), and
    by ten roundings.
    """
    rng = np.random.default_rng(SEED)
    square, volume = [], []
    for _ in range(RANDOM // CHUNK):
        axis = rng.normal(size=(CHUNK, 3))
        vectors = axis / np.linalg.norm(axis, axis=1, keepdims=True) * rng.uniform(0, 2 * np.pi, (CHUNK, 1))
        matrices = rodrigues(vectors)
        entry = turn_bound(np.linalg.norm(vectors, axis=1)) + U
        product = np.einsum("nki,nkj->nij", matrices, matrices) - np.eye(3)
        square.append(worst(np.abs(product).max(axis=(1, 2)), 2 * np.sqrt(3) * entry + 4 * U))
        triple = np.einsum("ni,ni->n", matrices[:, 0], np.cross(matrices[:, 1], matrices[:, 2]))
        volume.append(worst(np.abs(triple - 1), 3 * np.sqrt(3) * entry + 10 * U))
    name = f"{RANDOM:,} random rotations"
    yield HardNumber(f"{name}: R^T R", *worst(*np.transpose(square)), "entry of R^T R - I", HIGHAM)
    yield HardNumber(f"{name}: determinant", *worst(*np.transpose(volume)), "det R - 1", HIGHAM)


def exact_turn(rotvec: Sequence[float]) -> list[list[Decimal]]:
    """Return R - I, a list of three rows, of the axis-angle vector `rotvec` (3,), radians, to `DIGITS` digits.

    Let v be this vector, and t = |v|, below 1e9. R - I = a [v]x + b [v]x^2, where a = sin(t) / t and b = (1 - cos(t)) /
    t^2. First, t is reduced by multiples of 2 pi. After that, series compute sin and cos.
    """
    with localcontext() as context:
        context.prec = DIGITS
        x, y, z = (Decimal(float(value)) for value in rotvec)
        squared = x * x + y * y + z * z
        sine, cosine = _factors(squared)
        return [
            [-cosine * (y * y + z * z), cosine * x * y - sine * z, cosine * x * z + sine * y],
            [cosine * x * y + sine * z, -cosine * (x * x + z * z), cosine * y * z - sine * x],
            [cosine * x * z - sine * y, cosine * y * z + sine * x, -cosine * (x * x + y * y)],
        ]


def turn_error(found: F64, exact: Sequence[Sequence[Decimal]]) -> float:
    """Return the largest difference between an entry of `found` and of `exact`, both R - I (3,3).

    Return NaN if an entry of `found` is not finite.
    """
    if not np.isfinite(found).all():
        return float("nan")
    with localcontext() as context:
        context.prec = DIGITS
        differences = [abs(Decimal(float(found[i, j])) - exact[i][j]) for i in range(3) for j in range(3)]
        return float(max(differences))


def _factors(squared: Decimal) -> tuple[Decimal, Decimal]:
    """Return (sin(t) / t, (1 - cos(t)) / t^2) for the angle t in radians. `squared`: t^2."""
    angle = squared.sqrt()
    if angle < TINY:
        return 1 - squared / 6, Decimal("0.5") - squared / 24
    turned = angle % (2 * PI)
    if turned > PI:
        turned -= 2 * PI
    sine, cosine_below_one = _series(turned)
    return sine / angle, cosine_below_one / squared


def _series(angle: Decimal) -> tuple[Decimal, Decimal]:
    """Return (sin, 1 - cos) of an angle from -pi to pi, by Taylor's series."""
    term, sine, missing = angle, angle, Decimal(0)
    power = Decimal(1)
    for n in range(1, 60):
        power = -power * angle * angle / ((2 * n - 1) * (2 * n))
        missing -= power
        term = -term * angle * angle / ((2 * n) * (2 * n + 1))
        sine += term
    return sine, missing


def chain_cases(shaped: ShapedBody) -> Iterator[HardNumber]:
    """Yield rows about the joints of the whole body, and about the float32 skinning matrices for the GPU.

    `shaped`: body.
    """
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    poses = {name: np.tile(axis * angle, (len(shaped.joints), 1)) for name, angle in TURNS.items()}
    poses["turned at random, up to 2 pi"] = random_pose(len(shaped.joints))
    for name, pose in poses.items():
        wanted = walked(shaped, pose, np.zeros(3))[:, :, 3]
        errors, bounds = np.abs(skeleton.pose(pose).joints - wanted).max(axis=1), joint_bounds(shaped, pose, 0.0)
        yield HardNumber(f"joints of the whole body {name}", *in_mm(worst(errors, bounds)), "mm", HIGHAM)
    pose = poses["turned at random, up to 2 pi"]
    for name, metres in PLACES.items():
        root = metres * axis
        wanted = walked(shaped, pose, root)
        wanted[:, :, 3] -= np.einsum("jab,jb->ja", wanted[:, :, :3], shaped.joints)
        own = joint_bounds(shaped, pose, metres)[:, None]
        rest = np.linalg.norm(shaped.joints, axis=1)[:, None]
        bounds = own + _rotation_bounds(shaped, pose)[:, None] * rest + gamma(5) * (np.abs(wanted[:, :, 3]) + 2 * rest)
        bounds = bounds + U32 * (np.abs(wanted[:, :, 3]) + bounds)
        errors = np.abs(skeleton.pose(pose, root).matrices[:, :, 3] - wanted[:, :, 3])
        yield HardNumber(f"places of the skinning matrices, {name}", *in_mm(worst(errors, bounds)), "mm", HIGHAM)


def walked(shaped: ShapedBody, pose: F64, root: F64) -> Wide:
    """Return the world transforms (55,3,4) of the joints in extended precision, computed joint by joint from the root.

    The tested body/joints.py goes along the chain in steps of powers of two instead. `shaped`: body. `pose` (55,3):
    axis-angle vectors, radians. `root` (3,): translation of the root joint, metres.
    """
    wide = np.longdouble
    found: Wide = np.zeros((len(shaped.joints), 3, 4), wide)
    for joint, parent in enumerate(shaped.body.parents):
        own = np.zeros((3, 4), wide)
        own[:, :3] = _wide_rotation(pose[joint].astype(wide))
        own[:, 3] = shaped.joints[joint].astype(wide) - (shaped.joints[parent].astype(wide) if parent >= 0 else 0)
        if parent < 0:
            own[:, 3] += root.astype(wide)
            found[joint] = own
        else:
            above = found[parent]
            found[joint, :, :3] = above[:, :3] @ own[:, :3]
            found[joint, :, 3] = above[:, :3] @ own[:, 3] + above[:, 3]
    return found


def joint_bounds(shaped: ShapedBody, pose: F64, root_m: float) -> F64:
    """Return the bounds on the errors of the joints' places (55,), metres.

    A local rotation is off by at most 3 b in norm. b is the bound of `turn_bound`, plus U for adding I. A product of a
    row and a column rounds by gamma_4 of its size. The size is at most sqrt(3) * sqrt(3) for rotations, and sqrt(3)
    |place| + |place| for places. Over d joints these errors add up. With L the length of the chain's bones, the place
    of the last joint is off by at most

        L sum (3 b + 12 U) + d gamma_4 (sqrt(3) + 1) (|root| + L)

    `shaped`: body. `pose` (55,3): axis-angle vectors, radians. `root_m`: distance of the root from the origin, metres.
    """
    parents, joints = shaped.body.parents, shaped.joints
    length, depth = np.zeros(len(joints)), np.zeros(len(joints))
    for joint, parent in enumerate(parents):
        if parent >= 0:
            length[joint] = length[parent] + np.linalg.norm(joints[joint] - joints[parent])
            depth[joint] = depth[parent] + 1
    length += np.linalg.norm(joints[0])
    return np.asarray(
        length * _rotation_bounds(shaped, pose) + (depth + 2) * gamma(4) * (np.sqrt(3) + 1) * (root_m + length)
    )


def _rotation_bounds(shaped: ShapedBody, pose: F64) -> F64:
    """Return the bounds on the errors of the joints' world rotations (55,), in norm. Parameters: see `joint_bounds`."""
    local = 3 * (turn_bound(np.linalg.norm(pose, axis=1)) + U) + 12 * U
    total = np.zeros(len(local))
    for joint, parent in enumerate(shaped.body.parents):
        total[joint] = local[joint] + (total[parent] if parent >= 0 else 0.0)
    return total


def _wide_rotation(v: Wide) -> Wide:
    """Return the rotation matrix (3,3) of an axis-angle vector `v` (3,), radians, in the precision of `v`.

    The formula uses 1 - cos(t) = 2 sin^2(t / 2), which keeps all digits for small t.
    """
    angle = np.sqrt(v @ v)
    if angle == 0:
        return np.eye(3, dtype=v.dtype)
    cross = np.zeros((3, 3), v.dtype)
    cross[[2, 0, 1], [1, 2, 0]] = v
    cross[[1, 2, 0], [2, 0, 1]] = -v
    half = np.sin(angle / 2) / angle
    turned: Wide = np.eye(3, dtype=v.dtype) + np.sin(angle) / angle * cross + 2 * half * half * (cross @ cross)
    return turned


def random_pose(joints: int) -> F64:
    rng = np.random.default_rng(CHAIN_SEED)
    axis = rng.normal(size=(joints, 3))
    return np.asarray(axis / np.linalg.norm(axis, axis=1, keepdims=True) * rng.uniform(0, 2 * np.pi, (joints, 1)))


def in_mm(found: tuple[float, float]) -> tuple[float, float]:
    return found[0] * MM, found[1] * MM
