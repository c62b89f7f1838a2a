"""Camera tables: which reader a file gets; columns that were swapped, added or left out are read, or refused."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from collections.abc import Iterator
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from support.camera_files import OPTICAL, lines_of, load, nerf_text, pose_z_up, rows_of
from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.scene.camera.files import load_camera
from trilane.scene.camera.pose_table import TableLayout, elapsed, layout_of, read_table
from trilane.scene.rotations import Y_UP_FROM_Z_UP, about, matrix_from_quat, quat_from_matrix
from trilane.scene.schema import CameraSpec

COUNT = 60
STEPS = np.linspace(0.0, 1.0, COUNT)


class Truth(NamedTuple):
    """A camera, and its `table` as saved.

    `turns` (N, 3, 3) and `places` (N, 3): camera to world, OpenGL axes. `times_s` (N,).
    """

    turns: F64
    places: F64
    times_s: F64
    table: F64


def by_hand(heading: float) -> tuple[F64, F64]:
    """Someone looks about by 20 degrees, a little down, and sidesteps; Y up."""
    turns = about(1, heading + 0.35 * np.sin(5 * STEPS)) @ about(0, -0.2 + 0.06 * np.sin(11 * STEPS))
    turns = turns @ about(2, 0.02 * np.sin(17 * STEPS))
    places = np.column_stack([0.5 * np.sin(3 * STEPS), 1.5 + 0.05 * np.cos(9 * STEPS), 0.4 * np.cos(4 * STEPS)])
    return turns, places @ about(1, heading).T


def by_car() -> tuple[F64, F64]:
    """It drives 60 m round a bend, and looks ahead; the first picture's optical axes are the world's."""
    turns = about(1, -0.8 * STEPS**2) @ about(0, 0.03 * np.sin(13 * STEPS))
    places = np.cumsum(np.vstack([np.zeros(3), -turns[:-1, :, 2] * (0.9 + 0.2 * np.sin(6 * STEPS[1:, None]))]), axis=0)
    return OPTICAL @ turns, places @ OPTICAL


def ahead(turns: F64) -> F64:
    """Places (N, 3) of someone who walks where their camera looks."""
    return np.cumsum(-0.03 * turns[:, :, 2], axis=0)


def arkit(heading: float, roll: float = 0.0) -> Truth:
    turns, places = by_hand(heading)
    turns = turns @ about(2, roll)
    times = np.arange(COUNT) / 60
    ns = 105230574092166 + np.round(times * 1e9)
    return Truth(turns, places, times, np.column_stack([ns, np.dstack([turns, places]).reshape(-1, 12)]))


def kitti(first: int = 0) -> Truth:
    turns, places = (part[first:] for part in by_car())
    return Truth(turns, places, np.arange(len(turns)) / 10, np.dstack([turns @ OPTICAL, places]).reshape(-1, 12))


def tum(heading: float, is_map: bool = False) -> Truth:
    """Someone who looks about while they stand, as a map of SLAM has it, or who walks ahead, in a world with Z up."""
    turns, places = by_hand(heading)
    own = OPTICAL @ turns[0].T if is_map else Y_UP_FROM_Z_UP.T
    turns, places = own @ turns, (places - places[0] if is_map else ahead(turns)) @ own.T
    times = np.arange(COUNT) / 30 + 0.001 * np.sin(np.arange(COUNT) * 7)
    quats = quat_from_matrix(turns @ OPTICAL)[:, [1, 2, 3, 0]]
    return Truth(turns, places, times - times[0], np.column_stack([1305031098.5 + times, places, quats]))


TRUTHS: dict[str, Truth] = {
    "arkit": arkit(0.7),
    "arkit upright": arkit(-1.9, np.pi / 2),
    "kitti": kitti(),
    "kitti later": kitti(10),
    "tum": tum(0.5),
    "tum there": tum(2.3),
    "tum map": tum(1.1, is_map=True),
}
#: Columns of a place: which of them is which, no file tells.
PLACES = {12: {3, 7, 11}, 13: {4, 8, 12}, 8: {1, 2, 3}}


def variants(table: F64) -> Iterator[tuple[str, F64]]:
    """Everything that happens to columns."""
    rows, columns = table.shape
    index, clock = np.arange(rows) + 0.0, np.arange(rows) / 10 + 3.25
    yield "as it is", table
    for name, extra in (("frame", index), ("frame from 700", index + 700), ("time", clock), ("ones", np.ones(rows))):
        for at in (0, 1, columns):
            yield f"{name} added at {at}", np.insert(table, at, extra, axis=1)
    for at in range(columns):
        yield f"{at} left out", np.delete(table, at, axis=1)
        yield f"frame first, {at} left out", np.insert(np.delete(table, at, axis=1), 0, index, axis=1)
        for other in range(at):
            if not {at, other} <= PLACES[columns]:
                swapped = table.copy()
                swapped[:, [at, other]] = table[:, [other, at]]
                yield f"{other} and {at} swapped", swapped
    for unit, second in (("ms", 1e3), ("us", 1e6), ("ns", 1e9)) if columns != 12 else ():
        for first_s in (0.0, 4.2, 3600.0, 1.7e9):
            since_s = (table[:, 0] - table[0, 0]) * (1e-9 if columns == 13 else 1.0)
            yield f"{unit} since {first_s:g} s", np.column_stack([np.round((first_s + since_s) * second), table[:, 1:]])
    for every in (2, 10):
        yield f"every {every}th frame's number", np.column_stack([every * index, table[:, 1 if columns != 12 else 0 :]])
    yield "last first", np.roll(table, 1, axis=1)
    yield "first last", np.roll(table, -1, axis=1)
    if columns == 8:
        yield "scalar first", table[:, [0, 1, 2, 3, 7, 4, 5, 6]]
        yield "quaternion first", table[:, [0, 4, 5, 6, 7, 1, 2, 3]]
        yield "frames for times", np.column_stack([index, table[:, 1:]])
    else:
        first = table[:, : columns - 12]
        matrices = table[:, columns - 12 :].reshape(-1, 3, 4)
        yield "by columns", np.hstack([first, matrices.swapaxes(1, 2).reshape(-1, 12)])
        yield "place last", np.hstack([first, matrices[:, :, :3].reshape(-1, 9), matrices[:, :, 3]])


EVERY = [(name, *each) for name, truth in TRUTHS.items() for each in variants(truth.table)]


def seen_from_the_first(turns: F64, places: F64) -> F64:
    """All poses in the axes of the first: the same in every world."""
    return np.concatenate([(turns[0].T @ turns).ravel(), ((places - places[0]) @ turns[0]).ravel()])


def is_right_or_refused(path: Path, name: str, what: str, table: F64) -> bool:
    """Whether the camera in `table` was read; it must be that of the truth then, and refused in words otherwise."""
    truth = TRUTHS[name]
    path.write_text(lines_of(table))
    try:
        camera = load(path)
    except BadInputError as error:
        assert error.where.startswith(str(path)) and error.found and error.expected, what
        return False
    turns = matrix_from_quat(camera.quats) @ about(2, -camera.quarter * math.pi / 2)
    assert len(turns) == len(truth.turns), what
    assert seen_from_the_first(turns, camera.places) == pytest.approx(
        seen_from_the_first(truth.turns, truth.places), abs=1e-3
    ), what
    assert camera.times_s == pytest.approx(truth.times_s, abs=2e-3), what
    return True


def test_60_tables_are_right_or_refused(tmp_path: Path) -> None:
    chosen = np.random.default_rng(33).choice(len(EVERY), 60, replace=False)
    for k in chosen:
        is_right_or_refused(tmp_path / "a.txt", *EVERY[k])


@pytest.mark.slow
def test_all_tables_are_right_or_refused(tmp_path: Path) -> None:
    read = [is_right_or_refused(tmp_path / "a.txt", *each) for each in EVERY]
    assert len(read) > 600


@pytest.mark.parametrize("name", TRUTHS)
def test_tables_as_they_should_be_are_read(tmp_path: Path, name: str) -> None:
    assert is_right_or_refused(tmp_path / "a.txt", name, "as it is", TRUTHS[name].table)


@pytest.mark.parametrize("first", [0, 700])
def test_kitti_with_the_numbers_of_frames(tmp_path: Path, first: int) -> None:
    """Read as without them, 10 a second; a frame that is missing leaves a gap, and `rate_hz` and times.txt count."""
    table = np.insert(TRUTHS["kitti"].table, 0, np.arange(COUNT) + first, axis=1)
    path = tmp_path / "a.txt"
    assert is_right_or_refused(path, "kitti", "numbered", table)
    camera = load(path)
    assert camera.detected.format == "KITTI poses"
    assert camera.notes[-1] == "taken for KITTI poses: 13 columns: a frame's number and a 3x4 matrix"
    path.write_text(lines_of(np.delete(table, [4, 5], axis=0)))
    assert load(path, rate_hz=5).times_s[[3, 4, 5]] == pytest.approx([0.6, 1.2, 1.4])
    (tmp_path / "times.txt").write_text(lines_of(np.arange(COUNT - 2)[:, None] * 0.25))
    assert load(path).times_s[:5] == pytest.approx(np.arange(5) * 0.25)


def test_what_may_be_two_formats_is_a_question_that_format_settles(tmp_path: Path) -> None:
    """KITTI with a time in front, and ARKit without one: each is read right with what the sentence says."""
    path = tmp_path / "a.txt"
    for name, table, kind, times in (
        ("kitti", np.insert(TRUTHS["kitti"].table, 0, np.arange(COUNT) / 4 + 0.5, axis=1), "kitti", 0.25),
        ("arkit", TRUTHS["arkit"].table[:, 1:], "arkit", 1 / 30),
    ):
        path.write_text(lines_of(table))
        with pytest.raises(BadInputError) as asked:
            load(path)
        assert all(f'"{each}"' in asked.value.remedy for each in ("kitti", "arkit"))
        assert asked.value.remedy.startswith("set camera.format to ") and asked.value.exit_code == 2
        camera, truth = load(path, format=kind), TRUTHS[name]
        assert matrix_from_quat(camera.quats)[0].T @ matrix_from_quat(camera.quats)[-1] == pytest.approx(
            truth.turns[0].T @ truth.turns[-1], abs=1e-6
        )
        assert camera.times_s == pytest.approx(np.arange(COUNT) * times)
        assert load(path, format=kind, rate_hz=20).times_s[1] == pytest.approx(0.25 if kind == "kitti" else 0.05)


def test_the_order_of_a_quaternion_is_a_question_that_names_both(tmp_path: Path) -> None:
    truth = TRUTHS["tum"]
    (tmp_path / "a.txt").write_text(lines_of(truth.table[:, [0, 1, 2, 3, 7, 4, 5, 6]]))
    with pytest.raises(BadInputError, match=r'"tum" \(qx qy qz qw\) or "euroc" \(qw qx qy qz\)'):
        load(tmp_path / "a.txt")
    camera = load(tmp_path / "a.txt", format="euroc")
    assert seen_from_the_first(matrix_from_quat(camera.quats), camera.places) == pytest.approx(
        seen_from_the_first(truth.turns, truth.places), abs=1e-6
    )


def read_orders(path: Path, turns: F64, places: F64) -> list[tuple[int, ...]]:
    """Orders of the quaternion's four columns in which a table of a camera, Y up, is read."""
    quats = quat_from_matrix(Y_UP_FROM_Z_UP.T @ turns @ OPTICAL)[:, [1, 2, 3, 0]]
    read = []
    for order in permutations(range(4)):
        table = np.column_stack([1305031098.5 + np.arange(COUNT) / 30, places @ Y_UP_FROM_Z_UP, quats[:, order]])
        path.write_text(lines_of(table))
        try:
            load(path, place="none")
            read.append(order)
        except BadInputError as error:
            assert "order does not follow" in error.found
    return read


