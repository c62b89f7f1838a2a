"""`trilane inspect`: each kind is recognised by content and read; what is not usable says why and what to do."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TracePacket
from PIL import Image

from support.run_report import make_report
from support.small_inputs import bvh_text, nerf_text, picture, write_small_inputs
from trilane.apps.cli.inspect import lines
from trilane.apps.inspect import inspection, readers
from trilane.apps.inspect.inspect_file import inspect_file, kind_of
from trilane.apps.inspect.inspection import Length, drawn_cameras, drawn_skeletons
from trilane.avatars.bundle import bundle_folder
from trilane.body.joints import JOINT_NAMES
from trilane.errors import BadInputError

Command = Callable[..., tuple[str, str]]
KINDS = {
    "walk.bvh": "motion",
    "poses.npy": "motion",
    "amass.npz": "motion",
    "parts.npz": "motion",
    "aist.pkl": "motion",
    "romp.npz": "motion",
    "places.npy": "motion",
    "arkit.txt": "camera",
    "tum.txt": "camera",
    "transforms.json": "camera",
    "euroc.csv": "camera",
    "kitti.txt": "camera",
    "metadata.json": "camera",
    "odometry.csv": "camera",
    "colmap": "camera",
    "colmap-binary": "camera",
    "photo.png": "picture",
    "photo.jpg": "picture",
    "film.mkv": "video",
    "body.npz": "body",
    "network.onnx": "network",
    "scene.toml": "scene",
    "pictures": "pictures",
    "avatar": "avatar",
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_small_inputs(tmp_path_factory.mktemp("inputs"))


@pytest.mark.parametrize("name", KINDS)
def test_what_is_sound_is_usable_and_drawn(name: str, inputs: dict[str, Path]) -> None:
    found = inspect_file(inputs[name])
    assert found.usable, found.problem
    assert found.kind == KINDS[name]
    assert found.detected.format and found.detected.reason
    assert str(inputs[name]) in found.advice
    json.dumps(found.document(inputs[name], None), allow_nan=False)
    if name in ("network.onnx", "scene.toml"):
        assert found.draw is None
    else:
        assert found.draw is not None
        assert np.asarray(found.draw()).std() > 3


@pytest.mark.parametrize("name", [name for name in KINDS if Path(name).suffix and name not in ("network.onnx",)])
def test_no_name_is_needed(name: str, inputs: dict[str, Path], tmp_path: Path) -> None:
    """What is told by content is told under a wrong ending too; a reader that goes by endings may refuse it then."""
    file = tmp_path / "file.dat"
    shutil.copyfile(inputs[name], file)
    assert kind_of(file)[0] == KINDS[name]


def test_a_motion(inputs: dict[str, Path]) -> None:
    """30 frames per second, 4 frames: 0.1 s. A leg is 42 + 42 cm; the hips go forward by a centimetre a frame."""
    document = inspect_file(inputs["walk.bvh"]).document(Path("walk.bvh"), None)
    assert document["length"] == {
        "samples": 4,
        "seconds": pytest.approx(0.1, abs=1e-5),
        "rate_hz": pytest.approx(30, rel=1e-4),
    }
    assert document["facts"] == {"travels": True, "ground_m": [0.0, 0.03], "leg_m": 0.84, "betas": 0}
    assert document["joints"]["mapped"]["left_hip"] == "LeftUpLeg"
    assert document["joints"]["unmapped"] == []
    assert {"spine2", "spine3", "left_foot", "right_foot"} <= set(document["joints"]["missing"])


def test_a_camera(inputs: dict[str, Path]) -> None:
    """Five places, 0.1 m apart; of 0.9 rad over 640 pixels, 2 atan(tan(0.45) * 3 / 4) are over 480."""
    document = inspect_file(inputs["transforms.json"]).document(Path("t"), None)
    angle = round(float(np.degrees(2 * np.arctan(np.tan(0.45) * 0.75))), 3)
    assert document["facts"]["fov_y_deg"] == [angle, angle]
    assert document["facts"]["extent_m"] == [0.4, 0.0, 0.0]
    assert document["facts"]["path_m"] == 0.4
    assert document["detected"]["axes"] == "Z up"


def test_an_avatar_is_validated_if_it_has_the_figures(inputs: dict[str, Path]) -> None:
    assert inspect_file(inputs["avatar"]).facts["validated"] is False
    assert inspect_file(bundle_folder("default")).facts["validated"] is True


def test_a_picture_and_a_film(inputs: dict[str, Path], tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    picture().save(tmp_path / "turned.jpg", exif=exif)
    turned = inspect_file(tmp_path / "turned.jpg")
    assert turned.facts["exif_orientation"] == 6
    assert "turned" in turned.detected.axes
    assert turned.what == "a JPEG picture of 48x36 pixels"
    film = inspect_file(inputs["film.mkv"])
    assert film.length == Length(6, pytest.approx(0.24), 25.0)


def test_a_film_whose_tags_are_no_text_is_read(inputs: dict[str, Path], tmp_path: Path) -> None:
    """The name of the program that wrote it, in Latin-1."""
    content = inputs["film.mkv"].read_bytes()
    assert b"Lavf" in content
    (tmp_path / "a.mkv").write_bytes(content.replace(b"Lavf", b"L\xe4vf"))
    assert inspect_file(tmp_path / "a.mkv").usable


def test_a_film_without_a_frame_to_draw_says_so(inputs: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    none = SimpleNamespace(at=lambda _time_s: None, close=lambda: None)
    monkeypatch.setattr(readers, "open_background", lambda *_: none)
    draw = inspect_file(inputs["film.mkv"]).draw
    assert draw is not None
    with pytest.raises(BadInputError, match=r"film.mkv: found no frame that can be decoded"):
        draw()


def test_lengths() -> None:
    assert Length.of(np.array([0.0])) == Length(1, 0.0, None)
    assert Length.of(np.array([1.0, 1.5, 2.0, 4.0])) == Length(4, 3.0, 2.0)


REFUSED: dict[str, tuple[bytes, str, str, str]] = {
    "an FBX by its own name": (b"Kaydara FBX Binary  \0", "man.fbx", "an FBX file", "Motion Capture (.bvh)"),
    "an FBX named BVH": (b"Kaydara FBX Binary  \0", "man.bvh", "an FBX file", "Motion Capture (.bvh)"),
    "a ZIP": (b"PK\x05\x06" + bytes(18), "all.zip", "a ZIP archive", "unpack it"),
    "a letter": (b"Dear reader,\n", "a.txt", "nothing that Trilane knows", "motions: .bvh"),
    "bytes": (bytes(range(1, 200)), "a.bin", "nothing that Trilane knows", "motions: .bvh"),
    "a cut BVH": (bvh_text().encode()[:300], "a.bvh", "a motion", ""),
    "a cut NeRF": (nerf_text().encode()[:300], "a.json", "a broken JSON file", "again"),
    "a table of four columns": (b"1 2 3 4\n2 3 4 5\n", "a.txt", "a camera, by its content", ""),
    "a text as a trace": (b"Dear reader,\n", "t.perfetto-trace", "a trace", ""),
    "a picture that ends early": (b"\x89PNG\r\n\x1a\n", "a.png", "a picture", ""),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_not_usable_says_what_to_do(case: str, tmp_path: Path) -> None:
    content, name, what, advice = REFUSED[case]
    (tmp_path / name).write_bytes(content)
    found = inspect_file(tmp_path / name)
    assert not found.usable
    assert found.what.startswith(what)
    assert advice in found.advice
    assert "found" in found.problem and "expected" in found.problem
    assert found.draw is None


def test_a_scene_whose_files_are_missing(inputs: dict[str, Path], tmp_path: Path) -> None:
    shutil.copyfile(inputs["scene.toml"], tmp_path / "scene.toml")
    found = inspect_file(tmp_path / "scene.toml")
    assert not found.usable
    assert len(found.notes) == 3
    assert str(tmp_path / "walk.bvh") in " ".join(found.notes)


def test_folders(tmp_path: Path, inputs: dict[str, Path]) -> None:
    assert inspect_file(tmp_path).what == "a folder of nothing that Trilane knows"
    (tmp_path / "sequence").mkdir()
    shutil.copyfile(inputs["kitti.txt"], tmp_path / "sequence" / "00.txt")
    found = inspect_file(tmp_path / "sequence")
    assert not found.usable
    assert found.advice == "name a file of it: 00.txt (camera)"
    shutil.copytree(inputs["pictures"], tmp_path / "pictures")
    whole = (tmp_path / "pictures" / "001.png").read_bytes()
    (tmp_path / "pictures" / "001.png").write_bytes(whole[: len(whole) // 2])
    found = inspect_file(tmp_path / "pictures")
    assert not found.usable
    assert "001.png" in found.problem


def test_runs_and_reports(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "report.json").write_text(json.dumps(make_report()))
    picture().save(run / "contact.png")
    for path, kind in ((run, "run"), (run / "report.json", "report")):
        found = inspect_file(path)
        assert found.usable, found.problem
        assert found.kind == kind
        assert found.length is not None
        assert found.advice == f"trilane explain {run}"
    (tmp_path / "trace.json").write_text('{"traceEvents": [{}, {}]}')
    assert inspect_file(tmp_path / "trace.json").facts == {"events": 2}


def test_a_run_that_presented_nothing_is_of_no_frame(tmp_path: Path) -> None:
    report = make_report(fps=None)
    for presented, words in ((0, "no frame"), (1, "one frame")):
        report["frames"] |= {"requested": presented + 2, "presented": presented}
        (tmp_path / "report.json").write_text(json.dumps(report))
        assert inspect_file(tmp_path / "report.json").what == f"the report of {words} on the host clock"


def test_the_packets_of_a_trace_count_also_in_compressed_blocks(tmp_path: Path) -> None:
    plain = Trace(packet=[TracePacket(timestamp=at) for at in range(1, 4)]).SerializeToString()
    block = Trace(packet=[TracePacket(compressed_packets=zlib.compress(plain))]).SerializeToString()
    for name in ("trace.perfetto-trace", "trace.PFTRACE"):
        path = tmp_path / name
        path.write_bytes(plain + block + block)
        found = inspect_file(path)
        assert (found.what, found.facts) == ("a trace of 9 events", {"events": 9})
    path.write_bytes(plain + Trace(packet=[TracePacket(compressed_packets=b"no zlib")]).SerializeToString())
    damaged = inspect_file(path)
    assert not damaged.usable
    assert "bytes that do not parse" in damaged.problem


def test_a_folder_that_cannot_be_read_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(path: Path) -> Any:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "iterdir", refused)
    with pytest.raises(BadInputError, match=f"{tmp_path}: found permission denied"):
        inspect_file(tmp_path)


@pytest.mark.parametrize("make", ["missing", "fifo", "loop"])
def test_what_is_no_file_is_an_error(make: str, tmp_path: Path) -> None:
    file = tmp_path / "f"
    if make == "fifo":
        os.mkfifo(file)
    elif make == "loop":
        file.symlink_to(file)
    words = {"missing": "no such file", "fifo": "a pipe", "loop": "leads back to itself"}
    with pytest.raises(BadInputError, match=words[make]):
        inspect_file(file)


def shown(image: Image.Image, colour: tuple[int, int, int]) -> np.ndarray:
    """Columns and rows (N, 2) of the pixels near `colour`."""
    near = np.abs(np.asarray(image).astype(int) - colour).max(axis=2) < 40
    return np.argwhere(near)[:, ::-1]


def test_the_left_of_a_person_who_faces_us_is_on_our_right() -> None:
    """And their front, +Z, is to the right from their right side, and below from above."""
    joints = np.zeros((1, 55, 3))
    for number, name in enumerate(JOINT_NAMES):
        side = 1.0 if name.startswith("left") else -1.0 if name.startswith("right") else 0.0
        joints[0, number] = side * 0.4, 0.03 * number, 0.0
    joints[0, [JOINT_NAMES.index(name) for name in ("left_foot", "right_foot")], 2] = 0.3
    sheet = drawn_skeletons(joints, np.zeros(1), np.zeros((1, 3)))
    tile = inspection.TILE
    assert sheet.size == (2 * tile, 3 * tile)
    front = sheet.crop((0, 30, tile, tile))
    assert shown(front, inspection.LEFT)[:, 0].mean() > tile / 2 > shown(front, inspection.RIGHT)[:, 0].mean()
    right = sheet.crop((0, tile + 20, tile, 2 * tile))
    assert shown(right, inspection.RIGHT)[:, 0].max() > tile / 2 + 10
    above = sheet.crop((0, 2 * tile + 20, tile, 3 * tile))
    feet = shown(above, inspection.LEFT)
    assert feet[feet[:, 1].argmax(), 1] > tile / 2


def test_a_path_begins_green_and_ends_red() -> None:
    """One metre to the right and half a metre up; the frustum opens towards -Z, which from above is up."""
    places = np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.0]])
    sheet = drawn_cameras(np.tile(np.eye(3), (2, 1, 1)), places)
    side = inspection.PATH_TILE
    front = sheet.crop((0, 40, side, side))
    begin, end = (shown(front, colour).mean(axis=0) for colour in (inspection.BEGIN, inspection.END))
    assert end[0] > begin[0] and end[1] < begin[1]
    assert (end - begin)[0] == pytest.approx(-2 * (end - begin)[1], rel=0.05)
    above = sheet.crop((2 * side, 40, 3 * side, side))
    assert shown(above, inspection.LEFT)[:, 1].mean() < shown(above, inspection.BEGIN)[:, 1].mean()


def test_the_command(
    command: Command, check_printed: Callable[[str, str], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is not usable ends with 2, its sentence on stdout with the rest."""
    folder = Path("in")
    monkeypatch.chdir(tmp_path)
    folder.mkdir()
    write_small_inputs(folder, "walk.bvh", "tum.txt", "network.onnx")
    out, err = command("inspect", folder / "walk.bvh", "--out", "sheet.png")
    said = [line.strip() for line in out.splitlines()]
    assert said[0] == "in/walk.bvh: a motion: BVH"
    assert said[-2:] == ["sheet: sheet.png", "use: trilane run --motion in/walk.bvh"]
    assert "length: 4 samples at 30/s, 0.10 s" in said
    assert any(line.startswith("joints mapped: 16: pelvis = Hips") for line in said)
    assert err == ""
    with Image.open("sheet.png") as sheet:
        assert sheet.size == (7 * inspection.TILE, 3 * inspection.TILE)
    assert "nothing to draw" in command("inspect", folder / "network.onnx", "--out", "none.png")[1]
    assert not Path("none.png").exists()
    (folder / "man.fbx").write_bytes(b"Kaydara FBX Binary  \0")
    check_printed("inspect-fbx", command("inspect", folder / "man.fbx", code=2)[0])
    assert json.loads(command("inspect", folder / "man.fbx", "--json", code=2)[0])["usable"] is False
    assert "ends in .png" in command("inspect", folder / "tum.txt", "--out", "a.bmp", code=2)[1]


