"""Bundles: what is written is read back; whatever is wrong is named by file and key; nothing outside is opened."""

from __future__ import annotations

import copy
import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.small_inputs import net
from trilane.avatars.bundle import Bundle, bundle_folder, load_bundle, write_bundle
from trilane.avatars.manifest import Manifest, NetworkEntry, network_entry, parse_manifest
from trilane.avatars.network_file import check_network
from trilane.errors import BadInputError


def test_a_bundle_whose_parts_do_not_fit_is_not_written(tiny_bundle, tiny_quantised, tmp_path):
    manifest = Manifest(name="wrong", network=network_entry(tiny_quantised.network, "resnet18", "batch", 8))
    texture = np.zeros((4, 4, 6), np.float16)
    with pytest.raises(BadInputError, match="texture"):
        write_bundle(tmp_path / "b", manifest, tiny_bundle / "body.npz", texture, tiny_quantised.network)
    assert list(tmp_path.iterdir()) == []


def test_a_link_out_of_the_bundle_is_refused(tiny_bundle, tmp_path):
    copied = shutil.copytree(tiny_bundle, tmp_path / "copy")
    (tmp_path / "body.npz").write_bytes((copied / "body.npz").read_bytes())
    (copied / "body.npz").unlink()
    (copied / "body.npz").symlink_to(tmp_path / "body.npz")
    with pytest.raises(BadInputError, match="outside the bundle"):
        load_bundle(copied)


def test_a_word_like_default_is_no_folder(tmp_path: Path) -> None:
    """But a folder of that name is one."""
    with pytest.raises(BadInputError, match=r"defalt: found no such folder, expected .*; did you mean 'default'\?"):
        load_bundle(tmp_path / "defalt")
    with pytest.raises(
        BadInputError, match=r"walker: found no such folder, .* or one of default, hiker, dancer; docs/own-avatar"
    ):
        load_bundle(tmp_path / "walker")
    (tmp_path / "defalt").mkdir()
    with pytest.raises(BadInputError, match="expected an avatar's manifest"):
        load_bundle(tmp_path / "defalt")


# Manifests and bundles by value: each limit on both sides, each refusal with its sentence.

ENTRY = {
    "file": "n.onnx",
    "encoder": "e",
    "norm": "n",
    "width": 8,
    "channels": 3,
    "input": {"scale": 1, "zero_point": 0},
}


def manifest(**changes: Any) -> str:
    entry = {**ENTRY, **changes.pop("network", {})}
    return json.dumps({"name": "a", "network": entry, **changes})


#: Change -> key and beginning of what is expected; "" where the value is fine.
LIMITS: list[tuple[dict[str, Any], str]] = [
    ({"network": {"width": 1}}, ""),
    ({"network": {"width": 257}}, "network.width: found 257 (Input should be less than or equal to 256)"),
    ({"network": {"width": 0}}, "network.width: found 0 (Input should be greater than or equal to 1)"),
    ({"network": {"channels": 64}}, ""),
    ({"network": {"channels": 65}}, "network.channels: found 65 (Input should be less than or equal to 64)"),
    ({"network": {"file": "x" * 201}}, "network.file: found "),
    ({"network": {"input": {"scale": 1e-12, "zero_point": 255}}}, ""),
    ({"network": {"input": {"scale": 0.99e-12, "zero_point": 0}}}, "network.input.scale: found 9.9e-13 ("),
    ({"network": {"input": {"scale": 1, "zero_point": 256}}}, "network.input.zero_point: found 256 ("),
    ({"more": 1}, "more: found 1 (Extra inputs are not permitted), expected a valid manifest"),
    ({"schema_version": 2}, "schema_version: found 2 (Input should be 1)"),
    ({"name": "x" * 101}, f'name: found "{"x" * 56}... ('),
    ({"betas": [0] * 401}, "betas: found ["),
    ({"betas": [0, -100.1]}, "betas.1: found -100.1 ("),
    ({"betas": [float("nan")]}, "betas.0: found "),
    ({"network": {"input": {"scale": "inf", "zero_point": 0}}}, "network.input.scale: found "),
    ({"expression": [0] * 101}, "expression: found ["),
    ({"texture": 3}, "texture: found 3 ("),
    ({"more": "x" * 59}, f'more: found "{"x" * 56}... ('),
]


