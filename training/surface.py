"""The surface of a body at rest: its arrays, and functions on triangle meshes for making clothes and textures.

Rule: arrays are float64 and int64, so that no result is rounded to float32.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64, Ints
from trilane.body.body import ShapedBody


@dataclass(frozen=True)
class BodyArrays:
    """Arrays of a body at rest.

    `vertices`: (V,3), in metres. `faces`: (F,3) indices of vertices.
    `uv`: texture coordinates (T,2). `uv_faces`: (F,3) indices of `uv`.
    `weights`: skinning weights (V,55). `joints`: (55,3), in metres.
    """

    vertices: F64
    faces: NDArray[np.int64]
    uv: F64
    uv_faces: NDArray[np.int64]
    weights: F64
    joints: F64


def body_arrays(shaped: ShapedBody) -> BodyArrays:
    """Return the arrays of `shaped`, as float64 and int64."""
    body = shaped.body
    return BodyArrays(
        vertices=shaped.vertices.astype(np.float64),
        faces=body.faces.astype(np.int64),
        uv=body.uv.astype(np.float64),
        uv_faces=body.uv_faces.astype(np.int64),
        weights=body.weights.astype(np.float64),
        joints=shaped.joints,
    )


# Geometry of triangle surfaces: normals, areas, smoothing, shells that stand off, and ambient light behind occluders.
#
# Rule: functions take and return arrays; they know nothing of bodies and garments.


def vertex_normals(vertices: F64, faces: Ints) -> F64:
    """Return the unit normal (V,3) of each vertex: the mean of its faces' normals, weighted by area.

    A vertex without a face gets +Y.

    `vertices`: (V,3). `faces`: (F,3) indices of vertices.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    face_normal = np.cross(b - a, c - a)
    total = np.stack([_scatter(faces, np.repeat(face_normal[:, k], 3), len(vertices)) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-12, total / np.maximum(length, 1e-12), [0.0, 1.0, 0.0])


def vertex_areas(vertices: F64, faces: Ints) -> F64:
    """Return the area (V,) of each vertex, in square metres: a third of the total area of the vertex's faces.

    `vertices`: (V,3), in metres. `faces`: (F,3) indices of vertices.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6.0
    return _scatter(faces, np.repeat(area, 3), len(vertices))


class Smoother:
    """Smooths values at the vertices of a mesh by means over neighbours. A vertex without a face keeps its value.

    `faces`: (F,3). `count`: number V of vertices.
    """

    def __init__(self, faces: Ints, count: int) -> None:
        edges = np.unique(np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
        self._from = np.concatenate([edges[:, 0], edges[:, 1]])
        self._to = np.concatenate([edges[:, 1], edges[:, 0]])
        self._degree = np.bincount(self._to, minlength=count)
        self._count = count

    def mean(self, values: F64) -> F64:
        """Return, for each vertex, the mean of its neighbours' values. `values` and the result: (V,) or (V,C)."""
        columns = values.reshape(self._count, -1)
        sums = [np.bincount(self._to, weights=column[self._from], minlength=self._count) for column in columns.T]
        around = np.stack(sums, axis=1) / np.maximum(self._degree, 1)[:, None]
        return np.where(self._degree[:, None] > 0, around, columns).reshape(values.shape)

    def smooth(self, values: F64, rounds: int) -> F64:
        """Return `values` (V,) or (V,C) after `rounds` rounds; each moves them half way to the neighbours' means."""
        for _ in range(rounds):
            values = 0.5 * (values + self.mean(values))
        return values


def shell(vertices: F64, faces: Ints, offset: F64, least: F64, rounds: int) -> F64:
    """Return the vertices (V,3) of a smooth surface over a mesh, which bridges hollows as cloth does.

    The mesh is raised along smoothed normals. After that, each round smooths the surface. If vertices sink below their
    least height, the round raises them to it along the normals.

    `vertices` (V,3), `faces` (F,3): the mesh.
    `offset`: height (V,), in metres, to which the mesh is raised first.
    `least`: least height (V,) over the mesh, in metres.
    `rounds`: number of rounds of smoothing.
    """
    smoother = Smoother(faces, len(vertices))
    normal = smoother.smooth(vertex_normals(vertices, faces), 6)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    raised = vertices + offset[:, None] * normal
    for _ in range(rounds):
        raised = 0.5 * (raised + smoother.mean(raised))
        height = np.einsum("ij,ij->i", raised - vertices, normal)
        raised = raised + np.maximum(least - height, 0.0)[:, None] * normal
    return raised


def obscurance(points: F64, normals: F64, emitters: F64, emitter_normals: F64, areas: F64, reach: float) -> F64:
    """Return the share (N,) of ambient light, in 0..1, that reaches points although discs occlude it.

    The share is computed from disc-to-point form factors: M. Bunnell, Dynamic Ambient Occlusion and Indirect Lighting,
    GPU Gems 2, 2005.

    `points`, `normals`: points (N,3) at which the light is computed, and normals (N,3) there.
    `emitters`, `emitter_normals`: centres (M,3) and normals (M,3) of the discs.
    `areas`: areas (M,) of the discs, square metres.
    `reach`: distance in metres at which a disc's effect has faded out.
    """
    left = np.empty(len(points))
    for part in np.array_split(np.argsort(points[:, 1]), max(1, len(points) // 256)):
        low, high = points[part].min(axis=0) - reach, points[part].max(axis=0) + reach
        near = ((emitters >= low) & (emitters <= high)).all(axis=1)
        away = emitters[near][None] - points[part, None]
        square = np.einsum("ijk,ijk->ij", away, away) + 1e-6
        distance = np.sqrt(square)
        at_point = np.einsum("ijk,ik->ij", away, normals[part]) / distance
        at_emitter = -np.einsum("ijk,jk->ij", away, emitter_normals[near]) / distance
        area = areas[near]
        factor = np.clip(at_point, 0.0, 1.0) * np.clip(at_emitter, 0.0, 1.0) * area / (np.pi * square + area)
        fade = np.clip(1.0 - distance / reach, 0.0, 1.0)
        left[part] = 1.0 - np.minimum((factor * fade).sum(axis=1), 1.0)
    return left


def smoothstep(low: float, high: float, values: F64) -> F64:
    """Return GLSL's smoothstep of `values`: 0 at `low`, 1 at `high`, a cubic between. `low` may be above `high`."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _scatter(faces: Ints, values: F64, count: int) -> F64:
    return np.asarray(np.bincount(faces.ravel(), weights=values, minlength=count), np.float64)
