"""Bytes that the GPU unit says it moved: by hand, and by a second count at the library's own calls."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import moderngl
import numpy as np
import pytest

from support.small_pipeline import packet
from trilane.scene.planner import FrameWork
from trilane.stages.config import Quantisation, posed_vertices
from trilane.stages.gpu.composite import CompositeStage
from trilane.stages.gpu.raster import PackedAvatar, PackedPass, RasterStage
from trilane.stages.gpu.skinned_mesh import PosedMesh, SkinnedMesh
from trilane.transport.packets import Packet

TENSOR, OUTPUT = (96, 64), (240, 320)
HEADER = 24 + 168 + 4628 + 4  # of every packet, of the avatar's, of one avatar, to a multiple of 8
JOINTS, FEATURE, MATRIX = 55 * 12 * 4, 486 * 4, 64
FRAME, PICTURE = 240 * 320 * 3, 96 * 64 * 4
BLOBS = 11 * 16
WHOLE, QUARTER = (-1, -1, 1, 1), (-0.25, -0.25, 0.25, 0.25)
EYE = (1.2, 1.5, 3.0)  # well inside the room


class CountedUniform:
    """A uniform whose `write` is counted."""

    def __init__(self, member: Any, count: Callable[[str, int], None]) -> None:
        self.__dict__.update(member=member, count=count)

    def write(self, data: Any) -> None:
        self.count("uploaded", memoryview(data).nbytes)
        self.member.write(data)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self.member, name, value)


@pytest.fixture
def second(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """What moderngl is given to write and to fill, counted there."""
    counts: Counter[str] = Counter()

    def count(name: str, size: int) -> None:
        counts[name] += size

    def watch(kind: Any, name: str, figure: str) -> None:
        call = getattr(kind, name)

        def counted(self: Any, *given: Any, **how: Any) -> Any:
            if given:
                count(figure, memoryview(given[0]).nbytes)
            return call(self, *given, **how)

        monkeypatch.setattr(kind, name, counted)

    watch(moderngl.Buffer, "write", "uploaded")
    watch(moderngl.Texture, "write", "uploaded")
    watch(moderngl.Context, "buffer", "uploaded")
    watch(moderngl.Framebuffer, "read_into", "read_back")
    member = moderngl.Program.__getitem__
    monkeypatch.setattr(moderngl.Program, "__getitem__", lambda self, key: CountedUniform(member(self, key), count))
    return counts


def moved_by(stage: Any, second: Counter[str], slot_out: int = 0) -> tuple[int, ...]:
    """Read, written, uploaded, read back and the least of a job; both counts must agree."""
    second.clear()
    said = stage.run(0, 0, slot_out)
    assert (said["bytes_uploaded"], said["bytes_read_back"]) == (second["uploaded"], second["read_back"])
    return tuple(said[f"bytes_{name}"] for name in ("read", "written", "uploaded", "read_back", "least"))


def show(slot: Packet, joints: Any, camera: Any, rect: Any = WHOLE) -> None:
    """One avatar in view, which fills the tensor."""
    pose = slot.header
    pose["avatar_count"], pose["tensor_shape"], pose["work"] = 1, TENSOR, FrameWork.FULL
    pose["view"], pose["projection"] = camera
    avatar = pose["avatars"][0]
    avatar["visible"], avatar["rect"], avatar["tensor_rect"] = 1, rect, (0, 0, *TENSOR)
    avatar["joints"] = joints


@pytest.mark.parametrize(
    ("channels", "deferred", "cleared"),
    [(16, True, 98_304), (12, True, 98_304), (8, True, 49_152), (16, False, 0), (4, False, 0)],
)
def test_a_tensor_is_read_back_once(
    gl: Any, person: Any, neural_texture: Any, camera: Any, second: Any, channels: int, deferred: bool, cleared: int
) -> None:
    """Where the texture is read last, the target is overwritten to clear it: four words a pixel for three."""
    packed = PackedPass(gl, channels, Quantisation(6 / 255, 117), deferred)
    stage = RasterStage([packed], [PackedAvatar(packed, person.mesh, neural_texture[:, :, :channels])], [TENSOR])
    tensor = {16: 98_304, 12: 73_728, 8: 49_152, 4: 24_576}[channels]
    source, target = packet(0), packet(tensor + 64)
    stage.bind([source], [target])
    show(source, person.pose(np.zeros(165)), camera((0, 0.9, 3), (0, 0.9, 0), 40, 64 / 96))
    uploaded = JOINTS + MATRIX * len(person.mesh.batches) + cleared
    for _ in range(2):
        assert moved_by(stage, second) == (HEADER, HEADER + tensor, uploaded, tensor, JOINTS + tensor)


def test_nobody_in_view_costs_one_fill(gl: Any, person: Any, neural_texture: Any, second: Any) -> None:
    packed = PackedPass(gl, 16, Quantisation(6 / 255, 117), deferred=True)
    stage = RasterStage([packed], [PackedAvatar(packed, person.mesh, neural_texture)], [TENSOR])
    source, target = packet(0), packet(98_304)
    stage.bind([source], [target])
    source.header["avatar_count"], source.header["tensor_shape"] = 1, TENSOR
    assert moved_by(stage, second) == (HEADER, HEADER + 98_304, 0, 0, 0)


def test_vertices_of_the_cpu_are_read_by_corner(
    gl: Any, person: Any, neural_texture: Any, camera: Any, second: Any
) -> None:
    """A vertex on a seam of the texture has a corner on each side."""
    vertices, corners = len(person.body.v_template), len(person.arrays.source)
    assert corners > vertices
    packed = PackedPass(gl, 16, Quantisation(6 / 255, 117), deferred=False)
    mesh = PosedMesh(gl, person.arrays)
    stage = RasterStage([packed], [PackedAvatar(packed, mesh, neural_texture)], [TENSOR], [vertices])
    source, target = packet(vertices * 12), packet(98_304)
    stage.bind([source], [target])
    show(source, person.pose(np.zeros(165)), camera((0, 0.9, 3), (0, 0.9, 0), 40, 64 / 96))
    posed_vertices(source.payload, [vertices])[0][:] = person.body.v_template
    least = len(np.unique(person.body.faces)) * 12 + 98_304
    expected = (HEADER + corners * 12, HEADER + 98_304, corners * 12 + MATRIX, 98_304, least)
    assert moved_by(stage, second) == expected


def test_a_mesh_with_pose_blend_shapes_takes_the_feature(gl: Any, person: Any) -> None:
    posedirs = np.zeros((len(person.body.v_template), 3, 486), np.float32)
    assert SkinnedMesh(gl, person.arrays, posedirs).pose_bytes == JOINTS + FEATURE
    assert person.mesh.pose_bytes == JOINTS


def composite(gl: Any, person: Any, camera: Any, slots: int = 1) -> tuple[Any, Packet, list[Packet]]:
    """A stage in the room, with an avatar of a quarter of the screen's width and height."""
    stage = CompositeStage(gl, OUTPUT, [TENSOR], [person.rest], None)
    source, targets = packet(PICTURE), [packet(FRAME) for _ in range(slots)]
    stage.bind([source], targets)
    show(source, person.pose(np.zeros(165)), camera(EYE, (0, 0.8, 0), 45, 4 / 3), QUARTER)
    return stage, source, targets