@pytest.mark.parametrize("case", range(len(LIMITS)))
def test_limits_of_a_manifest_on_either_side(case: int) -> None:
    changes, sentence = LIMITS[case]
    if not sentence:
        parse_manifest(manifest(**copy.deepcopy(changes)), Path("m"))
        return
    with pytest.raises(BadInputError, match=re.escape(f"m: {sentence}")):
        parse_manifest(manifest(**copy.deepcopy(changes)), Path("m"))


@pytest.mark.parametrize("text", ["", "{", "[]", '{"name": 1}', "[" * 100_000])
def test_manifests_that_are_no_manifest(text: str) -> None:
    with pytest.raises(BadInputError, match=r"manifest\.json"):
        parse_manifest(text, Path("manifest.json"))


def test_the_entry_of_a_network() -> None:
    network = check_network(net(), "here")
    entry = network_entry(network, "resnet18", "group", 24)
    assert entry == NetworkEntry.model_validate(
        {
            "file": "network.onnx", "encoder": "resnet18", "norm": "group", "width": 24, "channels": 3,
            "input": {"scale": 0.5, "zero_point": 7}, "output": {"scale": 0.25, "zero_point": 11},
        }
    )  # fmt: skip


def bundle(tmp_path: Path, texture: np.ndarray, scale: Any = None, **entry: Any) -> Bundle:
    """A bundle of the small network, with the default avatar's body."""
    network = check_network(net(), "here")
    values = network_entry(network, "resnet18", "batch", 8).model_dump() | entry
    made = Manifest(name="small", network=NetworkEntry.model_validate(values))
    write_bundle(tmp_path / "b", made, bundle_folder("default") / "body.npz", texture, network, scale)
    return load_bundle(tmp_path / "b")


def test_a_bundle_by_its_files(tmp_path: Path) -> None:
    texture = np.arange(4 * 6 * 3).reshape(4, 6, 3).astype(np.float16)
    made = bundle(tmp_path, texture)
    folder = tmp_path / "b"
    assert (made.folder, made.body_path, made.texture_path, made.network_path) == (
        folder, folder / "body.npz", folder / "texture.npz", folder / "network.onnx",
    )  # fmt: skip
    assert {path.name for path in folder.iterdir()} == {"manifest.json", "body.npz", "texture.npz", "network.onnx"}
    np.testing.assert_array_equal(made.read_texture(), texture.astype(np.float32))
    assert made.read_network().shape == (1, 32, 64, 3)
    assert (folder / "manifest.json").read_text().endswith("}\n")
    assert made.body_path.read_bytes() == (bundle_folder("default") / "body.npz").read_bytes()
    assert bundle_folder("default").name == "default" and bundle_folder("x/y") == Path("x/y")


@pytest.mark.parametrize("scale", [np.array([1, 2, 0.5], np.float32), np.float32(2.0)])
def test_a_texture_of_bytes_is_scaled_by_channel(tmp_path: Path, scale: Any) -> None:
    texture = np.arange(-12, 12).reshape(2, 4, 3).astype(np.int8)
    np.testing.assert_allclose(bundle(tmp_path, texture, scale).read_texture(), texture * scale)


SHAPE = "expected (H, W, 3) with sides of 2 to 4096"
SCALE = "an int8 texture without a usable scale, expected array 'scale', finite, shape (3,)"


TEXTURES: dict[str, tuple[dict[str, Any], str]] = {
    "least": ({"texture": np.zeros((2, 2, 3), np.float32)}, ""),
    "most": ({"texture": np.zeros((4096, 2, 3), np.float16)}, ""),
    "one row": ({"texture": np.zeros((1, 2, 3), np.float16)}, f"a texture of shape (1, 2, 3), {SHAPE}"),
    "one column": ({"texture": np.zeros((2, 1, 3), np.float16)}, f"a texture of shape (2, 1, 3), {SHAPE}"),
    "4097": ({"texture": np.zeros((2, 4097, 3), np.float16)}, f"a texture of shape (2, 4097, 3), {SHAPE}"),
    "channels": ({"texture": np.zeros((2, 2, 4), np.float16)}, f"a texture of shape (2, 2, 4), {SHAPE}"),
    "flat": ({"texture": np.zeros((2, 3), np.float16)}, f"a texture of shape (2, 3), {SHAPE}"),
    "double": (
        {"texture": np.zeros((2, 2, 3))},
        "a texture of float64, expected float16, float32, or int8 with a scale",
    ),
    "NaN": (
        {"texture": np.full((2, 2, 3), np.nan, np.float32)},
        "a texture with NaN or infinite texels, expected finite numbers",
    ),
    "no scale": ({"texture": np.zeros((2, 2, 3), np.int8)}, SCALE),
    "integer scale": ({"texture": np.zeros((2, 2, 3), np.int8), "scale": np.ones(3, int)}, SCALE),
    "two scales": ({"texture": np.zeros((2, 2, 3), np.int8), "scale": np.ones(2, np.float32)}, SCALE),
    "infinite scale": ({"texture": np.zeros((2, 2, 3), np.int8), "scale": np.float32([1, np.inf, 1])}, SCALE),
    "no texture": ({"scale": np.ones(3, np.float32)}, "no array 'texture', expected a neural texture"),
}


