"""How a body is made of the mesh of `anny`: a double of that model, limbs with known directions, the file's arrays."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from trilane.body.joints import JOINT_INDEX, JOINT_NAMES
from trilane.errors import BadInputError, MissingPartError
from trilane.training import body_from_anny
from trilane.training.body_from_anny import AnnyMesh, joint_bones

MIDDLE = "pelvis spine05, spine1 spine04, spine2 spine02, spine3 spine01, neck neck01, head head, jaw jaw"
SIDES = (
    "hip upperleg01, knee lowerleg01, ankle foot, collar clavicle, shoulder upperarm01, elbow lowerarm01, wrist wrist, "
    "eye eye, thumb1 finger1-1, thumb2 finger1-2, thumb3 finger1-3, index1 finger2-1, index2 finger2-2, "
    "index3 finger2-3, middle1 finger3-1, middle2 finger3-2, middle3 finger3-3, ring1 finger4-1, ring2 finger4-2, "
    "ring3 finger4-3, pinky1 finger5-1, pinky2 finger5-2, pinky3 finger5-3"
)


def pairs(text: str) -> list[list[str]]:
    return [pair.split() for pair in text.split(", ")]


def test_each_joint_sits_at_the_head_of_its_bone() -> None:
    wanted = {joint: (bone,) for joint, bone in pairs(MIDDLE)}
    for side in ("left", "right"):
        letter = side[0].upper()
        wanted |= {f"{side}_{joint}": (f"{bone}.{letter}",) for joint, bone in pairs(SIDES)}
        wanted[f"{side}_foot"] = tuple(f"toe{toe}-1.{letter}" for toe in (1, 2, 3, 4, 5))
    assert joint_bones() == wanted


# --- the mesh, of a double of anny --------------------------------------------------------------------------------

PLAIN = {"gender": 0.25, "age": 0.7, "muscle": 0.5, "weight": 0.5, "height": 0.396, "proportions": 0.6}
ADULTS = {
    "gender": (0.0, 1.0),
    "age": (0.6, 1.0),
    "muscle": (0.2, 0.8),
    "weight": (0.2, 0.8),
    "height": (0.25, 0.58),
    "proportions": (0.3, 0.9),
}
EXPRESSIONS = (
    "jawOpen, mouthSmileLeft mouthSmileRight, mouthFrownLeft mouthFrownRight, mouthPucker, mouthStretchLeft "
    "mouthStretchRight, eyeBlinkLeft eyeBlinkRight, browInnerUp browOuterUpLeft browOuterUpRight, browDownLeft "
    "browDownRight, cheekPuff, noseSneerLeft noseSneerRight"
)
#: Of the double: vertices, and those that a shown face uses.
VERTICES, USED = 14, [1, 2, 3, 5, 8, 9, 13]


class Tensor:
    def __init__(self, array: Any) -> None:
        self.array = np.asarray(array)

    def numpy(self) -> Any:
        return self.array


class Anny:
    """Vertices and bones that are polynomials of the phenotype and linear in the actions."""

    def __init__(self, **settings: Any) -> None:
        self.settings, self.dtype = settings, None
        bones = [bone for group in joint_bones().values() for bone in group]
        self.bone_labels = ["root", *bones, "twist"]
        self.bone_parents = [-1, *[0] * len(bones), 1 + bones.index("lowerarm01.L")]
        random = np.random.default_rng(8)
        rows = VERTICES + 2 * len(self.bone_labels)
        self.shapes = random.normal(0, 0.1, (12, rows, 3))
        self.base = random.normal(0, 1, (rows, 3))
        self.moves = {action: random.normal(0, 0.1, (rows, 3)) for action in EXPRESSIONS.replace(",", "").split()}
        self.faces = Tensor([[1, 2, 3], [0, 4, 6], [5, 8, 9], [13, 1, 2]])
        self.face_texture_coordinate_indices = Tensor([[0, 1, 2], [3, 3, 3], [5, 4, 7], [2, 1, 0]])
        self.texture_coordinates = Tensor(random.uniform(0, 1, (8, 2)))
        self.vertex_bone_indices = Tensor(random.integers(0, len(self.bone_labels), (VERTICES, 3)))
        self.vertex_bone_weights = Tensor(random.uniform(0.1, 1, (VERTICES, 3)))

    def to(self, dtype: Any) -> Anny:
        self.dtype = dtype
        return self

    def points(self, phenotype: dict[str, Any], actions: dict[str, float]) -> Any:
        values = np.array([phenotype[name] for name in PLAIN])
        powers = np.concatenate([values, values**2])
        moved = sum(share * self.moves[action] for action, share in actions.items())
        return self.base + np.einsum("kb,kra->bra", powers, self.shapes) + moved

    def __call__(self, phenotype_kwargs: dict[str, Any], facial_actions: dict[str, float]) -> dict[str, Tensor]:
        every = self.points({name: value.numpy() for name, value in phenotype_kwargs.items()}, facial_actions)
        bones = len(self.bone_labels)
        vertices, heads, tails = np.split(every, [VERTICES, VERTICES + bones], axis=1)
        return {"rest_vertices": Tensor(vertices), "rest_bone_heads": Tensor(heads), "rest_bone_tails": Tensor(tails)}


def y_up(points: Any) -> Any:
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def at_joints(model: Anny, every: Any) -> Any:
    """(B, 55, 3): the mean of the heads of each joint's bones."""
    heads = every[:, VERTICES : VERTICES + len(model.bone_labels)]
    bones = joint_bones()
    rows = [[model.bone_labels.index(bone) for bone in bones[joint]] for joint in JOINT_NAMES]
    return np.stack([heads[:, row].mean(axis=1) for row in rows], axis=1)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """anny is the double; which model was made, and which parts were to be hidden."""
    pytest.importorskip("torch")
    asked: list[Any] = []

    def mask(model: Anny, parts: list[str]) -> Tensor:
        asked.extend([model, parts])
        return Tensor([False, True, False, False])

    module, segments = ModuleType("anny"), ModuleType("anny.face_segmentation")
    vars(module).update(Anny=Anny, face_segmentation=segments)
    vars(segments).update(get_face_segmentation_mask=mask)
    monkeypatch.setitem(sys.modules, "anny", module)
    monkeypatch.setitem(sys.modules, "anny.face_segmentation", segments)
    return asked


