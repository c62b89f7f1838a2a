"""Levels of a mesh as a file of a bundle: kept, checked, and drawn by a run that shows an avatar far off."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.avatars.bundle import add_mesh_levels, load_bundle, write_manifest
from trilane.avatars.mesh_levels import MESH_LEVELS, levels_from_arrays, levels_to_arrays, read_mesh_levels
from trilane.body.body import ShapedBody
from trilane.body.mesh_levels import MeshLevel
from trilane.errors import BadInputError
from trilane.stages.avatar_assets import AvatarData, load_avatar


def coarse(shaped: ShapedBody, every: int, rest_m: float) -> MeshLevel:
    """Each `every`th triangle of the mesh, said to move the surface by `rest_m` in any pose."""
    none = np.zeros((1, 54), np.float32)
    faces, uv_faces = (rows[::every].copy() for rows in (shaped.body.faces, shaped.body.uv_faces))
    return MeshLevel(faces, uv_faces, np.array([rest_m], np.float32), none, none, 0.001)


@pytest.fixture
def levelled(tiny_bundle: Path, tmp_path: Path) -> Path:
    """A bundle with two levels of its mesh."""
    bundle = load_bundle(shutil.copytree(tiny_bundle, tmp_path / "levelled"))
    shaped = bundle.shaped_body()
    add_mesh_levels(bundle, [coarse(shaped, 2, 0.001), coarse(shaped, 40, 0.02)])
    return bundle.folder


def test_levels_are_read_as_they_were_written(levelled: Path) -> None:
    bundle = load_bundle(levelled)
    shaped = bundle.shaped_body()
    levels = bundle.read_mesh_levels(shaped)
    assert [len(level.faces) for level in levels] == [len(shaped.body.faces[::2]), len(shaped.body.faces[::40])]
    np.testing.assert_array_equal(levels[1].uv_faces, shaped.body.uv_faces[::40])
    assert [level.uv_error for level in levels] == [0.001, 0.001]
    assert levels[1].least_m == pytest.approx(0.02)
    again = levels_from_arrays(levels_to_arrays(levels))
    np.testing.assert_array_equal(again[1].faces, levels[1].faces)


def test_an_avatar_without_levels_has_its_whole_mesh(tiny_bundle: Path) -> None:
    data: AvatarData = load_avatar(load_bundle(tiny_bundle))
    assert data.mesh_levels == ()
    assert not (tiny_bundle / MESH_LEVELS).exists()


def test_a_file_that_the_manifest_names_has_to_be_there(levelled: Path) -> None:
    (levelled / MESH_LEVELS).unlink()
    with pytest.raises(BadInputError, match="mesh_levels") as caught:
        load_bundle(levelled)
    assert "mesh-levels.npz" in str(caught.value)


def test_levels_of_another_shape_are_refused(levelled: Path) -> None:
    bundle = load_bundle(levelled)
    write_manifest(levelled, bundle.manifest.model_copy(update={"betas": (1.0,)}))
    taller = load_bundle(levelled)
    with pytest.raises(BadInputError, match="levels of another body") as caught:
        taller.read_mesh_levels(taller.shaped_body())
    assert "trilane avatar levels" in str(caught.value)


@pytest.mark.parametrize(("apart", "is_taken"), [(1e-7, True), (1e-4, False), (np.nan, False)])
def test_last_digits_of_a_sum_are_no_other_body(levelled: Path, apart: float, is_taken: bool) -> None:
    """Another processor, or another number of threads, adds the products of a shape in another order."""
    bundle = load_bundle(levelled)
    shaped = bundle.shaped_body()
    other = replace(shaped, vertices=(shaped.vertices + apart).astype(np.float32), joints=shaped.joints + apart)
    if is_taken:
        assert len(bundle.read_mesh_levels(other)) == 2
    else:
        with pytest.raises(BadInputError, match="levels of another body"):
            bundle.read_mesh_levels(other)


@pytest.mark.parametrize(
    ("key", "value", "match"),
    [
        ("uv_error", None, "no usable array"),
        ("uv_error", np.zeros(9), "no usable array"),
        ("uv_error", np.array([np.nan]), "NaN"),
        ("faces1", None, "no array"),
        ("faces1", np.zeros((0, 3), np.int32), "shape"),
        ("faces1", np.full((1, 3), 1 << 20), "out of range"),
        ("uv_faces2", np.full((642, 3), -1), "out of range"),
        ("faces2", np.zeros((642, 3)), "dtype"),
        ("rest1", np.array([-1.0], np.float32), "negative"),
        ("swing1", np.full((1, 54), np.inf, np.float32), "infinity"),
        ("blend2", np.zeros((2, 54), np.float32), "rows"),
        ("digest", np.zeros(32, np.uint8), "another body"),
        ("measures", None, "another body"),
        ("measures", np.zeros(3), "another body"),
    ],
)
def test_a_damaged_array_is_named(levelled: Path, key: str, value: Any, match: str) -> None:
    file, shaped = levelled / MESH_LEVELS, load_bundle(levelled).shaped_body()
    with np.load(file) as stored:
        arrays = {name: stored[name] for name in stored.files}
    arrays = {name: array for name, array in (arrays | {key: value}).items() if array is not None}
    np.savez(file, allow_pickle=False, **arrays)
    with pytest.raises(BadInputError, match=match) as caught:
        read_mesh_levels(file, shaped)
    assert key in str(caught.value) or match == "another body"
