"""Frames of a run that are compared when it is over: which, how they are kept, and what is said of all of them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.apps import run_check, run_job
from trilane.apps.experiments.error_by_cause import region
from trilane.apps.experiments.picture_errors import ErrorFigures
from trilane.apps.run_check import asked_frames, check_run, differs, summed_up
from trilane.bench.lib.layers import Box
from trilane.errors import TrilaneError
from trilane.stages.cpu.kept_frames import FOLDER, KeptFrames, kept_frames


@pytest.mark.parametrize(
    ("total", "count", "numbers"),
    [(10, 2, (2, 7)), (10, 1, (5,)), (3, 9, (0, 1, 2)), (1, 1, (0,)), (8, 4, (1, 3, 5, 7))],
)
def test_each_frame_is_in_the_middle_of_its_share(total: int, count: int, numbers: tuple[int, ...]) -> None:
    assert asked_frames(total, count) == numbers


def test_frames_that_were_asked_for_are_kept_or_the_next_ones(tmp_path: Path) -> None:
    """Frame 5 is never presented, so frame 6 stands for it, and for itself."""
    kept = KeptFrames(tmp_path, (2, 5, 6, 9))
    for frame in (0, 1, 2, 3, 4, 6, 7, 11, 12):
        kept.see(frame, np.full((2, 3, 3), frame, np.uint8))
    files = kept_frames(tmp_path)
    assert list(files) == [2, 6, 11]
    assert all((np.load(file) == number).all() for number, file in files.items())


def test_nothing_is_kept_unless_it_was_asked_for(tmp_path: Path) -> None:
    KeptFrames(tmp_path, ()).see(0, np.zeros((1, 1, 3), np.uint8))
    assert not (tmp_path / FOLDER).exists() and kept_frames(tmp_path) == {}


def test_the_check_is_of_all_frames_and_names_the_worst() -> None:
    errors = {
        3: ErrorFigures(1.0, 30.0, 0.9, None, 0.1, 1.0, 0.8),
        7: ErrorFigures(2.0, 40.0, None, None, 0.3, 1.0, 0.6),
    }
    check = summed_up(errors)
    assert check.pop("against") == run_check.AGAINST
    assert check == {
        "frames": 2,
        "psnr_db": 35.0,
        "worst_psnr_db": 30.0,
        "mae": 1.5,
        "ssim": 0.9,
        "flip": pytest.approx(0.2),
        "iou": pytest.approx(0.7),
        "numbers": (3, 7),
    }


def test_a_mask_is_where_the_background_was_changed() -> None:
    background = np.zeros((1, 3, 3), np.uint8)
    picture = background.copy()
    picture[0, 1, 2] = 1
    assert differs(picture, background).tolist() == [[False, True, False]]


class Black:
    """In place of the reference: black in its one box, over grey; nobody is seen in frame 4."""

    output = (200, 200)

    def __init__(self, checked: Any) -> None:
        assert checked == "checked"

    def moment(self, number: int) -> Any:
        picture = np.full((200, 200, 3), 0.2)
        picture[10:190, 10:190] = 0.0
        boxes = () if number == 4 else (Box(10, 10, 190, 190),)
        return SimpleNamespace(
            boxes=boxes,
            background=np.full((200, 200, 3), 51, np.uint8),
            frame=lambda causes: SimpleNamespace(picture=picture) if not causes else None,
        )


def test_kept_frames_are_compared_where_the_avatars_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The upper half of the box is 102 off, the lower one 51 and not to be told from the background."""
    pytest.importorskip("flip_evaluator")
    from trilane.apps.experiments import reference_path

    monkeypatch.setattr(reference_path, "ReferencePath", Black)
    kept, picture = KeptFrames(tmp_path, (2, 4)), np.full((200, 200, 3), 51, np.uint8)
    picture[10:100, 10:190] = 102
    picture[100:190, 10:190] = 51
    picture[0, 0] = 255  # beside the region: no error of the picture, but of the mask
    assert region((Box(10, 10, 190, 190),), (200, 200)) == Box(10, 10, 190, 190)
    kept.see(2, picture)
    kept.see(4, picture)
    done: list[tuple[int, int]] = []
    check = check_run("checked", tmp_path, lambda *said: done.append(said))  # type: ignore[arg-type]
    assert done == [(1, 2), (2, 2)] and check["numbers"] == (2,)
    assert check["mae"] == pytest.approx((102 + 51) / 2)
    assert check["psnr_db"] == pytest.approx(-10 * np.log10((0.4**2 + 0.2**2) / 2))
    assert check["iou"] == pytest.approx(90 * 180 / (180 * 180 + 1))


def test_without_any_frame_there_is_no_check_and_that_is_said(tmp_path: Path) -> None:
    with pytest.raises(TrilaneError, match="none of the frames"):
        check_run("checked", tmp_path)  # type: ignore[arg-type]
    said: list[str] = []
    hooks = run_job.Hooks(lambda *_: None, said.append)
    checked: Any = SimpleNamespace(notes=("planned",), config=SimpleNamespace(record=True))
    for interrupted in (False, True):
        facts = run_job._checked_frames(checked, tmp_path, hooks, lambda: interrupted)  # noqa: B023
        assert facts == {"notes": ["planned", said[-1]]}
    assert said == [
        "the run was not compared with the reference path: none of the frames that were kept shows an avatar",
        "the run was not compared with the reference path: it was interrupted",
    ]


def test_an_interrupt_is_heard_between_two_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame takes seconds, so that whoever asks for many and changes their mind would wait for minutes."""
    made: list[int] = []

    def check(_checked: Any, _folder: Path, told: Any) -> Any:
        for number in range(5):
            made.append(number)
            told(number + 1, 5)

    monkeypatch.setattr(run_job, "check_run", check)
    said: list[str] = []
    shown: list[tuple[str, int, int]] = []
    hooks = run_job.Hooks(lambda *words: shown.append(words), said.append)
    checked: Any = SimpleNamespace(notes=(), config=SimpleNamespace(record=True))
    run_job._checked_frames(checked, tmp_path, hooks, lambda: len(made) == 2)
    assert (made, shown) == ([0, 1], [("check", 1, 5), ("check", 2, 5)])
    assert said == ["the run was not compared with the reference path: it was interrupted"]
