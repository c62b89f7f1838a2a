"""A background in a run of real units: each presented frame has the background of its own time.

Rule: the GPU unit is killed on the way, poses are sampled late (`--latch`), and the background is shorter than the run.
"""

from __future__ import annotations

import signal
from collections.abc import Mapping
from pathlib import Path

import av
import numpy as np
import psutil
import pytest
from numpy.typing import NDArray
from PIL import Image

from trilane.pipeline.description import PipelineStage
from trilane.pipeline.fork_server import process_name
from trilane.pipeline.result import RunResult
from trilane.pipeline.run import run_pipeline
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.configure import configure
from trilane.stages.run_options import RunOptions

FPS, PICTURES, FRAMES, KILL_AT = 30, 60, 72, 20
WIDTH, HEIGHT = 96, 64
SCENE = f"""
size = "64x64"
output = {{ width = {WIDTH}, height = {HEIGHT} }}
[[avatars]]
"""

pytestmark = pytest.mark.usefixtures("nothing_left")


def grey(number: int) -> int:
    return 40 + 3 * (number % PICTURES)


def picture(number: int) -> NDArray[np.uint8]:
    return np.full((HEIGHT, WIDTH, 3), grey(number), np.uint8)


@pytest.fixture(scope="module")
def ramps(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """The same ramp as a video, a key frame every 10, and as a folder of pictures."""
    place = tmp_path_factory.mktemp("ramps")
    with av.open(str(place / "ramp.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"g": "10", "crf": "0"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv444p"
        for number in range(PICTURES):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(number), format="rgb24")))
        container.mux(stream.encode(None))
    (place / "pictures").mkdir()
    for number in range(PICTURES):
        Image.fromarray(picture(number)).save(place / "pictures" / f"{number:03d}.png")
    return {"video": place / "ramp.mp4", "pictures": place / "pictures"}


class KillsGpu:
    """Kills the GPU unit's process once, when enough frames were presented."""

    def __init__(self) -> None:
        self.killed = False

    def progress(self, presented: int, _requested: int) -> None:
        if presented >= KILL_AT and not self.killed:
            name = process_name("gpu")
            (unit,) = (child for child in psutil.Process().children(recursive=True) if child.name() == name)
            unit.send_signal(signal.SIGKILL)
            self.killed = True


def run(background: Path, bundle: Path, folder: Path, killer: KillsGpu) -> RunResult:
    """The avatar's pipeline, but for its last stage, which notes the grey of a corner that no avatar reaches into."""
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    asked = RunOptions(
        scene=str(folder / "scene.toml"), background=str(background), avatar=str(bundle), frames=FRAMES, runtime="ort"
    )
    checked = configure(asked, folder)
    pipeline = avatar_pipeline(checked.config, checked.assets, "double")
    notes = PipelineStage(
        name="present",
        unit="cpu",
        factory="support.doubles:build_corner_greys",
        settings={"log": str(folder / "greys"), "width": WIDTH},
    )
    pipeline = pipeline.model_copy(update={"stages": (*pipeline.stages[:-1], notes)})
    return run_pipeline(pipeline, FRAMES, fps=FPS, assets=checked.assets, latch_ms=3.0, on_progress=killer.progress)


@pytest.mark.parametrize("kind", ["video", "pictures"])
def test_every_presented_frame_shows_its_own_background(
    kind: str, ramps: Mapping[str, Path], drawable_bundle: Path, tmp_path: Path
) -> None:
    """Forwards, across the end, with late poses and after a restart of the GPU unit: grey 40 + 3 N within 2."""
    killer = KillsGpu()
    result = run(ramps[kind], drawable_bundle, tmp_path, killer)
    lines = [line.split() for line in (tmp_path / "greys").read_text().splitlines()]
    greys = {int(frame): float(mean) for frame, mean in lines}
    assert killer.killed
    assert result.report.units["gpu"].restarts == 1
    assert len(greys) == result.presented >= FRAMES - 2  # the job that the unit had begun, and one that it was to begin
    assert max(greys) == FRAMES - 1
    wrong = {number: (level, grey(number)) for number, level in greys.items() if abs(level - grey(number)) > 2}
    assert wrong == {}
