"""A scene of two people with a network each: what each one's tensor and picture are, beside scenes of one person."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from trilane.avatars.bundle import bundle_folder
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
#: Bundle, or its folder beside the scene -> place along x in metres, and motion.
PEOPLE = {"default": (-1.0, "builtin:walk-wave-turn"), "./hiker": (1.0, "builtin:idle")}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Checked]:
    """The scenes of both people and of each alone, before the same camera, in tensors of one size.

    The second person has a network file of its own, which computes the same.
    """
    folder, made = tmp_path_factory.mktemp("scenes"), {}
    shutil.copytree(bundle_folder("hiker"), folder / "hiker")
    network = folder / "hiker" / "network.onnx"
    model = onnx.load_model(network)
    model.doc_string = "another file"
    onnx.save_model(model, network)
    for name in ("both", *PEOPLE):
        avatars = [
            f'[[avatars]]\nbundle = "{bundle}"\nmotion = "{motion}"\nposition = [{x}, 0.0, 0.0]\n'
            for bundle, (x, motion) in PEOPLE.items()
            if name in ("both", bundle)
        ]
        path = folder / f"{Path(name).name}.toml"
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
    """The scene fixes another size than the validation of `default` has; nobody shares a tensor."""
    reasons = [figures["why"] for figures in scenes["both"].accuracy.values()]
    assert len(reasons) == 2 and not any("share" in why for why in reasons)
    assert any("tensor size" in why for why in reasons)


def test_three_people_of_one_network_share_a_tensor(gl: Any) -> None:
    """Each person has a texture of its own: painted in one tensor, the people differ."""
    people = configure(RunOptions(scene="people", runtime="ort", skinning="cpu"), Path.cwd())
    assert len(people.config.avatar_dirs) == 3 and people.config.networks == ()
    frames = frames_of(people, gl)
    changed = np.abs(frames.frame(FRAME).astype(int) - frames.background(FRAME)).max(axis=-1) > 40
    columns = np.flatnonzero(changed[160:240].any(axis=0))
    assert len(np.split(columns, np.flatnonzero(np.diff(columns) > 8) + 1)) == 3
