"""`trilane body`: what it writes and says of a small body, and what it leaves behind when it cannot."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.apps.cli import body as cli
from trilane.body.body import load_body
from trilane.body.skinning import posed_vertices
from trilane.training import body_from_anny

Command = Callable[..., tuple[str, str]]
POSES = ("body", "vertices", "--body", "body.npz", "--poses", "p.npy", "--out")
SHAPE = "expected poses of shape (T, 165)"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body_arrays: dict[str, NDArray[Any]]) -> Path:
    monkeypatch.chdir(tmp_path)
    np.savez("body.npz", allow_pickle=False, **body_arrays)
    return tmp_path


@pytest.mark.usefixtures("place")
def test_vertices_of_every_pose(command: Command) -> None:
    """(T, V, 3) float32, pose blend shapes on, the mean hand added unless told not to; a pose by itself is one."""
    poses, body = np.random.default_rng(0).normal(0, 0.5, (3, 165)), load_body(Path("body.npz"))
    np.save("p.npy", poses)
    for flags, flat in (((), False), (("--flat-hand-mean",), True)):
        assert json.loads(command(*POSES, "v.npy", "--json", *flags)[0]) == {"file": "v.npy", "shape": [3, 90, 3]}
        written = np.load("v.npy")
        expected = np.array(list(posed_vertices(body.shape(), body.full_pose(poses, flat))))
        assert written.dtype == np.float32
        np.testing.assert_array_equal(written, expected.astype(np.float32))
    np.save("p.npy", poses[0])
    assert command(*POSES, "v.npy") == ("", "wrote v.npy: 1 poses of 90 vertices\n")
    np.testing.assert_array_equal(
        np.load("v.npy"), np.array([*posed_vertices(body.shape(), body.full_pose(poses[:1], False))], np.float32)
    )


@pytest.mark.usefixtures("place")
def test_a_body_that_is_built_is_described(monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    monkeypatch.setattr(body_from_anny, "write_body", lambda out: shutil.copyfile("body.npz", out))
    facts = json.loads(command("body", "from-anny", "--out", "new.npz", "--json")[0])
    assert facts == json.loads(command("body", "inspect", "new.npz", "--json")[0])
    said = f"wrote new.npz: 90 vertices, {facts['height_m']} m tall\n"
    assert command("body", "from-anny", "--out", "new.npz") == ("", said)


def one_is(value: float, pose: int) -> NDArray[Any]:
    poses = np.zeros((4, 165))
    poses[pose, 9] = value
    return poses


@pytest.mark.parametrize(
    ("poses", "said"),
    [
        (None, f"p.npy: found no such file, {SHAPE}"),
        (np.zeros((0, 165)), f"p.npy: found shape (0, 165), {SHAPE}"),
        (np.zeros((2, 2, 165)), f"p.npy: found shape (2, 2, 165), {SHAPE}"),
        (np.zeros((2, 156)), f"p.npy: found shape (2, 156), {SHAPE}"),
        (np.full((2, 165), "x"), "dtype"),
        (one_is(np.inf, 2), "p.npy: found NaN or infinity in pose 2, expected finite joint angles"),
        (np.full((1, 165), np.nan), "p.npy: found NaN or infinity in pose 0, expected finite joint angles"),
        (one_is(1e9, 2), "found"),
    ],
)
def test_bad_poses_leave_the_old_file_as_it_was(poses: Any, said: str, place: Path, command: Command) -> None:
    Path("v.npy").write_bytes(b"old")
    if poses is not None:
        np.save("p.npy", poses)
    before = sorted(place.iterdir())
    out, err = command(*POSES, "v.npy", code=2)
    assert (out, err[:7]) == ("", "error: ") and said in err
    assert (sorted(place.iterdir()), Path("v.npy").read_bytes()) == (before, b"old")


@pytest.mark.usefixtures("place")
def test_places_are_refused(monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    """Two poses of 90 vertices are 2,160 bytes; a MiB must be left beside them."""
    np.save("p.npy", np.zeros((2, 165)))
    Path("folder").mkdir()
    other = "expected a file in a folder; give another --out"
    assert command(*POSES, "folder", code=2)[1] == f"error: folder: found a folder, {other}\n"
    assert command(*POSES, "none/v.npy", code=2)[1] == f"error: none/v.npy: found no such folder, {other}\n"
    free = SimpleNamespace(free=2160 + (1 << 20) - 1)
    monkeypatch.setattr(cli.shutil, "disk_usage", lambda _: free)
    said = f"found {free.free} bytes free, expected room for 2160; give another --out"
    assert command(*POSES, "folder/v.npy", code=2)[1] == f"error: folder: {said}\n"
    free.free += 1
    assert command(*POSES, "folder/v.npy") == ("", "wrote folder/v.npy: 2 poses of 90 vertices\n")


@pytest.mark.usefixtures("place")
def test_inspect(body_arrays: dict[str, NDArray[Any]], command: Command) -> None:
    facts = json.loads(command("body", "inspect", "body.npz", "--json")[0])
    width, height, _ = np.ptp(body_arrays["v_template"].astype(float), axis=0)
    assert (facts["height_m"], facts["arm_span_m"]) == pytest.approx((height, width), abs=1e-4)
    assert (facts["vertices"], facts["triangles"], facts["texture_coordinates"]) == (90, 120, 130)
    assert (facts["joints"], facts["betas"], facts["pose_blend_shapes"]) == (55, 10, True)
    assert facts["most_weights_per_vertex"] == 6
    assert facts["weights_error_bound_mm"]["8"] < 1e-2
    lines = [" ".join(line.split()) for line in command("body", "inspect", "body.npz")[0].splitlines()]
    assert lines == [f"{key} {value}" for key, value in facts.items()]
