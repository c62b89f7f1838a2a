"""`trilane avatar create` and an avatar made again: what is kept, what is said again, and what is refused."""

from __future__ import annotations

import datetime
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from trilane.apps import avatar_files
from trilane.apps.avatar_files import Parts, assemble
from trilane.apps.cli.sweep_options import SweptCommand
from trilane.apps.run.asked_run import prepare
from trilane.avatars.bundle import MANIFEST, OFFSETS, bundle_folder, load_bundle, save_offsets
from trilane.avatars.manifest import CAPTURED, UNTRAINED, Validation, digests_of, sha256_of, with_figures_digest
from trilane.avatars.validation import DrawnAs, accuracy_of
from trilane.bench.lib import full_picture
from trilane.errors import BadInputError
from trilane.stages.run_options import RunOptions, calibration_of
from trilane.training.clothing import LOOKS, look_of
from trilane.training.quantising.quantise import quantise

Command = Callable[..., tuple[str, str]]
Tiny = Callable[..., onnx.ModelProto]
BODY = bundle_folder("default") / "body.npz"


def integers(tiny: Tiny, file: Path, channels: int = 4, seed: int = 3) -> Path:
    """Write a network in integers of other weights, calibrated on values up to about 4."""
    frames = np.random.default_rng(seed).normal(0, 1, (2, 64, 64, channels)).astype(np.float32)
    onnx.save(quantise(tiny(channels, seed=seed), list(frames)).network.model, file)
    return file


