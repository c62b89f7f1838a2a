"""The layers a dressed body is made of: skin, trousers, shirt, hair, shoes and their soles.

Rule: a layer is a mesh that is skinned by the body's own weights; where it ends and how it looks is `paint.frag`'s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.training.clothing import landmarks as marks
from trilane.training.clothing.landmarks import Landmarks
from trilane.training.clothing.shoes import shoe
from trilane.training.clothing.surface import Smoother, obscurance, shell, smoothstep, vertex_areas, vertex_normals

MATERIALS = ("skin", "trousers", "shirt", "hair", "shoe", "sole")
OBSCURANCE_REACH_M = 0.25
EMITTERS = 6000


@dataclass(frozen=True)
class BodyArrays:
    """`vertices` (V,3) metres at rest, `faces` (F,3), `uv` (T,2), `uv_faces` (F,3), `weights` (V,55).

    `joints` (55,3) at rest.
    """

    vertices: F64
    faces: NDArray[np.int64]
    uv: F64
    uv_faces: NDArray[np.int64]
    weights: F64
    joints: F64


@dataclass(frozen=True)
class Layer:
    """A mesh of one material. `below` (N,3): the point of the body each vertex stands over. `normal` (N,3) unit.
    `light` (N,): obscurance, 1 in the open. `mark` (N,): 1 on the eyeballs, else 0.
    """

    material: str
    vertices: F64
    faces: NDArray[np.int64]
    below: F64
    weights: F64
    normal: F64
    light: F64
    mark: F64


def dress(body: BodyArrays, found: Landmarks) -> list[Layer]:
    """All layers of a dressed body, the outer ones first; the two shoes share one layer each for upper and sole."""
    plain = [
        *(_garment(body, found, name) for name in GARMENTS),
        *_shoes(body, found),
        ("skin", body.vertices, body.faces, body.vertices, body.weights),
    ]
    normals = [vertex_normals(vertices, faces) for _, vertices, faces, _, _ in plain]
    lights = _lights(plain, normals)
    return [
        Layer(name, vertices, faces, below, weights, normal, light, _mark(name, found, len(vertices)))
        for (name, vertices, faces, below, weights), normal, light in zip(plain, normals, lights, strict=True)
    ]


Plain = tuple[str, F64, NDArray[np.int64], F64, F64]


def _garment(body: BodyArrays, found: Landmarks, name: str) -> Plain:
    covers, thickness = GARMENTS[name]
    offset, least, rounds = thickness(body.vertices, found)
    raised = shell(body.vertices, body.faces, offset, least, rounds)
    inside = covers(body.vertices, found) & ~found.eyeball
    faces = body.faces[inside[body.faces].all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    return name, raised[used], faces.reshape(-1, 3), body.vertices[used], body.weights[used]


def _shirt_covers(at: F64, found: Landmarks) -> NDArray[np.bool_]:
    joints = found.joints
    below_sleeve = np.abs(at[:, 0]) < joints[marks.ELBOW, 0]
    above, below = at[:, 1] > joints[marks.HIP, 1] - 0.16, at[:, 1] < joints[marks.HEAD, 1] - 0.03
    return np.asarray(below_sleeve & above & below)


def _shirt_thickness(at: F64, found: Landmarks) -> tuple[F64, F64, int]:
    joints = found.joints
    along = (np.abs(at[:, 0]) - joints[marks.SHOULDER, 0]) / (joints[marks.ELBOW, 0] - joints[marks.SHOULDER, 0])
    sleeve = smoothstep(0.1, 0.7, along)
    hem = smoothstep(joints[marks.PELVIS, 1] + 0.2, joints[marks.HIP, 1] - 0.06, at[:, 1]) * (along < 0)
    neck = smoothstep(joints[marks.NECK, 1] - 0.09, joints[marks.NECK, 1] - 0.02, at[:, 1])
    folds = 0.003 * np.sin(38.0 * at[:, 1] + 9.0 * at[:, 0] + 3.0 * np.sin(11.0 * at[:, 2] + 5.0 * at[:, 0]))
    offset = (0.022 + 0.014 * np.maximum(sleeve, hem) + folds * (1 - neck)) * (1 - 0.35 * neck)
    return offset, 0.8 * offset, 14


def _trousers_covers(at: F64, found: Landmarks) -> NDArray[np.bool_]:
    joints = found.joints
    hand = np.abs(at[:, 0]) > joints[marks.SHOULDER, 0] + 0.1
    below, above = at[:, 1] < joints[marks.PELVIS, 1] + 0.2, at[:, 1] > joints[marks.ANKLE, 1] - 0.04
    return np.asarray(below & above & ~hand)


def _trousers_thickness(at: F64, found: Landmarks) -> tuple[F64, F64, int]:
    joints = found.joints
    shin = smoothstep(joints[marks.KNEE, 1] + 0.1, joints[marks.ANKLE, 1] + 0.1, at[:, 1])
    waist = smoothstep(joints[marks.HIP, 1] - 0.02, joints[marks.PELVIS, 1] + 0.08, at[:, 1])
    folds = 0.004 * np.sin(31.0 * at[:, 1] + 14.0 * at[:, 0] + 2.0 * np.sin(17.0 * at[:, 2]))
    offset = (0.020 + 0.022 * shin + folds * (0.3 + 0.7 * shin)) * (1 - waist) + 0.009 * waist
    return offset, 0.8 * offset, 20


def _hair_covers(at: F64, found: Landmarks) -> NDArray[np.bool_]:
    return np.asarray(at[:, 1] > found.joints[marks.NECK, 1] + 0.01)


def _hair_thickness(at: F64, found: Landmarks) -> tuple[F64, F64, int]:
    up = smoothstep(found.eye[1] + 0.01, found.crown - 0.02, at[:, 1])
    front = smoothstep(found.eye[2] - 0.09, found.eye[2] + 0.01, at[:, 2])
    nape = smoothstep(found.eye[1] - 0.02, found.eye[1] - 0.1, at[:, 1])
    temple = smoothstep(found.eye[1] + 0.05, found.eye[1], at[:, 1]) * smoothstep(
        found.ear[2] - 0.03, found.ear[2], at[:, 2]
    )
    lock = np.sin(60.0 * at[:, 0] + 25.0 * at[:, 2]) + np.sin(33.0 * at[:, 0] - 41.0 * at[:, 2] + 2.0)
    offset = (0.018 + 0.015 * up + 0.004 * up * front + 0.0022 * lock * up) * (1 - 0.6 * nape) * (1 - 0.7 * temple)
    return offset, 0.75 * offset, 8


Covers = Callable[[F64, Landmarks], NDArray[np.bool_]]
Thickness = Callable[[F64, Landmarks], tuple[F64, F64, int]]
#: Garment to the vertices it may cover, and its offset, least offset (metres) and rounds of relaxation.
GARMENTS: dict[str, tuple[Covers, Thickness]] = {
    "trousers": (_trousers_covers, _trousers_thickness),
    "shirt": (_shirt_covers, _shirt_thickness),
    "hair": (_hair_covers, _hair_thickness),
}


def _shoes(body: BodyArrays, found: Landmarks) -> list[Plain]:
    layers: list[Plain] = []
    for part in ("shoe", "sole"):
        pieces = [
            shoe(body.vertices, found.joints[ankle], side, part == "sole") for side, (ankle, _) in marks.LEG.items()
        ]
        vertices = np.vstack([vertices for vertices, _ in pieces])
        count = len(pieces[0][0])
        faces = np.vstack([faces + count * number for number, (_, faces) in enumerate(pieces)])
        nearest = _nearest(vertices, body.vertices)
        weights = body.weights[nearest].mean(axis=1)
        weights = Smoother(faces, len(vertices)).smooth(weights, 4)
        layers.append((part, vertices, faces, body.vertices[nearest[:, 0]], weights))
    return layers


def _nearest(points: F64, vertices: F64, count: int = 8) -> NDArray[np.int64]:
    candidates = np.flatnonzero(vertices[:, 1] < points[:, 1].max() + 0.05)
    square = ((points[:, None] - vertices[None, candidates]) ** 2).sum(axis=2)
    order = np.argsort(square, axis=1)[:, :count]
    return candidates[order]


def _lights(plain: list[Plain], normals: list[F64]) -> list[F64]:
    areas = [vertex_areas(vertices, faces) for _, vertices, faces, _, _ in plain]
    everything = np.vstack([vertices for _, vertices, _, _, _ in plain])
    every_normal, every_area = np.vstack(normals), np.concatenate(areas)
    step = -(-len(everything) // EMITTERS)
    some = slice(step // 2, None, step)
    lights = []
    for (_, vertices, faces, _, _), normal in zip(plain, normals, strict=True):
        raw = obscurance(
            vertices + 0.004 * normal,
            normal,
            everything[some],
            every_normal[some],
            every_area[some] * step,
            OBSCURANCE_REACH_M,
        )
        lights.append(Smoother(faces, len(vertices)).smooth(raw, 3))
    return lights


def _mark(name: str, found: Landmarks, count: int) -> F64:
    return np.asarray(found.eyeball, np.float64) if name == "skin" else np.zeros(count)
