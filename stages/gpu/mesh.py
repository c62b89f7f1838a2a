"""A skinned mesh: arrays of a body turned into the vertex and index buffers that the shaders read.

Rule: one interleaved buffer, one vertex per distinct (position, UV) corner, in an order that keeps neighbours together.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import moderngl
import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, Ints
from trilane.body.joints import JOINTS, POSE_FEATURES
from trilane.errors import BadInputError

WEIGHT_COUNTS = (4, 8, 12)
PATCH_TRIANGLES = 320
MAX_OPEN = 0.005
POSEDIRS_ROW = 8192  # texels in a row of the pose blend shape texture
GROUPS = "abc"


@dataclass(frozen=True)
class MeshArrays:
    """Per-vertex arrays after the split at UV seams, float32 unless told.

    `position` (N,3) metres, rest pose. `uv` (N,2). `joint` (N,K) uint8, `weight` (N,K) largest first, rows sum to 1.
    `triangles` (F,3) uint32. `source` (N,) int64: which vertex of the body a row came from. `normal` (N,3) and
    `colour` (N,4): only for meshes that are shaded. `closed`: triangles that face away are never seen from outside.
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
    vertices: NDArray[np.floating[Any]],
    faces: Ints,
    uv: NDArray[np.floating[Any]],
    uv_faces: Ints,
    joint: Ints,
    weight: NDArray[np.floating[Any]],
    normal: NDArray[np.floating[Any]] | None = None,
    colour: NDArray[np.floating[Any]] | None = None,
) -> MeshArrays:
    """Split vertices at UV seams and order them for the vertex cache.

    `vertices` (V,3) metres, `faces` (F,3), `uv` (T,2), `uv_faces` (F,3) per corner, `joint` and `weight` (V,K) with K
    4, 8 or 12, optionally `normal` (V,3) and `colour` (V,4), both given together. Vertices that no face uses are
    left out. Raises BadInputError when shapes, indices or values cannot be drawn.
    """
    _check(vertices, faces, uv, uv_faces, joint, weight)
    triangle_order = patch_order(np.asarray(vertices, np.float64)[faces].mean(axis=1))
    source, uv_source, triangles = split_corners(faces[triangle_order], uv_faces[triangle_order])
    surface = {"normal": normal, "colour": colour}
    order = np.argsort(-weight, axis=1, kind="stable")
    joint, weight = np.take_along_axis(joint, order, axis=1), np.take_along_axis(weight, order, axis=1)
    return MeshArrays(
        position=np.ascontiguousarray(vertices[source], np.float32),
        uv=np.ascontiguousarray(uv[uv_source], np.float32),
        joint=np.ascontiguousarray(joint[source], np.uint8),
        weight=np.ascontiguousarray(weight[source], np.float32),
        triangles=triangles,
        source=source,
        surface={
            name: np.ascontiguousarray(values[source], np.float32)
            for name, values in surface.items()
            if values is not None
        },
        closed=is_closed(vertices, faces),
    )


