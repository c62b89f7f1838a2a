"""Body files: read as the layout says, refused in one sentence; tables and formulas against second sources."""

from __future__ import annotations

import dataclasses
import io
import pickle
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.body import body as body_module
from trilane.body.body import Body, ShapedBody, load_body, read_pose_blend
from trilane.body.joints import (
    JOINT_INDEX,
    JOINT_NAMES,
    JOINT_PARENTS,
    JOINTS,
    LEFT_HAND,
    POSE_FEATURES,
    POSE_SIZE,
    RIGHT_HAND,
    Skeleton,
)
from trilane.body.skinning import (
    CpuSkinner,
    FrameSkinner,
    blend_matrices,
    branch_sums,
    joint_distance,
    posed_vertices,
    weight_error_bound,
)
from trilane.errors import BadInputError

Arrays = dict[str, NDArray[Any]]


def loaded(tmp_path: Path, arrays: Arrays) -> Body:
    np.savez(tmp_path / "body.npz", allow_pickle=False, **arrays)
    return load_body(tmp_path / "body.npz")


def test_float64_and_column_order_are_read(tmp_path: Path, body_arrays: Arrays) -> None:
    other = {k: np.asfortranarray(v.astype(np.float64)) if v.dtype.kind == "f" else v for k, v in body_arrays.items()}
    ours, same = loaded(tmp_path, body_arrays), loaded(tmp_path, other)
    assert ours.posedirs is not None
    assert same.posedirs is not None
    np.testing.assert_array_equal(ours.posedirs, same.posedirs)
    np.testing.assert_array_equal(ours.v_template, same.v_template)


def test_files_that_are_no_archive(tmp_path: Path, body_arrays: Arrays) -> None:
    np.savez_compressed(tmp_path / "whole.npz", allow_pickle=False, **body_arrays)
    whole = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "folder.npz").mkdir()
    contents = {"empty.npz": b"", "text.npz": b"body", "pickle.npz": pickle.dumps({"v_template": 1})}
    contents |= {f"cut{share}.npz": whole[: len(whole) * share // 10] for share in (1, 5, 9)}
    for name, data in contents.items():
        (tmp_path / name).write_bytes(data)
    for name in (*contents, "missing.npz", "folder.npz"):
        with pytest.raises(BadInputError, match=name):
            load_body(tmp_path / name)


def test_damaged_data_is_refused(tmp_path: Path, body_arrays: Arrays) -> None:
    path = tmp_path / "body.npz"
    np.savez(path, allow_pickle=False, **body_arrays)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(BadInputError):
        load_body(path)


def test_huge_header_takes_no_memory(tmp_path: Path, body_arrays: Arrays) -> None:
    for key in ("v_template", "posedirs"):
        path = tmp_path / f"{key}.npz"
        np.savez_compressed(path, **{name: array for name, array in body_arrays.items() if name != key})
        header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({10**12}, 3, 486), }}"
        header += " " * (63 - (10 + len(header)) % 64) + "\n"
        blob = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(f"{key}.npy", blob)
        with pytest.raises(BadInputError, match=key):
            load_body(path)


