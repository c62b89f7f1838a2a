"""Bundles: what is written is read back; whatever is wrong is named by file and key; nothing outside is opened."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from trilane.avatars.bundle import load_bundle, write_bundle
from trilane.avatars.manifest import Manifest, network_entry
from trilane.errors import BadInputError


@pytest.fixture
def copied(tiny_bundle, tmp_path):
    return shutil.copytree(tiny_bundle, tmp_path / "copy")


def edit(folder, **changes):
    """Set keys of the manifest; a dotted key reaches inside (`network__width`)."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    for key, value in changes.items():
        *parents, last = key.split("__")
        target = manifest
        for parent in parents:
            target = target[parent]
        target[last] = value
    path.write_text(json.dumps(manifest))


def test_what_is_written_is_read(tiny_bundle, tiny_quantised):
    bundle = load_bundle(tiny_bundle)
    assert bundle.manifest.name == "tiny" and bundle.manifest.network.channels == 5
    assert bundle.read_texture().shape == (32, 32, 5)
    assert bundle.read_texture().dtype == np.float32
    assert bundle.read_network().digest == tiny_quantised.network.digest
    assert bundle.body_path.is_file()


def test_an_int8_texture_is_scaled(tiny_bundle, tiny_quantised, tmp_path):
    manifest = Manifest(name="int8", network=network_entry(tiny_quantised.network, "resnet18", "batch", 8))
    texture = np.full((4, 4, 5), -3, np.int8)
    scale = np.arange(1, 6)
    write_bundle(tmp_path / "b", manifest, tiny_bundle / "body.npz", texture, tiny_quantised.network, scale)
    assert load_bundle(tmp_path / "b").read_texture()[2, 2] == pytest.approx(-3.0 * scale)


def test_a_bundle_whose_parts_do_not_fit_is_not_written(tiny_bundle, tiny_quantised, tmp_path):
    manifest = Manifest(name="wrong", network=network_entry(tiny_quantised.network, "resnet18", "batch", 8))
    texture = np.zeros((4, 4, 6), np.float16)
    with pytest.raises(BadInputError, match="texture"):
        write_bundle(tmp_path / "b", manifest, tiny_bundle / "body.npz", texture, tiny_quantised.network)
    assert list(tmp_path.iterdir()) == []


WRONG_MANIFEST = {
    "width": ({"network__width": 0}, r"network\.width"),
    "scale 0": ({"network__input": {"scale": 0, "zero_point": 0}}, r"network\.input\.scale"),
    "scale 1e-40": ({"network__input": {"scale": 1e-40, "zero_point": 0}}, r"network\.input\.scale"),
    "scale text": ({"network__input": {"scale": "inf", "zero_point": 0}}, r"network\.input\.scale"),
    "zero point": ({"network__input": {"scale": 1, "zero_point": 256}}, r"network\.input\.zero_point"),
    "unknown key": ({"colour": 1}, "colour"),
    "future version": ({"schema_version": 2}, "schema_version"),
    "outside": ({"body": "../body.npz"}, "outside the bundle"),
    "absolute": ({"texture": "/etc/hostname"}, "outside the bundle"),
    "the folder itself": ({"texture": "."}, "outside the bundle"),
    "missing": ({"network__file": "other.onnx"}, r"other\.onnx"),
    "NaN": ({"betas": [float("nan")]}, "betas"),
}


@pytest.mark.parametrize("case", WRONG_MANIFEST)
def test_wrong_manifests_are_named(copied, case):
    changes, message = WRONG_MANIFEST[case]
    edit(copied, **changes)
    with pytest.raises(BadInputError, match=message):
        load_bundle(copied)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"name": 1}', "[" * 100_000])
def test_manifests_that_are_no_manifest(copied, text):
    (copied / "manifest.json").write_text(text)
    with pytest.raises(BadInputError, match=r"manifest\.json"):
        load_bundle(copied)


def test_a_missing_bundle_is_named(tmp_path):
    with pytest.raises(BadInputError, match="nowhere"):
        load_bundle(tmp_path / "nowhere")


def test_a_link_out_of_the_bundle_is_refused(copied, tmp_path):
    (tmp_path / "body.npz").write_bytes((copied / "body.npz").read_bytes())
    (copied / "body.npz").unlink()
    (copied / "body.npz").symlink_to(tmp_path / "body.npz")
    with pytest.raises(BadInputError, match="outside the bundle"):
        load_bundle(copied)


WRONG_TEXTURE = {
    "NaN": {"texture": np.full((8, 8, 5), np.nan, np.float16)},
    "channels": {"texture": np.zeros((8, 8, 4), np.float16)},
    "flat": {"texture": np.zeros((8, 8), np.float16)},
    "one texel": {"texture": np.zeros((1, 1, 5), np.float16)},
    "integers": {"texture": np.zeros((8, 8, 5), np.int32)},
    "objects": {"texture": np.array([{}])},
    "no scale": {"texture": np.zeros((8, 8, 5), np.int8)},
    "wrong scale": {"texture": np.zeros((8, 8, 5), np.int8), "scale": np.ones(3, np.float32)},
    "NaN scale": {"texture": np.zeros((8, 8, 5), np.int8), "scale": np.float32(np.nan)},
    "other name": {"picture": np.zeros((8, 8, 5), np.float16)},
}


@pytest.mark.parametrize("case", WRONG_TEXTURE)
def test_wrong_textures_are_named(copied, case):
    np.savez(copied / "texture.npz", **WRONG_TEXTURE[case])
    with pytest.raises(BadInputError, match=r"texture\.npz"):
        load_bundle(copied).read_texture()


def test_a_truncated_texture_is_named(copied):
    path = copied / "texture.npz"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(BadInputError, match=r"texture\.npz"):
        load_bundle(copied).read_texture()


def test_a_network_that_is_not_the_manifests_is_named(copied):
    edit(copied, network__input={"scale": 0.5, "zero_point": 3})
    with pytest.raises(BadInputError, match=r"network\.onnx \(input\)"):
        load_bundle(copied).read_network()
    edit(copied, network__channels=6)
    with pytest.raises(BadInputError, match="5 channels"):
        load_bundle(copied).read_network()


def test_a_word_like_default_is_no_folder(tmp_path: Path) -> None:
    """But a folder of that name is one."""
    with pytest.raises(BadInputError, match=r"defalt: found no such folder, expected .*; did you mean 'default'\?"):
        load_bundle(tmp_path / "defalt")
    with pytest.raises(
        BadInputError, match=r"walker: found no such folder, .* or one of default, hiker; docs/own-avatar"
    ):
        load_bundle(tmp_path / "walker")
    (tmp_path / "defalt").mkdir()
    with pytest.raises(BadInputError, match="expected an avatar's manifest"):
        load_bundle(tmp_path / "defalt")
