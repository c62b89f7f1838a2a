"""Garments that hang: a closed mesh behind the skin, where the clothes are drawn, on texels that nothing else uses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from trilane.avatars.bundle import bundle_folder
from trilane.body.body import ShapedBody, load_body
from trilane.errors import BadInputError
from trilane.stages.gpu.skinned_mesh import enough_weights, is_closed
from trilane.training import hanging
from trilane.training.clothing import DANCER, HANGING, find_landmarks
from trilane.training.first_texture import used_texels
from trilane.training.hanging import LINING_M, dressed_body, largest_rectangle
from trilane.training.surface import ANGLES, BodyArrays, body_arrays, vertex_normals

DEFAULT_BODY = bundle_folder("default") / "body.npz"


@pytest.fixture(scope="module")
def dressed(tmp_path_factory: pytest.TempPathFactory) -> ShapedBody:
    return load_body(dressed_body(DEFAULT_BODY, "dancer", tmp_path_factory.mktemp("w"))).shape(DANCER.betas)


@pytest.fixture(scope="module")
def skin() -> ShapedBody:
    return load_body(DEFAULT_BODY).shape(DANCER.betas)


def test_a_look_without_a_garment_that_hangs_keeps_the_body_s_file(tmp_path: Path) -> None:
    assert dressed_body(DEFAULT_BODY, "hiker", tmp_path / "w") == DEFAULT_BODY
    assert not (tmp_path / "w").exists()


def test_a_file_of_another_body_is_replaced_and_the_same_body_gives_the_same_bytes(tmp_path: Path) -> None:
    (tmp_path / "body.npz").write_bytes(b"of another body")
    first = dressed_body(DEFAULT_BODY, "dancer", tmp_path).read_bytes()
    assert first != b"of another body"
    assert dressed_body(DEFAULT_BODY, "dancer", tmp_path).read_bytes() == first


def test_a_body_without_free_texels_is_refused_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eight free texels on a side are the margins alone."""
    used = np.ones((512, 512), bool)
    used[:8, :] = False
    monkeypatch.setattr(hanging, "used_texels", lambda *_: used)
    with pytest.raises(BadInputError, match="512 x 8 free texels, expected more than 8 on each side"):
        dressed_body(DEFAULT_BODY, "dancer", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_without_its_garments_the_body_is_what_it_was(dressed: ShapedBody, skin: ShapedBody) -> None:
    bare = dressed.bare()
    np.testing.assert_array_equal(bare.vertices, skin.vertices)
    np.testing.assert_array_equal(bare.body.faces, skin.body.faces)
    np.testing.assert_array_equal(bare.body.uv[bare.body.uv_faces], skin.body.uv[skin.body.uv_faces])
    np.testing.assert_allclose(bare.joints, skin.joints, atol=1e-12)
    np.testing.assert_allclose(dressed.joints, skin.joints, atol=1e-12)
    assert bare.body.skin is None and dressed.body.skin == (len(skin.vertices), len(skin.body.faces))


def garments(dressed: ShapedBody, skin: ShapedBody) -> dict[str, slice]:
    """Vertices of each garment's outside, in the order of `HANGING` in the look."""
    body = body_arrays(skin)
    landmarks = find_landmarks(body.vertices, body.joints, body.weights)
    at, found = len(skin.vertices), {}
    for name in (name for name in DANCER.garments if name in HANGING):
        count = len(HANGING[name](body, landmarks)[0][0])
        found[name] = slice(at, at + count)
        at += count * (2 if name == "skirt" else 1)
    assert at == len(dressed.vertices)
    return found


def test_a_garment_is_where_the_clothes_are_drawn(dressed: ShapedBody, skin: ShapedBody) -> None:
    """`shape` with the look's coefficients brings it there, to the rounding of float32."""
    body: BodyArrays = body_arrays(skin)
    landmarks = find_landmarks(body.vertices, body.joints, body.weights)
    for name, rows in garments(dressed, skin).items():
        (vertices, _), _ = HANGING[name](body, landmarks)
        np.testing.assert_allclose(dressed.vertices[rows], vertices, atol=5e-7)


def test_another_shape_moves_a_garment_as_the_skin_under_it(dressed: ShapedBody) -> None:
    assert dressed.body.skin is not None
    for betas in ((0.9, 3.0, 1.6, 0.6, 1.2, 0.3), (*DANCER.betas, 2.0, 2.0, 2.0, 2.0)):
        moved = np.linalg.norm(dressed.body.shape(betas).vertices - dressed.vertices, axis=1)
        under, garment = moved[: dressed.body.skin[0]], moved[dressed.body.skin[0] :]
        assert garment.max() <= under.max() and garment.mean() > 0.3 * under.mean()


def test_the_mesh_encloses_a_volume_and_the_lining_faces_inward(dressed: ShapedBody, skin: ShapedBody) -> None:
    assert is_closed(dressed.vertices, dressed.body.faces)
    rows = garments(dressed, skin)["skirt"]
    normals = vertex_normals(dressed.vertices.astype(np.float64), dressed.body.faces.astype(np.int64))
    outside = dressed.vertices[rows].reshape(-1, ANGLES, 3).astype(np.float64)
    away = (outside - outside.mean(axis=1, keepdims=True)).reshape(-1, 3)
    inner = slice(rows.stop, 2 * rows.stop - rows.start)
    assert ((normals[rows] * away).sum(axis=1)[ANGLES:-ANGLES] > 0).all()
    lining = dressed.vertices[inner].reshape(-1, ANGLES, 3)[::-1].reshape(-1, 3)
    np.testing.assert_allclose(np.linalg.norm(lining - outside.reshape(-1, 3), axis=1), LINING_M, atol=1e-6)
    faced = normals[inner].reshape(-1, ANGLES, 3)[::-1].reshape(-1, 3)
    assert ((faced * away).sum(axis=1)[ANGLES:-ANGLES] < 0).all()


def parts(faces: np.ndarray) -> list[np.ndarray]:
    """Numbers of the faces of each connected part."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    count = int(faces.max()) + 1
    label = connected_components(coo_array((np.ones(len(ends)), ends.T), shape=(count, count)), directed=False)[1]
    return [np.flatnonzero(label[faces[:, 0]] == number) for number in np.unique(label[faces[:, 0]])]


def test_a_garment_s_texels_are_its_own(dressed: ShapedBody, skin: ShapedBody) -> None:
    """Between a garment's texels and the skin's there are at least two more, for bilinear reads."""
    whole = body_arrays(dressed)
    assert dressed.body.skin is not None
    rows = slice(dressed.body.skin[1], None)
    only = replace(whole, faces=whole.faces[rows], uv_faces=whole.uv_faces[rows])
    charts = [only.uv[only.uv_faces[number]].reshape(-1, 2) for number in parts(only.faces)]
    skirt, hair = [(chart.min(axis=0), chart.max(axis=0)) for chart in charts]
    assert (skirt[0] > hair[1]).any() or (hair[0] > skirt[1]).any()
    assert not (used_texels(only, 512, 2) & used_texels(body_arrays(skin), 512, 0)).any()
    assert used_texels(only, 512, 0).mean() > 0.05
    for number in parts(only.faces):
        corners = only.uv[only.uv_faces[number]]
        turns = np.sign(np.linalg.det(corners[:, 1:] - corners[:, :1]))
        assert len(np.unique(turns)) == 1, "a lining has texels of its own: UVs that fold back would turn the other way"
    assert whole.uv.min() > 0 and whole.uv.max() < 1


def test_a_garment_has_no_more_weights_than_the_skin(dressed: ShapedBody, skin: ShapedBody) -> None:
    assert enough_weights(dressed.body) == enough_weights(skin.body)
    np.testing.assert_allclose(dressed.body.weights.sum(axis=1, dtype=np.float64), 1.0, atol=1e-6)


@settings(deadline=None)
@given(arrays(bool, st.tuples(st.integers(1, 7), st.integers(1, 7))))
def test_the_largest_rectangle_is_the_largest_of_all(free: np.ndarray) -> None:
    left, bottom, right, top = largest_rectangle(free)
    high, wide = free.shape
    every = (
        (c - a) * (d - b)
        for b in range(high)
        for d in range(b + 1, high + 1)
        for a in range(wide)
        for c in range(a + 1, wide + 1)
        if free[b:d, a:c].all()
    )
    assert (right - left) * (top - bottom) == max(every, default=0)
    assert free[bottom:top, left:right].all()
