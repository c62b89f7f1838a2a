"""The packets that pass between stages: one slot = one `PosePacket` header, then the payload of its stage.

Rule: everything a later stage needs to know about a frame travels in the packet; no stage asks another.
Axis orders and signs are those of docs/conventions.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

JOINTS = 55
POSE_FEATURES = 486  # 54 joints x 9: (R - I) of every joint but the root
PAGE = 4096

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
    """Layout of a `PosePacket` of `avatars` avatars.

    `frame`: number from 0. `epoch`: of the slot pool. `t_pose_ns`: CLOCK_MONOTONIC, when the pose was sampled.
    `media_time_s`: time in motion and camera. `view`: world to camera. `projection`: OpenGL clip matrix; both
    row-major for column vectors. `tensor_shape`: height, width of the tensor (the shape bucket) of this frame.
    """
    return np.dtype(
        [
            ("frame", "<u8"),
            ("t_pose_ns", "<i8"),
            ("media_time_s", "<f8"),
            ("epoch", "<u4"),
            ("avatar_count", "<i4"),
            ("tensor_shape", "<i4", (2,)),
            ("view", "<f4", (4, 4)),
            ("projection", "<f4", (4, 4)),
            ("avatars", AVATAR_DTYPE, (avatars,)),
        ],
        align=True,
    )


@dataclass(frozen=True)
class SlotLayout:
    """Bytes of one slot: the pose header rounded up to a page, then `payload_bytes`."""

    avatars: int
    payload_bytes: int

    @property
    def header_bytes(self) -> int:
        return -(-pose_dtype(self.avatars).itemsize // PAGE) * PAGE

    @property
    def slot_bytes(self) -> int:
        return self.header_bytes + -(-self.payload_bytes // PAGE) * PAGE


@dataclass(frozen=True)
class Packet:
    """A view of one slot. `pose`: 0-d structured array of `pose_dtype`. `payload`: (payload_bytes,) uint8."""

    pose: NDArray[np.void]
    payload: NDArray[np.uint8]


def view_packet(buffer: memoryview, layout: SlotLayout) -> Packet:
    """Views of a slot's memory, without a copy. Raises ValueError when `buffer` is shorter than the layout."""
    if len(buffer) < layout.slot_bytes:
        raise ValueError(f"slot of {len(buffer)} bytes, the layout needs {layout.slot_bytes}")
    dtype = pose_dtype(layout.avatars)
    pose = np.frombuffer(buffer, dtype=dtype, count=1).reshape(())
    payload = np.frombuffer(buffer, dtype=np.uint8, count=layout.payload_bytes, offset=layout.header_bytes)
    return Packet(pose, payload)


def posed_vertices(payload: NDArray[np.uint8], counts: Sequence[int]) -> list[NDArray[np.float32]]:
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


class Stage(Protocol):
    """One stage inside a unit's process. Made by `build` of `trilane.stages.<unit>.unit`."""

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Called once, with every slot of the stage's edges, before the first job: allocate here, never later."""

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Do frame `frame` from `inputs[slot_in]` to `outputs[slot_out]`; figures for the log, often empty.

        The worker has already copied the pose header from the input slot to the output slot.
        """

    def close(self) -> None:
        """Release what the stage holds (files are completed and renamed here)."""
