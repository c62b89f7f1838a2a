"""A scene of two people with a network each: what each one's tensor and picture are, beside scenes of one person."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.bench.lib.stage_chain import AvatarFrames, units_of
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.configure import Checked, configure
from trilane.stages.gpu.opengl import CONTEXT
from trilane.stages.run_options import RunOptions

FRAME = 20
HEAD = """
frames = 30
size = "192x96"
output = { width = 320, height = 240 }
camera = { source = "builtin:static", place = "none" }
"""
PEOPLE = {"default": (-1.0, "builtin:walk-wave-turn"), "hiker": (1.0, "builtin:idle")}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Checked]:
    """The scenes of both people and of each alone, before the same camera, in tensors of one size."""
    folder, made = tmp_path_factory.mktemp("scenes"), {}
    for name in ("both", *PEOPLE):
        avatars = [
            f'[[avatars]]\nbundle = "{bundle}"\nmotion = "{motion}"\nposition = [{x}, 0.0, 0.0]\n'
            for bundle, (x, motion) in PEOPLE.items()
            if name in ("both", bundle)
        ]
        path = folder / f"{name}.toml"
        path.write_text(HEAD + "".join(avatars))
        made[name] = configure(RunOptions(scene=str(path), runtime="ort", skinning="cpu"), Path.cwd())
    return made


def frames_of(checked: Checked, gl: Any) -> AvatarFrames:
    """The frames of a scene, drawn in the shared context."""
    units = units_of(avatar_pipeline(checked.config, checked.assets), checked.assets)
    units["gpu"].shared(CONTEXT, lambda: gl)
    return AvatarFrames(checked, units)


def test_each_person_is_drawn_and_painted_as_if_alone(scenes: dict[str, Checked], gl: Any) -> None:
    assert scenes["both"].config.networks == (0, 1)
    both = frames_of(scenes["both"], gl)
    picture, empty = both.frame(FRAME).astype(int), both.background(FRAME).astype(int)
    for network, name in enumerate(PEOPLE):
        alone = frames_of(scenes[name], gl)
        expected = alone.tensor_of(FRAME)
        assert np.array_equal(both.tensor_of(FRAME, network), expected)
        assert len(np.unique(expected)) > 50
        # The people stand 2 m apart, so each has a half of the picture; shadows meet in the middle.
        half = np.s_[:, :120] if network == 0 else np.s_[:, 200:]
        assert np.array_equal(picture[half], alone.frame(FRAME)[half])
        assert (np.abs(picture - empty)[half].max(axis=-1) > 40).sum() > 500


def test_the_accuracy_of_each_is_that_of_a_person_alone_in_a_tensor(scenes: dict[str, Checked]) -> None:
    """The scene fixes another size than the validation has; nobody shares a tensor."""
    for figures in scenes["both"].accuracy.values():
        assert "tensor size" in figures["why"] and "share" not in figures["why"]
