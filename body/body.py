"""A body file in the SMPL-X layout. The reader executes no pickles and checks sizes before it allocates memory.

A `Body` is finite, consistent and read-only. Any fault of the file raises one BadInputError. A body is refused if its
height at rest is not a person's, because all lengths must be metres. Pose blend shapes are read in chunks. Many files
hold 80 MB of zeros, so memory is allocated only at the first nonzero number.

The layout is that of https://smpl-x.is.tue.mpg.de, interpreted as the `smplx` package does. The rest shape is
`v_template + shapedirs @ [betas, expression]`; the joints are `J_regressor @ rest shape`.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trilane.arrays import F32, F64, I32, Ints
from trilane.body.joints import JOINTS, LEFT_HAND, POSE_FEATURES, POSE_SIZE, RIGHT_HAND
from trilane.errors import BadInputError
from trilane.files import DAMAGED, RATE_KEYS, npz_names, read_header, read_npz

#: Range of heights from sole to crown, metres: from less than a newborn child's to more than any adult's.
LEAST_HEIGHT_M, MOST_HEIGHT_M = 0.3, 3.0
USUAL_HEIGHT_M = 1.7
UNITS_M = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "feet": 0.3048, "decimetres": 0.1}


def _height_remedy(height: float) -> str:
    """Return how to fix a body of the wrong `height`, metres; names the unit of measure that explains it, if any."""
    fitting = {name: unit for name, unit in UNITS_M.items() if LEAST_HEIGHT_M <= height * unit <= MOST_HEIGHT_M}
    if not fitting:
        return "give its places in metres, Y up"
    name = min(fitting, key=lambda name: abs(math.log(height * fitting[name] / USUAL_HEIGHT_M)))
    scaled = f"{height * fitting[name]:.2f} m if they are {name}"
    return f"give its places in metres: {scaled}, so multiply v_template and shapedirs by {fitting[name]:g}"


POSE_BLEND_KEY = "posedirs"
MAX_POSE_BLEND_BYTES = 1 << 30
_CHUNK_ITEMS = 1 << 18


def read_pose_blend(path: Path, shape: tuple[int, int, int]) -> NDArray[np.float32] | None:
    """Return the array `posedirs` of the npz file at `path`: float32 of `shape`, read-only; None when it is all zero.

    Raises BadInputError for a file that cannot be read, and for an array that is missing, misshapen, pickled, too
    large, truncated or not finite.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if f"{POSE_BLEND_KEY}.npy" not in archive.namelist():
                raise BadInputError(path, f"no array {POSE_BLEND_KEY!r}", "a body file in the SMPL-X layout (.npz)")
            with archive.open(f"{POSE_BLEND_KEY}.npy") as file:
                return _read_pose_blend(f"{path}[{POSE_BLEND_KEY}]", file, shape)
    except DAMAGED as error:
        raise BadInputError(path, f"no readable .npz archive ({error})", "a body file (.npz)") from error


def _read_pose_blend(where: str, file: IO[bytes], shape: tuple[int, int, int]) -> NDArray[np.float32] | None:
    stored_shape, fortran, dtype = read_header(where, file)
    if dtype.kind not in "fiu":
        raise BadInputError(where, f"dtype {dtype}", "numbers")
    if stored_shape != shape:
        raise BadInputError(where, f"shape {stored_shape}", str(shape))
    count = math.prod(shape)
    if count * dtype.itemsize > MAX_POSE_BLEND_BYTES:
        raise BadInputError(where, f"shape {stored_shape} of {dtype}", f"at most {MAX_POSE_BLEND_BYTES} bytes")
    flat: NDArray[np.float32] | None = None
    for start in range(0, count, _CHUNK_ITEMS):
        items = min(_CHUNK_ITEMS, count - start)
        data = file.read(items * dtype.itemsize)
        if len(data) < items * dtype.itemsize:
            raise BadInputError(where, "truncated data", f"{count * dtype.itemsize} bytes by its own header")
        chunk = np.frombuffer(data, dtype)
        if not chunk.any():
            continue
        if flat is None:
            flat = np.zeros(count, np.float32)
        with np.errstate(over="ignore"):
            flat[start : start + items] = chunk
        if not np.isfinite(flat[start : start + items]).all():
            raise BadInputError(where, "NaN or infinity", "finite numbers")
    if flat is None:
        return None
    array = np.ascontiguousarray(flat.reshape(shape, order="F" if fortran else "C"))
    array.flags.writeable = False
    return array


