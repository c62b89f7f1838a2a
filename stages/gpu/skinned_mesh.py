"""A body's mesh on the GPU: its arrays, its vertex and index buffers, the pose of a frame, and how it is drawn.

There is one vertex for each distinct pair of a position and a UV. Triangles are ordered so that neighbours are drawn
together. There are two kinds of `Mesh`: the vertex shader skins the vertices of a `SkinnedMesh`; the CPU unit has
already skinned the vertices of a `PosedMesh`.

A triangle is skinned with four weights per corner if no corner has more, else with eight, else with twelve. This
changes no bit of a position, because a weight of 0 adds nothing. The arrays of a body's mesh are computed once and then
cached.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, Floats, Ints
from trilane.body.body import Body, ShapedBody
from trilane.body.joints import JOINTS, POSE_FEATURES
from trilane.body.skinning import WEIGHT_COUNTS, largest_weights
from trilane.cache import Arrays, cached_arrays
from trilane.errors import BadInputError
from trilane.stages.gpu.opengl import build_program, counter_of, set_uniforms, target_clip, upload

PATCH_TRIANGLES = 320
MAX_OPEN = 0.005


@dataclass(frozen=True)
class MeshArrays:
    """The vertices of a mesh after its split at UV seams, and its triangles.

    `position`: positions in the rest pose, (N,3), metres.
    `uv`: texture coordinates, (N,2).
    `joint`: joint indices, (N,K).
    `weight`: their skin weights, (N,K), the largest first; a row sums to 1.
    `triangles`: indices of vertices, (F,3).
    `source`: for each vertex, the body's vertex that it is a copy of, (N,).
    `surface`: arrays `normal` (N,3) and `colour` (N,4) of a mesh that is shaded, else empty.
    `closed`: whether the triangles enclose a volume. Triangles that face away from the camera are then never seen.
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

    `vertices`: positions, (V,3), metres.
    `faces`: indices of `vertices`, (F,3).
    `uv`: texture coordinates, (T,2).
    `uv_faces`: indices of `uv`, (F,3), for the corners of `faces`.
    `joint`: joint indices, (V,K); K is 4, 8 or 12.
    `weight`: their skin weights, (V,K).
    `normal`: unit normals, (V,3); None for a mesh that is not shaded.
    `colour`: colours, (V,4); None for a mesh that is not shaded.
    Raises BadInputError if shapes, indices or values cannot be drawn.
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
        surface={
            name: np.ascontiguousarray(rows[source], np.float32)
            for name, rows in (("normal", normal), ("colour", colour))
            if rows is not None
        },
        closed=is_closed(vertices, faces),
    )


def is_closed(vertices: Floats, faces: Ints) -> bool:
    """Return whether `faces` (F,3) of `vertices` (V,3) enclose a volume and wind outward.

    MAX_OPEN of the edges may be open, because bodies have small openings that no camera sees, such as behind eyes.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    there, back = edges @ [1 << 32, 1], edges @ [1, 1 << 32]
    corners = np.asarray(vertices, np.float64)[faces]
    volume = np.einsum("fi,fi->", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2])
    open_edges = np.count_nonzero(~np.isin(there, back))
    return bool(volume > 0 and open_edges <= MAX_OPEN * len(edges) and len(np.unique(there)) == len(there))


def split_corners(faces: Ints, uv_faces: Ints) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint32]]:
    """Return (vertex index of each corner, UV index of each corner, triangles of corner numbers): (N,), (N,), (F,3).

    A corner is a distinct pair of a vertex in `faces` (F,3) and a UV in `uv_faces` (F,3). Corners are numbered in the
    order of their first use.
    """
    corner = faces.astype(np.int64).ravel() << 32 | uv_faces.astype(np.int64).ravel()
    distinct, first, inverse = np.unique(corner, return_index=True, return_inverse=True)
    by_first_use = np.argsort(first)
    number = np.empty_like(by_first_use)
    number[by_first_use] = np.arange(len(by_first_use))
    ordered = distinct[by_first_use]
    return ordered >> 32, ordered & 0xFFFFFFFF, number[inverse].reshape(faces.shape).astype(np.uint32)


def patch_order(centres: NDArray[np.float64], patch: int = PATCH_TRIANGLES) -> NDArray[np.int64]:
    """Return an order of the triangles, (F,), in which compact patches follow each other.

    The triangles are halved along their longest side, again and again, until a patch has at most `patch` of them. A
    software driver shades a vertex once for each batch of about a thousand indices that contains the vertex. Compact
    patches have few vertices in common.

    `centres`: centres of the triangles, (F,3).
    `patch`: most triangles of a patch.
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
    return np.concatenate(done)


