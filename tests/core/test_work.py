"""What a frame asks for, and what pose, composite's memory, present and a bound stage make of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.small_pipeline import EDGES, OWN, STAGES, assets_of, packets, pipeline, without_bytes
from trilane.errors import BadInputError, TrilaneError
from trilane.pipeline.bound_stage import BoundStage
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.stage import Skip, UnitContext
from trilane.scene.schema import AvatarSpec, CameraSpec, OutputSpec, Scene
from trilane.scene.work import Work, shown_by, work_of
from trilane.stages.config import RunConfig
from trilane.stages.cpu.pose import PoseStage
from trilane.stages.cpu.present import PresentStage
from trilane.stages.gpu.drawn_frames import DrawnFrames
from trilane.stages.packets import pose_dtype
from trilane.transport.packets import SlotLayout, header_dtype, view_packet

UNITS = {unit: UnitSettings(cores=(0,), threads=1) for unit in ("cpu", "gpu", "dsp")}
STATIC = CameraSpec(source="builtin:static")


def never() -> bool:
    raise AssertionError("asked in vain")


def test_a_frame_is_made_again_only_when_something_differs() -> None:
    assert work_of(b"a", b"a", None, never) is Work.REUSE
    assert work_of(b"b", b"a", b"b", never) is Work.NONE
    assert work_of(b"c", b"a", b"b", lambda: True) is Work.FULL
    assert work_of(b"c", b"a", None, lambda: False) is Work.NONE
    assert work_of(b"a", None, None, lambda: True) is Work.FULL
    assert int(Work.FULL) == 0  # what a header says that nobody wrote to


def test_what_is_shown_differs_by_its_last_bit() -> None:
    view, pose = np.eye(4), np.zeros((55, 3))
    other = pose.copy()
    other[54, 2] = np.nextafter(0.0, 1.0)
    assert shown_by([view, pose]) == shown_by([view.copy(), pose.copy()])
    assert len({shown_by([view, pose]), shown_by([view, other]), shown_by([np.eye(4) * 2, pose])}) == 3


def bound_pose(bundle: Path, folder: Path, slots: int = 2, **scene: Any) -> tuple[PoseStage, list[Any]]:
    made = Scene(camera=STATIC, **scene)
    config = RunConfig(scene=made, out_dir=folder, avatar_dirs=(bundle,) * len(made.avatars), units=UNITS)
    stage, layout = PoseStage(config, assets_of(config)), SlotLayout(pose_dtype(len(made.avatars)), 0)
    made_packets = [view_packet(memoryview(bytearray(layout.slot_bytes)), layout) for _ in range(slots)]
    stage.bind([], made_packets)
    return stage, [packet.header for packet in made_packets]


def test_a_still_avatar_is_posed_once_until_the_stage_must_forget(tiny_bundle: Path, tmp_path: Path) -> None:
    stage, (first, second) = bound_pose(tiny_bundle, tmp_path, avatars=(AvatarSpec(motion="builtin:t-pose"),))
    assert type(stage.run(4, None, 0)) is dict
    second["epoch"] = 9
    assert without_bytes(stage.run(5, None, 1)) == Skip(visible=1.0)
    assert [int(header["work"]) for header in (first, second)] == [Work.FULL, Work.REUSE]
    assert [int(header["picture"]) for header in (first, second)] == [4, 4]
    assert [int(second[name]) for name in ("frame", "epoch")] == [5, 9]
    assert float(second["media_time_s"]) == 5 / 30
    for name in ("view", "projection", "avatars", "avatar_count", "tensor_shape"):
        assert first[name].tobytes() == second[name].tobytes()
    stage.forget()
    assert type(stage.run(6, None, 1)) is dict
    assert (int(second["work"]), int(second["picture"])) == (Work.FULL, 6)


def test_who_is_off_the_screen_is_neither_skinned_nor_drawn(
    tiny_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind the camera; that the body moves changes nothing, and to forget makes no frame full in which nobody is."""
    stage, (header, _) = bound_pose(tiny_bundle, tmp_path, avatars=(AvatarSpec(position=(0.0, 0.0, 40.0)),))
    monkeypatch.setattr(type(stage._actors[0].body.bounds), "rect", lambda *_: never())
    for frame in (0, 1, 30):
        assert without_bytes(stage.run(frame, None, 0)) == Skip(visible=0.0)
        assert (int(header["work"]), int(header["picture"])) == (Work.NONE, -1)
        stage.forget()


