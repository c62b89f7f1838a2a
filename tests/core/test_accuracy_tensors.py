"""The tensors that runtimes are compared on: which frames of a scene, and what passes between its first two stages."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from trilane.apps.experiments import accuracy
from trilane.pipeline.stage import UnitContext
from trilane.stages.config import pose_dtype

NOBODY_IN = 3


class Stage:
    """Notes what it is bound to, and what it runs."""

    def __init__(self, name: str, notes: list[Any]) -> None:
        self._name, self._notes = name, notes
        self.packets: list[Any] = []

    def bind(self, inputs: list[Any], outputs: list[Any]) -> None:
        self._notes.append((self._name, [len(p.payload) for p in inputs], [len(p.payload) for p in outputs]))
        self.packets = [*inputs, *outputs]

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> None:
        self._notes.append((self._name, frame, slot_in, slot_out))
        if self._name == "pose":
            self.packets[0].header["tensor_shape"] = (2, frame + 1)
            self.packets[0].header["avatars"]["visible"] = (False, frame != NOBODY_IN)
        else:
            posed, drawn = self.packets
            height, width = posed.header["tensor_shape"]
            drawn.payload[: height * width * 3] = range(height * width * 3)


@pytest.mark.parametrize(("asked", "frames"), [(3, [0, 3, 6]), (2, [0, 5]), (1, [0]), (99, list(range(10)))])
def test_frames_are_evenly_spread(asked: int, frames: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    notes: list[Any] = []

    def build(name: str) -> Any:
        def made(settings: Any, unit: UnitContext) -> Stage:
            notes.append((name, settings, unit.name, unit.settings, unit.assets))
            return Stage(name, notes)

        return made

    units = {"cpu": "the cpu's", "gpu": "the gpu's"}
    config: Any = SimpleNamespace(
        scene=SimpleNamespace(frames=10), avatar_dirs=("a", "b"), units=units, model_dump=lambda mode: {"mode": mode}
    )
    sizes = {"pose->raster": 40, "raster->infer": 80}
    monkeypatch.setattr(accuracy, "edge_bytes", lambda given, assets: sizes if given is config else assets)
    monkeypatch.setattr(accuracy, "build_pose", build("pose"))
    monkeypatch.setattr(accuracy, "build_raster", build("raster"))
    monkeypatch.setattr(accuracy, "network_of", lambda _: SimpleNamespace(channels=3))
    checked: Any = SimpleNamespace(config=config, assets="assets")
    found = [(frame, tensor.copy()) for frame, tensor in accuracy._tensors(checked, asked)]
    assert [frame for frame, _ in found] == [frame for frame in frames if frame != NOBODY_IN]
    for frame, tensor in found:
        assert tensor.shape == (2, frame + 1, 3)
        assert tensor.ravel().tolist() == list(range(6 * (frame + 1)))
    settings = {"config": {"mode": "json"}}
    assert notes[:4] == [
        ("pose", settings, "cpu", "the cpu's", "assets"),
        ("raster", settings, "gpu", "the gpu's", "assets"),
        ("pose", [], [40]),
        ("raster", [40], [80]),
    ]
    assert notes[4:] == [row for frame in frames for row in (("pose", frame, None, 0), ("raster", frame, 0, 0))]


def test_a_packet_has_the_header_of_so_many_avatars() -> None:
    packet = accuracy._packet(3, 128)
    assert (packet.header.dtype, len(packet.payload)) == (pose_dtype(3), 128)