EXPECTED = "a body file in the SMPL-X layout (.npz)"
MAX_VERTICES = 1 << 18
MAX_FACES = 1 << 19
SUM_TOLERANCE = 1e-3
#: Names of arrays that show that a file holds a motion, in AMASS files and similar ones.
MOTION_KEYS = frozenset({"poses", "smpl_poses", "smpl_pose", "smpl_thetas", "body_pose", "pose_body", *RATE_KEYS})
MOST_NAMED = 16
#: Unit roundoff of float32: the largest relative error of a weight that was rounded to float32.
ROUNDING = 2.0**-24

#: For each array of the file: its shape ("V" vertices, "F" faces, "T" texture coordinates, "*" any size), and whether
#: it holds indices.
_LAYOUT: dict[str, tuple[tuple[int | str, ...], bool]] = {
    "v_template": (("V", 3), False),
    "shapedirs": (("V", 3, "*"), False),
    "J_regressor": ((JOINTS, "V"), False),
    "weights": (("V", JOINTS), False),
    "kintree_table": ((2, JOINTS), True),
    "f": (("F", 3), True),
    "vt": (("T", 2), False),
    "ft": (("F", 3), True),
    "hands_componentsl": (("*", 45), False),
    "hands_componentsr": (("*", 45), False),
    "hands_meanl": ((45,), False),
    "hands_meanr": ((45,), False),
}
#: Key of an array (2,), which a file may lack: how many first vertices and faces are skin. The rest are garments.
SKIN_KEY = "skin"
_LIMITS = {"V": MAX_VERTICES, "F": MAX_FACES, "T": 3 * MAX_FACES}

#: Least number of columns of `shapedirs`, first expression column, number of expression columns.
_FULL, _SHORT = (400, 300, 100), (20, 10, 10)


@dataclass(frozen=True)
class Body:
    """A body of V vertices, F triangles and T texture coordinates. Metres, Y up. Arrays are read-only.

    `source`: path of the body file.
    `v_template` (V,3): vertices of the mean shape at rest.
    `shape_dirs` (V,3,S), `expression_dirs` (V,3,E): metres per unit of each coefficient.
    `posedirs` (V,3,486): metres per unit of each pose feature (`Posed.feature`); None when the file has only zeros.
    `j_regressor` (55,V): weights that give the rest joints from the rest vertices.
    `weights` (V,55): skinning weights.
    `parents` (55,): index of each joint's parent, -1 at the root.
    `faces` (F,3): vertex indices.
    `uv` (T,2): texture coordinates, u right, v up. `uv_faces` (F,3): index into `uv` of each corner of a face.
    `hand_components`: left (C,45) and right (C,45), principal components of hand poses.
    `hand_mean` (90,): mean hand pose, axis-angle, left then right.
    `offsets` (V,3): vectors from the rest shape to the drawn surface, such as clothes and hair; None for a bare body.
    `skin`: (number of vertices, number of faces) of the skin, which comes first; the rest are garments that hang, such
    as a skirt. None if the whole body is skin.
    """

    source: str
    v_template: F32
    shape_dirs: F32
    expression_dirs: F32
    posedirs: F32 | None
    j_regressor: F32
    weights: F32
    parents: I32
    faces: I32
    uv: F32
    uv_faces: I32
    hand_components: tuple[F32, F32]
    hand_mean: F32
    offsets: F32 | None = None
    skin: tuple[int, int] | None = None

    @property
    def has_pose_blend_shapes(self) -> bool:
        return self.posedirs is not None

    @np.errstate(over="ignore", invalid="ignore")  # the vertices are checked
    def shape(self, betas: ArrayLike = (), expression: ArrayLike = ()) -> ShapedBody:
        """Return the body shaped by up to S `betas` and up to E `expression` coefficients; missing coefficients are 0.

        Raises BadInputError when there are too many coefficients, or when some or their vertices are not finite.
        """
        rest = self.v_template.astype(np.float64)
        for name, dirs, coefficients in (
            ("betas", self.shape_dirs, betas),
            ("expression", self.expression_dirs, expression),
        ):
            values = np.atleast_1d(np.asarray(coefficients, np.float64))
            if values.ndim != 1 or len(values) > dirs.shape[2] or not np.isfinite(values).all():
                fault = f"an array of shape {values.shape}" if np.isfinite(values).all() else "NaN or infinity"
                raise BadInputError(name, fault, f"at most {dirs.shape[2]} finite numbers")
            if len(values):
                rest += dirs[:, :, : len(values)] @ values
        joints = self.j_regressor.astype(np.float64) @ rest
        if self.offsets is not None:
            rest += self.offsets
        vertices = rest.astype(np.float32)
        if not np.isfinite(vertices).all():
            raise BadInputError("betas and expression", "vertices that are not finite", "smaller coefficients")
        return ShapedBody(_frozen(vertices), _frozen(joints), self)

    def full_pose(self, poses: ArrayLike, flat_hand_mean: bool) -> F64:
        """Return a copy of `poses` whose hand poses are absolute, which means that they contain the mean hand pose.

        `poses` (..., 165): axis-angle, radians.
        `flat_hand_mean`: whether hand poses in `poses` are absolute already; otherwise the mean hand pose is added.
        Raises BadInputError if the last axis of `poses` has another length.
        """
        full = np.array(poses, np.float64)
        if full.ndim == 0 or full.shape[-1] != POSE_SIZE:
            raise BadInputError("poses", f"shape {full.shape}", f"(..., {POSE_SIZE})")
        if not flat_hand_mean:
            full[..., LEFT_HAND.start : RIGHT_HAND.stop] += self.hand_mean
        return full


