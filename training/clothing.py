"""The clothes, hair and paint of the default body: looks as tables, and the mesh layers that are made from them.

Rule: a look is one entry of a table; `clothing_layers` and `paint.frag` turn the entry into clothes and paint. A layer
is a mesh that is skinned by the body's own weights. `paint.frag` decides where a layer ends and how it looks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX
from trilane.errors import BadInputError
from trilane.training.surface import (
    HEM_M,
    BodyArrays,
    Smoother,
    Stitched,
    long_hair,
    long_hair_weights,
    obscurance,
    shell,
    shoe,
    skirt,
    skirt_weights,
    smoothstep,
    vertex_areas,
    vertex_normals,
)

#: Key of the look's name in an avatar's provenance.
KEY = "look"
DEFAULT_NAME = "default"
Triple = tuple[float, float, float]
#: Numbers of a look that `paint.frag` reads as they are.
NUMBERS = ("fringe", "ear_ring", "sleeve_end", "leg_kept", "sock_end")


@dataclass(frozen=True)
class Look:
    """The look of a person.

    `betas`: coefficients of the body's shape. `garments`: names of `GARMENTS`. `colours`: colours of `paint.frag` by
    name, sRGB in 0..1. `hairline`: heights of the hairline at forehead, temple and nape above the eyes, metres.
    `fringe`: raggedness of the hairline, 0 to 1. `whorl`: direction from the middle of the head to the place where
    strands begin. `ear_ring`: relative size of the gap in the hair around an ear. `sleeve_end`: place along the arm
    where sleeves end: 0 is the shoulder, 1 the elbow. `legs_end`: name of a joint, and height in metres above it where
    trouser legs or a skirt end. `leg_kept`: length in metres of the skin that is drawn inside trouser legs or skirt.
    `sock_end`: height above the ankle where socks end, metres.
    """

    betas: tuple[float, ...]
    garments: tuple[str, ...]
    colours: Mapping[str, Triple]
    hairline: Triple
    fringe: float
    whorl: Triple
    ear_ring: float
    sleeve_end: float
    legs_end: tuple[str, float]
    leg_kept: float
    sock_end: float

    def definitions(self, landmarks: Landmarks) -> dict[str, str]:
        """Return the preprocessor definitions of `paint.frag`, by name, for the body of `landmarks`.

        The values are constants and not uniforms, because the compiler rounds expressions of uniforms differently.
        """
        joint, over = self.legs_end
        end = landmarks.joints[JOINT_INDEX[joint], 1] - landmarks.joints[ANKLES[1], 1] + over
        triples = {**self.colours, "HAIRLINE": self.hairline, "WHORL": self.whorl}
        numbers = {name.upper(): getattr(self, name) for name in NUMBERS}
        return {
            **{name: f"vec3({', '.join(map(repr, triple))})" for name, triple in triples.items()},
            **{name: f"({float(number)!r})" for name, number in (numbers | {"LEGS_END": end}).items()},
        }


DEFAULT = Look(
    betas=(),
    garments=("trousers", "shirt", "hair"),
    colours=MappingProxyType(
        {
            "SKIN": (0.88, 0.67, 0.54),
            "BLUSH": (0.84, 0.47, 0.40),
            "LIP": (0.75, 0.42, 0.38),
            "BROW": (0.24, 0.15, 0.10),
            "IRIS": (0.24, 0.42, 0.46),
            "SHIRT": (0.07, 0.47, 0.52),
            "TRIM": (0.66, 0.80, 0.75),
            "TROUSERS": (0.20, 0.23, 0.36),
            "STITCH": (0.36, 0.34, 0.38),
            "HAIR": (0.29, 0.17, 0.10),
            "STRANDS": (0.50, 0.32, 0.19),
            "SHOE": (0.78, 0.24, 0.17),
            "RUBBER": (0.88, 0.85, 0.80),
            "SOCK": (0.90, 0.90, 0.88),
        }
    ),
    hairline=(0.046, -0.012, -0.088),
    fringe=1.0,
    whorl=(0.15, 0.80, -0.58),
    ear_ring=1.0,
    sleeve_end=0.60,
    legs_end=("left_ankle", 0.020),
    leg_kept=0.09,
    sock_end=-1.0,
)

HIKER = Look(
    betas=(-0.9, 1.4, 1.8, 0.0, -0.6, 0.9),
    garments=("shorts", "jacket", "bob"),
    colours=MappingProxyType(
        {
            "SKIN": (0.53, 0.35, 0.25),
            "BLUSH": (0.55, 0.27, 0.20),
            "LIP": (0.52, 0.25, 0.23),
            "BROW": (0.09, 0.06, 0.05),
            "IRIS": (0.26, 0.15, 0.08),
            "SHIRT": (0.86, 0.55, 0.12),
            "TRIM": (0.24, 0.26, 0.30),
            "TROUSERS": (0.50, 0.47, 0.34),
            "STITCH": (0.30, 0.24, 0.16),
            "HAIR": (0.08, 0.07, 0.07),
            "STRANDS": (0.24, 0.21, 0.20),
            "SHOE": (0.33, 0.22, 0.15),
            "RUBBER": (0.80, 0.74, 0.62),
            "SOCK": (0.62, 0.16, 0.22),
        }
    ),
    hairline=(0.030, -0.078, -0.105),
    fringe=0.25,
    whorl=(0.0, 0.97, -0.24),
    ear_ring=0.01,
    sleeve_end=1.80,
    legs_end=("left_knee", 0.055),
    leg_kept=0.09,
    sock_end=0.13,
)

DANCER = Look(
    betas=(0.9, 0.9, 1.6, 0.6, 1.2, 0.3),
    garments=("blouse", "skirt", "cap", "long_hair"),
    colours=MappingProxyType(
        {
            "SKIN": (0.95, 0.79, 0.70),
            "BLUSH": (0.92, 0.56, 0.50),
            "LIP": (0.80, 0.36, 0.36),
            "BROW": (0.42, 0.20, 0.10),
            "IRIS": (0.30, 0.46, 0.24),
            "SHIRT": (0.42, 0.56, 0.26),
            "TRIM": (0.92, 0.88, 0.74),
            "TROUSERS": (0.42, 0.17, 0.36),
            "STITCH": (0.80, 0.60, 0.70),
            "HAIR": (0.50, 0.20, 0.08),
            "STRANDS": (0.76, 0.38, 0.16),
            "SHOE": (0.16, 0.14, 0.18),
            "RUBBER": (0.52, 0.46, 0.44),
            "SOCK": (0.90, 0.90, 0.88),
        }
    ),
    hairline=(0.040, -0.085, -0.105),
    fringe=0.4,
    whorl=(-0.10, 0.96, -0.20),
    ear_ring=0.01,
    sleeve_end=0.42,
    legs_end=("left_knee", HEM_M),
    leg_kept=0.22,
    sock_end=-1.0,
)

#: Looks by name.
LOOKS: dict[str, Look] = {DEFAULT_NAME: DEFAULT, "hiker": HIKER, "dancer": DANCER}


def look_of(provenance: Mapping[str, Any]) -> Look:
    """Return the look that the `provenance` of an avatar's manifest names. Raises BadInputError for an unknown one."""
    return look_named(str(provenance.get(KEY, DEFAULT_NAME)))