@pytest.mark.parametrize("heading", [-0.4, 0.3, 1.8, 2.3, 2.9])
def test_one_order_of_24_is_read_where_a_camera_looks_where_it_goes(tmp_path: Path, heading: float) -> None:
    """Somebody films ahead while they walk, or one point 3 m off while they go round it."""
    turns, _ = by_hand(heading)
    assert read_orders(tmp_path / "a.txt", turns, ahead(turns)) == [(0, 1, 2, 3)]
    turns = about(1, heading + 1.2 * STEPS) @ about(0, np.full(COUNT, -0.2))
    assert read_orders(tmp_path / "a.txt", turns, 3 * turns[:, :, 2]) == [(0, 1, 2, 3)]


def test_the_order_of_a_quaternion_is_a_question_where_four_orders_are_equally_level(tmp_path: Path) -> None:
    """Nothing but where it goes tells which way a camera turns; a line of names does."""
    truth = TRUTHS["tum"]
    turns, places = by_hand(0.5)
    assert read_orders(tmp_path / "a.txt", turns, places) == []
    for name in ("tum", "tum map"):
        (tmp_path / "a.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + lines_of(TRUTHS[name].table))
        assert load(tmp_path / "a.txt").times_s == pytest.approx(truth.times_s, abs=2e-3)


@pytest.mark.parametrize(
    ("times", "unit", "names"),
    [
        (np.arange(COUNT) * 33.0, "ms", "t_ms tx ty tz qx qy qz qw"),
        (np.arange(COUNT) * 33.0, "ms", "timestamp [ms], tx, ty, tz, qx, qy, qz, qw"),
        (np.arange(COUNT) * 0.99 + 7, "s", "time (s), tx, ty, tz, qx, qy, qz, qw"),
        (np.arange(COUNT) * 33e6, "ns", "#timestampns tx ty tz qx qy qz qw"),
    ],
)
def test_a_unit_of_times_is_stated_by_the_scene_or_by_a_column_name(
    tmp_path: Path, times: F64, unit: str, names: str
) -> None:
    """Both are obeyed, and the scene first: tenfold numbers of frames are frames where it says so."""
    step_s = {"ms": 0.033, "s": 0.99, "ns": 0.033}[unit]
    text = lines_of(np.column_stack([times, TRUTHS["tum"].table[:, 1:]]), ", " if "," in names else " ")
    path = tmp_path / "a.txt"
    path.write_text(f"{names}\n{text}")
    assert load(path).times_s == pytest.approx(np.arange(COUNT) * step_s)
    assert load(path, time_unit="frames", rate_hz=50).times_s == pytest.approx((times - times[0]) / 50)
    path.write_text(text)
    assert load(path, time_unit=unit).times_s == pytest.approx(np.arange(COUNT) * step_s)


@pytest.mark.parametrize(("step", "units"), [(1337.0, '"ms" or "us"'), (1.2e6, '"us" or "ns"')])
def test_steps_of_a_second_or_a_thousandth_of_it_are_a_question_about_the_unit(
    tmp_path: Path, step: float, units: str
) -> None:
    truth = TRUTHS["tum"]
    (tmp_path / "a.txt").write_text(lines_of(np.column_stack([np.arange(COUNT) * step, truth.table[:, 1:]])))
    with pytest.raises(BadInputError, match=f"set camera.time_unit to {units}"):
        load(tmp_path / "a.txt")
    assert load(tmp_path / "a.txt", time_unit="us").times_s[1] == pytest.approx(step * 1e-6)


def test_a_unit_of_times_is_refused_where_there_are_none(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(nerf_text(pose_z_up(0)))
    (tmp_path / "00.txt").write_text(lines_of(TRUTHS["kitti"].table))
    for name, sentence in (("a.json", "a file that is no table of times"), ("00.txt", "poses without times")):
        with pytest.raises(BadInputError, match=rf'found camera\.time_unit = "ms" with {sentence}'):
            load(tmp_path / name, time_unit="ms")


def test_numbers_of_frames_are_no_seconds(tmp_path: Path) -> None:
    """A TUM table of a program that counts frames: 30 a second, or what the scene says."""
    (tmp_path / "a.txt").write_text(lines_of(np.column_stack([np.arange(COUNT), TRUTHS["tum"].table[:, 1:]])))
    camera = load(tmp_path / "a.txt")
    assert camera.times_s == pytest.approx(np.arange(COUNT) / 30)
    assert camera.notes[0].startswith("TUM trajectory, 60 poses, 30 a second assumed, time in frames")
    assert load(tmp_path / "a.txt", rate_hz=1).times_s == pytest.approx(np.arange(COUNT))


def test_column_names_without_a_whole_pose_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("timestamp tx ty tz qx qy qz confidence\n0.5 0 0 0 0 0 0 1\n")
    with pytest.raises(BadInputError, match=r"column names without qw, expected names of time, x, y, z, qw, qx"):
        load(tmp_path / "a.txt")


def test_a_table_has_comments_commas_and_blank_lines(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("# 9 9 9\n\n1, 2,3 # not 4\n  4 5\tnan\n")
    table = read_table(path, 3, "three")
    assert table.numbers == pytest.approx(np.array([[1, 2, 3], [4, 5, np.nan]]), nan_ok=True)
    assert [table.place_of(index) for index in (0, 1)] == ["line 3", "line 4"]
    assert layout_of(path, "three") == TableLayout(3, (), has_commas=True, is_ns=False)
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


def test_elapsed_times_by_hand() -> None:
    times, step = elapsed(np.array([np.nan, 5.0, 6.0, 8.0, 8.5]))
    assert times == pytest.approx([np.nan, 0, 1, 3, 3.5], nan_ok=True)
    assert step == 1.0
    times, step = elapsed(np.array([4.0, np.nan]))
    assert (times[0], step) == (0.0, 0.0)
    times, step = elapsed(np.array([np.nan, 4.0]))
    assert (times[1], step) == (0.0, 0.0)
    times, step = elapsed(np.array([4.0, 6.0]))
    assert (times.tolist(), step) == ([0.0, 2.0], 2.0)


def test_a_time_that_is_no_number_leaves_out_its_own_pose_alone(tmp_path: Path) -> None:
    (tmp_path / "two.txt").write_text("nan 0 0 0 0 0 0 1\n5 1 2 3 0 0 0 1\n")
    camera = load(tmp_path / "two.txt", format="tum")
    assert len(camera.times_s) == 1
    assert "1 samples not finite (first: line 1), interpolated across" in camera.notes


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


#: Three poses on the z axis at 1, 2 and 4 m after 0.25, 1.25 and 2.25 s, without a turn.
def three_poses(head: str, *, per_m: float = 1.0, per_s: float = 1.0) -> str:
    rows = (
        f"{(second + 0.25) * per_s:.9g},0,0,{metres * per_m:.9g},0,0,0,1" for second, metres in enumerate((1, 2, 4))
    )
    return "\n".join([head, *rows]) + "\n"


@pytest.mark.parametrize(
    ("head", "per_m", "per_s", "notes"),
    [
        ("timestamp [s],tx [cm],ty [cm],tz [cm],qx,qy,qz,qw", 100, 1, ("lengths in cm",)),
        ("timestamp,p_RS_R_x [mm],p_RS_R_y [mm],p_RS_R_z [mm],qx,qy,qz,qw", 1000, 1, ("lengths in mm",)),
        ("time (s),x (km),y (km),z (km),qx,qy,qz,qw", 0.001, 1, ("lengths in km",)),
        ("time,x [ft],y [ft],z [ft],qx,qy,qz,qw", 1 / 0.3048, 1, ("lengths in ft",)),
        ("time,x_in,y_in,z_in,qx,qy,qz,qw", 1 / 0.0254, 1, ("lengths in in",)),
        ("time [min],x,y,z,qx,qy,qz,qw", 1, 1 / 60, ("time in min",)),
        ("time [Seconds],x [Metres],y [Metres],z [Metres],qx [],qy [],qz [],qw []", 1, 1, ()),
        ("timestamp [ns],x [ m ],y [ m ],z [ m ],qx [-],qy [-],qz [-],qw [-]", 1, 1e9, ("time in ns",)),
        ("# time [ms] x [cm] y [cm] z [cm] qx qy qz qw", 100, 1000, ("lengths in cm", "time in ms")),
    ],
)
def test_units_in_column_names_count(
    tmp_path: Path, head: str, per_m: float, per_s: float, notes: tuple[str, ...]
) -> None:
    """The camera is 1 m farther after 1 s, and 3 m farther after 2 s, in any unit."""
    (tmp_path / "a.csv").write_text(three_poses(head, per_m=per_m, per_s=per_s))
    camera = load(tmp_path / "a.csv", up_axis="y", place="none")
    assert camera.places[:, 2] == pytest.approx([1, 2, 4], rel=1e-6)
    assert camera.times_s == pytest.approx([0, 1, 2], rel=1e-4)
    for note in notes:
        assert any(note in each for each in camera.notes)


def test_a_unit_of_column_names_that_the_scene_contradicts_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(three_poses("time [s],x [cm],y [cm],z [cm],qx,qy,qz,qw", per_m=100))
    for spec, sentence in (
        ({"metres_per_unit": 0.001}, "lengths in cm and camera.metres_per_unit = 0.001, expected 0.01 metres"),
        ({"time_unit": "ms"}, 'times in s and camera.time_unit = "ms", expected one unit; remove the wrong one'),
    ):
        with pytest.raises(BadInputError, match=sentence):
            load(path, **spec)
    same = load(path, metres_per_unit=0.01, time_unit="s", up_axis="y", place="none")
    assert same.places[:, 2] == pytest.approx([1, 2, 4])
    path.write_text(three_poses("time [s],x [m],y [m],z [m],qx,qy,qz,qw"))
    assert load(path, metres_per_unit=0.5, up_axis="y", place="none").places[:, 2] == pytest.approx([0.5, 1, 2])


@pytest.mark.parametrize(
    ("head", "sentence"),
    [
        ("time,x [px],y [px],z [px],qx,qy,qz,qw", "`x [px]`, expected a unit that is one of m, cm, mm, km, ft, in"),
        ("time [h],x,y,z,qx,qy,qz,qw", "`time [h]`, expected a unit that is one of s, ms, us, ns, min"),
        ("time,x [m],y [m],z [mm],qx,qy,qz,qw", "names `x [m]` and `z [mm]`, expected one unit"),
        ("time,x [m],y [m],z,qx,qy,qz,qw", "names `x [m]` and `z`, expected one unit"),
    ],
)
def test_units_of_column_names_that_are_unknown_or_differ_are_refused(tmp_path: Path, head: str, sentence: str) -> None:
    (tmp_path / "a.csv").write_text(three_poses(head))
    with pytest.raises(BadInputError, match=re.escape(sentence)):
        load(tmp_path / "a.csv")


def test_units_of_a_table_of_matrices_count(tmp_path: Path) -> None:
    """12 numbers after a time in ms; the camera is 2 m off after 1 s."""
    head = "time [ms],r11,r12,r13,tx [cm],r21,r22,r23,ty [cm],r31,r32,r33,tz [cm]"
    rows = (f"{1000 * k},1,0,0,{200 * k},0,1,0,0,0,0,1,0" for k in range(3))
    (tmp_path / "a.csv").write_text("\n".join([head, *rows]))
    camera = load(tmp_path / "a.csv", format="arkit", place="none")
    assert camera.times_s == pytest.approx([0, 1, 2]) and camera.places[:, 0] == pytest.approx([0, 2, 4])


def panning(pitch: float, count: int = 40) -> F64:
    """A level camera, Y up, that looks up by `pitch`, pans by 2.4 rad and stays 1.5 m over 0: 3x4 matrices."""
    turns = about(1, np.linspace(0.2, 2.6, count)) @ about(0, pitch)
    return np.dstack([turns, np.tile([0.5, 1.5, 0.25], (count, 1))])


def orbit(count: int = 40) -> F64:
    """A camera, Y up, that goes round a point at the height of its eyes, 2.5 m off: 3x4 matrices."""
    angles = np.linspace(0.3, 1.7, count)
    return np.dstack([about(1, angles), 2.5 * np.column_stack([np.sin(angles), np.zeros(count), np.cos(angles)])])


def with_times(matrices: F64, first_ns: float = 0.0) -> str:
    return lines_of(np.column_stack([first_ns + np.arange(len(matrices)) * 33e6, matrices.reshape(-1, 12)]))


#: ns since a phone was switched on.
UPTIME_NS = 105230574092166.0
WAYS = {"pan": panning(-0.1), "pan, down": panning(-0.4), "orbit": orbit()}


@pytest.mark.parametrize("world", ["y", "z", "-y"])
@pytest.mark.parametrize("way", WAYS)
def test_optical_matrices_with_times_are_a_question_that_format_settles(tmp_path: Path, way: str, world: str) -> None:
    """They would look backwards as ARKit's."""
    path, matrices = tmp_path / "a.txt", WAYS[way]
    system = {"y": np.eye(3), "z": Y_UP_FROM_Z_UP.T, "-y": OPTICAL}[world]
    optical = np.dstack([system @ matrices[:, :, :3] @ OPTICAL, matrices[:, :, 3] @ system.T])
    path.write_text(with_times(optical))
    with pytest.raises(BadInputError, match=r"KITTI's|unlike a camera over the floor") as asked:
        load(path)
    assert all(each in asked.value.remedy for each in ("camera.format", "camera.axes"))
    assert asked.value.exit_code == 2
    camera = load(path, format="kitti", place="none")
    assert seen_from_the_first(matrix_from_quat(camera.quats), camera.places) == pytest.approx(
        seen_from_the_first(matrices[:, :, :3], matrices[:, :, 3]), abs=1e-9
    )


@pytest.mark.parametrize("first_ns", [0.0, UPTIME_NS])
@pytest.mark.parametrize("quarter", [0, 1, 3])
@pytest.mark.parametrize("way", WAYS)
def test_a_phone_s_matrices_are_read_where_something_tells_where_it_looks(
    tmp_path: Path, way: str, quarter: int, first_ns: float
) -> None:
    """Held upright, the view is as level along either axis: a clock tells it, or a point that the camera goes round.

    So does a view down, where the phone's lower end is down (quarter 3).
    """
    path, matrices = tmp_path / "a.txt", WAYS[way].copy()
    matrices[:, :, :3] = matrices[:, :, :3] @ about(2, quarter * np.pi / 2)
    path.write_text(with_times(matrices, first_ns))
    told = load(path, format="arkit", place="none")
    assert bool(told.quarter) == bool(quarter)
    if not first_ns and (way, quarter) in (("pan", 1), ("pan", 3), ("pan, down", 1)):
        with pytest.raises(BadInputError, match="which do not tell where the camera looks"):
            load(path)
    else:
        camera = load(path, place="none")
        assert (camera.quats.tolist(), camera.places.tolist()) == (told.quats.tolist(), told.places.tolist())


@pytest.mark.parametrize("way", ["pan, down"])
@pytest.mark.parametrize("first_ns", [0.0, UPTIME_NS])
def test_matrices_in_another_order_are_refused(tmp_path: Path, way: str, first_ns: float) -> None:
    """Transposed, world to camera, or with the axes of a robot, whose x is ahead: their pictures swing."""
    turns, places = WAYS[way][:, :, :3], WAYS[way][:, :, 3]
    back = turns.swapaxes(1, 2)
    for matrices in (
        np.dstack([back, places]),
        np.dstack([back, -(back @ places[:, :, None])]),
        np.dstack([turns[:, :, [2, 0, 1]], places]),
        np.dstack([turns[:, :, [1, 2, 0]], places]),
    ):
        (tmp_path / "a.txt").write_text(with_times(matrices, first_ns))
        with pytest.raises(BadInputError, match=r"fit better if .* expected the order r11 r12 r13 tx"):
            load(tmp_path / "a.txt")


def test_matrices_of_somebody_who_walks_are_refused_in_another_order(tmp_path: Path) -> None:
    """They look ahead of their way; transposed they are nearly as level, but look to the other side of it."""
    turns, _ = by_hand(0.0)
    matrices = np.dstack([turns, ahead(turns)])
    (tmp_path / "a.txt").write_text(with_times(matrices, UPTIME_NS))
    assert load(tmp_path / "a.txt").detected.format == "ARKit log"
    (tmp_path / "a.txt").write_text(with_times(np.dstack([turns.swapaxes(1, 2), ahead(turns)]), UPTIME_NS))
    with pytest.raises(BadInputError, match="fit better if each is transposed"):
        load(tmp_path / "a.txt")


def test_a_pose_of_kitti_with_one_number_that_is_none_is_left_out(tmp_path: Path) -> None:
    """The number is off the diagonal: with 0 in its place, the matrix would be a rotation."""
    table = TRUTHS["kitti"].table.copy()
    row, column = next(map(tuple, np.argwhere(np.abs(table[:, [1, 2, 4, 6, 8, 9]]) < 1e-3)))
    table[row, [1, 2, 4, 6, 8, 9][column]] = np.nan
    path = tmp_path / "poses.txt"
    path.write_text(lines_of(table))
    assert len(load(path, format="kitti", place="none").times_s) == COUNT - 1


def test_kitti_matrices_that_fit_as_well_transposed_are_a_question(tmp_path: Path) -> None:
    """A car looks where it goes, and transposed it does not; of a camera that goes round a point nothing tells."""
    car = TRUTHS["kitti"].table.reshape(-1, 3, 4)
    turns = about(1, 1.2 * STEPS) @ about(0, np.full(COUNT, -0.2))
    turns, places = turns[0].T @ turns, 3 * (turns - turns[0])[:, :, 2] @ turns[0]
    orbit = np.dstack([OPTICAL @ turns @ OPTICAL, places @ OPTICAL])
    for matrices, how in (
        (np.dstack([car[:, :, :3].swapaxes(1, 2), car[:, :, 3]]), "each is transposed"),
        (orbit, "each is that of world to camera"),
    ):
        (tmp_path / "a.txt").write_text(lines_of(matrices.reshape(-1, 12)))
        with pytest.raises(BadInputError, match=f"fit as well if {how}"):
            load(tmp_path / "a.txt")
    assert load(tmp_path / "a.txt", format="kitti").detected.format == "KITTI poses"
    (tmp_path / "times.txt").write_text(lines_of(np.arange(COUNT)[:, None] / 10))
    assert load(tmp_path / "a.txt").detected.format == "KITTI poses"
    assert is_right_or_refused(tmp_path / "a.txt", "kitti", "as it is", TRUTHS["kitti"].table)


@pytest.mark.parametrize("has_time", [True, False])
def test_matrices_that_are_rotations_by_their_first_nine_numbers_are_refused(tmp_path: Path, has_time: bool) -> None:
    """Column by column, or with the place after the rotation: both are told as an order of numbers."""
    matrices = panning(-0.4)
    for numbers in (
        matrices.swapaxes(1, 2).reshape(-1, 12),
        np.hstack([matrices[:, :, :3].reshape(-1, 9), matrices[:, :, 3]]),
    ):
        rows = np.insert(numbers, 0, np.arange(40) / 30 + 0.25, axis=1) if has_time else numbers
        (tmp_path / "a.txt").write_text(lines_of(rows))
        with pytest.raises(BadInputError) as refused:
            load(tmp_path / "a.txt", format="kitti")
        assert refused.value.where == f"{tmp_path / 'a.txt'}, line 1"
        assert refused.value.found == "a matrix whose first nine numbers are a rotation"
        assert "r11 r12 r13 tx" in refused.value.expected


@pytest.mark.parametrize(
    ("head", "twice"),
    [
        ("time x y z x y z qx qy qz qw", "two columns of x, `x` and `x`"),
        ("time,x,y,z,pos_x,qx,qy,qz,qw", "two columns of x, `x` and `pos_x`"),
        ("# timestamp x y z qx qy qz qw qw", "two columns of qw, `qw` and `qw`"),
        ("t tx ty tz qx qy qz qw timestamp", "two columns of time, `t` and `timestamp`"),
    ],
)
def test_column_names_that_are_given_twice_are_refused(tmp_path: Path, head: str, twice: str) -> None:
    count = len(head.replace(",", " ").replace("#", "").split())
    rows = [", ".join(["0.5", *"0" * (count - 2), "1"]), ", ".join(["1", *"0" * (count - 2), "1"])]
    (tmp_path / "a.txt").write_text("\n".join([head, *rows]))
    with pytest.raises(BadInputError) as refused:
        load(tmp_path / "a.txt")
    assert refused.value.found == twice


def test_arrays_and_folders_of_matrices_are_refused_with_what_makes_a_table(tmp_path: Path) -> None:
    """The lines in the messages are run, and make a table that is read."""
    matrices = np.tile(np.eye(4), (12, 1, 1))
    matrices[:, :3] = orbit(12)
    matrices[:, :3, :3] = matrices[:, :3, :3] @ OPTICAL
    np.save(tmp_path / "poses.npy", matrices)
    folder = tmp_path / "scan" / "pose"
    folder.mkdir(parents=True)
    for number, matrix in enumerate(matrices):
        (folder / f"{number}.txt").write_text(lines_of(matrix))
    tables = []
    for source in (tmp_path / "poses.npy", tmp_path / "scan", folder):
        with pytest.raises(BadInputError) as refused:
            load(source)
        line = refused.value.remedy.partition(": ")[2].replace("python -c", f"{sys.executable} -c")
        subprocess.run(["bash", "-c", line], cwd=tmp_path, check=True)
        tables.append(np.loadtxt(tmp_path / "poses.txt"))
        assert tables[-1] == pytest.approx(matrices[:, :3].reshape(-1, 12), abs=1e-15)
    camera = load(tmp_path / "poses.txt", format="kitti", place="none")
    assert matrix_from_quat(camera.quats) == pytest.approx(orbit(12)[:, :, :3], abs=1e-9)
