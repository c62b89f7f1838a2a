"""Body files: read as the layout says, refused in one sentence when anything is wrong with them."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.body.body import Body, load_body
from trilane.errors import BadInputError

Arrays = dict[str, NDArray[Any]]


def save(path: Path, arrays: Arrays) -> Path:
    np.savez_compressed(path, **arrays)
    return path


def load(tmp_path: Path, arrays: Arrays) -> Body:
    return load_body(save(tmp_path / "body.npz", arrays))


def test_reads_every_array(tmp_path: Path, body_arrays: Arrays) -> None:
    """Arrays come back in their shapes, float32 and int32, and cannot be written to."""
    body = load(tmp_path, body_arrays)
    assert body.posedirs is not None
    assert body.has_pose_blend_shapes
    for ours, key in ((body.v_template, "v_template"), (body.posedirs, "posedirs"), (body.weights, "weights")):
        np.testing.assert_array_equal(ours, body_arrays[key])
        assert ours.dtype == np.float32
        assert not ours.flags.writeable
    np.testing.assert_array_equal(body.shape_dirs, body_arrays["shapedirs"][:, :, :10])
    np.testing.assert_array_equal(body.expression_dirs, body_arrays["shapedirs"][:, :, 10:])
    np.testing.assert_array_equal(body.uv_faces, body_arrays["ft"])
    assert body.faces.dtype == np.int32


def test_root_parent_is_never_trusted(tmp_path: Path, body_arrays: Arrays) -> None:
    """Whatever the file says of the root's parent, it is -1."""
    for stored in (0, 54, 2**32 - 1):
        body_arrays["kintree_table"][0, 0] = stored
        assert load(tmp_path, body_arrays).parents[0] == -1


def test_full_files_keep_expression_at_300(tmp_path: Path, body_arrays: Arrays) -> None:
    """In 400-column files betas are columns 0 to 299 and expression starts at 300."""
    columns = np.random.default_rng(0).normal(0, 0.01, (90, 3, 400))
    body = load(tmp_path, body_arrays | {"shapedirs": columns})
    np.testing.assert_array_equal(body.shape_dirs, columns[:, :, :300].astype(np.float32))
    np.testing.assert_array_equal(body.expression_dirs, columns[:, :, 300:].astype(np.float32))


def test_zero_pose_blend_shapes_cost_nothing(tmp_path: Path, body_arrays: Arrays) -> None:
    """All-zero pose blend shapes are recognised and take no memory."""
    body = load(tmp_path, body_arrays | {"posedirs": np.zeros((90, 3, 486))})
    assert body.posedirs is None
    assert not body.has_pose_blend_shapes


def test_float64_and_column_order_are_read(tmp_path: Path, body_arrays: Arrays) -> None:
    """Files in float64 and in Fortran order give the same body."""
    other = {k: np.asfortranarray(v.astype(np.float64)) if v.dtype.kind == "f" else v for k, v in body_arrays.items()}
    ours, same = load(tmp_path, body_arrays), load(tmp_path, other)
    assert ours.posedirs is not None
    assert same.posedirs is not None
    np.testing.assert_array_equal(ours.posedirs, same.posedirs)
    np.testing.assert_array_equal(ours.v_template, same.v_template)


def test_unneeded_pickled_arrays_are_ignored(tmp_path: Path, body_arrays: Arrays) -> None:
    """The published files hold tables of objects beside what is needed; they are never opened."""
    extra = np.array({"a": 1}, dtype=object)
    assert load(tmp_path, body_arrays | {"joint2num": extra, "allow_pickle": np.array(True)}).has_pose_blend_shapes


def _without(key: str) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.__delitem__(key)


def _with(key: str, value: Any) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.__setitem__(key, np.asarray(value))


def _at(key: str, index: tuple[int, ...], value: float) -> Callable[[Arrays], None]:
    return lambda arrays: arrays[key].__setitem__(index, value)