@pytest.fixture(scope="module")
def network(tiny_float_network_of: Tiny, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return integers(tiny_float_network_of, tmp_path_factory.mktemp("network") / "mine.onnx")


@pytest.fixture
def base(drawable_bundle: Path, tmp_path: Path) -> Path:
    """An avatar with a name, a shape, words about its training, and a validation of these very files."""
    folder = tmp_path / "base"
    shutil.copytree(drawable_bundle, folder)
    change(folder, name="anna", betas=[0.5], provenance={"steps": 9}, training_command="train", quantisation={"a": 1})
    digests = digests_of(folder, load_bundle(folder).manifest)
    figures = {
        "psnr_db_by_band": {"face": 30.0},
        "psnr_db_by_background": {"black": 30.0},
        "iou": 0.9,
        "ssim": 0.8,
        "date": datetime.date(2026, 1, 2),
        "digests": digests,
    }
    validation = with_figures_digest(Validation.model_validate(figures))
    change(folder, validation=validation.model_dump(mode="json"))
    return folder


def change(folder: Path, **keys: Any) -> None:
    file = folder / "manifest.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | keys))


def test_another_network_brings_its_scales_and_loses_the_validation(
    base: Path, network: Path, tmp_path: Path, command: Command
) -> None:
    facts = json.loads(command("avatar", "create", base, "--network", network, "--out", tmp_path / "new", "--json")[0])
    own, made = load_bundle(base), load_bundle(tmp_path / "new")
    read = made.read_network()
    assert read.digest != own.read_network().digest
    entry = made.manifest.network
    assert (entry.input.scale, entry.input.zero_point) == (pytest.approx(read.input.scale), read.input.zero_point)
    assert entry.input != own.manifest.network.input
    assert (entry.encoder, entry.norm, entry.width) == ("resnet18", "batch", 8), (
        "the graph is the same, so are its names"
    )
    assert made.manifest.validation is None and own.manifest.validation is not None
    assert (made.manifest.quantisation, made.manifest.training_command) == ({}, "")
    assert made.manifest.provenance == {"made_from": "anna", "replaced": {"network": "mine.onnx"}, "base": {"steps": 9}}
    assert (made.manifest.name, made.manifest.betas) == ("new", (0.5,))
    assert np.array_equal(made.read_texture(), own.read_texture())
    assert made.body_path.read_bytes() == own.body_path.read_bytes()
    assert facts["accuracy"].startswith("it was never validated; `trilane avatar validate")
    assert facts["network"]["shapes"] == "any with sides in multiples of 32"
    assert facts["replaced"] == {"network": str(network)} and facts["made_from"] == "anna"


def test_who_is_shown_stays_known_while_the_body_stays(base: Path, tmp_path: Path) -> None:
    """`avatar validate` draws the truth in this look."""
    change(base, provenance={"look": "hiker"})
    assemble(load_bundle(base), Parts(texture=base / "texture.npz"), tmp_path / "same")
    assemble(load_bundle(base), Parts(body=base / "body.npz"), tmp_path / "other")
    looks = [look_of(load_bundle(tmp_path / name).manifest.provenance) for name in ("same", "other")]
    assert looks == [LOOKS["hiker"], LOOKS["default"]]


def test_the_same_network_keeps_validation_and_words(base: Path, tmp_path: Path) -> None:
    facts = assemble(load_bundle(base), Parts(network=base / "network.onnx"), tmp_path / "same")
    own, made = load_bundle(base).manifest, load_bundle(tmp_path / "same").manifest
    assert facts["accuracy"] == "validated, and unchanged since"
    assert (made.validation, made.quantisation, made.network) == (own.validation, {"a": 1}, own.network)


def test_a_network_of_another_kind_is_not_called_by_the_old_names(
    tiny_float_network_of: Tiny, base: Path, tmp_path: Path
) -> None:
    """One activation is another operator. The width is that of the first convolution, whatever the manifest said."""
    plain = tiny_float_network_of(4)
    next(node for node in plain.graph.node if node.name == "level.relu").op_type = "Sigmoid"
    frames = np.random.default_rng(3).normal(0, 1, (2, 64, 64, 4)).astype(np.float32)
    onnx.save(quantise(plain, list(frames)).network.model, tmp_path / "other.onnx")
    change(base, network=json.loads((base / "manifest.json").read_text())["network"] | {"width": 24})
    assemble(load_bundle(base), Parts(network=tmp_path / "other.onnx"), tmp_path / "new")
    entry = load_bundle(tmp_path / "new").manifest.network
    assert (entry.encoder, entry.norm, entry.width) == ("other", "other", 8)


def test_clipped_values_of_the_texture_are_counted(base: Path, network: Path, tmp_path: Path) -> None:
    """A quarter of the texels is far beyond what the input's bytes stand for."""
    texture = np.zeros((8, 8, 4), np.float16)
    texture[:4, :4] = 900.0
    np.savez(tmp_path / "texture.npz", texture=texture)
    parts = Parts(network=network, texture=tmp_path / "texture.npz")
    facts = assemble(load_bundle(base), parts, tmp_path / "new")
    assert facts["texture"] == {"shape": [8, 8, 4], "clipped": 0.25}
    assert np.array_equal(load_bundle(tmp_path / "new").read_texture(), texture.astype(np.float32))


def test_another_body_has_its_own_shape(base: Path, tmp_path: Path) -> None:
    arrays = dict(np.load(BODY))
    arrays["v_template"] = arrays["v_template"] * 1.1
    np.savez(tmp_path / "tall.npz", **arrays)
    assemble(load_bundle(base), Parts(body=tmp_path / "tall.npz"), tmp_path / "new")
    made = load_bundle(tmp_path / "new")
    assert made.manifest.betas == () and made.body_path.read_bytes() == (tmp_path / "tall.npz").read_bytes()
    arrays["vt"] = arrays["vt"] * 0.5
    np.savez(tmp_path / "other.npz", **arrays)
    with pytest.raises(BadInputError, match=r"another UV layout, expected that of .*; give its --texture as well"):
        assemble(load_bundle(base), Parts(body=tmp_path / "other.npz"), tmp_path / "none")
    parts = Parts(body=tmp_path / "other.npz", texture=base / "texture.npz")
    assert assemble(load_bundle(base), parts, tmp_path / "two")["replaced"].keys() == {"body", "texture"}


def test_clothes_stay_with_their_body(base: Path, network: Path, tmp_path: Path) -> None:
    """Offsets of the vertices: kept to the byte with the body, left out with another one."""
    offsets = np.random.default_rng(4).normal(0, 0.01, (len(np.load(BODY)["v_template"]), 3)).astype(np.float32)
    save_offsets(base / OFFSETS, offsets)
    change(base, offsets=OFFSETS)
    assemble(load_bundle(base), Parts(network=network), tmp_path / "new")
    assert (tmp_path / "new" / OFFSETS).read_bytes() == (base / OFFSETS).read_bytes()
    assert np.abs(load_bundle(tmp_path / "new").read_body().offsets - offsets).max() < 1e-4
    assemble(load_bundle(base), Parts(body=BODY), tmp_path / "bare")
    assert load_bundle(tmp_path / "bare").manifest.offsets is None and not (tmp_path / "bare" / OFFSETS).exists()


@pytest.mark.parametrize(
    ("provenance", "part", "kept", "why"),
    [
        (
            {"body": CAPTURED, "held_out_error": {"psnr_db": 30}},
            "network",
            "body",
            "only frames of its person are known",
        ),
        ({"weights": UNTRAINED}, "texture", "weights", "its network is untrained"),
        ({"weights": UNTRAINED}, "network", "", "it was never validated"),
    ],
)
def test_what_is_said_of_person_and_weights_stays_where_they_stay(
    provenance: dict[str, Any], part: str, kept: str, why: str, base: Path, network: Path, tmp_path: Path
) -> None:
    change(base, provenance=provenance, validation=None)
    file = {"network": network, "texture": base / "texture.npz"}[part]
    facts = assemble(load_bundle(base), Parts(**{part: file}), tmp_path / "new")
    said = load_bundle(tmp_path / "new").manifest.provenance
    assert {key: said[key] for key in ("body", "weights") if key in said} == ({kept: provenance[kept]} if kept else {})
    assert said["base"] == provenance and "held_out_error" not in said
    assert facts["accuracy"].startswith(why) and "held out" not in facts["accuracy"]


def test_refused(tiny_float_network_of: Tiny, base: Path, network: Path, tmp_path: Path) -> None:
    """All before anything is written."""
    onnx.save(tiny_float_network_of(4), tmp_path / "float.onnx")
    shifted = onnx.load(network)
    (last,) = [node for node in shifted.graph.node if shifted.graph.output[0].name in node.output]
    while last.op_type != "QuantizeLinear":
        (last,) = [node for node in shifted.graph.node if last.input[0] in node.output]
    for tensor in shifted.graph.initializer:
        if tensor.name == last.input[1]:
            tensor.CopyFrom(numpy_helper.from_array(np.array(1 / 128, np.float32), tensor.name))
    onnx.save(shifted, tmp_path / "shifted.onnx")
    np.savez(tmp_path / "eight.npz", texture=np.zeros((8, 8, 8), np.float16))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    eight = integers(tiny_float_network_of, tmp_path / "eight.onnx", 8)
    cases: list[tuple[Parts, str, str]] = [
        (Parts(), "new", "found no part, expected --network, --texture or --body"),
        (Parts(network=network), "full", "found files, expected a folder that is not there yet"),
        (Parts(network=network), "eight.npz", "found a file, expected a folder that is not there yet"),
        (Parts(network=tmp_path / "float.onnx"), "new", "type FLOAT, expected uint8; .* trilane avatar quantise"),
        (
            Parts(network=integers(tiny_float_network_of, tmp_path / "five.onnx", 5)),
            "new",
            "5 channels, expected 4, 8, 12 or 16, which",
        ),
        (Parts(network=eight), "new", "8 channels, expected 4, as .*texture.npz has; give a --texture of 8 channels"),
        (Parts(texture=tmp_path / "eight.npz"), "new", "8 channels, expected 4, as .* give a --network of 8 channels"),
        (Parts(network=tmp_path / "shifted.onnx"), "new", "scale 0.0078125, zero point 0, expected scale 1/255"),
        (Parts(body=network), "new", "mine.onnx"),
    ]
    for parts, out, said in cases:
        with pytest.raises(BadInputError, match=said):
            assemble(load_bundle(base), parts, tmp_path / out)
    assert not (tmp_path / "new").exists() and (tmp_path / "full" / "mine.txt").read_text() == "mine"


def test_a_body_where_an_avatar_is_expected_is_answered_with_both_ways(command: Command) -> None:
    _, err = command("avatar", "inspect", BODY, code=2)
    assert "a body, which has no texture and no network" in err
    assert "`trilane avatar train`" in err and "`trilane avatar create --body`" in err


OWN = RunOptions(width=8, channels=4)


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
    folder, said = avatar_files.remade_avatar(str(drawable_bundle), OWN)
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
    folder, said = avatar_files.remade_avatar(str(drawable_bundle), remake)
    assert said == "made again: width 4, 8 channels, untrained; minmax on 2 views; its times count, its pictures do not"
    made, own = load_bundle(folder), load_bundle(drawable_bundle)
    assert (made.manifest.network.width, made.manifest.network.channels, views) == (4, 8, [2])
    assert made.read_network().shape == (1, 64, 64, 8)
    assert (made.read_texture() == np.tile(own.read_texture(), 2)).all()
    assert avatar_files.is_untrained(made) and not avatar_files.is_untrained(own)
    facts = accuracy_of(made, DrawnAs("ort", "256", "linear"))
    assert facts["source"] == "no figures" and "untrained" in facts["why"]
    assert avatar_files.remade_avatar(str(drawable_bundle), remake)[0] == folder and views == [2]
    other = avatar_files.remade_avatar(str(drawable_bundle), RunOptions(width=4, channels=8, calibration="minmax:1"))[0]
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
        avatar_files.remade_avatar(str(drawable_bundle), RunOptions(calibration="entropy:1"))
    manifest = json.loads((drawable_bundle / MANIFEST).read_text())
    named = tmp_path / "named"
    named.mkdir()
    for file in drawable_bundle.iterdir():
        (named / file.name).write_bytes(file.read_bytes())
    manifest["quantisation"]["float_network"] = f"own.npz, sha256 {sha256_of([weights])}"
    (named / MANIFEST).write_text(json.dumps(manifest))
    folder, said = avatar_files.remade_avatar(str(named), RunOptions(calibration="minmax:1", width=8))
    made = load_bundle(folder)
    assert said == "made again: minmax on 1 view" and not avatar_files.is_untrained(made)
    assert full_picture.float_weights(made) == weights
    assert views == [1] and made.manifest.quantisation["method"] == "minmax" and made.manifest.validation is None
    assert (made.read_texture() == load_bundle(named).read_texture()).all()


def test_of_several_avatars_none_is_made_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(avatar_files, "remade_avatar", pytest.fail)
    with pytest.raises(BadInputError, match="a scene of 2 avatars"):
        prepare(RunOptions(scene="pair", width=8), pytest.fail)