@dataclass(frozen=True)
class ShapedBody:
    """One person at rest, in body space.

    `vertices` (V,3) float32 and `joints` (55,3) float64: positions, metres. `body`: body that was shaped.
    """

    vertices: F32
    joints: F64
    body: Body

    def bare(self) -> ShapedBody:
        """Return the person without offsets and garments, which is the skin under clothes and hair."""
        moved = self._without_offsets()
        if moved.body.skin is None:
            return moved
        (vertices, faces), body = moved.body.skin, moved.body
        return moved.part(np.arange(vertices), body.faces[:faces], body.uv_faces[:faces])

    def part(self, used: Ints, faces: I32, uv_faces: I32) -> ShapedBody:
        """Return the person with only some vertices and triangles.

        `used`: indices (N,) of the kept vertices. `faces`: triangles (G,3), as indices into `used`.
        `uv_faces`: the same triangles (G,3), as indices into the body's texture coordinates.
        """
        body = self.body
        smaller = replace(
            body,
            v_template=_frozen(body.v_template[used]),
            shape_dirs=_frozen(body.shape_dirs[used]),
            expression_dirs=_frozen(body.expression_dirs[used]),
            posedirs=None if body.posedirs is None else _frozen(body.posedirs[used]),
            j_regressor=_frozen(body.j_regressor[:, used]),
            weights=_frozen(body.weights[used]),
            faces=faces,
            uv_faces=uv_faces,
            offsets=None if body.offsets is None else _frozen(body.offsets[used]),
            skin=None,
        )
        return ShapedBody(_frozen(self.vertices[used]), self.joints, smaller)

    def with_offsets(self, offsets: F32) -> ShapedBody:
        """Return the person with `offsets` (V,3), metres at rest, which replace all earlier offsets."""
        moved = (self._without_offsets().vertices.astype(np.float64) + offsets).astype(np.float32)
        # Copied, because freezing would make the caller's array read-only.
        return ShapedBody(_frozen(moved), self.joints, replace(self.body, offsets=_frozen(offsets.copy())))

    def _without_offsets(self) -> ShapedBody:
        if self.body.offsets is None:
            return self
        return ShapedBody(_frozen(self.vertices - self.body.offsets), self.joints, replace(self.body, offsets=None))