def test_control_characters_of_a_file_do_not_reach_the_terminal(command: Command, tmp_path: Path) -> None:
    """A joint's name may hold the sequence that clears a screen."""
    text = bvh_text().replace("LeftUpLeg", "\x1b[2JLeg")
    (tmp_path / "a.bvh").write_text(text)
    out, err = command("inspect", tmp_path / "a.bvh", code=2)
    assert "\x1b" not in out + err
    assert "\x1b" not in command("body", "inspect", tmp_path / "\x1b[2J.npz", code=2)[1]


def test_a_sweep_is_no_scene(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text('command = "run"\n[axes]\nsize = ["64", "128"]\n')
    found = inspect_file(tmp_path / "s.toml")
    assert found.usable, found.problem
    assert (found.kind, found.facts["axes"]) == ("sweep file", ["size"])


def test_the_line_that_uses_a_file_is_one_for_a_shell(inputs: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "a walk & $HOME;'x'.bvh"
    shutil.copyfile(inputs["walk.bvh"], path)
    assert shlex.split(inspect_file(path).advice) == ["trilane", "run", "--motion", str(path)]


def test_of_a_file_only_the_line_is_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.bvh").write_text(bvh_text().replace("CHANNELS 6 ", "CHANNELS six ", 1))
    monkeypatch.chdir(tmp_path)
    assert inspect_file(Path("a.bvh")).problem.startswith("line ")
    np.save(tmp_path / "a.npy", np.zeros((4, 322)))
    found = inspect_file(Path("a.npy"))
    assert found.problem.startswith("found shape (4, 322)") and "Motion-X" in found.advice


def test_a_picture_that_moves_is_said_to_be_the_video_as_which_it_is_shown(tmp_path: Path) -> None:
    first, *others = (Image.new("RGB", (32, 24), colour) for colour in ("red", "green", "blue"))
    first.save(tmp_path / "a.gif", save_all=True, append_images=others, duration=100)
    found = inspect_file(tmp_path / "a.gif")
    assert (found.kind, found.length and found.length.samples) == ("video", 3)
    first.save(tmp_path / "still.gif")
    assert inspect_file(tmp_path / "still.gif").kind == "picture"


def test_what_is_not_known_is_not_printed(inputs: dict[str, Path]) -> None:
    found = inspect_file(inputs["amass.npz"])
    assert found.facts["leg_m"] is None
    assert not any("None" in line for line in lines(found, inputs["amass.npz"], None))


def test_frames_of_a_video_of_variable_rate_are_counted(tmp_path: Path) -> None:
    """Matroska has no number of frames: 4 of 1/10 s, then 3 of 1 s."""
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height = 32, 24
        for time in (0, 1, 2, 3, 4, 14, 24):
            frame = av.VideoFrame.from_image(Image.new("RGB", (32, 24)))
            frame.pts = time
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    found = inspect_file(tmp_path / "a.mkv")
    assert found.length is not None and found.length.samples == 7
    assert found.length.rate_hz == pytest.approx(7 / found.length.seconds)
