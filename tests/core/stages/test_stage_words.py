"""What stages refuse, word for word, and what a configuration leaves to them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.pipeline.description import UnitSettings
from trilane.pipeline.moved_bytes import BYTES
from trilane.scene.schema import Scene
from trilane.stages.config import RunConfig
from trilane.stages.cpu.present import PresentStage
from trilane.stages.dsp.runtime import RuntimeOptions
from trilane.stages.gpu.composite import CompositeStage
from trilane.stages.gpu.raster import RasterStage
from trilane.transport.packets import Packet


def config(folder: Path, **changes: Any) -> RunConfig:
    return RunConfig(scene=Scene(), out_dir=folder, avatar_dirs=(), units={}, **changes)


def test_what_a_configuration_leaves_out(tmp_path: Path) -> None:
    said = config(tmp_path)
    assert (said.runtime, said.record, said.posed_vertices, said.pace_ns, said.cuts) == ("ort", True, (), {}, ())
    assert RuntimeOptions() == RuntimeOptions(threads=1, spin=False, device={})


def test_a_configuration_has_three_units(tmp_path: Path) -> None:
    settings = UnitSettings(cores=(0,), threads=1)
    with pytest.raises(ValueError, match=r"found unknown unit \['fpga', 'npu'\], expected cpu, gpu, dsp"):
        RunConfig(
            scene=Scene(), out_dir=tmp_path, avatar_dirs=(), units=dict.fromkeys(("npu", "cpu", "fpga"), settings)
        )


@pytest.mark.parametrize("slots", [(None, 0), (0, None), (None, None)])
@pytest.mark.parametrize(("stage", "name"), [(RasterStage, "raster"), (CompositeStage, "composite")])
def test_the_gpus_stages_need_two_slots(stage: Any, name: str, slots: tuple[Any, Any]) -> None:
    with pytest.raises(ValueError) as caught:
        object.__new__(stage).run(0, *slots)
    assert str(caught.value) == f"{name} needs an input and an output slot"


def test_the_present_stage_has_an_input_alone(tmp_path: Path) -> None:
    packet = Packet(np.zeros(1, "u8")[0], np.zeros(1 << 22, np.uint8))
    for record in (False, True):
        stage = PresentStage(config(tmp_path / "run", record=record))
        with pytest.raises(ValueError) as caught:
            stage.bind([packet], [packet])
        assert str(caught.value) == "the present stage has no output edge"
        assert not (tmp_path / "run").exists()
        with pytest.raises(ValueError) as caught:
            stage.run(0, None, None)
        assert str(caught.value) == "the present stage needs an input slot"


def test_without_a_recording_nothing_is_written_or_measured(tmp_path: Path) -> None:
    stage = PresentStage(config(tmp_path / "run", record=False))
    stage.bind([Packet(np.zeros(1, "u8")[0], np.zeros(1 << 22, np.uint8))], [])
    assert stage.run(0, 0, None) == dict.fromkeys(BYTES, 0)
    stage.close()
    assert not (tmp_path / "run").exists()
