"""What the bench of plans compares is what runs present, and bad questions to it are refused before any work."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from trilane.bench import planner
from trilane.bench.lib.stage_chain import AvatarFrames
from trilane.errors import BadInputError
from trilane.stages.avatar_pipeline import run_avatar
from trilane.stages.configure import Request, configure
from trilane.stages.cpu.present import SEGMENTS

SCENE = """
frames = 3
size = "64x64"
output = {{width = 96, height = 80}}
[[avatars]]
bundle = "{bundle}"
"""


def test_frames_made_here_are_those_that_a_run_presents(drawable_bundle: Path, tmp_path: Path) -> None:
    """To the byte, by the digests that the run's present stage noted of its slots."""
    file = tmp_path / "small.toml"
    file.write_text(SCENE.format(bundle=drawable_bundle), encoding="utf-8")
    checked = configure(Request(scene=str(file), runtime="ort"), tmp_path)
    result = run_avatar(checked.config, checked.assets, isolated_frames=0)
    assert result.failure is None and result.presented == 3
    lines = [line.split() for path in (tmp_path / SEGMENTS).glob("*.sha256") for line in path.read_text().splitlines()]
    frames = AvatarFrames(checked)
    own = [[str(number), hashlib.sha256(frames.frame(number).tobytes()).hexdigest()] for number in range(3)]
    assert lines == own
    assert len({digest for _, digest in own}) == 3


@pytest.mark.parametrize("asked", [{"frames": 19}, {"pictures": 0}, {"frames": 20, "pictures": 21}])
def test_numbers_out_of_range_are_refused(asked: dict[str, int]) -> None:
    with pytest.raises(BadInputError, match=r"--(frames|pictures)"):
        planner.measure(**asked)  # type: ignore[arg-type]