def test_the_mesh_of_a_plain_adult_with_its_shapes_and_expressions(asked: list[Any]) -> None:
    mesh = body_from_anny.read_anny()
    model, hidden = asked
    groups = [group.split() for group in EXPRESSIONS.split(", ")]
    assert hidden == ["tongue", "eye_cavity.L", "eye_cavity.R", "eye_back.L", "eye_back.R"]
    actions = sorted(action for group in groups for action in group)
    assert model.settings == {
        "rig": "makehuman", "topology": "anny", "facial_actions": actions, "skinning_method": "lbs",
    }  # fmt: skip
    assert str(model.dtype) == "torch.float64"

    def body(phenotype: dict[str, Any], moved: dict[str, float]) -> Any:
        every = model.points(phenotype, moved)
        return y_up(np.concatenate([every[:, USED], at_joints(model, every)], axis=1))

    plain = {name: np.array([value]) for name, value in PLAIN.items()}
    template = body(plain, {})[0]
    assert mesh.points.shape == (1 + 10 + 10, len(USED) + 55, 3)
    np.testing.assert_allclose(mesh.points[0], template, atol=1e-12)
    for row, group in zip(mesh.points[11:], groups, strict=True):
        offset = body(plain, dict.fromkeys(group, 1.0))[0] - template
        offset[len(USED) :] = 0
        np.testing.assert_allclose(row, offset, atol=1e-12)

    random = np.random.default_rng(0)
    people = body({name: random.uniform(low, high, 400) for name, (low, high) in ADULTS.items()}, {}).reshape(400, -1)
    _, sizes, directions = np.linalg.svd(people - people.mean(axis=0), full_matrices=False)
    for row, size, direction in zip(mesh.points[1:11], sizes, directions, strict=False):
        sign = np.sign(direction[np.abs(direction).argmax()])
        np.testing.assert_allclose(row.ravel(), sign * size * direction / np.sqrt(399), atol=1e-6)

    ends = [model.bone_labels.index(f"finger{n}-3.{letter}") for letter in "LR" for n in (1, 2, 3, 4, 5)]
    tails = model.points(plain, {})[0, VERTICES + len(model.bone_labels) :]
    np.testing.assert_allclose(mesh.tips, y_up(tails[ends]), atol=1e-12)
    assert mesh.faces.tolist() == [[0, 1, 2], [3, 4, 5], [6, 0, 1]]
    assert mesh.uv_faces.tolist() == [[0, 1, 2], [4, 3, 5], [2, 1, 0]]
    np.testing.assert_array_equal(mesh.uv, model.texture_coordinates.numpy()[[0, 1, 2, 4, 5, 7]])


def test_weights_of_bones_without_a_joint_go_to_their_ancestors_joint(asked: list[Any]) -> None:
    mesh = body_from_anny.read_anny()
    model = asked[0]
    owner = {bone: joint for joint, bones in joint_bones().items() for bone in bones}
    owner |= {"root": "pelvis", "twist": "left_elbow"}
    wanted = np.zeros((VERTICES, 55))
    for vertex, (bones, weights) in enumerate(
        zip(model.vertex_bone_indices.numpy(), model.vertex_bone_weights.numpy(), strict=True)
    ):
        for bone, weight in zip(bones, weights, strict=True):
            wanted[vertex, JOINT_INDEX[owner[model.bone_labels[bone]]]] += weight
    wanted /= wanted.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.weights, wanted[USED], atol=1e-12)


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


def test_a_body_is_written_whole_or_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.setattr(body_from_anny, "build_body", lambda: {"f": np.arange(3)})
    body_from_anny.write_body(tmp_path / "body.npz")
    with np.load(tmp_path / "body.npz") as written:
        assert written.files == ["f"] and written["f"].tolist() == [0, 1, 2]
    for path, message in (
        (tmp_path / "body.obj", "found suffix '.obj', expected a file name that ends in .npz"),
        (
            tmp_path / "none" / "b.npz",
            f"found no such folder, expected an existing folder; make it with: mkdir -p {tmp_path / 'none'}",
        ),
    ):
        with pytest.raises(BadInputError) as caught:
            body_from_anny.write_body(path)
        assert str(caught.value) == f"{path}: {message}"
    assert [file.name for file in tmp_path.iterdir()] == ["body.npz"]