def look_named(name: str) -> Look:
    """Return the look `name`. Raises BadInputError for an unknown one."""
    if name not in LOOKS:
        raise BadInputError("look", repr(name), f"one of {', '.join(LOOKS)}")
    return LOOKS[name]


# Landmarks of a body at rest, by which garments and paint are placed: joints, eyes, ears, top and bottom.
#
# Rule: every landmark is measured from the body's arrays (rest pose, metres); no coordinate is a constant.

PELVIS, NECK, HEAD = JOINT_INDEX["pelvis"], JOINT_INDEX["neck"], JOINT_INDEX["head"]
#: Joints that the body has on both sides: index of the left one.
HIP, KNEE, ANKLE, FOOT = (JOINT_INDEX[f"left_{name}"] for name in ("hip", "knee", "ankle", "foot"))
SHOULDER, ELBOW, WRIST = (JOINT_INDEX[f"left_{name}"] for name in ("shoulder", "elbow", "wrist"))
LEFT_EYE, RIGHT_EYE = JOINT_INDEX["left_eye"], JOINT_INDEX["right_eye"]
#: Index of each ankle, by side: 1 is left (+X), -1 is right.
ANKLES = {1: JOINT_INDEX["left_ankle"], -1: JOINT_INDEX["right_ankle"]}