def weight_batches(arrays: MeshArrays) -> dict[int, NDArray[np.uint32]]:
    """Return the triangles (F_k,3) by the number of skin weights, 4, 8 or 12, that their corners need."""
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


LARGEST_LOSS = 1e-3  # share of a vertex's weight
VERSION = "avatar mesh 1"  # raise it when the same body gives other arrays


def avatar_mesh(shaped: ShapedBody) -> MeshArrays:
    """Return the mesh of `shaped`, computed or from the cache."""
    body = shaped.body
    sources = (shaped.vertices, body.faces, body.uv, body.uv_faces, body.weights)
    arrays: dict[str, Any] = dict(cached_arrays(VERSION, sources, lambda: _arrays(shaped)))
    closed = bool(arrays.pop("closed"))
    return MeshArrays(**arrays, closed=closed)


def _arrays(shaped: ShapedBody) -> Arrays:
    body = shaped.body
    top = largest_weights(body.weights, enough_weights(body))
    mesh = mesh_arrays(shaped.vertices, body.faces, body.uv, body.uv_faces, top.joints, top.weights)
    return {field.name: np.asarray(getattr(mesh, field.name)) for field in fields(mesh) if field.name != "surface"}


def enough_weights(body: Body) -> int:
    """Return the least number of weights, 4, 8 or 12, with which no vertex loses more than LARGEST_LOSS; else 12."""
    left = -np.sort(-body.weights, axis=1)
    lost = {k: float(left[:, k:].sum(axis=1).max(initial=0.0)) for k in WEIGHT_COUNTS}
    return next((k for k in WEIGHT_COUNTS if lost[k] <= LARGEST_LOSS), WEIGHT_COUNTS[-1])


POSEDIRS_ROW = 8192  # texels in a row of the pose blend shape texture
GROUPS = "abc"


@dataclass(frozen=True)
class BodyPose:
    """The pose of one body in one frame.

    `joints`: skinning matrices, (55,3,4).
    `feature`: factors of the pose blend shapes, (486,); None for a body without them.
    `vertices`: the body's vertices, (V,3), metres, world space; None unless the CPU unit has skinned them.
    """

    joints: F32
    feature: F32 | None = None
    vertices: F32 | None = None


class Mesh:
    """A mesh that `MeshDraw` draws: buffers, a vertex shader, and the pose of a frame.

    `arrays`: vertices and triangles.
    `vertex_shader`: file of `trilane.shaders`.
    `defines`: preprocessor definitions of the vertex shader, except K.
    `batches`: pairs of a number of skin weights and the index buffer of the triangles that are drawn with it.
    `pose_bytes`: size of a frame's pose in bytes. A number that is uploaded several times counts once.
    """

    vertex_shader: str
    pose_bytes: int
    _content: list[tuple[Any, ...]]

    def __init__(self, ctx: Any, arrays: MeshArrays, batches: dict[int, NDArray[np.uint32]]) -> None:
        self.arrays, self._ctx = arrays, ctx
        self.defines: dict[str, int | str] = {}
        # Software drivers read an index of two bytes faster.
        self._index_size = 2 if len(arrays.position) <= 1 << 16 else 4
        kind = f"u{self._index_size}"
        self.batches = [(k, ctx.buffer(triangles.astype(kind).tobytes())) for k, triangles in batches.items()]

    def prepare(self, ctx: Any) -> None:
        """Enable the depth test. For a closed mesh, also leave out the triangles that face away."""
        ctx.enable_only(moderngl.DEPTH_TEST | (moderngl.CULL_FACE if self.arrays.closed else moderngl.NOTHING))
        ctx.depth_func = "<"
        ctx.front_face = "cw"  # row 0 is on top: triangles that wind counter-clockwise there are stored clockwise

    def vertex_array(self, program: Any, indices: Any) -> Any:
        """Return a vertex array with which `program` draws the triangles of index buffer `indices`.

        It lacks attributes that the shader's compiler removed.
        """
        size = self._index_size
        return self._ctx.vertex_array(
            program, self._content, index_buffer=indices, index_element_size=size, skip_errors=True
        )

    def upload_pose(self, pose: BodyPose) -> None:
        """Write a frame's pose to the GPU. Raises ValueError if `pose` lacks an array that the mesh needs."""
        raise NotImplementedError

    def bind_pose(self, program: Any) -> None:
        """Make `program` read the uploaded pose. Vertex attributes need nothing."""