def test_a_still_camera_costs_a_copy_to_keep_the_background_and_one_a_frame(
    gl: Any, person: Any, camera: Any, second: Any
) -> None:
    """Drawn, drawn and kept, then copied; the picture's alpha is read again to see where it shows anything."""
    stage, _, _ = composite(gl, person, camera)
    read, written, least = HEADER + PICTURE + PICTURE // 4, HEADER + FRAME, PICTURE + FRAME
    avatar = PICTURE + MATRIX + BLOBS + 16
    kept = 240 * 320 * 4
    assert moved_by(stage, second) == (read, written, avatar + MATRIX, FRAME, least)
    assert moved_by(stage, second) == (read, written, avatar + MATRIX, FRAME + kept, least)
    assert moved_by(stage, second) == (read, written, avatar + kept, FRAME, least)


def test_a_frame_that_a_slot_holds_is_not_drawn(gl: Any, person: Any, camera: Any, second: Any) -> None:
    """Copied once to the other slot; then both hold it, and nothing but the header moves."""
    stage, source, targets = composite(gl, person, camera, slots=2)
    moved_by(stage, second)
    source.header["work"] = FrameWork.REUSE
    assert moved_by(stage, second, 1) == (HEADER + FRAME, HEADER + FRAME, 0, 0, 0)
    assert np.array_equal(targets[0].payload, targets[1].payload)
    for slot in (0, 1):
        assert moved_by(stage, second, slot) == (HEADER, HEADER, 0, 0, 0)


def test_a_picture_that_is_shown_again_is_not_uploaded_again(gl: Any, person: Any, camera: Any, second: Any) -> None:
    """The camera moves, the avatar stays: the frame alone is needed."""
    stage, source, _ = composite(gl, person, camera)
    moved_by(stage, second)
    source.header["work"] = FrameWork.REUSE
    source.header["view"][0, 3] += 0.1
    assert moved_by(stage, second) == (HEADER, HEADER + FRAME, 2 * MATRIX + BLOBS + 16, FRAME, FRAME)
