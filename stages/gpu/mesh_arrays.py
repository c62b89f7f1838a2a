"""Arrays of a mesh, in the order in which the GPU draws it.

Rule: one vertex per distinct (position, UV) corner, and triangles ordered so that neighbours are drawn together.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, Floats, Ints
from trilane.body.joints import JOINTS
from trilane.body.skin_weights import WEIGHT_COUNTS
from trilane.errors import BadInputError

PATCH_TRIANGLES = 320
MAX_OPEN = 0.005


@dataclass(frozen=True)
class MeshArrays:
    """Per-vertex arrays after the split at UV seams.

    `position` (N,3) metres, rest pose. `uv` (N,2). `joint` (N,K) uint8 and `weight` (N,K), largest first, rows sum to
    1. `triangles` (F,3) uint32. `source` (N,) int64: the body's vertex that each row is a copy of. `surface`: arrays
    `normal` (N,3) and `colour` (N,4) of meshes that are shaded, else empty. `closed`: whether the triangles enclose a
    volume, so that those facing away from the camera are never seen from outside.
    """

    position: F32
    uv: F32
    joint: NDArray[np.uint8]
    weight: F32
    triangles: NDArray[np.uint32]
    source: NDArray[np.int64]
    surface: dict[str, F32] = field(default_factory=dict)
    closed: bool = False

    @property
    def weights_per_vertex(self) -> int:
        return int(self.joint.shape[1])


def mesh_arrays(
    vertices: Floats,
    faces: Ints,
    uv: Floats,
    uv_faces: Ints,
    joint: Ints,
    weight: Floats,
    normal: Floats | None = None,
    colour: Floats | None = None,
) -> MeshArrays:
    """Split vertices at UV seams and order them for the vertex cache. Vertices that no face uses are left out.

    `vertices`: (V,3) metres.
    `faces`: (F,3) indices of `vertices`.
    `uv`: (T,2).
    `uv_faces`: (F,3) indices of `uv`, per corner.
    `joint`: (V,K) joint indices, K of 4, 8 or 12.
    `weight`: (V,K) their skin weights.
    `normal`, `colour`: (V,3) unit normals and (V,4) colours of a mesh that is shaded.
    Raises BadInputError when shapes, indices or values cannot be drawn.
    """
    _check(vertices, faces, uv, uv_faces, joint, weight)
    triangle_order = patch_order(np.asarray(vertices, np.float64)[faces].mean(axis=1))
    source, uv_source, triangles = split_corners(faces[triangle_order], uv_faces[triangle_order])
    order = np.argsort(-weight, axis=1, kind="stable")
    joint, weight = np.take_along_axis(joint, order, axis=1), np.take_along_axis(weight, order, axis=1)
    return MeshArrays(
        position=np.ascontiguousarray(vertices[source], np.float32),
        uv=np.ascontiguousarray(uv[uv_source], np.float32),
        joint=np.ascontiguousarray(joint[source], np.uint8),
        weight=np.ascontiguousarray(weight[source], np.float32),
        triangles=triangles,
        source=source,
        surface=_surface(normal, colour, source),
        closed=is_closed(vertices, faces),
    )


def _surface(normal: Floats | None, colour: Floats | None, source: NDArray[np.int64]) -> dict[str, F32]:
    arrays = {"normal": normal, "colour": colour}
    return {name: np.ascontiguousarray(rows[source], np.float32) for name, rows in arrays.items() if rows is not None}


def is_closed(vertices: Floats, faces: Ints) -> bool:
    """Whether the faces (F,3) wind outward around a volume with at most a share `MAX_OPEN` of their edges open.

    Bodies have small openings that no camera sees, such as the backs of the eyes.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    there, back = edges @ [1 << 32, 1], edges @ [1, 1 << 32]
    corners = np.asarray(vertices, np.float64)[faces]
    volume = np.einsum("fi,fi->", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2])
    open_edges = np.count_nonzero(~np.isin(there, back))
    return bool(volume > 0 and open_edges <= MAX_OPEN * len(edges) and len(np.unique(there)) == len(there))