def test_the_skin_is_the_body_without_its_garments(tmp_path: Path, body_arrays: Arrays) -> None:
    """The last ten vertices and the faces that use one of them are a garment; the skin has the same joints."""
    is_skin = (body_arrays["f"] < 80).all(axis=1)
    order = np.argsort(~is_skin, kind="stable")
    body_arrays["f"], body_arrays["ft"] = body_arrays["f"][order], body_arrays["ft"][order]
    body_arrays["J_regressor"][:, 80:] = 0
    faces = int(is_skin.sum())
    whole = loaded(tmp_path, body_arrays).shape((1.0,), (0.5,))
    assert faces > 0 and whole.bare() is whole
    body_arrays["skin"] = np.array([80, faces])
    dressed = loaded(tmp_path, body_arrays).shape((1.0,), (0.5,)).with_offsets(np.full((90, 3), 0.25, np.float32))
    np.testing.assert_allclose(dressed.vertices, whole.vertices + 0.25, atol=2e-7)
    bare = dressed.bare()
    np.testing.assert_allclose(bare.vertices, whole.vertices[:80], atol=2e-7)
    np.testing.assert_array_equal(bare.joints, whole.joints)
    np.testing.assert_array_equal(bare.body.faces, body_arrays["f"][:faces])
    np.testing.assert_array_equal(bare.body.uv_faces, body_arrays["ft"][:faces])
    np.testing.assert_array_equal(bare.body.weights, whole.body.weights[:80])
    assert whole.body.posedirs is not None and bare.body.posedirs is not None
    np.testing.assert_array_equal(bare.body.posedirs, whole.body.posedirs[:80])
    assert not any(array.flags.writeable for array in (bare.vertices, bare.body.weights, bare.body.posedirs))
    np.testing.assert_allclose(bare.body.shape((1.0,), (0.5,)).vertices, whole.vertices[:80], atol=1e-6)
    np.testing.assert_allclose(bare.body.shape((1.0,), (0.5,)).joints, whole.joints, atol=1e-6)


def test_full_pose_adds_the_mean_hand(tmp_path: Path, body_arrays: Arrays) -> None:
    body = loaded(tmp_path, body_arrays)
    poses = np.zeros((2, 165))
    added = body.full_pose(poses, flat_hand_mean=False)
    mean = np.concatenate([body_arrays["hands_meanl"], body_arrays["hands_meanr"]])
    np.testing.assert_array_equal(added[1, 75:], mean)
    assert not added[:, :75].any()
    assert not poses.any()
    assert not body.full_pose(poses, flat_hand_mean=True).any()
    with pytest.raises(BadInputError, match="156"):
        body.full_pose(np.zeros((1, 156)), flat_hand_mean=True)


#: The first 55 of JOINT_NAMES in the published smplx package (smplx/joint_names.py, vchoutas/smplx), as listed there.
PUBLISHED = """
pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot right_foot neck
left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist jaw
left_eye_smplhf right_eye_smplhf
left_index1 left_index2 left_index3 left_middle1 left_middle2 left_middle3 left_pinky1 left_pinky2 left_pinky3
left_ring1 left_ring2 left_ring3 left_thumb1 left_thumb2 left_thumb3
right_index1 right_index2 right_index3 right_middle1 right_middle2 right_middle3 right_pinky1 right_pinky2 right_pinky3
right_ring1 right_ring2 right_ring3 right_thumb1 right_thumb2 right_thumb3
"""
#: The limbs of the skeleton from the root outwards; each name's parent is the one before it.
CHAINS = """
pelvis left_hip left_knee left_ankle left_foot
pelvis right_hip right_knee right_ankle right_foot
pelvis spine1 spine2 spine3 neck head jaw
head left_eye
head right_eye
spine3 left_collar left_shoulder left_elbow left_wrist
spine3 right_collar right_shoulder right_elbow right_wrist
"""


def test_joint_names_are_the_published_ones_in_their_order() -> None:
    assert list(JOINT_NAMES) == [name.removesuffix("_smplhf") for name in PUBLISHED.split()]
    assert len(JOINT_NAMES) == JOINTS == 55
    assert [JOINT_INDEX[name] for name in JOINT_NAMES] == list(range(55))
    assert (POSE_SIZE, POSE_FEATURES) == (165, 486)
    assert (JOINT_NAMES.index("left_index1"), JOINT_NAMES.index("right_index1")) == (25, 40)
    assert (LEFT_HAND.start, LEFT_HAND.stop, RIGHT_HAND.start, RIGHT_HAND.stop) == (75, 120, 120, 165)


def test_every_joint_hangs_on_the_joint_before_it_in_its_limb() -> None:
    parents = {"pelvis": None}
    for line in CHAINS.strip().splitlines():
        names = line.split()
        parents |= dict(zip(names[1:], names[:-1], strict=True))
    for side in ("left", "right"):
        for finger in ("thumb", "index", "middle", "ring", "pinky"):
            chain = [f"{side}_wrist", *(f"{side}_{finger}{part}" for part in (1, 2, 3))]
            parents |= dict(zip(chain[1:], chain[:-1], strict=True))
    found = [None if parent < 0 else JOINT_NAMES[parent] for parent in JOINT_PARENTS]
    assert found == [parents[name.removesuffix("_smplhf")] for name in PUBLISHED.split()]