@dataclass(frozen=True)
class Landmarks:
    """Landmarks of a body in the rest pose, metres.

    `joints`: (55,3). `eye`, `eye_radius`: centre (3,) and radius of the left eyeball. `eyeball`: (V,) bool, whether a
    vertex belongs to an eyeball. `ear`: tip (3,) of the left ear. `crown`: greatest y. `sole`: least y.
    """

    joints: F64
    eye: F64
    eye_radius: float
    eyeball: NDArray[np.bool_]
    ear: F64
    crown: float
    sole: float


def find_landmarks(vertices: F64, joints: F64, weights: NDArray[np.floating[Any]]) -> Landmarks:
    """Return the landmarks of a body at rest.

    `vertices`: (V,3), metres. `joints`: (55,3), metres. `weights`: skinning weights (V,55).
    """
    eyeball = weights[:, [LEFT_EYE, RIGHT_EYE]].sum(axis=1) > 0.5
    left = vertices[weights[:, LEFT_EYE] > 0.5]
    eye = 0.5 * (left.min(axis=0) + left.max(axis=0))
    head = vertices[(weights[:, HEAD] > 0.5) & (vertices[:, 1] < eye[1])]
    return Landmarks(
        joints=joints,
        eye=eye,
        eye_radius=float(np.ptp(left[:, 1]) / 2),
        eyeball=eyeball,
        ear=head[np.argmax(head[:, 0])],
        crown=float(vertices[:, 1].max()),
        sole=float(vertices[:, 1].min()),
    )


# The layers of a clothed body: its garments and hair, shoes and their soles, skin.

#: A material's index here is the value of `material` in `paint.frag`.
MATERIALS = (
    *("skin", "trousers", "shirt", "hair", "shoe", "sole", "shorts", "jacket", "bob"),
    *("blouse", "skirt", "cap", "long_hair"),
)
OBSCURANCE_REACH_M = 0.25
#: Approximate number of vertices, of all layers together, that keep ambient light from other vertices.
EMITTERS = 6000


@dataclass(frozen=True)
class Layer:
    """A mesh of one material.

    `vertices`: (N,3), metres at rest. `faces`: (F,3). `below`: point (N,3) of the body under each vertex. `weights`:
    skinning weights (N,55). `normal`: unit normals (N,3). `light`: share (N,) of ambient light that reaches each
    vertex, 1 for an open vertex. `mark`: (N,), 1 on the eyeballs, else 0.
    """

    material: str
    vertices: F64
    faces: NDArray[np.int64]
    below: F64
    weights: F64
    normal: F64
    light: F64
    mark: F64


class _Sheet(NamedTuple):
    """A layer before its normals and light are computed. `Layer` describes the fields."""

    material: str
    vertices: F64
    faces: NDArray[np.int64]
    below: F64
    weights: F64


def clothing_layers(body: BodyArrays, landmarks: Landmarks, look: Look = DEFAULT) -> list[Layer]:
    """Return all layers of the body in `look`: garments, shoes, soles, skin. Both shoes are one layer."""
    sheets = [
        *(_garment(body, landmarks, name) for name in look.garments),
        *_shoes(body, landmarks),
        _Sheet("skin", body.vertices, body.faces, body.vertices, body.weights),
    ]
    normals = [vertex_normals(sheet.vertices, sheet.faces) for sheet in sheets]
    lights = _lights(sheets, normals)
    eyeball = landmarks.eyeball.astype(np.float64)
    return [
        Layer(*sheet, normal, light, eyeball if sheet.material == "skin" else np.zeros(len(light)))
        for sheet, normal, light in zip(sheets, normals, lights, strict=True)
    ]


