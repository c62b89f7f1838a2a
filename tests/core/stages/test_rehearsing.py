"""What is asked of a rehearsal and of a trial, and in which order the answers come; both are doubles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.pipeline.trial import Group, Round
from trilane.scheduler.places import Core, Place, Placement
from trilane.stages import avatar_pipeline
from trilane.stages.configure import Checked

ANY: Any = None


class Copied(SimpleNamespace):
    """A frozen model, as far as the rehearsal takes one."""

    def model_copy(self, update: dict[str, Any]) -> Copied:
        return Copied(**{**vars(self), **update})


def checked_of(frames: int = 100, buckets: Sequence[tuple[int, int]] = ((64, 64),), most: int = 64 * 64) -> Checked:
    scene = Copied(frames=frames, size="auto")
    config = Copied(scene=scene, buckets=buckets, max_tensor_pixels=most, units=None, out_dir=None, shapes=(9,))
    made: Any = SimpleNamespace(config=config, assets="the assets")
    return made


@pytest.fixture(autouse=True)
def described(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The configurations of which pipelines were made, in order; a pipeline is its configuration here."""
    made: list[Any] = []

    def pipeline(config: Any, assets: Any) -> Any:
        assert assets == "the assets" and Path(config.out_dir).is_dir() and config.shapes == ()
        made.append(config)
        return config

    monkeypatch.setattr(avatar_pipeline, "avatar_pipeline", pipeline)
    return made


def placement(cpu: Sequence[int], gpu: Sequence[int], dsp: Sequence[int], threads: int) -> Placement:
    return {"cpu": Place(tuple(cpu), 1), "gpu": Place(tuple(gpu), 1), "dsp": Place(tuple(dsp), threads)}


#: The first and the last can have the same processes: one thread each, for which it is the same whether they spin.
PLACEMENTS = [
    placement([0], [1], [2], 1),
    placement([0], [1], [2, 3], 2),  # its threads spin, on cores of their own
    placement([0], [2], [2, 3], 2),  # they do not
    placement([2], [2], [0], 1),
]


@pytest.fixture
def trials(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """What was tried; a placement takes 1000 ns times its place among those of its group, plus 10 for each round."""
    asked: list[tuple[Any, ...]] = []

    def try_in_turns(groups: Any, windows: Any, assets: Any, starter: Any, is_enough: Any) -> list[Round]:
        asked.append((groups, list(windows), assets, starter))
        rounds: list[Round] = []
        for turn in range(len(windows)):
            ns = [1000.0 * number + 100 * of + 10 * turn for of, group in enumerate(groups) for number in group.places]
            rounds.append(Round(tuple(ns), turn / 8))
            if is_enough(rounds):
                break
        return rounds

    monkeypatch.setattr(avatar_pipeline, "try_in_turns", try_in_turns)
    monkeypatch.setattr(avatar_pipeline, "Group", lambda pipeline, places: Group(pipeline, list(Numbered(places))))
    return asked


class Numbered(list[Any]):
    """Places whose numbers stand for them: the first core of the CPU's unit."""

    def __iter__(self) -> Any:
        return (place["cpu"][0] for place in super().__iter__())


def test_frame_times_come_in_the_order_of_the_placements(trials: list[tuple[Any, ...]], described: list[Any]) -> None:
    """Groups: the first and the last placement, then one each for those that spin and that do not."""
    found = avatar_pipeline.tried(checked_of(), PLACEMENTS, 3, "starter")  # type: ignore[arg-type]
    assert [each.frame_ns for each in found] == [
        (0.0 + turn, 100.0 + turn, 200.0 + turn, 2000.0 + turn) for turn in (0, 10, 20)
    ]
    assert [each.others for each in found] == [0, 1 / 8, 2 / 8]
    ((groups, windows, assets, starter),) = trials
    assert [list(group.places) for group in groups] == [[0, 2], [0], [0]]
    assert windows == [0, 84 // 3, 2 * 84 // 3]  # 16 frames of 100 each time
    assert (assets, starter) == ("the assets", "starter")
    kinds = [[(unit.cores, unit.threads, unit.spin) for unit in config.units.values()] for config in described]
    assert kinds == [
        [((0,), 1, True), ((1,), 1, True), ((2,), 1, True)],
        [((0,), 1, True), ((1,), 1, True), ((2, 3), 2, True)],
        [((0,), 1, True), ((2,), 1, False), ((2, 3), 2, False)],
    ]
    assert not Path(described[0].out_dir).exists()


def test_rounds_end_when_the_time_is_up_but_not_before_the_least(
    trials: list[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Begun at 5 s, for 3 s: after two rounds it is 7 s, after three 8 s, which is not past it, after four 8.5 s."""
    now = iter([5.0, 7.0, 8.0, 8.5])
    monkeypatch.setattr(avatar_pipeline.time, "monotonic", lambda: next(now))
    assert len(avatar_pipeline.tried(checked_of(10), PLACEMENTS[:1], 6, ANY, 3.0, 2)) == 4
    assert trials[0][1] == [0] * 6  # the scene is shorter than a slice


def test_every_number_of_threads_is_measured_on_the_fastest_cores(
    described: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cores 3 and 1 are the fastest. All units have core 3; the DSP also 3 and 1, then 3, 1, 0, then all.

    Its threads spin where two cores are left for the others: of four that is with two threads.
    """
    asked: list[Any] = []

    def rehearse(first: Any, others: Any, frames: Any, assets: Any, starter: Any) -> str:
        asked.append((first, others, frames, assets, starter))
        return "times"

    monkeypatch.setattr(avatar_pipeline, "rehearse", rehearse)
    cores = [Core(0, 0, 500), Core(1, 1, 900), Core(2, 2, 500), Core(3, 3, 900)]
    buckets = ((64, 64), (128, 128), (64, 256), (120, 140))
    checked = checked_of(103, buckets, 2 * 64 * 64 + 1)
    assert avatar_pipeline.measured_times(checked, cores, PLACEMENTS[0], "starter") == "times"  # type: ignore[arg-type,comparison-overlap]
    ((first, others, frames, assets, starter),) = asked
    assert [first, *others] == described
    rows = [[(*unit.cores, unit.threads, unit.spin) for unit in config.units.values()] for config in described]
    one = (1, 1, False)
    assert rows == [
        [one, one, one],
        *([one, one, (*own, len(own), len(own) == 2)] for own in ((1, 3), (0, 1, 3), (0, 1, 2, 3))),
    ]
    assert frames == [0, 8, 17, 25, 34, 42, 51, 60, 68, 77, 85, 94]
    assert (assets, starter) == ("the assets", "starter")
    assert {config.scene.size for config in described} == {"128x128"}


def test_the_shape_is_the_squarest_of_those_that_are_large() -> None:
    """Half of the most pixels is too small; of two as square the one with fewer rows."""

    def shape(*buckets: tuple[int, int], most: int = 20_000) -> tuple[int, int]:
        return avatar_pipeline.one_shape(checked_of(9, buckets, most).config)

    assert shape((100, 100), (90, 140), (140, 90)) == (90, 140)
    assert shape((100, 100), (80, 240), (140, 90), most=19_999) == (100, 100)
