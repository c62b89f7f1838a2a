"""Bodies: extreme shapes, skinning in float32, skin weights that are left out or do not sum to 1.

Rule: the reference sums all weights in extended precision; the bound counts the roundings of what is computed.

Skinning. With n weights of a vertex that are not 0, the blended matrix M is off by gamma_(n+1) of sum w |matrix| in
float32 (one rounding for the float32 matrices), and M [p, 1] by four roundings more. Pose blend shapes move p by a sum
of 486 products, off by gamma_488 of their absolute values.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from trilane.apps.experiments.hard_numbers.hard_number import EXACT, HIGHAM, U32, HardNumber, U, gamma, worst
from trilane.apps.experiments.hard_numbers.rotations import MM, random_pose
from trilane.arrays import F64
from trilane.body.body import Body, ShapedBody, weights_of_one
from trilane.body.joints import JOINTS, POSE_FEATURES
from trilane.body.kinematics import Skeleton
from trilane.body.skinning import WEIGHT_COUNTS, CpuSkinner, FrameSkinner, weight_error_bound

SIGMAS = 5.0
#: Drawn shape directions: how many, and how far one sigma of each moves a vertex, metres.
DRAWN, DRAWN_M = 10, 0.01
#: Metres of the root joint from the origin.
PLACES = {"0.2 m": 0.2, "20 m": 20.0, "200 m": 200.0}
#: Sums of a vertex's skin weights, as files have them that are just accepted.
SUMS = (0.9991, 1.0009)
POSES = 8
#: Skin weights of a vertex that are drawn, on joints from all over the body.
DRAWN_WEIGHTS = 16
PROOF = "the bound that body/skinning.py proves"


def body_cases(shaped: ShapedBody) -> Iterator[HardNumber]:
    """Rows of shapes, skinning and weights of the body `shaped`."""
    yield from _shapes(shaped.body)
    yield from _skinning(shaped)
    yield from _left_out(shaped)
    yield from _sums(shaped)


def _shapes(body: Body) -> Iterator[HardNumber]:
    """The rest vertices are a sum in float64 of S + 1 numbers and an offset, rounded to float32.

    The shape directions are drawn.
    """
    rng = np.random.default_rng(9)
    drawn = rng.normal(0, DRAWN_M, (2, *body.v_template.shape, DRAWN)).astype(np.float32)
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
            yield HardNumber(f"all {count} {name} at {word}", *_in_mm(worst(errors, bounds)), "mm", HIGHAM)


def _skinning(shaped: ShapedBody) -> Iterator[HardNumber]:
    skeleton, skinner = Skeleton(shaped.joints, shaped.body.parents), FrameSkinner(shaped)
    pose, found = random_pose(JOINTS), np.empty(shaped.vertices.shape, np.float32)
    for name, metres in PLACES.items():
        posed = skeleton.pose(pose, metres * np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0))
        skinner.skin_into(posed, found)
        wanted, bounds = _skinned(shaped, posed.matrices.astype(np.float64), posed.feature.astype(np.float64))
        errors = np.abs(found - wanted)
        name = f"vertices skinned in float32, a pose never trained, {name} away"
        yield HardNumber(name, *_in_mm(worst(errors, bounds)), "mm", HIGHAM)


def _skinned(shaped: ShapedBody, matrices: F64, feature: F64) -> tuple[F64, F64]:
    """Vertices (V, 3) in float64, and how far float32 may be off them."""
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
    """Of the body, whose vertices have seven weights at most, the four largest; of drawn weights all that are offered.

    200 m away, remaining weights that do not sum to 1 would show.
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
    """Beside the proof's bound each of the two sums of weights is off by gamma_n, times how far the body reaches."""
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    few, whole = CpuSkinner(shaped, count, pose_blend=False), CpuSkinner(shaped, pose_blend=False)
    reach = metres + 1.0 + np.abs(shaped.vertices).max()
    rounding = 2 * gamma(int(np.count_nonzero(shaped.body.weights, axis=1).max()) + 4, U32) * reach
    posed = (skeleton.pose(pose, np.array([0.0, 0.0, metres])) for pose in poses)
    moved = [np.linalg.norm(few.vertices(one) - whole.vertices(one), axis=1) for one in posed]
    found = _in_mm(worst(np.max(moved, axis=0), weight_error_bound(shaped, count) + rounding))
    return HardNumber(f"the {count} largest {what}, {POSES} poses never trained", *found, "mm", PROOF)


def _sums(shaped: ShapedBody) -> Iterator[HardNumber]:
    """A body 200 m from the origin: weights that sum to 1 + d would move it by 200 d metres."""
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    posed = skeleton.pose(np.zeros((JOINTS, 3)), np.array([200.0, 0.0, 0.0]))
    wanted = CpuSkinner(shaped, pose_blend=False).vertices(posed)
    for total in SUMS:
        weights = weights_of_one(shaped.body.weights * np.float32(total))
        scaled = replace(shaped, body=replace(shaped.body, weights=weights))
        errors = np.abs(CpuSkinner(scaled, pose_blend=False).vertices(posed) - wanted).max(axis=1)
        many = np.count_nonzero(shaped.body.weights, axis=1)
        bounds = (gamma(many + 4, U32) + gamma(many, U)) * (201.0 + np.abs(shaped.vertices).max())
        found = _in_mm(worst(errors, bounds))
        yield HardNumber(f"skin weights of a file that sum to {total}, 200 m away", *found, "mm", HIGHAM)
    sums = [np.abs(weights_of_one(shaped.body.weights * np.float32(t)).sum(axis=1, dtype=np.float64) - 1) for t in SUMS]
    many = np.count_nonzero(shaped.body.weights, axis=1)
    yield HardNumber("their sums after loading", *worst(np.max(sums, axis=0), gamma(many + 2, U32)), "of 1", HIGHAM)
    negative = weights_of_one(np.array([[1.0005, -0.0005], [0.0, 1.0]], np.float32))
    error = float(np.abs(negative - np.eye(2)).max())
    yield HardNumber("a weight just below 0 after loading", error, 0.0, "of 1", EXACT)


def _in_mm(found: tuple[float, float]) -> tuple[float, float]:
    return found[0] * MM, found[1] * MM
