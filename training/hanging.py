"""A body file with the garments that hang, such as a skirt: meshes of their own, skinned and textured with the body.

Offsets move the skin's vertices. They cannot close the gap between two legs, nor follow hair that falls over the back.
Therefore such a garment has vertices, faces and texture coordinates of its own. The body's arrays hold the skin first,
then the garments. Everything that reads a body draws a garment as it draws the skin.

Rule: a garment takes the largest rectangle of the texture that neither the body nor an earlier garment uses. Triangles
that face away from the camera are not drawn, so the mesh must enclose a volume. Therefore an open garment has a lining.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64, I64, Mask
from trilane.body.body import SKIN_KEY, load_body
from trilane.errors import BadInputError
from trilane.training.clothing import HANGING, Look, find_landmarks, look_named, nearest
from trilane.training.first_texture import used_texels
from trilane.training.surface import ANGLES, body_arrays
from trilane.writing import write_atomically

#: Garments that are open above and below.
OPEN = frozenset({"skirt"})
#: Distance of a lining from the outside, metres, and the share of the garment's texture that the lining has.
LINING_M, LINING_SHARE = 0.004, 0.25
#: Side of the grid of texels on which free rectangles are searched, and texels that stay free at a rectangle's edges.
SIDE, MARGIN = 512, 4
BODY = "body.npz"


@dataclass(frozen=True)
class _Sheet:
    """A garment's mesh.

    `vertices`: (N,3), metres at rest. `faces`: (F,3). `weights`: skinning weights (N,55). `across`, `along`: texture
    coordinates (T,) in 0..1, around a ring and from ring to ring. `uv_faces`: (F,3) indices of texture coordinates.
    `size`: length around a ring, and length from the first to the last ring, metres.
    """

    vertices: F64
    faces: I64
    weights: F64
    across: F64
    along: F64
    uv_faces: I64
    size: tuple[float, float]


def dressed_body(body: Path, look: str, folder: Path) -> Path:
    """Return the file of the body in `look`: `body` itself, or a file in `folder` with the garments that hang.

    A file that is there is replaced, because it may be of another body or look. Raises BadInputError for an unknown
    look, a wrong body file, a texture without room for a garment, or a file that cannot be written.

    `body`: file of the body without garments. `look`: name of a look.
    """
    hanging = [name for name in look_named(look).garments if name in HANGING]
    path = folder / BODY
    if not hanging:
        return body
    folder.mkdir(parents=True, exist_ok=True)
    with write_atomically(path) as draft, draft.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **_dressed(body, look_named(look), hanging))
    return path


def _dressed(path: Path, look: Look, hanging: list[str]) -> dict[str, Any]:
    """Return the arrays of the body file `path` with the garments `hanging`, for the shape of `look`."""
    shaped = load_body(path).shape(look.betas)
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    body = body_arrays(shaped)
    landmarks = find_landmarks(body.vertices, body.joints, body.weights)
    arrays[SKIN_KEY] = np.array([len(body.vertices), len(body.faces)])
    free = ~used_texels(body, SIDE, 0)
    for name in hanging:
        (vertices, _), weights = HANGING[name](body, landmarks)
        sheet = _sheet(vertices, weights, lined=name in OPEN)
        uv, free = _placed(sheet, free)
        dirs = arrays["shapedirs"][nearest(sheet.vertices, body.vertices)].mean(axis=1)
        more = {
            "v_template": sheet.vertices - dirs[:, :, : len(look.betas)] @ np.asarray(look.betas),
            "shapedirs": dirs,
            "posedirs": np.zeros((len(sheet.vertices), *arrays["posedirs"].shape[1:])),
            "weights": sheet.weights,
            "f": sheet.faces + len(arrays["v_template"]),
            "ft": sheet.uv_faces + len(arrays["vt"]),
            "vt": uv,
        }
        for key, rows in more.items():
            arrays[key] = np.concatenate([arrays[key], rows.astype(arrays[key].dtype)])
        no_joint = np.zeros((len(arrays["J_regressor"]), len(sheet.vertices)), arrays["J_regressor"].dtype)
        arrays["J_regressor"] = np.hstack([arrays["J_regressor"], no_joint])
    return arrays


def _sheet(vertices: F64, weights: F64, lined: bool) -> _Sheet:
    """Return the mesh of a garment that is stitched from rings of ANGLES vertices, the lowest ring first.

    `vertices`: (N,3), metres. `weights`: (N,55). `lined`: whether the mesh gets a lining from the last ring back to the
    first.
    """
    rings, own = vertices.reshape(-1, ANGLES, 3), weights.reshape(-1, ANGLES, weights.shape[1])
    outside = len(rings)
    around = float(np.linalg.norm(np.diff(rings, axis=1, append=rings[:, :1]), axis=2).sum(axis=1).mean())
    high = float(np.linalg.norm(np.diff(rings, axis=0), axis=2).sum(axis=0).mean())
    along = np.linspace(0.0, 1.0, outside)
    if lined:
        inward = rings.mean(axis=1, keepdims=True) - rings
        inward /= np.linalg.norm(inward, axis=2, keepdims=True)
        rings = np.concatenate([rings, (rings + LINING_M * inward)[::-1]])
        own = np.concatenate([own, own[::-1]])
        share = 1.0 - LINING_SHARE
        edge = LINING_SHARE / (outside + 1)
        along = np.concatenate([share * along, np.linspace(share + edge, 1.0 - edge, outside), [1.0]])
    rows, columns = len(along), ANGLES + 1
    low, here = (grid.ravel() for grid in np.meshgrid(np.arange(rows - 1), np.arange(ANGLES), indexing="ij"))
    corners = {(up, right): (low + up, here + right) for up in (0, 1) for right in (0, 1)}
    vertex = {key: row % len(rings) * ANGLES + column % ANGLES for key, (row, column) in corners.items()}
    texel = {key: row * columns + column for key, (row, column) in corners.items()}
    triangles = (((0, 0), (0, 1), (1, 0)), ((0, 1), (1, 1), (1, 0)))
    faces, uv_faces = (
        np.stack([np.stack([grid[corner] for corner in triangle], axis=1) for triangle in triangles], axis=1)
        for grid in (vertex, texel)
    )
    return _Sheet(
        vertices=rings.reshape(-1, 3),
        faces=faces.reshape(-1, 3),
        weights=own.reshape(-1, own.shape[2]),
        across=np.tile(np.linspace(0.0, 1.0, columns), rows),
        along=np.repeat(along, columns),
        uv_faces=uv_faces.reshape(-1, 3),
        size=(around, high),
    )


def _placed(sheet: _Sheet, free: Mask) -> tuple[F64, Mask]:
    """Return (texture coordinates (T,2) of `sheet` in the largest free rectangle, `free` without this rectangle).

    The longer side of the sheet lies along the longer side of the rectangle. Raises BadInputError without enough room.

    `free`: (S,S), whether a texel is free; row 0 is at v = 0.
    """
    left, bottom, right, top = largest_rectangle(free)
    if min(right - left, top - bottom) <= 2 * MARGIN:
        found, expected = f"{right - left} x {top - bottom} free texels", f"more than {2 * MARGIN} on each side"
        raise BadInputError("texture of the body", found, expected, "use a body that leaves texels for the garment")
    taken = free.copy()
    taken[bottom:top, left:right] = False
    low = np.array([left + MARGIN, bottom + MARGIN]) / len(free)
    size = np.array([right - left - 2 * MARGIN, top - bottom - 2 * MARGIN]) / len(free)
    turned = (sheet.size[0] > sheet.size[1]) != (size[0] > size[1])
    places = np.stack([sheet.along, sheet.across] if turned else [sheet.across, sheet.along], axis=1)
    return low + places * size, taken


def largest_rectangle(free: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """Return (left, bottom, right, top) of the rectangle of true cells of `free` (H,W) with the most cells.

    `right` and `top` are exclusive; `bottom` is the first row. Of rectangles of the same size, the first one found is
    returned. All numbers are 0 if no cell is true.
    """
    best, where = 0, (0, 0, 0, 0)
    heights = np.zeros(free.shape[1] + 1, np.int64)
    for row, cells in enumerate(free):
        heights[:-1] = np.where(cells, heights[:-1] + 1, 0)
        rising: list[tuple[int, int]] = []
        for column, height in enumerate(heights.tolist()):
            start = column
            while rising and rising[-1][1] >= height:
                start, high = rising.pop()
                if high * (column - start) > best:
                    best, where = high * (column - start), (start, row - high + 1, column, row + 1)
            rising.append((start, height))
    return where
