"""Looks: build, garments, hair and colours of the synthetic persons.

Rule: there is one table, and a look is numbers and names alone; `layers.py` and `paint.frag` turn it into clothes and
paint.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX
from trilane.errors import BadInputError

#: Key of the look's name in an avatar's provenance.
KEY = "look"
DEFAULT_NAME = "default"
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Look:
    """The look of a person.

    `betas`: coefficients of the body's shape. `garments`: names of `GARMENTS`, outer ones last. `colours`: colours of
    `paint.frag`, sRGB from 0 to 1. `hairline`: height of forehead, temple and nape over the eyes, metres. `fringe`:
    raggedness of the hairline, at most 1. `whorl`: direction from the middle of the head to where strands begin.
    `ear_ring`: size of the gap in the hair around an ear. `sleeve_end`: place along the arm where sleeves end: 0 is the
    shoulder, 1 the elbow. `legs_end`: a joint, and the height over it where trousers end, metres. `sock_end`: height
    over the ankle, metres.
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
    sock_end: float

    def definitions(self, landmarks: Landmarks) -> dict[str, str]:
        """Return the definitions that `paint.frag` is compiled with for the body of `landmarks`.

        Constants, unlike uniforms, are rounded once.
        """
        joint, over = self.legs_end
        end = landmarks.joints[JOINT_INDEX[joint], 1] - landmarks.joints[ANKLES[1], 1] + over
        triples = {**self.colours, "HAIRLINE": self.hairline, "WHORL": self.whorl}
        numbers = {name.upper(): getattr(self, name) for name in ("fringe", "ear_ring", "sleeve_end", "sock_end")}
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
    sock_end=0.13,
)

#: Looks by name.
LOOKS: dict[str, Look] = {DEFAULT_NAME: DEFAULT, "hiker": HIKER}


def look_of(provenance: Mapping[str, Any]) -> Look:
    """Return the look of the person in an avatar whose manifest has `provenance`. Raises BadInputError."""
    return look_named(str(provenance.get(KEY, DEFAULT_NAME)))


def look_named(name: str) -> Look:
    """Return the look `name`. Raises BadInputError for an unknown one."""
    if name not in LOOKS:
        raise BadInputError("look", repr(name), f"one of {', '.join(LOOKS)}")
    return LOOKS[name]


# Landmarks of a body at rest, which place garments and paint: joints, eyes, ears, top and bottom.
#
# Rule: everything is measured from the body's arrays (rest pose, metres); no coordinate is a constant.

PELVIS, NECK, HEAD = JOINT_INDEX["pelvis"], JOINT_INDEX["neck"], JOINT_INDEX["head"]
#: Index of the left joint, for joints that both sides have.
HIP, KNEE, ANKLE, FOOT = (JOINT_INDEX[f"left_{name}"] for name in ("hip", "knee", "ankle", "foot"))
SHOULDER, ELBOW, WRIST = (JOINT_INDEX[f"left_{name}"] for name in ("shoulder", "elbow", "wrist"))
LEFT_EYE, RIGHT_EYE = JOINT_INDEX["left_eye"], JOINT_INDEX["right_eye"]
#: Index of each foot's ankle by its side: 1 is the left one (+X), -1 the right one.
ANKLES = {1: JOINT_INDEX["left_ankle"], -1: JOINT_INDEX["right_ankle"]}


@dataclass(frozen=True)
class Landmarks:
    """Positions in metres, rest pose.

    `joints` (55,3). `eye` (3,): centre of the left eyeball; `eye_radius`: its radius. `eyeball` (V,) bool: whether a
    vertex is of either eyeball. `ear` (3,): tip of the left ear. `crown`: greatest y. `sole`: least y.
    """

    joints: F64
    eye: F64
    eye_radius: float
    eyeball: NDArray[np.bool_]
    ear: F64
    crown: float
    sole: float


def find_landmarks(vertices: F64, joints: F64, weights: NDArray[np.floating[Any]]) -> Landmarks:
    """Find the landmarks of a body at rest.

    `vertices` (V,3), `joints` (55,3), `weights` (V,55).
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