def _garment(body: BodyArrays, landmarks: Landmarks, name: str) -> _Sheet:
    if name in HANGING:
        (vertices, faces), weights = HANGING[name](body, landmarks)
        below = body.vertices[nearest(vertices, body.vertices, 1)[:, 0]]
        return _Sheet(name, vertices, faces, below, weights)
    covers, thickness = GARMENTS[name]
    offset, least, rounds = thickness(body.vertices, landmarks)
    raised = shell(body.vertices, body.faces, offset, least, rounds)
    inside = covers(body.vertices, landmarks) & ~landmarks.eyeball
    faces = body.faces[inside[body.faces].all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    return _Sheet(name, raised[used], faces.reshape(-1, 3), body.vertices[used], body.weights[used])


def _shoes(body: BodyArrays, landmarks: Landmarks) -> list[_Sheet]:
    sheets = []
    for part in ("shoe", "sole"):
        pieces = [shoe(body.vertices, landmarks.joints[ankle], side, part == "sole") for side, ankle in ANKLES.items()]
        vertices = np.vstack([vertices for vertices, _ in pieces])
        count = len(pieces[0][0])
        faces = np.vstack([faces + count * number for number, (_, faces) in enumerate(pieces)])
        near = nearest(vertices, body.vertices)
        weights = body.weights[near].mean(axis=1)
        weights = Smoother(faces, len(vertices)).smooth(weights, 4)
        sheets.append(_Sheet(part, vertices, faces, body.vertices[near[:, 0]], weights))
    return sheets


def nearest(points: F64, vertices: F64, count: int = 8) -> NDArray[np.int64]:
    """Return the indices (N,count) of the `vertices` (V,3) nearest to each of `points` (N,3), nearest first."""
    from scipy.spatial import cKDTree  # here, because commands that draw no clothes import this module without SciPy

    _, order = cKDTree(vertices).query(points, range(1, count + 1))
    return np.asarray(order, np.int64)


def _lights(sheets: list[_Sheet], normals: list[F64]) -> list[F64]:
    """Return, for each sheet, the share (N,) of ambient light that all `sheets` let through to its vertices."""
    vertices = np.vstack([sheet.vertices for sheet in sheets])
    areas = np.concatenate([vertex_areas(sheet.vertices, sheet.faces) for sheet in sheets])
    step = -(-len(vertices) // EMITTERS)
    emitters = slice(step // 2, None, step)
    lights = []
    for sheet, normal in zip(sheets, normals, strict=True):
        raw = obscurance(
            sheet.vertices + 0.004 * normal,
            normal,
            vertices[emitters],
            np.vstack(normals)[emitters],
            areas[emitters] * step,
            OBSCURANCE_REACH_M,
        )
        lights.append(Smoother(sheet.faces, len(sheet.vertices)).smooth(raw, 3))
    return lights


# The garments that are shells of the body: the vertices that each garment may cover, and how far it stands off.
#
# Rule: `GARMENTS` lists all of them. A garment is placed by the body's landmarks, never by coordinates.

Covers = Callable[[F64, Landmarks], NDArray[np.bool_]]
Thickness = Callable[[F64, Landmarks], tuple[F64, F64, int]]


def _shirt_covers(at: F64, landmarks: Landmarks) -> NDArray[np.bool_]:
    joints = landmarks.joints
    below_sleeve = np.abs(at[:, 0]) < joints[ELBOW, 0]
    above, below = at[:, 1] > joints[HIP, 1] - 0.16, at[:, 1] < joints[HEAD, 1] - 0.03
    return np.asarray(below_sleeve & above & below)


def _shirt_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    joints = landmarks.joints
    along = (np.abs(at[:, 0]) - joints[SHOULDER, 0]) / (joints[ELBOW, 0] - joints[SHOULDER, 0])
    sleeve = smoothstep(0.1, 0.7, along)
    hem = smoothstep(joints[PELVIS, 1] + 0.2, joints[HIP, 1] - 0.06, at[:, 1]) * (along < 0)
    neck = smoothstep(joints[NECK, 1] - 0.09, joints[NECK, 1] - 0.02, at[:, 1])
    folds = 0.003 * np.sin(38.0 * at[:, 1] + 9.0 * at[:, 0] + 3.0 * np.sin(11.0 * at[:, 2] + 5.0 * at[:, 0]))
    offset = (0.022 + 0.014 * np.maximum(sleeve, hem) + folds * (1 - neck)) * (1 - 0.35 * neck)
    return offset, 0.8 * offset, 14


def _trousers_covers(at: F64, landmarks: Landmarks) -> NDArray[np.bool_]:
    joints = landmarks.joints
    hand = np.abs(at[:, 0]) > joints[SHOULDER, 0] + 0.1
    below, above = at[:, 1] < joints[PELVIS, 1] + 0.2, at[:, 1] > joints[ANKLE, 1] - 0.04
    return np.asarray(below & above & ~hand)


def _trousers_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    joints = landmarks.joints
    shin = smoothstep(joints[KNEE, 1] + 0.1, joints[ANKLE, 1] + 0.1, at[:, 1])
    waist = smoothstep(joints[HIP, 1] - 0.02, joints[PELVIS, 1] + 0.08, at[:, 1])
    folds = 0.004 * np.sin(31.0 * at[:, 1] + 14.0 * at[:, 0] + 2.0 * np.sin(17.0 * at[:, 2]))
    offset = (0.020 + 0.022 * shin + folds * (0.3 + 0.7 * shin)) * (1 - waist) + 0.009 * waist
    return offset, 0.8 * offset, 20


def _hair_covers(at: F64, landmarks: Landmarks) -> NDArray[np.bool_]:
    return np.asarray(at[:, 1] > landmarks.joints[NECK, 1] + 0.01)


def _hair_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    up = smoothstep(landmarks.eye[1] + 0.01, landmarks.crown - 0.02, at[:, 1])
    front = smoothstep(landmarks.eye[2] - 0.09, landmarks.eye[2] + 0.01, at[:, 2])
    nape = smoothstep(landmarks.eye[1] - 0.02, landmarks.eye[1] - 0.1, at[:, 1])
    temple = smoothstep(landmarks.eye[1] + 0.05, landmarks.eye[1], at[:, 1]) * smoothstep(
        landmarks.ear[2] - 0.03, landmarks.ear[2], at[:, 2]
    )
    lock = np.sin(60.0 * at[:, 0] + 25.0 * at[:, 2]) + np.sin(33.0 * at[:, 0] - 41.0 * at[:, 2] + 2.0)
    offset = (0.018 + 0.015 * up + 0.004 * up * front + 0.0022 * lock * up) * (1 - 0.6 * nape) * (1 - 0.7 * temple)
    return offset, 0.75 * offset, 8


def _shorts_covers(at: F64, landmarks: Landmarks) -> NDArray[np.bool_]:
    return np.asarray(_trousers_covers(at, landmarks) & (at[:, 1] > landmarks.joints[KNEE, 1] - 0.02))


def _shorts_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    joints = landmarks.joints
    thigh = smoothstep(joints[HIP, 1] - 0.08, joints[KNEE, 1] + 0.06, at[:, 1])
    waist = smoothstep(joints[HIP, 1] - 0.02, joints[PELVIS, 1] + 0.08, at[:, 1])
    folds = 0.003 * np.sin(27.0 * at[:, 0] + 12.0 * at[:, 2] + 2.0 * np.sin(13.0 * at[:, 1]))
    offset = (0.018 + 0.020 * thigh + folds * thigh) * (1 - waist) + 0.009 * waist
    return offset, 0.8 * offset, 20


def _jacket_covers(at: F64, landmarks: Landmarks) -> NDArray[np.bool_]:
    joints = landmarks.joints
    sleeve = np.abs(at[:, 0]) < joints[WRIST, 0]
    above, below = at[:, 1] > joints[HIP, 1] - 0.12, at[:, 1] < joints[HEAD, 1] - 0.02
    return np.asarray(sleeve & above & below)


def _jacket_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    joints = landmarks.joints
    along = (np.abs(at[:, 0]) - joints[SHOULDER, 0]) / (joints[WRIST, 0] - joints[SHOULDER, 0])
    cuff = smoothstep(0.75, 0.97, along)
    hem = smoothstep(joints[PELVIS, 1] + 0.14, joints[HIP, 1] + 0.02, at[:, 1]) * (along < 0)
    neck = smoothstep(joints[NECK, 1] - 0.09, joints[NECK, 1] - 0.02, at[:, 1])
    folds = 0.004 * np.sin(29.0 * at[:, 1] + 34.0 * np.abs(at[:, 0]) + 2.0 * np.sin(9.0 * at[:, 2]))
    offset = (0.027 + 0.014 * hem + folds * (1 - neck)) * (1 - 0.45 * cuff) * (1 - 0.25 * neck)
    return offset, 0.8 * offset, 14


def _bob_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    """Return offset, least offset and rounds for hair that falls straight to the jaw, over the ears."""
    up = smoothstep(landmarks.eye[1] + 0.01, landmarks.crown - 0.02, at[:, 1])
    front = smoothstep(landmarks.eye[2] - 0.07, landmarks.eye[2] - 0.01, at[:, 2])
    end = smoothstep(landmarks.eye[1] - 0.03, landmarks.eye[1] - 0.09, at[:, 1])
    ear = smoothstep(0.05, 0.0, np.linalg.norm(np.abs(at) * (1, 0, 0) + at * (0, 1, 1) - landmarks.ear, axis=1))
    lock = np.sin(75.0 * at[:, 0] + 60.0 * at[:, 2])
    offset = (0.020 + 0.006 * up + 0.0012 * lock) * (1 - 0.35 * front) * (1 - 0.3 * end) * (1 - 0.7 * ear)
    return offset, 0.75 * offset, 16


def _blouse_thickness(at: F64, landmarks: Landmarks) -> tuple[F64, F64, int]:
    """Return offset, least offset and rounds for a blouse that is tucked in at the waist."""
    joints = landmarks.joints
    along = (np.abs(at[:, 0]) - joints[SHOULDER, 0]) / (joints[ELBOW, 0] - joints[SHOULDER, 0])
    sleeve = smoothstep(0.05, 0.45, along)
    waist = smoothstep(joints[PELVIS, 1] + 0.20, joints[PELVIS, 1] + 0.11, at[:, 1]) * (along < 0)
    folds = 0.003 * np.sin(33.0 * at[:, 0] + 4.0 * np.sin(8.0 * at[:, 1]))
    offset = (0.020 + 0.016 * sleeve + folds) * (1 - 0.6 * waist)
    return offset, 0.8 * offset, 14


#: For each garment that is a shell, two functions of the vertices (V,3) and landmarks. The first returns (V,) whether a
#: vertex may be covered. The second returns offsets (V,) and least offsets (V,) in metres, and the number of relaxation
#: rounds.
GARMENTS: dict[str, tuple[Covers, Thickness]] = {
    "trousers": (_trousers_covers, _trousers_thickness),
    "shirt": (_shirt_covers, _shirt_thickness),
    "hair": (_hair_covers, _hair_thickness),
    "shorts": (_shorts_covers, _shorts_thickness),
    "jacket": (_jacket_covers, _jacket_thickness),
    "bob": (_hair_covers, _bob_thickness),
    "blouse": (_shirt_covers, _blouse_thickness),
    "cap": (_hair_covers, _bob_thickness),
}


# The garments that hang. They have surfaces of their own, because no shell of the body has their form.


def _skirt(body: BodyArrays, landmarks: Landmarks) -> tuple[Stitched, F64]:
    points, faces = skirt(body.vertices, landmarks.joints)
    trunk = body.weights[nearest(points, body.vertices)].mean(axis=1)
    return (points, faces), skirt_weights(points, trunk, landmarks.joints)


def _long_hair(body: BodyArrays, landmarks: Landmarks) -> tuple[Stitched, F64]:
    points, faces = long_hair(body.vertices, landmarks.joints, landmarks.eye)
    return (points, faces), long_hair_weights(points, landmarks.joints)


#: For each garment that hangs, a function that returns its vertices and faces, and its skinning weights (N,55).
HANGING: dict[str, Callable[[BodyArrays, Landmarks], tuple[Stitched, F64]]] = {
    "skirt": _skirt,
    "long_hair": _long_hair,
}
