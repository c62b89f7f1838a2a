"""What `--check` says of pictures that are changed by a known amount: of the real avatar, drawn by the run's stages.

The presented picture p differs from the truth t by r (root mean square) where the avatar is. A change f that moves no
two pictures apart makes f(p) differ from t by |f(t) - t|, at least less r and at most more r: a tint and a shift keep
distances, an alpha of 0.7 shrinks them. f(t) is made of the truth alone. The same holds of another avatar in place of
this one, and of another camera, by their own picture and their own truth.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("flip_evaluator")
pytest.importorskip("torch")

from trilane.apps.experiments import reference_path
from trilane.apps.experiments.scene_pictures import around
from trilane.apps.run.run_job import FLOAT_PATH, TRUTH, check_run
from trilane.arrays import U8
from trilane.bench.lib.cast import blended
from trilane.bench.lib.full_picture import TruePictures, true_pictures
from trilane.bench.lib.stage_chain import AvatarFrames
from trilane.stages.configure import Checked, configure
from trilane.stages.cpu.present import KeptFrames
from trilane.stages.run_options import RunOptions

SCENE = """
frames = 12
fps = 6
size = "128x64"
output = {{width = 160, height = 128}}
camera = {{source = "{camera}"}}
[[avatars]]
bundle = "{avatar}"
"""
NUMBER, ALPHA, SHIFT, TINT = 5, 0.7, 3, 20


def scene(folder: Path, avatar: str, camera: str = "builtin:static") -> Checked:
    file = folder / "scene.toml"
    file.write_text(SCENE.format(avatar=avatar, camera=camera), encoding="utf-8")
    return configure(RunOptions(scene=str(file), runtime="ort"), folder)


class Pictures:
    """Frame `NUMBER` of one avatar: as presented, its truth and its background, and both changed."""

    def __init__(self, checked: Checked) -> None:
        self.path = reference_path.ReferencePath(checked)
        self.frames: AvatarFrames = self.path.frames
        true = true_pictures(self.path.cast, self.path.gl)
        assert isinstance(true, TruePictures)
        self.layers = true.layers(NUMBER)
        self.background = self.frames.background(NUMBER)
        self.own, self.truth = self.frames.frame(NUMBER), blended(self.background, self.layers)
        self.part = around(self.path.cast.boxes(NUMBER), self.path.output)

    def see_through(self) -> tuple[U8, U8]:
        """By the network's alpha, and by that of the truth."""
        chain = self.frames._chain
        rgba = chain.run(NUMBER, self.frames._composite - 1).payload
        height, width = self.frames.posed["tensor_shape"].tolist()
        painted: U8 = rgba[: height * width * 4].reshape(height, width, 4).copy()
        painted[..., 3] = np.rint(painted[..., 3] * ALPHA)
        thin = [replace(layer, light=layer.light * ALPHA) for layer in self.layers]
        return self.frames.composited(NUMBER, {0: painted}), blended(self.background, thin)

    def shifted(self) -> tuple[U8, U8]:
        return np.roll(self.own, SHIFT, axis=1), np.roll(self.truth, SHIFT, axis=1)

    def tinted(self) -> tuple[U8, U8]:
        """By `TINT`, up where the truth is dark and down where it is light, so that nothing is cut off."""
        tint = np.where(self.truth > 127, -TINT, TINT)
        first, second = (np.clip(picture + tint, 0, 255).astype(np.uint8) for picture in (self.own, self.truth))
        return first, second

    def distance(self, one: U8, other: U8) -> float:
        """Root mean square where the avatar is, in 0..1."""
        return float(np.sqrt(((one[self.part].astype(float) - other[self.part]) ** 2).mean())) / 255


@pytest.mark.slow
def test_the_check_moves_as_the_picture_is_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    others = {
        "avatar": Pictures(scene(tmp_path, "hiker")),
        "camera": Pictures(scene(tmp_path, "default", "builtin:orbit")),
    }
    checked = scene(tmp_path, "default")
    pictures = Pictures(checked)  # after the others, as its OpenGL context must be the one in use
    moment = cache(pictures.path.moment)
    path = SimpleNamespace(**vars(pictures.path), gl=pictures.path.gl, moment=moment)
    monkeypatch.setattr(reference_path, "ReferencePath", lambda _: path)

    def checked_db(name: str, presented: U8) -> float:
        (tmp_path / name).mkdir()
        kept = KeptFrames(tmp_path / name, (NUMBER,))
        kept.see(NUMBER, presented)
        found = check_run(checked, tmp_path / name)
        assert (found["against"], found["float_path"]["against"]) == (TRUTH, FLOAT_PATH)
        return float(found["psnr_db"])

    def db(square_root: float) -> float:
        return float(-20 * np.log10(square_root))

    own = pictures.distance(pictures.own, pictures.truth)
    assert checked_db("own", pictures.own) == pytest.approx(db(own), abs=1e-6)
    assert pictures.distance(pictures.tinted()[1], pictures.truth) == pytest.approx(TINT / 255)
    changes = {"see-through": pictures.see_through(), "shifted": pictures.shifted(), "tinted": pictures.tinted()}
    changes |= {name: (other.own, other.truth) for name, other in others.items()}
    for name, (presented, truth) in changes.items():
        made = pictures.distance(truth, pictures.truth)
        apart = pictures.distance(presented, truth) if name in others else own
        assert made > 2 * apart, f"{name}: too small a change to be seen"
        assert db(made + apart) <= checked_db(name, presented) <= db(made - apart), name
