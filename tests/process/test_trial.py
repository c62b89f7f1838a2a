"""Placements in turns on real processes: where the units run, on which frames, and what happens when one fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from trilane import machine
from trilane.hw_profiles.host import usable_cores
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, UnitSettings
from trilane.pipeline.rehearsal import SLICE, Group, try_in_turns
from trilane.pipeline.unit_starter import UnitStarter

pytestmark = pytest.mark.usefixtures("nothing_left")
MODULE = """
import os
from pathlib import Path

from trilane import machine

class Stage:
    def __init__(self, file, fails):
        self.file, self.fails = open(file, "a", buffering=1), fails
    def bind(self, inputs, outputs):
        pass
    def run(self, frame, slot_in, slot_out):
        if frame == self.fails:
            raise RuntimeError("no more")
        cores = ",".join(map(str, machine.here.cores()))
        self.file.write(f"{frame} {cores}\\n")
        return {}
    def close(self):
        self.file.close()

def build(settings, unit):
    return Stage(settings["file"], settings["fails"])
"""


def described(folder: Path, name: str, fails: int = -1) -> Pipeline:
    (folder / "noting.py").write_text(MODULE)
    stages = tuple(
        PipelineStage(
            name=unit,
            unit=unit,
            factory="noting:build",
            settings={"file": str(folder / f"{name}-{unit}"), "fails": fails},
        )
        for unit in ("a", "b")
    )
    units = {unit: UnitSettings(cores=usable_cores()[:1], threads=1) for unit in ("a", "b")}
    return Pipeline(stages=stages, edges=(PipelineEdge(payload_bytes=64),), units=units, module_folders=(folder,))


def noted(file: Path) -> list[tuple[int, str]]:
    return [(int(frame), cores) for frame, cores in map(str.split, file.read_text().splitlines())]


@pytest.mark.skipif(len(usable_cores()) < 2, reason="there is one core")
def test_units_are_moved_between_slices_and_every_slice_has_the_same_frames(tmp_path: Path) -> None:
    one, two = usable_cores()[:2]
    before = set(machine.here.cores())
    apart, crossed, floating = (
        {"a": (one,), "b": (two,)},
        {"a": (two,), "b": (one,)},
        {"a": (one, two), "b": (two,)},
    )
    groups = [Group(described(tmp_path, "x"), [apart, crossed, floating]), Group(described(tmp_path, "y"), [crossed])]
    with UnitStarter() as starter:
        rounds = try_in_turns(groups, [0, 40], {}, starter)
        enough = try_in_turns(groups[1:], [0, 40], {}, starter, lambda done: len(done) == 1)
    assert set(machine.here.cores()) == before
    assert [len(each.frame_ns) for each in rounds] == [4, 4]
    assert len(enough) == 1
    assert all(ns > 0 for each in rounds for ns in each.frame_ns)
    assert all(each.others >= 0 for each in rounds)
    rows = noted(tmp_path / "x-a")
    first, second = rows[: len(rows) // 2], rows[len(rows) // 2 :]
    assert [frame for frame, _ in first[: 3 * SLICE]] == list(range(SLICE)) * 3
    assert [frame for frame, _ in second[: 3 * SLICE]] == list(range(40, 40 + SLICE)) * 3
    where = list(dict.fromkeys(cores for _, cores in first))
    assert where == [str(one), str(two), f"{one},{two}"]
    assert second[0][1] == where[1]  # the second round begins with the second placement
    assert {cores for _, cores in noted(tmp_path / "y-a")} == {str(two)}


def test_a_stage_that_fails_ends_the_trial_with_its_error(tmp_path: Path) -> None:
    place = {"a": usable_cores()[:1], "b": usable_cores()[:1]}
    with UnitStarter() as starter, pytest.raises(Exception, match="stage a, frame 5: RuntimeError: no more"):
        try_in_turns([Group(described(tmp_path, "x", fails=5), [place])], [0], {}, starter)