def test_the_default_body_has_the_published_tree() -> None:
    stored = np.load(Path(body_module.__file__).parents[1] / "avatars/default/body.npz")["kintree_table"]
    assert stored[0].astype(np.int32).tolist()[1:] == list(JOINT_PARENTS)[1:]


# --- the body file ---


def test_every_array_of_the_file_is_where_its_name_says(tmp_path: Path, body_arrays: Arrays) -> None:
    body_arrays["hands_componentsl"], body_arrays["hands_componentsr"] = (
        np.full((k, 45), k, np.float32) for k in (6, 12)
    )
    body = loaded(tmp_path, body_arrays)
    assert body.source == str(tmp_path / "body.npz")
    for ours, key in (
        (body.v_template, "v_template"),
        (body.posedirs, "posedirs"),
        (body.weights, "weights"),
        (body.j_regressor, "J_regressor"),
        (body.faces, "f"),
        (body.uv, "vt"),
        (body.uv_faces, "ft"),
        (body.hand_components[0], "hands_componentsl"),
        (body.hand_components[1], "hands_componentsr"),
    ):
        assert ours is not None and not ours.flags.writeable
        np.testing.assert_array_equal(ours, body_arrays[key])
        assert ours.dtype == (np.int32 if key in ("f", "ft") else np.float32)
    assert body.has_pose_blend_shapes
    np.testing.assert_array_equal(body.hand_mean[:45], body_arrays["hands_meanl"])
    np.testing.assert_array_equal(body.hand_mean[45:], body_arrays["hands_meanr"])
    assert body.parents.tolist() == [-1, *JOINT_PARENTS[1:]]
    shaped = body.shape()
    for array in (shaped.vertices, shaped.joints, body.parents, body.posedirs, body.shape_dirs, body.hand_mean):
        assert array is not None and not array.flags.writeable
    assert shaped.body is body


NEAR = "expected a body file in the SMPL-X layout (.npz); arrays that were found: "
FINITE = "found NaN or infinity, expected finite numbers"
#: An array, what stands in its place (None: nothing), and what the message says.
BROKEN: list[tuple[str, Any, str]] = [
    ("f", None, f"no array 'f', {NEAR}J_regressor, ft"),
    ("vt", None, f"no array 'vt', {NEAR}J_regressor, f"),
    ("vt", np.full((9, 2), "a"), "[vt]: found dtype <U1, expected numbers"),
    ("f", np.zeros((5, 3)), "[f]: found dtype float64, expected integers"),
    ("vt", np.zeros((130, 3)), "[vt]: found shape (130, 3), expected (130, 2)"),
    ("ft", np.zeros((121, 3), int), "[ft]: found shape (121, 3), expected (120, 3)"),
    ("v_template", np.zeros((0, 3)), "[shapedirs]: found shape (90, 3, 20), expected (0, 3, *)"),
    ("weights", np.ones((91, 55)) / 55, "[weights]: found shape (91, 55), expected (90, 55)"),
    ("posedirs", np.ones((91, 3, 486)), "[posedirs]: found shape (91, 3, 486), expected (90, 3, 486)"),
    ("shapedirs", np.zeros((90, 2, 20)), "[shapedirs]: found shape (90, 2, 20), expected (90, 3, *)"),
    ("J_regressor", np.zeros((54, 90)), "[J_regressor]: found shape (54, 90), expected (55, 90)"),
    ("kintree_table", np.zeros((3, 55), int), "[kintree_table]: found shape (3, 55), expected (2, 55)"),
    ("hands_meanl", np.zeros(44), "[hands_meanl]: found shape (44,), expected (45)"),
    ("hands_meanr", np.zeros(46), "[hands_meanr]: found shape (46,), expected (45)"),
    ("hands_componentsl", np.zeros((6, 44)), "[hands_componentsl]: found shape (6, 44), expected (*, 45)"),
    ("hands_componentsr", np.zeros((6, 46)), "[hands_componentsr]: found shape (6, 46), expected (*, 45)"),
    ("J_regressor", np.full((55, 90), 1e39), f"[J_regressor]: {FINITE}"),
    ("v_template", np.where(np.eye(90, 3, -1), np.nan, 0.0), f"[v_template]: {FINITE}"),
    ("weights", np.where(np.eye(90, 55, 1), np.inf, 0.0), f"[weights]: {FINITE}"),
    ("shapedirs", np.zeros((90, 3, 19)), "found 19 columns, expected 400 (betas, expression from 300) or 20 (from 10)"),
    ("skin", np.array([1, 2, 3]), "two integers"),
    ("skin", np.array([1.0, 2.0]), "two integers"),
    ("skin", np.array([0, 2]), "1 to 90 vertices"),
    ("skin", np.array([90, 10**6]), "1 to 90 vertices, 1 to"),
    ("skin", np.array([1, 2]), "a face of the skin"),
    ("skin", np.array([89, 1]), "a joint that depends"),
]