def load_body(path: Path) -> Body:
    """Read a body file.

    Raises BadInputError when the file is missing, truncated, pickled, too large, not finite, inconsistent or of another
    layout.
    """
    arrays = read_npz(path, (*_LAYOUT, SKIN_KEY), EXPECTED)
    _check_layout(path, arrays)
    vertices = len(arrays["v_template"])
    parents = _parents(path, arrays["kintree_table"])
    _check_indices(path, arrays["f"], vertices, "f", "vertices")
    _check_indices(path, arrays["ft"], len(arrays["vt"]), "ft", "texture coordinates")
    weights = _floats(path, arrays, "weights")
    _check_weights(path, weights)
    weights = weights_of_one(weights)
    shape_dirs, expression_dirs = _split_shape(path, _floats(path, arrays, "shapedirs"))
    template = _floats(path, arrays, "v_template")
    height = float(np.ptp(template[:, 1]))
    if not LEAST_HEIGHT_M <= height <= MOST_HEIGHT_M:
        found, expected = f"a body {height:.4g} m high, along Y at rest", f"{LEAST_HEIGHT_M:g} to {MOST_HEIGHT_M:g} m"
        raise BadInputError(f"{path}[v_template]", found, expected, _height_remedy(height))
    return Body(
        source=str(path),
        v_template=template,
        shape_dirs=shape_dirs,
        expression_dirs=expression_dirs,
        posedirs=read_pose_blend(path, (vertices, 3, POSE_FEATURES)),
        j_regressor=_floats(path, arrays, "J_regressor"),
        weights=weights,
        parents=parents,
        faces=_frozen(arrays["f"].astype(np.int32)),
        uv=_floats(path, arrays, "vt"),
        uv_faces=_frozen(arrays["ft"].astype(np.int32)),
        hand_components=(_floats(path, arrays, "hands_componentsl"), _floats(path, arrays, "hands_componentsr")),
        hand_mean=_frozen(np.concatenate([_floats(path, arrays, "hands_meanl"), _floats(path, arrays, "hands_meanr")])),
        skin=_skin(path, arrays),
    )


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array


