"""What the bench of plans compares is what runs present, and bad questions to it are refused before any work."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from trilane.bench import planner
from trilane.bench.lib.cast import Cast
from trilane.bench.lib.full_picture import FullPictures
from trilane.bench.lib.stage_chain import AvatarFrames
from trilane.bench.planner import fixed
from trilane.errors import BadInputError
from trilane.stages.avatar_pipeline import run_avatar
from trilane.stages.configure import Checked, configure
from trilane.stages.cpu.pose import PoseStage
from trilane.stages.cpu.present import SEGMENTS, kept_frames
from trilane.stages.run_options import RunOptions

#: Three seconds from frame to frame.
SCENE = """
frames = 6
fps = 0.33333333
size = "auto"
output = {{width = 96, height = 72}}
camera = {{source = "builtin:static", place = "none"}}
[[avatars]]
bundle = "{bundle}"
motion = "builtin:there-and-back"
position = [1.6, 0.0, -0.6]
heading_deg = 90.0
"""
SEEN = [True, True, False, False, True, True]


def small(bundle: Path, folder: Path, policy: str = "pipelined") -> Checked:
    """Who walks out of the picture and back."""
    file = folder / "small.toml"
    file.write_text(SCENE.format(bundle=bundle), encoding="utf-8")
    return configure(RunOptions(scene=str(file), runtime="ort", policy=policy), folder)


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


def test_the_frame_after_a_step_is_that_of_the_new_size_alone(drawable_bundle: Path, tmp_path: Path) -> None:
    """Stepped to half the sides and back, at 30 frames a second: no frame has a share of the picture before."""
    checked = small(drawable_bundle, tmp_path, policy="latest")
    checked = checked.changed(scene=checked.config.scene.model_copy(update={"fps": 30.0}))
    assert checked.config.works == (1000, 563, 250)

    stepped = AvatarFrames(checked)
    for number, rung in enumerate((0, 2, 2, 1, 0, 2)):
        frame = on_rung(stepped, rung).frame(number)
        alone, largest = (on_rung(AvatarFrames(checked, stepped.units), each) for each in (rung, 0))
        assert np.array_equal(frame, alone.frame(number)) and stepped.tensor == alone.tensor
        assert np.array_equal(frame, largest.frame(number)) == (rung == 0)


def on_rung(frames: AvatarFrames, rung: int) -> AvatarFrames:
    """`frames`, whose tensors are stepped down to `rung`."""
    stage = frames._chain.made[0]
    assert isinstance(stage, PoseStage)
    stage.step_to(rung)
    return frames


LOG = "{time} 1 0 0 {x} 0 1 0 1.0 0 0 1 {z}"
CAMERA = """
frames = 2
size = "256x256"
output = {{width = 320, height = 240}}
camera = {{source = "{log}", place = "none", up_axis = "y", fov_y_deg = 40.0}}
[[avatars]]
bundle = "default"
motion = "builtin:t-pose"
"""


def silhouette(folder: Path, x: float, z: float) -> tuple[float, float]:
    """Height and middle, from left to right, in pixels of what a camera at (x, 1, z) that looks along -Z sees of the
    default avatar in the T pose.
    """
    log, file = folder / "log.txt", folder / "scene.toml"
    log.write_text("\n".join(LOG.format(time=time / 30, x=x, z=z) for time in range(9)), encoding="utf-8")
    file.write_text(CAMERA.format(log=log), encoding="utf-8")
    frames = AvatarFrames(configure(RunOptions(scene=str(file), runtime="ort"), folder))
    moved = np.abs(frames.frame(0).astype(int) - frames.background(0)).max(axis=2) > STEPS
    rows, columns = np.flatnonzero(moved.any(axis=1)), np.flatnonzero(moved.any(axis=0))
    return float(np.ptp(rows)) + 1, float(columns.min() + columns.max() + 1) / 2


#: A pixel that differs by more than this from its background shows the avatar.
STEPS = 24


def test_the_picture_moves_as_the_camera_is_moved(tmp_path: Path) -> None:
    """From 4 m, 8 m and half a metre beside it. A lens of 40 degrees shows a length of 1 at a distance of 1 with
    120 / tan 20 degrees pixels. Depths of the body's parts differ by 0.3 m at most, and an edge may be two pixels off.
    """
    focal = 120 / np.tan(np.radians(20))
    (near, middle), (far, _), (_, beside) = (silhouette(tmp_path, *at) for at in ((0.0, 4.0), (0.0, 8.0), (0.5, 4.0)))
    assert middle == pytest.approx(160, abs=3)
    assert middle - beside == pytest.approx(focal * 0.5 / 4, abs=focal * 0.5 * (1 / 3.85 - 1 / 4) + 2)
    assert near / far == pytest.approx(2, abs=2 * 0.15 / 4 + 4 / far)