@pytest.mark.parametrize(("key", "value", "sentence"), BROKEN)
def test_a_broken_file_is_refused_in_one_sentence(
    tmp_path: Path, body_arrays: Arrays, key: str, value: Any, sentence: str
) -> None:
    arrays = {name: array for name, array in body_arrays.items() if name != key}
    with pytest.raises(BadInputError, match=re.escape(sentence)) as raised:
        loaded(tmp_path, arrays if value is None else arrays | {key: value})
    assert "body.npz" in str(raised.value)


@pytest.mark.parametrize("key", ["weights", "posedirs"])
def test_pickled_arrays_are_not_read(tmp_path: Path, body_arrays: Arrays, key: str) -> None:
    pickled: Any = body_arrays | {key: np.array([None, {}], dtype=object)}
    np.savez(tmp_path / "body.npz", **pickled)
    with pytest.raises(BadInputError, match=r"body.npz.*pickled"):
        load_body(tmp_path / "body.npz")


def changed(arrays: Arrays, key: str, index: tuple[int, ...], value: float) -> Arrays:
    array = arrays[key].copy()
    array[index] = value
    return arrays | {key: array}


def test_indices_may_reach_the_last_vertex_and_no_further(tmp_path: Path, body_arrays: Arrays) -> None:
    signed = body_arrays | {key: body_arrays[key].astype(np.int64) for key in ("f", "ft")}
    for key, last, of in (("f", 89, "vertices"), ("ft", 129, "texture coordinates")):
        loaded(tmp_path, changed(changed(signed, key, (0, 0), last), key, (0, 1), 0))
        said = f"[{key}]: found indices from 0 to {last + 1}, expected 0 to {last}, the {of}"
        with pytest.raises(BadInputError, match=re.escape(said)):
            loaded(tmp_path, changed(changed(signed, key, (0, 0), last + 1), key, (0, 1), 0))
        with pytest.raises(BadInputError, match="indices from -1 to"):
            loaded(tmp_path, changed(signed, key, (0, 0), -1))


def test_weights_may_miss_1_and_0_by_a_thousandth(tmp_path: Path, body_arrays: Arrays) -> None:
    rigid = np.zeros((90, 55), np.float32)
    rigid[:, 3] = 1.0
    for extra, fine in ((0.0009, True), (-0.0009, True), (0.0011, False), (-0.0011, False)):
        arrays = changed(body_arrays | {"weights": rigid}, "weights", (7, 3), 1.0 + extra)
        if fine:
            loaded(tmp_path, arrays)
        else:
            with pytest.raises(BadInputError, match=f"a sum of {1 + extra:.4g} at vertex 7, expected rows that sum to"):
                loaded(tmp_path, arrays)
    loaded(tmp_path, changed(body_arrays | {"weights": rigid}, "weights", (7, 4), -0.0009))
    with pytest.raises(BadInputError, match=r"a weight of -0.0011, expected weights of at least 0"):
        loaded(tmp_path, changed(body_arrays | {"weights": rigid}, "weights", (7, 4), -0.0011))