class PosedMesh(Mesh):
    """A mesh whose vertices the CPU unit skins for each frame; they are vertex attributes."""

    vertex_shader = "posed_vertices.vert"

    def __init__(self, ctx: Any, arrays: MeshArrays) -> None:
        super().__init__(ctx, arrays, {WEIGHT_COUNTS[0]: arrays.triangles})
        self._corners = np.empty((len(arrays.source), 3), np.float32)
        self.pose_bytes = len(np.unique(arrays.source)) * self._corners.itemsize * 3
        self._positions = ctx.buffer(reserve=self._corners.nbytes, dynamic=True)
        self._content = [(self._positions, "3f", "position"), (ctx.buffer(arrays.uv.tobytes()), "2f", "uv")]

    def upload_pose(self, pose: BodyPose) -> None:
        """Write the body's vertices to the GPU. Raises ValueError without them."""
        if pose.vertices is None:
            raise ValueError("a posed mesh needs the frame's vertices")
        np.take(pose.vertices, self.arrays.source, axis=0, out=self._corners, mode="clip")  # mode "raise" copies twice
        self._positions.orphan()
        counter_of(self._ctx).read += self._corners.nbytes
        upload(self._ctx, self._positions, self._corners)


class SkinnedMesh(Mesh):
    """A mesh whose vertices the vertex shader skins.

    `posedirs`: texture with the pose blend shapes of the body's vertices; None for a body without them.
    """

    vertex_shader = "skin.vert"

    def __init__(self, ctx: Any, arrays: MeshArrays, posedirs: NDArray[np.floating[Any]] | None = None) -> None:
        super().__init__(ctx, arrays, weight_batches(arrays))
        self.defines["JOINTS"] = JOINTS
        self.posedirs = None if posedirs is None else _posedirs_texture(ctx, posedirs)
        if self.posedirs is not None:
            self.defines |= {"POSE_FEATURES": POSE_FEATURES, "ROW": POSEDIRS_ROW}
        if arrays.surface:
            self.defines["SURFACE"] = 1
        names, formats, columns = _layout(arrays, self.posedirs is not None)
        packed = np.hstack([np.ascontiguousarray(column).view(np.uint8) for column in columns])
        self._content = [(ctx.buffer(packed.tobytes()), " ".join(formats), *names)]
        self._joints = ctx.buffer(reserve=JOINTS * 48)
        self._feature = ctx.buffer(reserve=-(-POSE_FEATURES // 4) * 16)
        self.pose_bytes = 4 * (JOINTS * 12 + (0 if posedirs is None else POSE_FEATURES))

    def upload_pose(self, pose: BodyPose) -> None:
        """Write the skinning matrices, and for a mesh with pose blend shapes the pose feature, to the GPU.

        Raises ValueError if `pose` lacks the feature that the mesh needs.
        """
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


def _layout(arrays: MeshArrays, with_source: bool) -> tuple[list[str], list[str], list[NDArray[Any]]]:
    """Return (names, formats, columns) of the interleaved vertex buffer; the formats are moderngl's."""
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


class MeshDraw:
    """A mesh that is drawn with one fragment shader."""

    def __init__(self, ctx: Any, mesh: Mesh, fragment: str | Path, **defines: int | str) -> None:
        """Build a program for each number of skin weights.

        `ctx`: OpenGL context.
        `mesh`: mesh to draw.
        `fragment`: file of `trilane.shaders`, or a path.
        `defines`: preprocessor definitions of both shaders.
        Raises TrilaneError if a shader does not compile.
        """
        self._mesh, self._ctx = mesh, ctx
        self._parts = []
        for weights, indices in mesh.batches:
            program = build_program(ctx, mesh.vertex_shader, fragment, **mesh.defines, **defines, K=weights)
            self._parts.append((program, mesh.vertex_array(program, indices)))

    def set(self, values: dict[str, Any]) -> None:
        """Set the uniforms named in `values`, except any that the shader's compiler removed."""
        for program, _ in self._parts:
            set_uniforms(program, values)

    def draw(self, pose: BodyPose, view: Floats, projection: Floats) -> None:
        """Draw the mesh in `pose` into the current target, with the depth test and culling that are enabled.

        `view`, `projection`: OpenGL matrices (4,4).
        """
        clip = target_clip(view, projection)
        self._mesh.upload_pose(pose)
        for program, vertices in self._parts:
            self._mesh.bind_pose(program)
            upload(self._ctx, program["clip_from_world"], clip)
            vertices.render()
