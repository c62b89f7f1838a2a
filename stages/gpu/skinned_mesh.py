"""A body's mesh on the GPU: vertex and index buffers, and the pose of the frame.

Rule: a mesh offers `Mesh`, whether the vertex shader skins its vertices (`SkinnedMesh`) or the CPU unit (`PosedMesh`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import moderngl
import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32
from trilane.body.joints import JOINTS, POSE_FEATURES
from trilane.body.skin_weights import WEIGHT_COUNTS
from trilane.errors import BadInputError
from trilane.stages.gpu.mesh_arrays import MeshArrays, weight_batches
from trilane.stages.gpu.transfers import counter_of, upload

POSEDIRS_ROW = 8192  # texels in a row of the pose blend shape texture
GROUPS = "abc"


@dataclass(frozen=True)
class BodyPose:
    """One body in one frame. `joints` (55,3,4): skinning matrices. `feature` (486,): of the pose blend shapes.

    `vertices` (V,3): the body's vertices in the world, metres, when the CPU unit has skinned them.
    """

    joints: F32
    feature: F32 | None = None
    vertices: F32 | None = None


class Mesh(Protocol):
    """What `MeshDraw` draws: buffers, a vertex shader, and the pose of a frame.

    `batches`: pairs of a number of skin weights and the index buffer of the triangles drawn with as many.
    `pose_bytes`: of a frame's pose, each number of it once.
    """

    arrays: MeshArrays
    vertex_shader: str
    batches: list[tuple[int, Any]]
    pose_bytes: int

    @property
    def defines(self) -> dict[str, int | str]:
        """Preprocessor definitions of the vertex shader, without K."""

    def prepare(self, ctx: Any) -> None:
        """Enable the depth test, and for a closed mesh leave out the triangles that face away."""

    def vertex_array(self, program: Any, indices: Any) -> Any:
        """A vertex array of this mesh for `program`, drawn in the order of index buffer `indices`."""

    def upload_pose(self, pose: BodyPose) -> None:
        """Write a frame's pose to the GPU. Raises ValueError when it lacks an array that the mesh needs."""

    def bind_pose(self, program: Any) -> None:
        """Make `program` read the uploaded pose."""


class PosedMesh:
    """A mesh whose vertices the CPU unit skins frame by frame."""

    vertex_shader = "posed_vertices.vert"

    def __init__(self, ctx: Any, arrays: MeshArrays) -> None:
        self.arrays, self._ctx = arrays, ctx
        self.defines: dict[str, int | str] = {}
        self._corners = np.empty((len(arrays.source), 3), np.float32)
        self.pose_bytes = len(np.unique(arrays.source)) * self._corners.itemsize * 3
        self._positions = ctx.buffer(reserve=self._corners.nbytes, dynamic=True)
        self._uv = ctx.buffer(arrays.uv.tobytes())
        self.batches = [(WEIGHT_COUNTS[0], ctx.buffer(_index_bytes(arrays, arrays.triangles)))]

    def prepare(self, ctx: Any) -> None:
        """Enable the depth test, and for a closed mesh leave out the triangles that face away."""
        _prepare(ctx, self.arrays.closed)

    def vertex_array(self, program: Any, indices: Any) -> Any:
        """A vertex array of this mesh for `program`."""
        content = [(self._positions, "3f", "position"), (self._uv, "2f", "uv")]
        return _vertex_array(self._ctx, program, content, indices, self.arrays)

    def upload_pose(self, pose: BodyPose) -> None:
        """Write the body's vertices to the GPU. Raises ValueError without them."""
        if pose.vertices is None:
            raise ValueError("a posed mesh needs the frame's vertices")
        np.take(pose.vertices, self.arrays.source, axis=0, out=self._corners, mode="clip")  # "raise" copies twice
        self._positions.orphan()
        counter_of(self._ctx).read += self._corners.nbytes
        upload(self._ctx, self._positions, self._corners)

    def bind_pose(self, program: Any) -> None:
        """Does nothing: the positions are vertex attributes."""


class SkinnedMesh:
    """A mesh whose vertices the vertex shader skins. `posedirs` (V,3,486): pose blend shapes of the body's vertices."""

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
        self.pose_bytes = 4 * (JOINTS * 12 + (0 if posedirs is None else POSE_FEATURES))
        self._ctx = ctx

    @property
    def defines(self) -> dict[str, int | str]:
        """Preprocessor definitions of the vertex shader for this mesh, without K."""
        values: dict[str, int | str] = {"JOINTS": JOINTS}
        if self.posedirs is not None:
            values |= {"POSE_FEATURES": POSE_FEATURES, "ROW": POSEDIRS_ROW}
        if self.arrays.surface:
            values["SURFACE"] = 1
        return values

    def prepare(self, ctx: Any) -> None:
        """Enable the depth test, and for a closed mesh leave out the triangles that face away."""
        _prepare(ctx, self.arrays.closed)

    def vertex_array(self, program: Any, indices: Any) -> Any:
        """A vertex array of this mesh for `program`; attributes that the shader's compiler removed are skipped."""
        return _vertex_array(self._ctx, program, [self._content], indices, self.arrays)

    def upload_pose(self, pose: BodyPose) -> None:
        """Write the skinning matrices, and for a mesh with pose blend shapes the pose feature. Raises ValueError."""
        upload(self._ctx, self._joints, np.ascontiguousarray(pose.joints, np.float32))
        if self.posedirs is None:
            return
        if pose.feature is None:
            raise ValueError("a mesh with pose blend shapes needs the pose feature")
        upload(self._ctx, self._feature, np.ascontiguousarray(pose.feature, np.float32))

    def bind_pose(self, program: Any) -> None:
        """Make `program` read the uploaded matrices, pose feature and pose blend shapes."""
        self._joints.bind_to_uniform_block(0)
        program["Joints"].binding = 0
        if self.posedirs is None:
            return
        self._feature.bind_to_uniform_block(1)
        program["PoseFeature"].binding = 1
        self.posedirs.use(location=8)
        program["posedirs"].value = 8


def _index_size(arrays: MeshArrays) -> int:
    """Bytes of an index: two where they suffice, because software drivers read them faster."""
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
    ctx.front_face = "cw"  # row 0 is on top: triangles that wind counter-clockwise in the picture are stored clockwise


def _layout(arrays: MeshArrays, with_source: bool) -> tuple[list[str], list[str], list[NDArray[Any]]]:
    """Names, moderngl formats and columns of the interleaved vertex buffer."""
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
