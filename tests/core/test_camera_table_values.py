"""Tables of cameras, and which reader a file gets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.camera_files import load, nerf_text, pose_z_up, rows_of
from trilane.errors import BadInputError
from trilane.scene.camera import text_table
from trilane.scene.camera.load import load_camera
from trilane.scene.camera.text_table import Layout, elapsed, layout_of, read_table
from trilane.scene.rotations import about
from trilane.scene.schema import CameraSpec


def test_a_table_has_comments_commas_and_blank_lines(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("# 9 9 9\n\n1, 2,3 # not 4\n  4 5\tnan\n")
    table = read_table(path, 3, "three")
    assert table.numbers == pytest.approx(np.array([[1, 2, 3], [4, 5, np.nan]]), nan_ok=True)
    assert [table.place_of(index) for index in (0, 1)] == ["line 3", "line 4"]
    assert layout_of(path, "three") == Layout(3, (), has_commas=True, is_ns=False)
    path.write_text("# only this\n")
    assert layout_of(path, "three").columns == 0
    path.write_text("1 2 3\n# x\n1 2\n")
    with pytest.raises(BadInputError) as raised:
        read_table(path, 3, "three numbers")
    assert str(raised.value) == f"{path}, line 3: found 2 columns, expected three numbers"
    path.write_text("1 2 3\n1 2 x\n")
    with pytest.raises(BadInputError) as raised:
        read_table(path, 3, "three numbers")
    assert str(raised.value) == f"{path}, line 2: found could not convert string to float: 'x', expected three numbers"


def test_column_names_without_end_take_no_time(tmp_path: Path) -> None:
    """Brackets that are never closed: a search that looks for the end of each would take minutes."""
    (tmp_path / "a.txt").write_text("[" * 2_000_000 + "\n0 0 0 0 0 0 0 1\n")
    assert layout_of(tmp_path / "a.txt", "a table").columns == 1


def test_a_table_may_have_a_million_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert text_table.MAX_ROWS == 1_000_000
    monkeypatch.setattr(text_table, "MAX_ROWS", 2)
    path = tmp_path / "a.txt"
    path.write_text("1\n2\n")
    assert len(read_table(path, 1, "one").numbers) == 2
    for text, count in (("1\n2\n3\n", 3), ("# 1\n", 0)):
        path.write_text(text)
        with pytest.raises(BadInputError, match=f"found {count} poses, expected 1 to 2; one"):
            read_table(path, 1, "one")


def test_elapsed_times_by_hand() -> None:
    times, step = elapsed(np.array([np.nan, 5.0, 6.0, 8.0, 8.5]))
    assert times == pytest.approx([np.nan, 0, 1, 3, 3.5], nan_ok=True)
    assert step == 1.0
    times, step = elapsed(np.array([4.0, np.nan]))
    assert (times[0], step) == (0.0, 0.0)
    times, step = elapsed(np.array([4.0, 6.0]))
    assert (times.tolist(), step) == ([0.0, 2.0], 2.0)


def test_the_format_is_told_by_columns_or_given(tmp_path: Path) -> None:
    tum, ark, other = "0 0 0 0 0 0 0 1\n", rows_of(about(1, 0.1)), "1 2 3 4\n"
    for text, note in ((tum, "TUM trajectory, 1 poses"), (ark, "ARKit log, 1 poses")):
        (tmp_path / "a.log").write_text(text)
        assert load(tmp_path / "a.log").notes[0].startswith(note)
    (tmp_path / "a.JSON").write_text(nerf_text(pose_z_up(0)))
    assert load(tmp_path / "a.JSON").notes[0].startswith("NeRF")
    (tmp_path / "a.txt").write_text(nerf_text(pose_z_up(0)))
    assert load(tmp_path / "a.txt", format="nerf").notes[0].startswith("NeRF")
    for text, kind, sentence in (
        (other, "auto", "found 4 columns, expected 8 (TUM, EuRoC), 12 (KITTI) or 13 (ARKit), or column names"),
        (
            tum,
            "arkit",
            ", line 1: found 8 columns, expected an ARKit log: time and the 12 numbers of a 3x4 matrix a line",
        ),
        (ark, "tum", ", line 1: found 13 columns, expected a TUM trajectory: time, tx ty tz, qx qy qz qw a line"),
        (tum, "nerf", "expected a NeRF transforms.json: `frames`, each with a 4x4 `transform_matrix`"),
    ):
        (tmp_path / "a.txt").write_text(text)
        with pytest.raises(BadInputError) as raised:
            load(tmp_path / "a.txt", format=kind)
        assert f"{tmp_path}/a.txt" in str(raised.value) and str(raised.value).endswith(sentence)
    with pytest.raises(BadInputError) as raised:
        load("builtin:drone")
    assert str(raised.value) == (
        "camera: found 'builtin:drone', expected builtin:{orbit, static, closeup, far, top-to-floor, wayside} or a file"
    )
    with pytest.raises(BadInputError, match=r"; did you mean 'builtin:wayside'\?$"):
        load("builtin:waside")
    with pytest.raises(BadInputError) as raised:
        load(tmp_path / "nowhere.txt")
    assert str(raised.value) == (
        f"{tmp_path}/nowhere.txt: found no such file, expected a camera: an ARKit log, a TUM, KITTI or EuRoC "
        "trajectory, a transforms.json, odometry.csv of Stray Scanner, metadata.json of Record3D or a "
        "folder of COLMAP"
    )


def test_a_relative_path_starts_at_the_base(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("0 0 0 0 0 0 0 1\n")
    assert load_camera(CameraSpec(source="a.txt"), tmp_path).recorded