def is_closed(vertices: NDArray[np.floating[Any]], faces: Ints) -> bool:
    """Do the faces (F,3) wind outward around a volume, with at most MAX_OPEN of their edges open?

    Bodies have small openings where no camera looks, such as the backs of the eyes.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    there, back = edges @ [1 << 32, 1], edges @ [1, 1 << 32]
    corners = np.asarray(vertices, np.float64)[faces]
    volume = np.einsum("fi,fi->", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2])
    open_edges = np.count_nonzero(~np.isin(there, back))
    return bool(volume > 0 and open_edges <= MAX_OPEN * len(edges) and len(np.unique(there)) == len(there))


def split_corners(faces: Ints, uv_faces: Ints) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint32]]:
    """Distinct (vertex, uv) corners numbered by first use.

    Returns the vertex (N,) and the uv (N,) of each, and the triangles (F,3) that index them.
    """
    corner = faces.astype(np.int64).ravel() << 32 | uv_faces.astype(np.int64).ravel()
    distinct, first, inverse = np.unique(corner, return_index=True, return_inverse=True)
    by_first_use = np.argsort(first)
    number = np.empty_like(by_first_use)
    number[by_first_use] = np.arange(len(by_first_use))
    kept = distinct[by_first_use]
    return kept >> 32, kept & 0xFFFFFFFF, number[inverse].reshape(faces.shape).astype(np.uint32)


def patch_order(centres: NDArray[np.float64], patch: int = PATCH_TRIANGLES) -> NDArray[np.int64]:
    """Order of triangles (F,) that keeps compact patches together: the longest side is halved until `patch` are left.

    Software drivers shade vertices again for each batch of about a thousand indices; compact patches share few.
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
    """Triangles (F_k,3) by the number of weights, 4, 8 or 12, that the neediest of their corners has above 0."""
    used = np.count_nonzero(arrays.weight, axis=1)
    needed = np.maximum(-(-used // 4) * 4, 4)[arrays.triangles].max(axis=1)
    return {k: arrays.triangles[needed == k] for k in WEIGHT_COUNTS if (needed == k).any()}


@dataclass(frozen=True)
class BodyPose:
    """One body in one frame. `joints` (55,3,4): skinning matrices. `feature` (486,): for pose blend shapes.

    `vertices` (V,3): where the body's vertices are, when the CPU unit has skinned them.
    """

    joints: F32
    feature: F32 | None = None
    vertices: F32 | None = None


class Mesh(Protocol):
    """What `MeshDraw` draws: buffers, a vertex shader, and a way to take a frame's pose."""

    arrays: MeshArrays
    vertex_shader: str
    batches: list[tuple[int, Any]]

    @property
    def defines(self) -> dict[str, int | str]:
        """Definitions that the vertex shader needs, beside K."""

    def prepare(self, ctx: Any) -> None:
        """Set the tests that the mesh is drawn with."""

    def vertex_array(self, program: Any, indices: Any) -> Any:
        """A vertex array of this mesh for `program`."""

    def upload_pose(self, pose: BodyPose) -> None:
        """Take a frame's pose."""

    def bind_pose(self, program: Any) -> None:
        """Let `program` read it."""


class PosedMesh:
    """A `MeshArrays` on the GPU whose vertices come skinned, frame by frame."""

    vertex_shader = "posed.vert"

    def __init__(self, ctx: Any, arrays: MeshArrays) -> None:
        self.arrays, self._ctx = arrays, ctx
        self.defines: dict[str, int | str] = {}
        self._corners = np.empty((len(arrays.source), 3), np.float32)
        self._positions = ctx.buffer(reserve=self._corners.nbytes, dynamic=True)
        self._uv = ctx.buffer(arrays.uv.tobytes())
        self.batches = [(WEIGHT_COUNTS[0], ctx.buffer(_index_bytes(arrays, arrays.triangles)))]

    def prepare(self, ctx: Any) -> None:
        """As `SkinnedMesh.prepare`."""
        _prepare(ctx, self.arrays.closed)

    def vertex_array(self, program: Any, indices: Any) -> Any:
        """A vertex array of this mesh for `program`."""
        content = [(self._positions, "3f", "position"), (self._uv, "2f", "uv")]
        return _vertex_array(self._ctx, program, content, indices, self.arrays)

    def upload_pose(self, pose: BodyPose) -> None:
        """Take the body's vertices; ValueError without them."""
        if pose.vertices is None:
            raise ValueError("a posed mesh needs the frame's vertices")
        np.take(pose.vertices, self.arrays.source, axis=0, out=self._corners, mode="clip")  # "raise" copies twice
        self._positions.orphan()
        self._positions.write(self._corners)

    def bind_pose(self, program: Any) -> None:
        """Nothing: positions are attributes."""


class SkinnedMesh:
    """A `MeshArrays` on the GPU. `posedirs` (V,3,486): pose blend shapes, indexed by `MeshArrays.source`.

    `batches`: number of weights and index buffer of the triangles that need as many.
    """

    vertex_shader = "skin.vert"

    def __init__(self, ctx: Any, arrays: MeshArrays, posedirs: NDArray[np.floating[Any]] | None = None) -> None:
        self.arrays = arrays
        self.posedirs = None if posedirs is None else _posedirs_texture(ctx, posedirs)
        names, formats, columns = _layout(arrays, self.posedirs is not None)
        packed = np.hstack([np.ascontiguousarray(column).view(np.uint8) for column in columns])
        self._content = (ctx.buffer(packed.tobytes()), " ".join(formats), *names)
        self.batches = [(k, ctx.buffer(_index_bytes(arrays, part))) for k, part in weight_batches(arrays).items()]
        self._joints = ctx.buffer(reserve=JOINTS * 48)
        self._feature = ctx.buffer(reserve=-(-POSE_FEATURES // 4) * 16)
        self._ctx = ctx

    @property
    def defines(self) -> dict[str, int | str]:
        """Definitions that the vertex shader needs for this mesh, beside K."""
        values: dict[str, int | str] = {"JOINTS": JOINTS}
        if self.posedirs is not None:
            values |= {"POSE_FEATURES": POSE_FEATURES, "ROW": POSEDIRS_ROW}
        if self.arrays.surface:
            values["SURFACE"] = 1
        return values

    def prepare(self, ctx: Any) -> None:
        """Depth test, and leave out the triangles that face away when the mesh is closed."""
        _prepare(ctx, self.arrays.closed)

    def vertex_array(self, program: Any, indices: Any) -> Any:
        """A vertex array of this mesh for `program`; attributes that the compiler dropped are skipped."""
        return _vertex_array(self._ctx, program, [self._content], indices, self.arrays)

    def upload_pose(self, pose: BodyPose) -> None:
        """Take the skinning matrices, and the pose feature for a mesh with pose blend shapes."""
        self._joints.write(np.ascontiguousarray(pose.joints, np.float32))
        if self.posedirs is None:
            return
        if pose.feature is None:
            raise ValueError("a mesh with pose blend shapes needs the pose feature")
        self._feature.write(np.ascontiguousarray(pose.feature, np.float32))

    def bind_pose(self, program: Any) -> None:
        """Let `program` read what was uploaded."""
        self._joints.bind_to_uniform_block(0)
        program["Joints"].binding = 0
        if self.posedirs is None:
            return
        self._feature.bind_to_uniform_block(1)
        program["PoseFeature"].binding = 1
        self.posedirs.use(location=8)
        program["posedirs"].value = 8


def _index_size(arrays: MeshArrays) -> int:
    """Bytes of an index: two where they suffice, which software drivers read faster."""
    return 2 if len(arrays.position) <= 1 << 16 else 4


def _index_bytes(arrays: MeshArrays, triangles: NDArray[np.uint32]) -> bytes:
    return triangles.astype(f"u{_index_size(arrays)}").tobytes()


def _vertex_array(ctx: Any, program: Any, content: Any, indices: Any, arrays: MeshArrays) -> Any:
    return ctx.vertex_array(
        program, content, index_buffer=indices, index_element_size=_index_size(arrays), skip_errors=True
    )


def _prepare(ctx: Any, closed: bool) -> None:
    ctx.enable_only(moderngl.DEPTH_TEST | (moderngl.CULL_FACE if closed else moderngl.NOTHING))
    ctx.depth_func = "<"
    ctx.front_face = "cw"  # rows run downward: what winds counter-clockwise in the picture is stored clockwise


def _layout(arrays: MeshArrays, with_source: bool) -> tuple[list[str], list[str], list[NDArray[Any]]]:
    columns: dict[str, tuple[str, NDArray[Any]]] = {"position": ("3f", arrays.position), "uv": ("2f", arrays.uv)}
    columns |= {name: (f"{values.shape[1]}f", values) for name, values in arrays.surface.items()}
    for group in range(arrays.weights_per_vertex // 4):
        part = slice(4 * group, 4 * group + 4)
        columns[f"joint_{GROUPS[group]}"] = ("4u1", arrays.joint[:, part])
        columns[f"weight_{GROUPS[group]}"] = ("4f", arrays.weight[:, part])
    if with_source:
        columns["source"] = ("1u4", arrays.source.astype(np.uint32)[:, None])
    return list(columns), [fmt for fmt, _ in columns.values()], [values for _, values in columns.values()]


def _posedirs_texture(ctx: Any, posedirs: NDArray[np.floating[Any]]) -> Any:
    if posedirs.shape[1:] != (3, POSE_FEATURES):
        raise BadInputError("posedirs", f"shape {posedirs.shape}", f"(vertices, 3, {POSE_FEATURES})")
    texels = posedirs.shape[0] * POSE_FEATURES
    rows = -(-texels // POSEDIRS_ROW)
    image = np.zeros((rows * POSEDIRS_ROW, 3), np.float16)
    image[:texels] = posedirs.transpose(0, 2, 1).reshape(-1, 3)
    return ctx.texture((POSEDIRS_ROW, rows), 3, image.tobytes(), dtype="f2", alignment=1)


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
    for passed, where, found, expected in tests:
        if not passed:
            raise BadInputError(f"mesh {where}", str(found), expected)


def _indexes(values: Any, count: int) -> bool:
    return bool(values.size) and int(values.min()) >= 0 and int(values.max()) < count
