"""Offsets of a bundle's body: kept, checked, drawn over joints that stay, and part of the body's digest."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from trilane.avatars.bundle import (
    as_kept,
    bundle_folder,
    load_bundle,
    read_offsets,
    save_offsets,
    write_bundle,
    write_manifest,
)
from trilane.avatars.manifest import digests_of
from trilane.errors import BadInputError
from trilane.units import AVATARS


def some_offsets(vertices: int) -> np.ndarray:
    return np.random.default_rng(0).normal(0, 0.02, (vertices, 3)).astype(np.float32)


@pytest.fixture
def raised(tiny_bundle: Path, tmp_path: Path) -> Path:
    """A bundle whose body has offsets."""
    bundle = load_bundle(tiny_bundle)
    offsets = some_offsets(len(bundle.read_body().v_template))
    texture = bundle.read_texture().astype(np.float16)
    write_bundle(tmp_path / "raised", bundle.manifest, bundle.body_path, texture, bundle.read_network(), None, offsets)
    return tmp_path / "raised"


def test_a_body_is_drawn_with_its_offsets_and_its_joints_stay(raised: Path, tiny_bundle: Path) -> None:
    bare, shaped = load_bundle(tiny_bundle).shaped_body(), load_bundle(raised).shaped_body()
    offsets = as_kept(some_offsets(len(bare.vertices)))
    np.testing.assert_allclose(shaped.vertices, bare.vertices.astype(np.float64) + offsets, atol=2e-7)
    np.testing.assert_array_equal(shaped.joints, bare.joints)
    np.testing.assert_allclose(shaped.bare().vertices, bare.vertices, atol=2e-7)
    assert shaped.bare().body.offsets is None and bare.bare() is bare
    np.testing.assert_array_equal(bare.with_offsets(offsets).vertices, shaped.vertices)
    np.testing.assert_allclose(shaped.with_offsets(-offsets).vertices, bare.vertices - offsets, atol=3e-7)
    assert not shaped.vertices.flags.writeable and not shaped.body.offsets.flags.writeable  # type: ignore[union-attr]


def test_what_is_kept_is_within_16_micrometres(tmp_path: Path) -> None:
    """Half a step of float16 between 3.1 and 6.3 cm is 2^-5 * 2^-11 m."""
    offsets = np.clip(some_offsets(500), -0.0625, 0.0625)
    assert np.abs(as_kept(offsets) - offsets).max() <= 2.0**-16
    save_offsets(tmp_path / "o.npz", offsets)
    np.testing.assert_array_equal(read_offsets(tmp_path / "o.npz", 500), as_kept(offsets))


def test_offsets_are_part_of_the_body_s_digest(raised: Path, tiny_bundle: Path) -> None:
    one, other = load_bundle(raised), load_bundle(tiny_bundle)
    assert digests_of(raised, one.manifest).body != digests_of(tiny_bundle, other.manifest).body
    assert (one.manifest.offsets, other.manifest.offsets) == ("offsets.npz", None)
    save_offsets(raised / "offsets.npz", some_offsets(len(one.read_body().v_template))[::-1])
    assert (
        digests_of(raised, one.manifest).body
        != digests_of(raised, one.manifest.model_copy(update={"offsets": None})).body
    )


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"other": np.zeros((4, 3))}, "no array 'offsets'"),
        ({"offsets": np.zeros((5, 3))}, r"shape \(5, 3\), expected floating-point numbers of shape \(4, 3\)"),
        ({"offsets": np.zeros((4, 3), np.int32)}, "int32 of shape"),
        ({"offsets": np.full((4, 3), np.nan)}, "not finite or too long, expected at most 0.5 m"),
        ({"offsets": np.full((4, 3), 1e300)}, "not finite or too long"),
        ({"offsets": np.full((4, 3), 0.3)}, "not finite or too long"),
    ],
)
def test_a_file_that_is_none_of_this_body_is_refused(arrays: dict[str, np.ndarray], said: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "o.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match=said):
        read_offsets(tmp_path / "o.npz", 4)


def test_a_manifest_s_offsets_lie_in_its_folder(raised: Path, tmp_path: Path) -> None:
    shutil.copy(raised / "offsets.npz", tmp_path / "away.npz")
    manifest = load_bundle(raised).manifest
    for name in ("../away.npz", "missing.npz"):
        write_manifest(raised, manifest.model_copy(update={"offsets": name}))
        with pytest.raises(BadInputError, match=r"offsets|missing"):
            load_bundle(raised)


#: How far clothes and hair of each avatar may stand off, in metres: a skirt spans the gap between the legs.
STAND_OFF_M = {"default": 0.1, "hiker": 0.1, "dancer": 0.2}


@pytest.mark.parametrize("name", AVATARS)
def test_avatars_of_the_package_wear_clothes_and_their_figures_are_of_their_files(name: str) -> None:
    """Clothes stand off by a centimetre or two in the mean, hair and shoes by some more."""
    bundle = load_bundle(name)
    length = np.linalg.norm(bundle.read_body().offsets, axis=1)  # type: ignore[arg-type]
    assert 0.005 < length.mean() < 0.03 and 0.03 < length.max() < STAND_OFF_M[name]
    assert bundle.manifest.name == name and bundle.folder == bundle_folder(name)
    assert bundle.manifest.validation is not None
    assert bundle.manifest.validation.digests == digests_of(bundle.folder, bundle.manifest)