#: What is done to a good file, and what the message must say.
BROKEN: dict[str, tuple[Callable[[Arrays], None], str]] = {
    "no template": (_without("v_template"), "no array 'v_template'"),
    "no uv": (_without("vt"), "no array 'vt'"),
    "no pose blend shapes": (_without("posedirs"), "no array 'posedirs'"),
    "54 joints": (_with("weights", np.ones((90, 54)) / 54), r"weights.*\(90, 54\).*\(90, 55\)"),
    "24 joints in the tree": (_with("kintree_table", np.zeros((2, 24), int)), "kintree_table"),
    "flat template": (_with("v_template", np.zeros(270)), "v_template"),
    "other vertex count": (_with("weights", np.ones((91, 55)) / 55), "weights"),
    "no vertices": (_with("v_template", np.zeros((0, 3))), "shape|0 V"),
    "text": (_with("vt", np.full((9, 2), "a")), "dtype"),
    "fractional faces": (_with("f", np.zeros((5, 3))), "integers"),
    "NaN vertex": (_at("v_template", (3, 1), np.nan), "NaN"),
    "NaN pose blend shape": (_at("posedirs", (3, 1, 7), np.nan), "NaN"),
    "infinite weight": (_at("weights", (3, 1), np.inf), "NaN or infinity"),
    "weights that sum to 2": (_at("weights", (5, 0), 2.0), "sum"),
    "negative weight": (_at("weights", (5, 0), -0.5), "weight"),
    "face beyond the vertices": (_at("f", (0, 0), 90), "indices"),
    "uv beyond the coordinates": (_at("ft", (0, 0), 10**6), "indices"),
    "parent beyond the joints": (_at("kintree_table", (0, 7), 55), "parent 55"),
    "cycle": (_at("kintree_table", (0, 1), 4), "cycle"),
    "15 shape columns": (_with("shapedirs", np.zeros((90, 3, 15))), "15 columns"),
    "pose blend shapes of another body": (_with("posedirs", np.ones((91, 3, 486))), "posedirs"),
    "pickled weights": (_with("weights", np.array([None, {}], dtype=object)), "pickled"),
    "pickled pose blend shapes": (_with("posedirs", np.array([None], dtype=object)), "pickled"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_files_are_refused(tmp_path: Path, body_arrays: Arrays, case: str) -> None:
    """Each names the file and says what is wrong."""
    damage, words = BROKEN[case]
    damage(body_arrays)
    with pytest.raises(BadInputError, match=words) as caught:
        load(tmp_path, body_arrays)
    assert "body.npz" in str(caught.value)


def test_files_that_are_no_archive(tmp_path: Path, body_arrays: Arrays) -> None:
    """Missing, empty, a folder, text, a pickle and a cut archive are refused."""
    whole = save(tmp_path / "whole.npz", body_arrays).read_bytes()
    (tmp_path / "folder.npz").mkdir()
    contents = {"empty.npz": b"", "text.npz": b"body", "pickle.npz": pickle.dumps({"v_template": 1})}
    contents |= {f"cut{share}.npz": whole[: len(whole) * share // 10] for share in (1, 5, 9)}
    for name, data in contents.items():
        (tmp_path / name).write_bytes(data)
    for name in (*contents, "missing.npz", "folder.npz"):
        with pytest.raises(BadInputError, match=name):
            load_body(tmp_path / name)


def test_damaged_data_is_refused(tmp_path: Path, body_arrays: Arrays) -> None:
    """A flipped byte inside an array is found by the archive's checksum."""
    path = tmp_path / "body.npz"
    np.savez(path, allow_pickle=False, **body_arrays)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(BadInputError):
        load_body(path)


def test_huge_header_takes_no_memory(tmp_path: Path, body_arrays: Arrays) -> None:
    """A header that announces terabytes is refused before any memory is taken."""
    for key in ("v_template", "posedirs"):
        path = tmp_path / f"{key}.npz"
        save(path, {name: array for name, array in body_arrays.items() if name != key})
        header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({10**12}, 3, 486), }}"
        header += " " * (63 - (10 + len(header)) % 64) + "\n"
        blob = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(f"{key}.npy", blob)
        with pytest.raises(BadInputError, match=key):
            load_body(path)


def test_shape_is_linear_and_moves_joints(tmp_path: Path, body_arrays: Arrays) -> None:
    """Rest vertices are the template plus components; joints follow by the regressor."""
    body = load(tmp_path, body_arrays)
    betas, expression = [0.5, -2.0, 1.0], [1.5]
    shaped = body.shape(betas, expression)
    dirs = body_arrays["shapedirs"].astype(np.float64)
    expected = body_arrays["v_template"] + dirs[:, :, :3] @ betas + dirs[:, :, 10:11] @ expression
    np.testing.assert_allclose(shaped.vertices, expected, atol=1e-6)
    np.testing.assert_allclose(shaped.joints, body_arrays["J_regressor"].astype(np.float64) @ expected, atol=1e-6)


@pytest.mark.parametrize("betas", [[0.0] * 11, [np.nan], [[1.0, 2.0]]])
def test_bad_shapes_are_refused(tmp_path: Path, body_arrays: Arrays, betas: Any) -> None:
    """Too many, not finite or not a row."""
    with pytest.raises(BadInputError, match="betas"):
        load(tmp_path, body_arrays).shape(betas)


def test_full_pose_adds_the_mean_hand(tmp_path: Path, body_arrays: Arrays) -> None:
    """Only without `flat_hand_mean`, only to the hands, and never in place."""
    body = load(tmp_path, body_arrays)
    poses = np.zeros((2, 165))
    added = body.full_pose(poses, flat_hand_mean=False)
    mean = np.concatenate([body_arrays["hands_meanl"], body_arrays["hands_meanr"]])
    np.testing.assert_array_equal(added[1, 75:], mean)
    assert not added[:, :75].any()
    assert not poses.any()
    assert not body.full_pose(poses, flat_hand_mean=True).any()
    with pytest.raises(BadInputError, match="156"):
        body.full_pose(np.zeros((1, 156)), flat_hand_mean=True)