def split_corners(faces: Ints, uv_faces: Ints) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint32]]:
    """Number the distinct (vertex, uv) corners of `faces` (F,3) and `uv_faces` (F,3) by first use.

    Returns the vertex index (N,) and the uv index (N,) of each corner, and the triangles (F,3) of corner numbers.
    """
    corner = faces.astype(np.int64).ravel() << 32 | uv_faces.astype(np.int64).ravel()
    distinct, first, inverse = np.unique(corner, return_index=True, return_inverse=True)
    by_first_use = np.argsort(first)
    number = np.empty_like(by_first_use)
    number[by_first_use] = np.arange(len(by_first_use))
    ordered = distinct[by_first_use]
    return ordered >> 32, ordered & 0xFFFFFFFF, number[inverse].reshape(faces.shape).astype(np.uint32)


def patch_order(centres: NDArray[np.float64], patch: int = PATCH_TRIANGLES) -> NDArray[np.int64]:
    """Order of triangles (F,) in compact patches: groups are halved along their longest side down to `patch` triangles.

    `centres` (F,3). Software drivers shade vertices again for each batch of about a thousand indices, and compact
    patches have few vertices in common.
    """
    pending, done = [np.arange(len(centres))], []
    while pending:
        part = pending.pop()
        if len(part) <= patch:
            done.append(part)
            continue
        points = centres[part]
        axis = int(np.argmax(np.ptp(points, axis=0)))
        part = part[np.argsort(points[:, axis], kind="stable")]
        half = -(-len(part) // 2 // patch) * patch if len(part) >= 2 * patch else len(part) // 2
        pending += [part[half:], part[:half]]
    return np.concatenate(done) if done else np.empty(0, np.int64)


def weight_batches(arrays: MeshArrays) -> dict[int, NDArray[np.uint32]]:
    """Triangles (F_k,3) by the number of skin weights, 4, 8 or 12, that suffices for all three of their corners."""
    used = np.count_nonzero(arrays.weight, axis=1)
    needed = np.maximum(-(-used // 4) * 4, 4)[arrays.triangles].max(axis=1)
    return {k: arrays.triangles[needed == k] for k in WEIGHT_COUNTS if (needed == k).any()}


def _check(vertices: Any, faces: Any, uv: Any, uv_faces: Any, joint: Any, weight: Any) -> None:
    tests = (
        (faces.ndim == 2 and faces.shape[1] == 3 and len(faces) > 0, "faces", faces.shape, "(F, 3) with F > 0"),
        (uv_faces.shape == faces.shape, "uv_faces", uv_faces.shape, f"{faces.shape} as faces has"),
        (_indexes(faces, len(vertices)), "faces", "an index out of range", f"0 to {len(vertices) - 1}"),
        (_indexes(uv_faces, len(uv)), "uv_faces", "an index out of range", f"0 to {len(uv) - 1}"),
        (joint.shape == weight.shape == (len(vertices), joint.shape[-1]), "joint", joint.shape, "(V, K) as weight"),
        (joint.shape[-1] in WEIGHT_COUNTS, "joint", f"{joint.shape[-1]} weights a vertex", "4, 8 or 12"),
        (_indexes(joint, JOINTS), "joint", "an index out of range", f"0 to {JOINTS - 1}"),
        (bool(np.isfinite(vertices).all()), "vertices", "NaN or infinity", "finite metres"),
        (bool(np.isfinite(uv).all()), "uv", "NaN or infinity", "finite values"),
        (bool(np.isfinite(weight).all()), "weight", "NaN or infinity", "finite values"),
    )
    for passed, where, value, expected in tests:
        if not passed:
            raise BadInputError(f"mesh {where}", str(value), expected)


def _indexes(values: Any, count: int) -> bool:
    return bool(values.size) and int(values.min()) >= 0 and int(values.max()) < count