def test_a_slot_that_holds_a_drawing_need_not_be_drawn_again() -> None:
    drawn = DrawnFrames()
    still, other = (3, 0, b"v", b"p"), (3, 1, b"v", b"p")
    assert drawn.slot_of(still, 0) is None
    assert drawn.note(0, still, 7, None) == 0
    assert (drawn.slot_of(still, 1), drawn.slot_of(other, 1), drawn.slot_of(None, 0)) == (0, None, None)
    assert drawn.note(1, still, 8, 0) == 8  # 1 + 7
    assert (drawn.slot_of(still, 1), drawn.slot_of(still, 0)) == (1, 0)
    assert drawn.note(0, other, 9, None) == 0
    assert (drawn.slot_of(still, 0), drawn.slot_of(other, 1)) == (1, 0)
    assert drawn.note(0, still, 10, 1) == 8
    assert drawn.note(0, None, 11, None) == 0
    assert drawn.slot_of(None, 0) is None


def test_a_repeated_frame_is_digested_and_shown_as_the_one_that_it_repeats(tmp_path: Path) -> None:
    """Frames 0 to 5: 1 and 2 say that they are 0, 4 says 3; 5 says 0, which was not the last one, so it is digested."""
    layout = SlotLayout(pose_dtype(1), 64 * 64 * 3)
    slots = [view_packet(memoryview(bytearray(layout.slot_bytes)), layout) for _ in range(3)]
    for number, slot in enumerate(slots):
        slot.payload[:] = 50 * number + 1
    scene = Scene(output=OutputSpec(width=64, height=64))
    stage = PresentStage(RunConfig(scene=scene, out_dir=tmp_path, avatar_dirs=(), units=UNITS))
    stage.bind(slots, [])
    for frame, slot, repeats in ((0, 0, 0), (1, 0, 1), (2, 0, 1), (3, 1, 0), (4, 1, 4), (5, 2, 1)):
        slots[slot].header["repeats"] = repeats
        stage.run(frame, slot, None)
    stage.close()
    (file,) = (tmp_path / "segments").glob("*.sha256")
    digests = [line.split()[1] for line in file.read_text().splitlines()]
    assert digests[0] == digests[1] == digests[2] and digests[3] == digests[4]
    assert len(set(digests)) == 3


class Skipping:
    """Notes what it is asked; every frame skips."""

    def __init__(self) -> None:
        self.forgot = 0

    def bind(self, inputs: Any, outputs: Any) -> None:
        self.bound = inputs, outputs

    def run(self, frame: int, *_slots: int | None) -> Mapping[str, float]:
        return Skip(frame=frame)

    def forget(self) -> None:
        self.forgot += 1

    def close(self) -> None:
        pass


def test_a_stage_is_told_to_forget_and_may_skip_only_where_a_bypass_begins() -> None:
    unit = UnitContext("left", UNITS["cpu"], {})
    stage = Skipping()
    bound = BoundStage("a", stage, [], packets(OWN, 1), 0, unit, may_skip=True)
    assert (bound.run(3, -1, 0, 0), stage.forgot) == (Skip(frame=3), 0)
    bound.run(4, -1, 0, 0, fresh=True)
    assert stage.forgot == 1
    other = BoundStage("b", stage, [], packets(OWN, 1), 0, unit)
    with pytest.raises(TrilaneError, match="stage b returned a Skip, and the pipeline's bypass does not begin at it"):
        other.run(3, -1, 0, 0, fresh=True)
    assert stage.forgot == 1


def test_a_header_is_passed_on_from_either_edge_at_the_end_of_a_bypass() -> None:
    inputs, outputs = packets(OWN, 3), packets(OWN, 1)
    bound = BoundStage("c", Skipping(), inputs, outputs, 0, UnitContext("right", UNITS["cpu"], {}), may_skip=True)
    inputs[2].header["frame"] = 77
    bound.run(77, 2, 0, 5)
    assert (int(outputs[0].header["frame"]), int(outputs[0].header["epoch"])) == (77, 5)


def test_a_bypass_joins_edges_of_one_header() -> None:
    names = (STAGES[0].name, STAGES[2].name)
    alike = tuple(edge.model_copy(update={"header": OWN}) for edge in EDGES)
    made = pipeline(edges=alike, bypass=names)
    assert made.edges_into(names[1]) == ("mid->out", "in->mid")
    assert made.edges_into("mid") == ("in->mid",) and made.edges_into("in") == ()
    assert made.graph().bypass == names
    unlike = (alike[0], alike[1].model_copy(update={"header": header_dtype()}))
    with pytest.raises(BadInputError, match="different headers of edges mid->out, in->mid"):
        pipeline(edges=unlike, bypass=names)
    with pytest.raises(BadInputError, match="bypass"):
        pipeline(edges=alike, bypass=("in", "mid"))