def test_a_tree_may_have_any_order_but_no_cycle(tmp_path: Path, body_arrays: Arrays) -> None:
    chain = np.array([0, *range(2, 55), 0])  # joint 54 hangs on the root, every other one on the joint after it
    tree = np.array([chain, range(55)])
    assert loaded(tmp_path, body_arrays | {"kintree_table": tree}).parents.tolist() == [-1, *chain[1:]]
    tree[0, 54] = 1
    with pytest.raises(BadInputError, match="found a cycle through joint 1, expected a tree whose root is joint 0"):
        loaded(tmp_path, body_arrays | {"kintree_table": tree})
    for parent in (55, -1):
        tree[0, 54] = parent
        with pytest.raises(BadInputError, match=f"found parent {parent} at joint 54, expected 0 to 54"):
            loaded(tmp_path, body_arrays | {"kintree_table": tree})


@pytest.mark.parametrize(
    ("columns", "betas", "expression"), [(20, 10, 10), (399, 10, 10), (400, 300, 100), (450, 300, 100)]
)
def test_columns_of_shape_and_expression(
    tmp_path: Path, body_arrays: Arrays, columns: int, betas: int, expression: int
) -> None:
    dirs = np.broadcast_to(np.arange(columns, dtype=np.float32), (90, 3, columns))
    body = loaded(tmp_path, body_arrays | {"shapedirs": dirs})
    assert body.shape_dirs[4, 1].tolist() == list(range(betas))
    assert body.expression_dirs[4, 1].tolist() == list(range(betas, betas + expression))


def test_coefficients_up_to_the_last_column(tmp_path: Path, body_arrays: Arrays) -> None:
    body = loaded(tmp_path, body_arrays)
    full = body.shape(np.ones(10), np.ones(10)).vertices
    np.testing.assert_allclose(
        full, body_arrays["v_template"] + body_arrays["shapedirs"].astype(np.float64).sum(axis=2), atol=1e-6
    )
    np.testing.assert_allclose(body.shape(2.0).vertices, body.shape([2.0]).vertices)
    for name, wrong, found in (
        ("betas", {"betas": np.ones(11)}, "an array of shape (11,)"),
        ("betas", {"betas": [[1.0, 2.0]]}, "an array of shape (1, 2)"),
        ("expression", {"expression": np.ones(11)}, "an array of shape (11,)"),
        ("expression", {"expression": [np.inf]}, "NaN or infinity"),
    ):
        with pytest.raises(BadInputError) as raised:
            body.shape(**wrong)
        assert str(raised.value) == f"{name}: found {found}, expected at most 10 finite numbers"
    for huge in (1e42, 1e300):
        with pytest.raises(BadInputError, match=r"^betas and expression: found vertices that are not finite, "):
            body.shape([huge, -huge])
    with pytest.raises(BadInputError, match=r"poses: found shape \(\), expected \(..., 165\)"):
        body.full_pose(1.0, flat_hand_mean=True)


# --- pose blend shapes ---


def npz_with(path: Path, array: NDArray[Any]) -> Path:
    np.savez(path, posedirs=array)
    return path