@pytest.mark.parametrize("case", TEXTURES)
def test_textures_on_either_side_of_their_limits(tmp_path: Path, case: str) -> None:
    made = bundle(tmp_path, np.zeros((2, 2, 3), np.float16))
    arrays, sentence = TEXTURES[case]
    np.savez(made.texture_path, **arrays)
    if not sentence:
        assert made.read_texture().shape == arrays["texture"].shape
        return
    with pytest.raises(BadInputError) as raised:
        made.read_texture()
    assert str(raised.value) == f"{made.texture_path}: found {sentence}"


@pytest.mark.parametrize("case", ["no texture", "flat"])
def test_levels_need_a_texture(tmp_path: Path, case: str) -> None:
    made = bundle(tmp_path, np.zeros((2, 2, 3), np.float16))
    arrays, sentence = TEXTURES[case]
    np.savez(made.texture_path, levels=np.zeros((1, 1, 3), np.float16), **arrays)
    with pytest.raises(BadInputError) as raised:
        made.read_levels()
    assert str(raised.value) == f"{made.texture_path}: found {sentence}"


def test_a_network_that_contradicts_its_manifest(tmp_path: Path) -> None:
    """Scales may differ by 1e-5 of themselves, zero points and channels not at all."""
    made = bundle(tmp_path, np.zeros((2, 2, 3), np.float16))

    def with_entry(**entry: Any) -> Bundle:
        values = made.manifest.network.model_dump() | entry
        manifest = made.manifest.model_copy(update={"network": NetworkEntry.model_validate(values)})
        return dataclasses.replace(made, manifest=manifest)

    with_entry(input={"scale": 0.5 * (1 + 0.9e-5), "zero_point": 7}).read_network()
    path = made.network_path
    has_in, has_out = "found scale 0.5, zero point 7, expected", "found scale 0.25, zero point 11, expected"
    for entry, sentence in (
        ({"input": {"scale": 0.50001, "zero_point": 7}}, f" (input): {has_in} scale 0.50001, zero point 7 by"),
        ({"input": {"scale": 0.5, "zero_point": 8}}, f" (input): {has_in} scale 0.5, zero point 8 by the manifest"),
        ({"output": {"scale": 0.25, "zero_point": 7}}, f" (output): {has_out} scale 0.25, zero point 7 by the manif"),
        ({"channels": 4}, ": found 3 channels, expected 4 by the manifest"),
    ):
        with pytest.raises(BadInputError, match=re.escape(f"{path}{sentence}")):
            with_entry(**entry).read_network()


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("body", "../x", ": body: found '../x', outside the bundle, expected a file of the bundle's folder"),
        ("texture", ".", ": texture: found '.', outside the bundle, expected a file of the bundle's folder"),
        ("texture", "no.npz", "b/no.npz: found no such file, expected the file that "),
        ("network", "/etc/hostname", ": network.file: found '/etc/hostname', outside the bundle"),
    ],
)
def test_files_of_a_bundle_lie_in_its_folder(tmp_path: Path, key: str, value: str, sentence: str) -> None:
    bundle(tmp_path, np.zeros((2, 2, 3), np.float16))
    path = tmp_path / "b" / "manifest.json"
    content = json.loads(path.read_text())
    if key == "network":
        content["network"]["file"] = value
    else:
        content[key] = value
    path.write_text(json.dumps(content))
    with pytest.raises(BadInputError, match=re.escape(sentence)):
        load_bundle(tmp_path / "b")


def test_a_bundle_with_a_wrong_network_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"\(output\): found scale 0.25"):
        bundle(tmp_path, np.zeros((2, 2, 3), np.float16), output={"scale": 0.5, "zero_point": 11})
    assert not (tmp_path / "b").exists()
