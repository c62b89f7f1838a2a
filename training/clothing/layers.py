"""The layers of a clothed body: its garments and hair, shoes and their soles, skin.

Rule: a layer is a mesh that is skinned by the body's own weights; `paint.frag` decides where it ends and how it looks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.training.body_arrays import BodyArrays
from trilane.training.clothing.garments import GARMENTS
from trilane.training.clothing.landmarks import ANKLES, Landmarks
from trilane.training.clothing.looks import DEFAULT, Look
from trilane.training.clothing.shoes import shoe
from trilane.training.clothing.surface_geometry import Smoother, obscurance, shell, vertex_areas, vertex_normals

#: Their order is that of `material` in `paint.frag`.
MATERIALS = ("skin", "trousers", "shirt", "hair", "shoe", "sole", "shorts", "jacket", "bob")
OBSCURANCE_REACH_M = 0.25
#: Number of vertices, of all layers together, that obscure others.
EMITTERS = 6000


@dataclass(frozen=True)
class Layer:
    """A mesh of one material.

    `vertices` (N,3) metres at rest, `faces` (F,3). `below` (N,3): the point of the body under each vertex. `weights`
    (N,55): skin weights. `normal` (N,3) unit. `light` (N,): obscurance, 1 in the open. `mark` (N,): 1 on the eyeballs,
    else 0.
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
    """A layer before its normals and its light are known; fields as of `Layer`."""

    material: str
    vertices: F64
    faces: NDArray[np.int64]
    below: F64
    weights: F64


def clothing_layers(body: BodyArrays, landmarks: Landmarks, look: Look = DEFAULT) -> list[Layer]:
    """All layers of the body in `look`, outer ones first. Both shoes are one layer, their soles another."""
    sheets = [
        *(_garment(body, landmarks, name) for name in look.garments),
        *_shoes(body, landmarks),
        _Sheet("skin", body.vertices, body.faces, body.vertices, body.weights),
    ]
    normals = [vertex_normals(sheet.vertices, sheet.faces) for sheet in sheets]
    lights = _lights(sheets, normals)
    return [
        Layer(*sheet, normal, light, _mark(sheet.material, landmarks, len(sheet.vertices)))
        for sheet, normal, light in zip(sheets, normals, lights, strict=True)
    ]


def _garment(body: BodyArrays, landmarks: Landmarks, name: str) -> _Sheet:
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
        nearest = _nearest(vertices, body.vertices)
        weights = body.weights[nearest].mean(axis=1)
        weights = Smoother(faces, len(vertices)).smooth(weights, 4)
        sheets.append(_Sheet(part, vertices, faces, body.vertices[nearest[:, 0]], weights))
    return sheets


def _nearest(points: F64, vertices: F64, count: int = 8) -> NDArray[np.int64]:
    """(N,count) indices of the `vertices` (V,3) nearest to each of `points` (N,3), nearest first."""
    candidates = np.flatnonzero(vertices[:, 1] < points[:, 1].max() + 0.05)
    square = ((points[:, None] - vertices[None, candidates]) ** 2).sum(axis=2)
    order = np.argsort(square, axis=1)[:, :count]
    return candidates[order]


def _lights(sheets: list[_Sheet], normals: list[F64]) -> list[F64]:
    """The obscurance of each sheet's vertices by all sheets."""
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


def _mark(name: str, landmarks: Landmarks, count: int) -> F64:
    return np.asarray(landmarks.eyeball, np.float64) if name == "skin" else np.zeros(count)