def _check_layout(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    sizes: dict[str, int] = {}
    for key, (sides, is_index) in _LAYOUT.items():
        if key not in arrays:
            raise BadInputError(path, f"no array {key!r}", EXPECTED, _instead_of_body(npz_names(path, EXPECTED)))
        array = arrays[key]
        if array.dtype.kind not in ("iu" if is_index else "fiu"):
            raise BadInputError(f"{path}[{key}]", f"dtype {array.dtype}", "integers" if is_index else "numbers")
        if len(array.shape) == len(sides):
            for side, size in zip(sides, array.shape, strict=True):
                if isinstance(side, str):
                    sizes.setdefault(side, size)
        wanted = tuple(sizes.get(str(side), side) if side != "*" else "*" for side in sides)
        if len(array.shape) != len(wanted) or any(b not in ("*", a) for a, b in zip(array.shape, wanted, strict=True)):
            raise BadInputError(f"{path}[{key}]", f"shape {array.shape}", f"({', '.join(map(str, wanted))})")
    for side, limit in _LIMITS.items():
        if not 0 < sizes[side] <= limit:
            raise BadInputError(path, f"{sizes[side]} {side}", f"1 to {limit} (V vertices, F faces, T vt)")


def _instead_of_body(names: Collection[str]) -> str:
    """Return a part of a message about a file that is no body: its array `names`, and whether it is a motion."""
    listed = f"arrays that were found: {', '.join(sorted(names)[:MOST_NAMED]) or 'none'}"
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    motion = ": a motion, which `trilane run --motion` takes" if MOTION_KEYS & set(names) else ""
    return f"{listed}{more}{motion}"


def _floats(path: Path, arrays: dict[str, NDArray[Any]], key: str) -> F32:
    with np.errstate(over="ignore"):
        array = arrays[key].astype(np.float32)
    if not np.isfinite(array).all():
        raise BadInputError(f"{path}[{key}]", "NaN or infinity", "finite numbers")
    return _frozen(array)


def _check_indices(path: Path, indices: NDArray[Any], count: int, key: str, of: str) -> None:
    low, high = int(indices.min()), int(indices.max())
    if low < 0 or high >= count:
        raise BadInputError(f"{path}[{key}]", f"indices from {low} to {high}", f"0 to {count - 1}, the {of}")


def _check_weights(path: Path, weights: F32) -> None:
    sums = weights.sum(axis=1, dtype=np.float64)
    worst = int(np.abs(sums - 1.0).argmax())
    where = f"{path}[weights]"
    if weights.min() < -SUM_TOLERANCE:
        raise BadInputError(where, f"a weight of {weights.min():.3g}", "weights of at least 0")
    if abs(sums[worst] - 1.0) > SUM_TOLERANCE:
        raise BadInputError(where, f"a sum of {sums[worst]:.4g} at vertex {worst}", "rows that sum to 1")


def weights_of_one(weights: F32) -> F32:
    """Return skinning weights (V,J) with negative weights set to 0 and each row scaled to sum to 1.

    A row without negative weights stays as it is if its sum is 1 within rounding. If a sum is 1 + e, a vertex at a
    distance of p metres from the origin moves by e * p metres.
    """
    bounded = np.maximum(weights, 0)
    sums = bounded.sum(axis=1, dtype=np.float64, keepdims=True)
    kept = (np.abs(sums - 1.0) <= weights.shape[1] * ROUNDING) & (weights >= 0).all(axis=1, keepdims=True)
    return _frozen(np.where(kept, weights, (bounded / sums).astype(np.float32)))


def _skin(path: Path, arrays: dict[str, NDArray[Any]]) -> tuple[int, int] | None:
    """Return the numbers of vertices and faces of the skin; None without the array.

    Raises BadInputError for another array, and if a face of the skin or a joint depends on a garment's vertex.
    """
    array, vertices, faces = arrays.get(SKIN_KEY), len(arrays["v_template"]), len(arrays["f"])
    if array is None:
        return None
    where = f"{path}[{SKIN_KEY}]"
    if array.shape != (2,) or array.dtype.kind not in "iu":
        raise BadInputError(where, f"{array.dtype} of shape {array.shape}", "two integers, of vertices and faces")
    skin = int(array[0]), int(array[1])
    if not (0 < skin[0] <= vertices and 0 < skin[1] <= faces):
        raise BadInputError(where, f"{skin}", f"1 to {vertices} vertices, 1 to {faces} faces")
    mixed = np.flatnonzero((arrays["f"][: skin[1]] >= skin[0]).any(axis=1))
    if len(mixed):
        found = f"face {mixed[0]}, a face of the skin with a garment's vertex"
        raise BadInputError(where, found, f"vertices 0 to {skin[0] - 1}")
    joints = np.flatnonzero(arrays["J_regressor"][:, skin[0] :].any(axis=1))
    if len(joints):
        found = f"joint {joints[0]}, a joint that depends on a garment's vertex"
        raise BadInputError(where, found, "zeros there in J_regressor")
    return skin


def _split_shape(path: Path, dirs: F32) -> tuple[F32, F32]:
    columns = dirs.shape[2]
    for least, first, count in (_FULL, _SHORT):
        if columns >= least:
            split = dirs[:, :, :first], dirs[:, :, first : first + count]
            return _frozen(np.ascontiguousarray(split[0])), _frozen(np.ascontiguousarray(split[1]))
    raise BadInputError(f"{path}[shapedirs]", f"{columns} columns", "400 (betas, expression from 300) or 20 (from 10)")


def _parents(path: Path, table: NDArray[Any]) -> I32:
    """Return each joint's parent (55,) from the first row of `table`; the root's parent is always -1.

    Raises BadInputError when a parent is out of range, or when the joints form a cycle.
    """
    stored = [int(parent) for parent in table[0]]
    where = f"{path}[kintree_table]"
    for joint, parent in enumerate(stored[1:], start=1):
        if not 0 <= parent < JOINTS:
            raise BadInputError(where, f"parent {parent} at joint {joint}", f"0 to {JOINTS - 1}")
    parents = [-1, *stored[1:]]
    for joint in range(JOINTS):
        at, steps = joint, 0
        while at >= 0 and steps <= JOINTS:
            at, steps = parents[at], steps + 1
        if at >= 0:
            raise BadInputError(where, f"a cycle through joint {joint}", "a tree whose root is joint 0")
    return _frozen(np.array(parents, np.int32))
