"""An avatar made anew: what may be asked, what is kept, and which of its pictures count."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.apps.avatar import remade_avatar
from trilane.apps.cli.sweep_options import SweptCommand
from trilane.apps.run.asked_run import prepare
from trilane.avatars.bundle import MANIFEST, load_bundle
from trilane.avatars.manifest import sha256_of
from trilane.avatars.validation import DrawnAs, accuracy_of
from trilane.bench.lib import full_picture
from trilane.errors import BadInputError
from trilane.stages.run_options import METHODS, RunOptions, calibration_of
from trilane.training.quantising import calibration

OWN = RunOptions(width=8, channels=4)


def test_the_methods_are_those_of_the_quantiser() -> None:
    assert set(METHODS) == set(calibration.METHODS)


@pytest.mark.parametrize(
    ("text", "meant"),
    [("as-it-is", None), ("minmax", ("minmax", 5)), ("entropy:10", ("entropy", 10)), ("minmax:1000", ("minmax", 1000))],
)
def test_a_calibration_is_a_method_and_a_number_of_views(text: str, meant: Any) -> None:
    assert calibration_of(text) == meant


@pytest.mark.parametrize(
    "text", ["", "minmx", "minmax:", "minmax:0", "minmax:1001", "minmax:+5", "as-it-is:5", "minmax:5:5"]
)
def test_other_calibrations_are_refused(text: str) -> None:
    with pytest.raises(BadInputError, match="--calibration"):
        RunOptions.checked({"calibration": text}, as_typed=True)


@pytest.mark.parametrize(
    ("name", "value"),
    [("width", 0), ("width", 257), ("width", True), ("channels", 5), ("channels", 20), ("channels", 8.0)],
)
def test_other_numbers_are_refused(name: str, value: Any) -> None:
    RunOptions.checked({"width": 256, "channels": 16})
    with pytest.raises(BadInputError, match=f"^--{name}: found {value!r}"):
        RunOptions.checked({name: value}, as_typed=True)
    with pytest.raises(BadInputError, match=f"^{name}: found {value!r}"):
        RunOptions.checked({name: value})


@pytest.mark.parametrize(("name", "value"), [("calibration", "entrpy"), ("channels", 5), ("width", 300)])
def test_a_sweep_refuses_them_before_its_first_trial(name: str, value: Any) -> None:
    with pytest.raises(BadInputError, match=name):
        SweptCommand(["run"]).converted(name, value)


def test_nothing_is_asked_of_an_avatar_as_it_is(drawable_bundle: Path) -> None:
    assert not RunOptions().remakes_avatar and not RunOptions(calibration="as-it-is").remakes_avatar
    assert RunOptions(width=8).remakes_avatar
    folder, said = remade_avatar.remade_avatar(str(drawable_bundle), OWN)
    assert folder == drawable_bundle and "as its files are" in said


@pytest.fixture
def views(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Views are random numbers; how many were asked for, each time."""
    pytest.importorskip("torch")
    from trilane.training import make_bundle, validate

    asked: list[int] = []

    def training_views(_renderer: Any, bundle: Any, count: int) -> list[Any]:
        asked.append(count)
        shape = (*make_bundle.CALIBRATION_SHAPE, bundle.manifest.network.channels)
        return [np.random.default_rng(number).normal(0, 1, shape).astype(np.float32) for number in range(count)]

    monkeypatch.setattr(make_bundle, "training_views", training_views)
    monkeypatch.setattr(validate, "open_renderer", lambda *_: None)
    return asked


def test_another_number_of_channels_is_untrained_and_has_as_many_of_the_texture(
    drawable_bundle: Path, views: list[int]
) -> None:
    """Channels 4 to 7 are the first four once more. It is made once, by another recipe again."""
    remake = RunOptions(width=4, channels=8, calibration="minmax:2")
    folder, said = remade_avatar.remade_avatar(str(drawable_bundle), remake)
    assert said == "made again: width 4, 8 channels, untrained; minmax on 2 views; its times count, its pictures do not"
    made, own = load_bundle(folder), load_bundle(drawable_bundle)
    assert (made.manifest.network.width, made.manifest.network.channels, views) == (4, 8, [2])
    assert made.read_network().shape == (1, 64, 64, 8)
    assert (made.read_texture() == np.tile(own.read_texture(), 2)).all()
    assert remade_avatar.is_untrained(made) and not remade_avatar.is_untrained(own)
    facts = accuracy_of(made, DrawnAs("ort", "256", "linear"))
    assert facts["source"] == "no figures" and "untrained" in facts["why"]
    assert remade_avatar.remade_avatar(str(drawable_bundle), remake)[0] == folder and views == [2]
    other = remade_avatar.remade_avatar(str(drawable_bundle), RunOptions(width=4, channels=8, calibration="minmax:1"))[
        0
    ]
    assert other != folder and views == [2, 1]
    with pytest.raises(BadInputError, match="--check: found a network that is made untrained"):
        prepare(remake.changed(avatar=str(drawable_bundle), check=1), pytest.fail)


def test_a_calibration_quantises_the_float_network_that_the_manifest_names(
    drawable_bundle: Path, views: list[int], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from trilane.training import make_bundle
    from trilane.training.network import UNet, export_onnx

    weights = tmp_path / "own.npz"
    weights.write_bytes(b"weights")
    monkeypatch.setattr(full_picture, "WEIGHTS", tmp_path)
    monkeypatch.setattr(
        make_bundle,
        "float_model",
        lambda *_: export_onnx(UNet(width=8, channels=4), *make_bundle.CALIBRATION_SHAPE),
    )
    with pytest.raises(BadInputError, match="no float network"):
        remade_avatar.remade_avatar(str(drawable_bundle), RunOptions(calibration="entropy:1"))
    manifest = json.loads((drawable_bundle / MANIFEST).read_text())
    named = tmp_path / "named"
    named.mkdir()
    for file in drawable_bundle.iterdir():
        (named / file.name).write_bytes(file.read_bytes())
    manifest["quantisation"]["float_network"] = f"own.npz, sha256 {sha256_of([weights])}"
    (named / MANIFEST).write_text(json.dumps(manifest))
    folder, said = remade_avatar.remade_avatar(str(named), RunOptions(calibration="minmax:1", width=8))
    made = load_bundle(folder)
    assert said == "made again: minmax on 1 view" and not remade_avatar.is_untrained(made)
    assert full_picture.float_weights(made) == weights
    assert views == [1] and made.manifest.quantisation["method"] == "minmax" and made.manifest.validation is None
    assert (made.read_texture() == load_bundle(named).read_texture()).all()


def test_of_several_avatars_none_is_made_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remade_avatar, "remade_avatar", pytest.fail)
    with pytest.raises(BadInputError, match="a scene of 2 avatars"):
        prepare(RunOptions(scene="pair", width=8), pytest.fail)