def test_pose_blend_shapes_come_in_chunks_and_in_either_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks of 10 numbers, the first of them zeros; float64 in Fortran order gives the same numbers."""
    monkeypatch.setattr(body_module, "_CHUNK_ITEMS", 10)
    array = np.arange(42, dtype=np.float32).reshape(7, 3, 2)
    array[:3] = 0.0
    for stored in (array, np.asfortranarray(array.astype(np.float64)), array.astype(np.int16)):
        read = read_pose_blend(npz_with(tmp_path / "a.npz", stored), (7, 3, 2))
        assert read is not None and read.dtype == np.float32 and not read.flags.writeable
        np.testing.assert_array_equal(read, array)
    assert read_pose_blend(npz_with(tmp_path / "a.npz", np.zeros((7, 3, 2))), (7, 3, 2)) is None


WRONG_BLEND = {
    "text": (np.full((7, 3, 2), "a"), "[posedirs]: found dtype <U1, expected numbers"),
    "shape": (np.ones((7, 2, 3)), "[posedirs]: found shape (7, 2, 3), expected (7, 3, 2)"),
    "late NaN": (np.append(np.ones(41), np.nan).reshape(7, 3, 2), "[posedirs]: found NaN or infinity, expected finite"),
    "too large": (np.full((7, 3, 2), 1e39), "[posedirs]: found NaN or infinity, expected finite numbers"),
}


@pytest.mark.parametrize("case", WRONG_BLEND)
def test_wrong_pose_blend_shapes_are_refused(tmp_path: Path, case: str) -> None:
    array, sentence = WRONG_BLEND[case]
    with pytest.raises(BadInputError, match=re.escape(sentence)):
        read_pose_blend(npz_with(tmp_path / "a.npz", array), (7, 3, 2))


def test_pose_blend_shapes_have_a_largest_size_and_all_their_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = npz_with(tmp_path / "a.npz", np.ones((7, 3, 2)))
    monkeypatch.setattr(body_module, "MAX_POSE_BLEND_BYTES", 42 * 8)
    assert read_pose_blend(path, (7, 3, 2)) is not None
    monkeypatch.setattr(body_module, "MAX_POSE_BLEND_BYTES", 42 * 8 - 1)
    with pytest.raises(
        BadInputError, match=r"a.npz\[posedirs\]: found shape \(7, 3, 2\) of float64, expected at most 335 bytes"
    ):
        read_pose_blend(path, (7, 3, 2))
    whole = io.BytesIO()
    np.save(whole, np.ones((7, 3, 2)))
    cut = io.BytesIO(whole.getvalue()[:-1])
    monkeypatch.undo()
    with pytest.raises(BadInputError, match="x: found truncated data, expected 336 bytes by its own header"):
        body_module._read_pose_blend("x", cut, (7, 3, 2))
    np.savez(path, other=np.ones(3))
    with pytest.raises(BadInputError, match=r"no array 'posedirs', expected a body file in the SMPL-X layout \(.npz\)"):
        read_pose_blend(path, (7, 3, 2))
    path.write_bytes(b"no archive")
    with pytest.raises(
        BadInputError, match=r"no readable .npz archive \(File is not a zip file\), expected a body file"
    ):
        read_pose_blend(path, (7, 3, 2))


# --- kinematics ---


def test_numbers_below_a_million_are_posed() -> None:
    skeleton = Skeleton(np.zeros((55, 3)), np.array(JOINT_PARENTS, np.int32))
    pose = np.zeros(165)
    pose[7] = 1e6
    skeleton.pose(pose)
    skeleton.pose(np.zeros(165), [9.9e5, 0, 0])
    pose[7] = 1.001e6
    for arguments, sentence in (
        ((pose,), "pose: found NaN, infinity or a huge number, expected joint angles below 1e6 rad"),
        ((np.zeros(165), [1.001e6, 0, 0]), "place of the body: found NaN, infinity or a huge number, expected metres"),
    ):
        with pytest.raises(BadInputError, match=re.escape(sentence)):
            skeleton.pose(*arguments)


# --- skinning ---


def big(shaped: ShapedBody, rows: int, blend: bool) -> ShapedBody:
    """The body with its vertices repeated to `rows`, so that skinning takes more than one block."""
    pick = np.arange(rows) % len(shaped.vertices)
    body = shaped.body
    assert body.posedirs is not None
    posedirs = body.posedirs[pick] if blend else None
    vertices = shaped.vertices[pick] + np.linspace(0, 0.1, rows, dtype=np.float32)[:, None]
    return ShapedBody(vertices, shaped.joints, dataclasses.replace(body, weights=body.weights[pick], posedirs=posedirs))


def vertex_by_vertex(shaped: ShapedBody, pose: NDArray[Any], blend: bool) -> NDArray[np.float64]:
    """x = sum_j w_j G_j (p + posedirs (R - I)), one vertex and one joint at a time."""
    posed = Skeleton(shaped.joints, shaped.body.parents).pose(pose)
    result = np.zeros((len(shaped.vertices), 3))
    for v, rest in enumerate(shaped.vertices.astype(np.float64)):
        point = rest.copy()
        if blend and shaped.body.posedirs is not None:
            point += shaped.body.posedirs[v].astype(np.float64) @ posed.feature
        for j in np.flatnonzero(shaped.body.weights[v]):
            matrix = posed.matrices[j].astype(np.float64)
            result[v] += shaped.body.weights[v, j] * (matrix[:, :3] @ point + matrix[:, 3])
    return result


@pytest.mark.parametrize("rows", [90, 256, 300, 515])
@pytest.mark.parametrize("blend", [True, False])
def test_both_skinners_equal_a_loop_over_vertices(shaped: ShapedBody, rows: int, blend: bool) -> None:
    many = big(shaped, rows, blend)
    pose = np.random.default_rng(rows).normal(0, 0.7, 165)
    expected = vertex_by_vertex(many, pose, blend)
    posed = Skeleton(many.joints, many.body.parents).pose(pose)
    np.testing.assert_allclose(CpuSkinner(many).vertices(posed), expected, atol=1e-6)
    vertices = np.full((rows, 3), np.nan, np.float32)
    FrameSkinner(many).skin_into(posed, vertices)
    np.testing.assert_allclose(vertices, expected, atol=1e-5)
    np.testing.assert_allclose(
        CpuSkinner(many, pose_blend=False).vertices(posed), vertex_by_vertex(many, pose, False), atol=1e-6
    )


def test_products_in_blocks_are_products() -> None:
    random = np.random.default_rng(0)
    for rows in (1, 255, 256, 257, 600):
        weights, per_joint = random.normal(size=(rows, 55)), random.normal(size=(55, 12))
        np.testing.assert_allclose(blend_matrices(weights, per_joint), weights @ per_joint, atol=1e-12)


def test_each_posed_mesh_is_that_of_its_pose(shaped: ShapedBody) -> None:
    poses = np.random.default_rng(3).normal(0, 0.5, (3, 165))
    for pose, mesh in zip(poses, posed_vertices(shaped, poses, [0.0, 2.0, 0.0]), strict=True):
        np.testing.assert_allclose(mesh - [0, 2, 0], vertex_by_vertex(shaped, pose, True), atol=2e-6)


# --- the bound on what leaving out weights costs ---


def test_branch_sums_and_distances_by_hand() -> None:
    parents = np.array([-1, 0, 1, 0], np.int32)
    assert branch_sums(parents, np.array([[1.0, 10.0, 100.0, 1000.0]])).tolist() == [[1111.0, 110.0, 100.0, 1000.0]]


def two_joints(shaped: ShapedBody, loser: str) -> ShapedBody:
    """One vertex, 0.3 m from joint `loser`: four joints of the trunk with 0.2375 each, and `loser`."""
    joint = JOINT_INDEX[loser]
    weights = np.zeros((1, 55), np.float32)
    weights[0, [0, 3, 6, 9]] = 0.2375
    weights[0, joint] = 0.05
    vertex = (shaped.joints[joint] + [0.0, 0.3, 0.0]).astype(np.float32)[None]
    return ShapedBody(vertex, shaped.joints, dataclasses.replace(shaped.body, weights=weights, posedirs=None))


def test_the_bound_is_the_sum_over_branches_by_hand(shaped: ShapedBody) -> None:
    """Leaving out the head's 0.05 adds 0.0125 to pelvis, spine1, spine2 and spine3 each; the branches' sums follow."""
    one = two_joints(shaped, "head")
    distance = {name: float(np.linalg.norm(one.vertices[0] - one.joints[JOINT_INDEX[name]])) for name in JOINT_NAMES}
    assert joint_distance(one)[0] == pytest.approx([distance[name] for name in JOINT_NAMES])
    assert distance["head"] == pytest.approx(0.3)
    sums = {"spine1": -0.0125, "spine2": -0.025, "spine3": -0.0375, "neck": -0.05, "head": -0.05}
    expected = sum(abs(change) * 2 * distance[name] for name, change in sums.items())
    assert weight_error_bound(one, 4)[0] == pytest.approx(expected, rel=1e-5)
    assert weight_error_bound(one, 8)[0] == pytest.approx(0.0, abs=1e-6)


def test_the_bound_is_reached_where_one_joint_turns_half_round(shaped: ShapedBody) -> None:
    """All kept weights on the neck: the head's half turn moves the vertex by 0.05 of twice its distance, no less."""
    exact = np.zeros((1, 55), np.float32)
    exact[0, [JOINT_INDEX["neck"], JOINT_INDEX["head"]]] = 0.95, 0.05
    vertex = (shaped.joints[JOINT_INDEX["head"]] + [0.0, 0.3, 0.0]).astype(np.float32)[None]
    body = dataclasses.replace(shaped.body, weights=exact, posedirs=None)
    one = ShapedBody(vertex, shaped.joints, body)
    pose = np.zeros(165)
    pose[3 * JOINT_INDEX["head"]] = np.pi
    posed = Skeleton(one.joints, body.parents).pose(pose)
    whole = CpuSkinner(one).vertices(posed)[0]
    neck_only = dataclasses.replace(body, weights=np.eye(55, dtype=np.float32)[[JOINT_INDEX["neck"]]])
    fewer = CpuSkinner(ShapedBody(vertex, shaped.joints, neck_only)).vertices(posed)[0]
    assert np.linalg.norm(whole - fewer) == pytest.approx(0.05 * 2 * 0.3, rel=1e-5)


