"""Frames of a run that are compared when it is over: which, how they are kept, and what is said of all of them."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane import machine
from trilane.apps.cli import main as cli
from trilane.apps.cli import sweep as cli_sweep
from trilane.apps.experiments.picture_errors import ErrorFigures
from trilane.apps.experiments.scene_pictures import region
from trilane.apps.run import asked_run, run_job
from trilane.apps.run.run_job import FLOAT_PATH, TRUTH, asked_frames, check_run, differs, require_parts, summed_up
from trilane.arrays import U8
from trilane.bench.lib.cast import Box
from trilane.errors import MissingPartError, TrilaneError
from trilane.stages.cpu.present import KeptFrames, kept_frames


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


def test_the_check_is_of_all_frames_and_names_the_worst() -> None:
    """The 1st percentile of two values is a hundredth of the way from the lower one."""
    errors = [
        ErrorFigures(1.0, 30.0, 0.9, None, 0.1, 1.0, 0.8),
        ErrorFigures(2.0, 40.0, None, None, 0.3, 1.0, 0.6),
    ]
    assert summed_up("something", errors) == {
        "against": "something",
        "psnr_db": 35.0,
        "worst_psnr_db": 30.0,
        "p1_psnr_db": pytest.approx(30.1),
        "mae": 1.5,
        "ssim": 0.9,
        "flip": pytest.approx(0.2),
        "iou": pytest.approx(0.7),
    }


def test_a_mask_is_where_the_background_was_changed() -> None:
    background = np.zeros((1, 3, 3), np.uint8)
    picture = background.copy()
    picture[0, 1, 2] = 1
    assert differs(picture, background).tolist() == [[False, True, False]]


class Black:
    """In place of the float path: black in its one box, over grey; nobody is seen in frame 4."""

    output, cast, gl = (200, 200), "cast", "gl"

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
    black_float_path(monkeypatch, None)
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
    assert (check["against"], check["float_path"]) == (FLOAT_PATH, None)


def black_float_path(monkeypatch: pytest.MonkeyPatch, truth: U8 | None) -> None:
    """`truth`: the true picture of every frame; None where nobody knows it."""
    from trilane.apps.experiments import reference_path
    from trilane.bench.lib import full_picture

    true = None if truth is None else SimpleNamespace(frame=lambda _number, _background: truth)
    monkeypatch.setattr(reference_path, "ReferencePath", Black)
    monkeypatch.setattr(full_picture, "true_pictures", lambda cast, gl: true if (cast, gl) == ("cast", "gl") else 1 / 0)


BOX = np.s_[10:190, 10:190]
GREY = np.full((200, 200, 3), 51, np.uint8)


def person() -> U8:
    """Somebody of random colours, far from 0 and 255, in the box, over grey."""
    picture = GREY.copy()
    picture[BOX] = np.random.default_rng(8).integers(90, 160, (180, 180, 3))
    return picture


def tinted(picture: U8, levels: int, rows: int) -> U8:
    changed = picture.copy()
    changed[10 : 10 + rows, 10:190] += np.uint8(levels)
    return changed


def see_through(picture: U8, alpha: float) -> U8:
    return np.asarray(np.rint(GREY + alpha * (picture.astype(float) - GREY)), np.uint8)


def moved(picture: U8, pixels: int) -> U8:
    changed = GREY.copy()
    changed[10:190, 10 + pixels : 190] = picture[10:190, 10 : 190 - pixels]
    return changed


@pytest.mark.parametrize(
    ("changed", "square"),
    [
        (person(), 0.0),
        (tinted(person(), 12, 180), 12**2),
        (tinted(person(), 12, 45), 12**2 / 4),
        (tinted(person(), 40, 45), 40**2 / 4),
        (see_through(person(), 0.7), 0.3**2 * ((124.5 - 51) ** 2 + (70**2 - 1) / 12)),
        (moved(person(), 9), 0.95 * (70**2 - 1) / 6 + 0.05 * ((124.5 - 51) ** 2 + (70**2 - 1) / 12)),
    ],
    ids=["as it is", "tinted", "a quarter tinted", "a quarter tinted more", "see-through", "moved"],
)
def test_the_check_moves_as_the_picture_is_changed(
    changed: U8, square: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The true picture is a person of evenly random colours from 90 to 159: mean 124.5, variance (70^2 - 1) / 12.

    Mean squares of the changes by hand: d^2 times the share that is tinted; of alpha 0.7, 0.09 times the mean square
    of colour less background; of a person moved by 9 of 180 columns, twice the variance where they still overlap, and
    the colour less the background where they do not. Of random colours: within 3 %; a byte of rounding is below that.
    """
    pytest.importorskip("flip_evaluator")
    black_float_path(monkeypatch, person())
    kept = KeptFrames(tmp_path, (2,))
    kept.see(2, changed)
    check = check_run("checked", tmp_path)  # type: ignore[arg-type]
    wanted_db = 100.0 if not square else -10 * np.log10(square / 255**2)
    assert check["against"] == TRUTH and check["psnr_db"] == pytest.approx(wanted_db, abs=0.13)
    assert check["float_path"]["against"] == FLOAT_PATH
    black = -20 * np.log10(np.sqrt((changed[BOX].astype(float) ** 2).mean()) / 255)
    assert check["float_path"]["psnr_db"] == pytest.approx(black)


def test_a_check_without_its_libraries_is_refused_before_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where an avatar's float network is here PyTorch must be too; of an avatar without one it need not."""
    from trilane.avatars.bundle import load_bundle
    from trilane.bench.lib import full_picture

    bundle = load_bundle("default")
    monkeypatch.setattr(full_picture, "float_weights", lambda each: Path("weights") if each == bundle else None)
    there = {"skimage", "flip_evaluator", "torch"}
    monkeypatch.setattr(machine.here, "has_package", there.__contains__)
    require_parts([bundle])
    there.remove("torch")
    with pytest.raises(MissingPartError, match="torch") as refused:
        require_parts([bundle])
    assert "[train]" in str(refused.value)
    require_parts([load_bundle("hiker")])
    there.remove("skimage")
    with pytest.raises(MissingPartError, match=r"skimage.*\[metrics\]"):
        require_parts([])
    with pytest.raises(MissingPartError, match=r"skimage, and the FP32 network needs torch.*\[metrics,train\]"):
        require_parts([bundle, bundle])
    checked: Any = SimpleNamespace(config=SimpleNamespace(avatar_dirs=(bundle.folder,)))
    with pytest.raises(MissingPartError, match="skimage"):
        asked_run._require_check(checked)


def test_a_sweep_whose_runs_cannot_be_checked_is_refused_before_its_first_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(machine.here, "has_package", lambda _: False)
    words = ("sweep", "run", "--size", "64", "--size", "128", "--check")
    for check, code in (("2", 3), ("0", 0)):
        monkeypatch.setattr(cli_sweep, "_run", lambda *_: False)
        monkeypatch.setattr(sys, "argv", ["trilane", *words, check, "--out", str(tmp_path / "sweep")])
        with pytest.raises(SystemExit) as left:
            cli.main()
        assert (left.value.code or 0) == code
    assert "[metrics,train]" in capsys.readouterr().err
    assert not (tmp_path / "sweep").exists()


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
        "the run's frames were not compared: none of the frames that were kept shows an avatar",
        "the run's frames were not compared: it was interrupted",
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
    assert said == ["the run's frames were not compared: it was interrupted"]
