"""`trilane body`: what it writes, and what it leaves behind when it cannot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from trilane.apps.cli.body import app
from trilane.body.body import load_body
from trilane.body.skinning import posed_vertices
from trilane.errors import BadInputError

RUNNER = CliRunner()


@pytest.fixture
def body_file(tmp_path: Path, body_arrays: dict[str, NDArray[Any]]) -> Path:
    np.savez(tmp_path / "body.npz", allow_pickle=False, **body_arrays)
    return tmp_path / "body.npz"


def save_poses(folder: Path, poses: Any) -> Path:
    np.save(folder / "poses.npy", np.asarray(poses))
    return folder / "poses.npy"


def run(*arguments: str | Path) -> Any:
    return RUNNER.invoke(app, [str(argument) for argument in arguments], catch_exceptions=True)


def test_vertices_of_every_pose(tmp_path: Path, body_file: Path) -> None:
    """(T, V, 3) float32, pose blend shapes on, the mean hand added unless told not to."""
    poses = np.random.default_rng(0).normal(0, 0.5, (3, 165))
    file, body = save_poses(tmp_path, poses), load_body(body_file)
    for flags, flat in (((), False), (("--flat-hand-mean",), True)):
        result = run("vertices", "--body", body_file, "--poses", file, "--out", tmp_path / "v.npy", "--json", *flags)
        assert result.exit_code == 0
        written = np.load(tmp_path / "v.npy")
        expected = np.array(list(posed_vertices(body.shape(), body.full_pose(poses, flat))))
        assert written.dtype == np.float32
        np.testing.assert_array_equal(written, expected.astype(np.float32))
        assert json.loads(result.stdout)["shape"] == [3, 90, 3]


def test_one_pose_is_enough(tmp_path: Path, body_file: Path) -> None:
    """A file of one pose, (165,), gives one mesh."""
    run("vertices", "--body", body_file, "--poses", save_poses(tmp_path, np.zeros(165)), "--out", tmp_path / "v.npy")
    assert np.load(tmp_path / "v.npy").shape == (1, 90, 3)


@pytest.mark.parametrize(
    ("poses", "words"),
    [
        (np.zeros((0, 165)), "shape"),
        (np.zeros((2, 156)), "156"),
        (np.zeros((2, 2, 165)), "shape"),
        (np.full((2, 165), np.nan), "NaN"),
        (np.full((2, 165), "x"), "dtype"),
    ],
)
def test_bad_poses_leave_nothing_behind(tmp_path: Path, body_file: Path, poses: Any, words: str) -> None:
    """Empty, misshapen, not finite, no numbers: one error, no output."""
    result = run("vertices", "--body", body_file, "--poses", save_poses(tmp_path, poses), "--out", tmp_path / "v.npy")
    assert isinstance(result.exception, BadInputError)
    assert words in str(result.exception)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["body.npz", "poses.npy"]


def test_huge_angles_leave_nothing_half_written(tmp_path: Path, body_file: Path) -> None:
    """A pose that is refused half way leaves the old output as it was."""
    (tmp_path / "v.npy").write_bytes(b"old")
    poses = np.zeros((3, 165))
    poses[2, 9] = 1e9
    result = run("vertices", "--body", body_file, "--poses", save_poses(tmp_path, poses), "--out", tmp_path / "v.npy")
    assert isinstance(result.exception, BadInputError)
    assert (tmp_path / "v.npy").read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 3


def test_output_that_cannot_be_written(tmp_path: Path, body_file: Path) -> None:
    """A missing folder and a folder in the file's place are refused."""
    file = save_poses(tmp_path, np.zeros(165))
    for out in (tmp_path / "no" / "v.npy", tmp_path):
        result = run("vertices", "--body", body_file, "--poses", file, "--out", out)
        assert isinstance(result.exception, BadInputError)


def test_inspect(body_file: Path) -> None:
    """Counts for people and for programs."""
    facts = json.loads(run("inspect", body_file, "--json").stdout)
    assert (facts["vertices"], facts["joints"], facts["pose_blend_shapes"]) == (90, 55, True)
    assert facts["weights_error_bound_mm"]["8"] < 1e-2
    assert "triangles" in run("inspect", body_file).stdout
