"""What the avatar's packets hold: the header of every edge, and the payload of the pose edge.

Rule: axis orders and signs are those of docs/conventions.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from trilane.arrays import F32, U8
from trilane.body.joints import JOINTS, POSE_FEATURES
from trilane.transport.packets import header_dtype

#: One avatar of a frame.
#: `joints`: skinning matrices, metres, world space, row-major 3x4: x_world = sum_k w_k (joints_k @ [x_rest, 1]).
#: `pose_feature`: (R - I) row-major of joints 1..54; multiplies the body's `posedirs`.
#: `rect`: crop rectangle x0, y0, x1, y1 in normalised device coordinates, y up: the mesh's rectangle clipped to
#: [-1, 1], grown to the tensor's aspect so that tensor pixels are square; what is grown may hang over the screen.
#: `tensor_rect`: top, left, height, width in tensor pixels that the crop rectangle fills.
#: `visible`: 0 when nothing of the avatar is on screen; the other fields are then unspecified.
AVATAR_DTYPE = np.dtype(
    [
        ("avatar", "<i4"),
        ("visible", "<i4"),
        ("rect", "<f4", (4,)),
        ("tensor_rect", "<i4", (4,)),
        ("joints", "<f4", (JOINTS, 3, 4)),
        ("pose_feature", "<f4", (POSE_FEATURES,)),
    ],
    align=True,
)


def pose_dtype(avatars: int) -> np.dtype[Any]:
    """Layout of the header of a packet with `avatars` avatars.

    `work`: a number of `FrameWork`. `picture`: number of the frame whose picture of the avatars is shown,
    -1 when none is. `repeats`: of a composited frame, 0 when it was drawn, else 1 + the number of the frame that was
    drawn with the same bytes. `media_time_s`: time in motion and camera. `view`: world to camera. `projection`: OpenGL
    clip matrix; both row-major for column vectors. `tensor_shape`: height, width of the tensor (the shape bucket) of
    this frame.
    """
    return header_dtype(
        [
            ("avatar_count", "<i4"),
            ("work", "<i4"),
            ("picture", "<i8"),
            ("repeats", "<i8"),
            ("media_time_s", "<f8"),
            ("tensor_shape", "<i4", (2,)),
            ("view", "<f4", (4, 4)),
            ("projection", "<f4", (4, 4)),
            ("avatars", AVATAR_DTYPE, (avatars,)),
        ]
    )


def posed_vertices(payload: U8, counts: Sequence[int]) -> list[F32]:
    """Views (V,3) float32 into the payload of the pose edge, one for each avatar of `counts` vertices; none if empty.

    They hold skinned vertices in the body's order, metres, world space, when the CPU unit skins.
    """
    views, start = [], 0
    for count in counts:
        size = posed_vertices_bytes([count])
        views.append(payload[start : start + size].view(np.float32).reshape(count, 3))
        start += size
    return views


def posed_vertices_bytes(counts: Sequence[int]) -> int:
    """Bytes that `posed_vertices` needs."""
    return sum(counts) * 3 * np.dtype(np.float32).itemsize