@pytest.mark.parametrize("keys", ["mocap_framerate, poses, trans", "fps, trans"])
def test_a_motion_is_said_to_be_one(tmp_path: Path, keys: str) -> None:
    np.savez(tmp_path / "m.npz", **dict.fromkeys(keys.split(", "), np.zeros(1)))
    with pytest.raises(BadInputError) as raised:
        load_body(tmp_path / "m.npz")
    assert raised.value.remedy == f"arrays that were found: {keys}: a motion, which `trilane run --motion` takes"
    np.savez(tmp_path / "m.npz", **{f"a{k:02}": np.zeros(1) for k in range(18)})
    with pytest.raises(BadInputError) as raised:
        load_body(tmp_path / "m.npz")
    assert raised.value.remedy.endswith("a14, a15 and 2 more")


def tall(arrays: Arrays, height: float) -> Arrays:
    """The arrays of a body whose lowest and highest vertices are `height` apart."""
    places = arrays["v_template"].astype(np.float64)
    low, high = places[:, 1].min(), places[:, 1].max()
    return {**arrays, "v_template": places * (height / (high - low))}


@pytest.mark.parametrize(("height", "unit"), [
    (176.0, "1.76 m if they are centimetres, so multiply v_template and shapedirs by 0.01"),
    (1760.0, "1.76 m if they are millimetres, so multiply v_template and shapedirs by 0.001"),
    (69.0, "1.75 m if they are inches, so multiply v_template and shapedirs by 0.0254"),
    (5.6, "1.71 m if they are feet, so multiply v_template and shapedirs by 0.3048"),
    (0.29, "give its places in metres, Y up"),
    (1e6, "give its places in metres, Y up"),
])  # fmt: skip
def test_a_body_of_no_persons_height_is_refused_with_the_unit_that_fits(
    tmp_path: Path, body_arrays: Arrays, height: float, unit: str
) -> None:
    with pytest.raises(BadInputError) as raised:
        loaded(tmp_path, tall(body_arrays, height))
    sentence = str(raised.value)
    assert f"[v_template]: found a body {height:.4g} m high, along Y at rest, expected 0.3 to 3 m; " in sentence
    assert sentence.endswith(unit)


def test_bodies_from_a_child_to_a_giant_are_read(tmp_path: Path, body_arrays: Arrays) -> None:
    for height in (0.31, 2.99):
        assert np.ptp(loaded(tmp_path, tall(body_arrays, height)).v_template[:, 1]) == pytest.approx(height)
