"""What the bench of plans compares is what runs present, and bad questions to it are refused before any work."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from trilane.bench import planner
from trilane.bench.lib.cast import Cast
from trilane.bench.lib.full_picture import FullPictures
from trilane.bench.lib.plans import fixed
from trilane.bench.lib.stage_chain import AvatarFrames
from trilane.errors import BadInputError
from trilane.stages.avatar_pipeline import run_avatar
from trilane.stages.configure import Checked, Request, configure
from trilane.stages.cpu.kept_frames import kept_frames
from trilane.stages.cpu.present import SEGMENTS

#: Three seconds from frame to frame.
SCENE = """
frames = 6
fps = 0.33333333
size = "auto"
output = {{width = 96, height = 72}}
camera = {{source = "builtin:static"}}
[[avatars]]
bundle = "{bundle}"
motion = "builtin:there-and-back"
position = [1.6, 0.0, -0.6]
heading_deg = 90.0
"""
SEEN = [True, True, False, False, True, True]


def small(bundle: Path, folder: Path) -> Checked:
    """Who walks out of the picture and back."""
    file = folder / "small.toml"
    file.write_text(SCENE.format(bundle=bundle), encoding="utf-8")
    return configure(Request(scene=str(file), runtime="ort"), folder)


def test_frames_made_here_are_those_that_a_run_presents(drawable_bundle: Path, tmp_path: Path) -> None:
    """To the byte, by the digests that the run's present stage noted; with nobody in view, too."""
    checked = small(drawable_bundle, tmp_path).changed(kept=(1, 4))
    result = run_avatar(checked.config, checked.assets)
    assert result.failure is None and result.presented == len(SEEN)
    assert result.report.stages["infer"].jobs == sum(SEEN)
    lines = [line.split() for path in (tmp_path / SEGMENTS).glob("*.sha256") for line in path.read_text().splitlines()]
    frames = AvatarFrames(checked)
    for number, file in kept_frames(tmp_path).items():
        assert np.array_equal(np.load(file), frames.frame(number))
    assert list(kept_frames(tmp_path)) == [1, 4]
    own, drew, tensors = [], [], []
    for number in range(len(SEEN)):
        background = frames.background(number)
        made = frames.frame(number)
        own.append([str(number), hashlib.sha256(made.tobytes()).hexdigest()])
        drew.append(not np.array_equal(made, background))
        tensors.append(frames.tensor != "none")
    assert lines == own
    assert drew == tensors == SEEN
    assert own[2][1] == own[3][1] and own[5][1] == own[0][1]  # nobody; and the motion begins anew after 15 s
    assert len({digest for _, digest in own}) == 4


def test_the_picture_of_nobody_is_the_background_by_every_plan(drawable_bundle: Path, tmp_path: Path) -> None:
    """What is compared in a frame with nobody in view: no box, and no difference."""
    checked = small(drawable_bundle, tmp_path)
    cast, frames = Cast(checked), AvatarFrames(checked)
    square = AvatarFrames(fixed(checked), frames.units)
    background = frames.background(2)
    assert cast.boxes(2) == [] and cast.boxes(0) != []
    for picture in (frames.frame(2), square.frame(2), FullPictures(cast).frame(2, background)):
        assert np.array_equal(picture, background)


@pytest.mark.parametrize("asked", [{"frames": 19}, {"pictures": 0}, {"frames": 20, "pictures": 21}])
def test_numbers_out_of_range_are_refused(asked: dict[str, int]) -> None:
    with pytest.raises(BadInputError, match=r"--(frames|pictures)"):
        planner.measure(**asked)  # type: ignore[arg-type]
