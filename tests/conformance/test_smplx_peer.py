"""The body against the official `smplx` package: same file, same poses, same vertices to 0.01 mm."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.body.body import load_body
from trilane.body.skinning import posed_vertices

torch = pytest.importorskip("torch")
smplx = pytest.importorskip("smplx")

DEFAULT = Path(__file__).resolve().parents[2] / "avatars" / "default" / "body.npz"
LIMIT_M = 1e-5
#: Joints of each argument of the peer's forward call.
PARTS = {
    "global_orient": (0, 1),
    "body_pose": (1, 22),
    "jaw_pose": (22, 23),
    "leye_pose": (23, 24),
    "reye_pose": (24, 25),
    "left_hand_pose": (25, 40),
    "right_hand_pose": (40, 55),
}


class Peer:
    def __init__(self, path: Path, flat_hand_mean: bool = True) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            self.model = smplx.SMPLX(
                str(path), ext="npz", batch_size=1, use_pca=False, flat_hand_mean=flat_hand_mean, num_betas=10
            )

    def __call__(self, pose: NDArray[Any], **shape: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        parts = {key: pose[3 * a : 3 * b] for key, (a, b) in PARTS.items()} | shape
        tensors = {key: torch.tensor(value, dtype=torch.float32)[None] for key, value in parts.items()}
        with torch.no_grad():
            out = self.model(**tensors)
        return out.vertices[0].numpy(), out.joints[0, :55].numpy()


@pytest.fixture(scope="module")
def blended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the default body whose pose blend shapes are random, up to a centimetre or so together."""
    arrays = dict(np.load(DEFAULT))
    random = np.random.default_rng(5)
    arrays["posedirs"] = random.normal(0, 1e-3, arrays["posedirs"].shape).astype(np.float32)
    path = tmp_path_factory.mktemp("body") / "SMPLX_NEUTRAL.npz"
    np.savez(path, allow_pickle=False, **arrays)
    return path


def worst(path: Path, poses: NDArray[Any]) -> float:
    peer, ours = Peer(path), posed_vertices(load_body(path).shape(), poses)
    return max(float(np.abs(peer(pose)[0] - mesh).max()) for pose, mesh in zip(poses, ours, strict=True))


def test_random_poses_with_pose_blend_shapes(blended: Path) -> None:
    """200 random poses, pose blend shapes on."""
    poses = np.random.default_rng(1).normal(0.0, 0.6, (200, 165))
    assert worst(blended, poses) <= LIMIT_M


def test_recorded_poses_with_pose_blend_shapes(blended: Path, shared_data: Path) -> None:
    """The recorded poses that lie beside the checkout."""
    assert worst(blended, np.load(shared_data / "motion" / "smplx_poses_8.npy")) <= LIMIT_M


def test_random_shapes() -> None:
    """Betas and expression move vertices and joints as the peer moves them, on the committed file as it is."""
    random = np.random.default_rng(2)
    peer, body = Peer(DEFAULT), load_body(DEFAULT)
    for _ in range(5):
        betas, expression, pose = random.normal(0, 1.5, 10), random.normal(0, 0.5, 10), random.normal(0, 0.4, 165)
        shaped = body.shape(betas, expression)
        vertices, _ = peer(pose, betas=betas, expression=expression)
        assert np.abs(vertices - next(posed_vertices(shaped, pose))).max() <= LIMIT_M
        _, joints = peer(np.zeros(165), betas=betas, expression=expression)
        assert np.abs(joints - shaped.joints).max() <= LIMIT_M


def test_mean_hand() -> None:
    """Without a flat hand the mean hand is added as the peer adds it."""
    body = load_body(DEFAULT)
    pose = np.random.default_rng(3).normal(0, 0.3, 165)
    vertices, _ = Peer(DEFAULT, flat_hand_mean=False)(pose)
    ours = next(posed_vertices(body.shape(), body.full_pose(pose, flat_hand_mean=False)))
    assert np.abs(vertices - ours).max() <= LIMIT_M
