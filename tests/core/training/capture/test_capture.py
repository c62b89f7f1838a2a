"""Captures: what is read from a folder is what lies there, and all that is wrong with it is listed together."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from support.small_inputs import CAMERA, HEIGHT, WIDTH, fit, write_capture_folder
from trilane.body.body import ShapedBody
from trilane.body.joints import rodrigues
from trilane.errors import BadInputError
from trilane.training.capture import check
from trilane.training.capture.capture import frames_by_side, open_capture, read_fit, widest_gap_deg
from trilane.training.capture.capture_file import (
    OPENGL_FROM_OPENCV,
    Fault,
    FaultyCaptureError,
    fault_lines,
    open_pictures,
    read_capture_file,
)
from trilane.unexpected_value import UnexpectedValue

Command = Callable[..., tuple[str, str]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_capture_folder(tmp_path / "mine")


def faults_of(folder: Path) -> tuple[Fault, ...]:
    with pytest.raises(FaultyCaptureError) as caught:
        open_capture(folder)
    assert caught.value.exit_code == 2
    return caught.value.faults


def test_a_whole_capture_is_read_as_it_lies_there(folder: Path) -> None:
    looked: list[int] = []
    capture = open_capture(folder, lambda numbers: (looked.append(number) or number for number in numbers))
    assert (len(capture), capture.shape, looked) == (8, (HEIGHT, WIDTH), list(range(8)))
    assert capture.betas == pytest.approx(np.full(10, 0.35)) and capture.expression.shape == (0,)
    bodies = capture.shaped.body
    assert np.array_equal(capture.shaped.vertices, bodies.shape(np.full(10, 0.35)).vertices)
    third = capture.fits[3]
    assert third.pose[1:22].reshape(-1) == pytest.approx(fit(3)["body_pose"]) and not third.pose[22:].any()
    assert third.place.tolist() == [0.1, 0.2, -3.0]
    picture = capture.picture(3)
    with Image.open(folder / "frames" / "003.png") as frame:
        assert np.array_equal(picture[..., :3], np.array(frame))
    assert np.flatnonzero(picture[20, :, 3]).tolist() == list(range(33, 60))
    # The camera stands still while the body turns to its right: it sees more and more of the left side.
    yaws = [round(yaw % 360) for yaw, _ in capture.directions()]
    assert abs(yaws[0] - 358) < 4 and [45 * k for k in range(1, 8)] == pytest.approx(yaws[1:], abs=4)


def test_masks_belong_to_frames_by_name(folder: Path) -> None:
    """A mask more, before all others, moves none."""
    Image.fromarray(np.full((HEIGHT, WIDTH), 255, np.uint8)).save(folder / "masks" / "000-old.png")
    capture = open_capture(folder)
    assert [int((capture.picture(k)[20, :, 3] > 0).sum()) for k in range(8)] == [30 - k for k in range(8)]


def test_every_fault_is_listed_with_its_file(folder: Path, command: Command) -> None:
    (folder / "masks" / "000.png").unlink()
    Image.fromarray(np.zeros((HEIGHT, WIDTH, 4), np.uint8)).save(folder / "frames" / "001.png")
    np.savez(folder / "fits" / "002.npz", **fit(2) | {"body_pose": np.zeros(69)})
    Image.fromarray(np.full((HEIGHT, WIDTH), 127, np.uint8)).save(folder / "masks" / "003.png")
    Image.fromarray(np.zeros((HEIGHT + 2, WIDTH, 3), np.uint8)).save(folder / "frames" / "004.png")
    np.savez(folder / "fits" / "005.npz", **fit(5) | {"transl": np.array([0.0, np.nan, 0.0])})
    whole = (folder / "frames" / "006.png").read_bytes()
    (folder / "frames" / "006.png").write_bytes(whole[: len(whole) // 2])
    (folder / "fits" / "007.npz").unlink()
    Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(folder / "masks" / "007.png")
    np.savez(folder / "fits" / "006.npz", global_orient=np.zeros(3), betas=np.zeros(400))
    found = {(fault.where, re.sub(r"truncated \(.*\)\)", "truncated)", fault.found)) for fault in faults_of(folder)}
    assert found == {
        ("masks/000.png", "no mask"),
        ("frames/001.png", "four channels (RGBA)"),
        ("fits/002.npz[body_pose]", "69 numbers (23 joints: the SMPL layout)"),
        ("masks/003.png", "an all-black mask (its greatest value is 127)"),
        ("frames/004.png", f"{WIDTH}x{HEIGHT + 2} pixels"),
        ("masks/004.png", f"{WIDTH}x{HEIGHT} pixels"),
        ("fits/005.npz[transl]", "NaN, infinity or a huge number"),
        ("frames/006.png", "a file that cannot be read (image file is truncated)"),
        ("fits/006.npz", "no `body_pose`"),
        ("fits/006.npz", "no place of the body"),
        ("fits/006.npz[betas]", "400 coefficients"),
        ("fits/007.npz", "no such file"),
        ("masks/007.png", "three channels (RGB)"),
        ("fits", "no frame that shows the right among the 4 with fits that could be read"),
    }
    _, err = command("avatar", "check-data", folder, code=2)
    assert err.startswith(f"error: {folder}: {len(found)} faults; nothing was started\n")
    for where, text in found:
        assert any(where in line and text.rstrip(")") in line for line in err.splitlines()), (where, text)
    assert not (folder / "check-data.png").exists()


def test_a_missing_side_is_listed_with_everything_else(folder: Path) -> None:
    """Frame 3 alone shows nothing of use, so its side counts for nothing; what is said of the back says so."""
    for number in range(8):
        turned = {"global_orient": np.array([0.0, np.radians(180 if number == 3 else 110 * np.sin(number)), 0.0])}
        np.savez(folder / "fits" / f"{number:03}.npz", **fit(number) | turned)
    assert len(open_capture(folder)) == 8
    np.savez(folder / "fits" / "003.npz", **fit(3) | {"body_pose": np.zeros(69)})
    (folder / "masks" / "000.png").unlink()
    found = [fault.found for fault in faults_of(folder)]
    joints = "69 numbers (23 joints: the SMPL layout)"
    assert found == ["no mask", joints, "no frame that shows the back among the 7 with fits that could be read"]


def test_a_side_that_no_frame_shows_is_a_fault_unless_it_may_be_missing(folder: Path) -> None:
    for number in range(8):
        turned = {"global_orient": np.array([0.0, np.radians(110 * np.sin(number)), 0.0])}
        np.savez(folder / "fits" / f"{number:03}.npz", **fit(number) | turned)
    (fault,) = faults_of(folder)
    assert fault.found == "no frame that shows the back" and "missing_views = ['back']" in fault.remedy
    text = (folder / "capture.toml").read_text()
    (folder / "capture.toml").write_text("missing_views = ['back']\n" + text)
    assert len(open_capture(folder)) == 8


def test_faults_of_a_kind_are_one_line() -> None:
    faults = [Fault(f"masks/{n}.png", "no mask", "one") for n in range(14)] + [Fault("fits", "none", "one", "add it")]
    first, second = fault_lines(faults)
    assert first.endswith("masks/11.png and 2 more: found no mask, expected one") and first.startswith(
        "  masks/0.png, "
    )
    assert second == "  fits: found none, expected one; add it"


def test_all_defects_of_the_file_are_listed(tmp_path: Path) -> None:
    text = CAMERA.replace("fx = 90.0\n", "").replace("cy = 30.0", "cy = '30'\nfocal = 3")
    (tmp_path / "capture.toml").write_text(f"schema = 2\nmask = 'm'\n{text}")
    found = {fault.where.removeprefix("capture.toml: "): fault for fault in faults_of(tmp_path)}
    assert set(found) == {"schema", "mask", "camera.fx", "camera.cy", "camera.focal"}
    assert found["mask"].remedy == "did you mean 'masks'?" and found["camera.fx"].found == "nothing"
    (tmp_path / "capture.toml").write_text("schema = ")
    with pytest.raises(BadInputError, match="no valid TOML"):
        read_capture_file(tmp_path)
    with pytest.raises(BadInputError, match="no such file"):
        read_capture_file(tmp_path / "other")


def test_nothing_where_the_file_points_is_said_for_each(tmp_path: Path) -> None:
    (tmp_path / "capture.toml").write_text(f"body = 'b.npz'\nframes = 'f.txt'\n{CAMERA}")
    (tmp_path / "f.txt").write_text("x")
    (tmp_path / "masks").mkdir()
    found = {Path(fault.where).name: fault.found for fault in faults_of(tmp_path)}
    assert found == {"b.npz": "no such file", "f.txt": "the ending '.txt'", "masks": "no pictures"}


def test_names_of_amass_in_one_file_mean_the_same(folder: Path, body: ShapedBody) -> None:
    """Root, body, jaw, both eyes and both hands by the names of AMASS, one row a frame, against one row of 165."""
    rng = np.random.default_rng(2)
    poses = rng.normal(0, 0.3, (8, 165))
    poses[:, :3] = [fit(number)["global_orient"] for number in range(8)]
    place = rng.normal(0, 0.1, (8, 3)) - (0, 0, 3)
    names = {
        "root_orient": (0, 3),
        "pose_body": (3, 66),
        "pose_jaw": (66, 69),
        "pose_eye": (69, 75),
        "pose_hand": (75, 165),
    }
    for number in range(8):
        (folder / "fits" / f"{number:03}.npz").unlink()
    (folder / "fits").rmdir()
    text = (folder / "capture.toml").read_text()
    (folder / "capture.toml").write_text("fits = 'all.npz'\n" + text)
    parts = {name: poses[:, slice(*span)] for name, span in names.items()}
    np.savez(folder / "all.npz", trans=place, betas=np.arange(3.0), mocap_frame_rate=30, **parts)
    capture = open_capture(folder)
    assert np.array_equal([each.pose.reshape(-1) for each in capture.fits], poses)
    assert np.array_equal([each.place for each in capture.fits], place) and capture.betas.tolist() == [0, 1, 2]
    np.savez(folder / "all.npz", transl=place, poses=poses)
    assert np.array_equal(open_capture(folder).fits[5].pose.reshape(-1), poses[5])
    np.savez(folder / "all.npz", transl=place, poses=poses[:7])
    assert [fault.found for fault in faults_of(folder)] == ["shape (7, 165)"]
    whole, none = read_fit("f", {"poses": poses[0, :156], "trans": place[0]}, body.body, True)
    assert not none and whole is not None and not whole.pose[22:25].any()
    assert np.array_equal(whole.pose[25:].reshape(-1), poses[0, 66:156])


def test_hands_may_be_components_and_lack_the_mean(body: ShapedBody) -> None:
    of = body.body
    weights = np.array([0.5, -1.0, 2.0])
    arrays: dict[str, Any] = fit(1) | {"right_hand_pose": weights}
    found, faults = read_fit("f", arrays, of, flat_hand_mean=False)
    assert not faults and found is not None
    wanted = sum(w * row for w, row in zip(weights, of.hand_components[1], strict=False)) + of.hand_mean[45:]
    assert found.pose[40:].reshape(-1) == pytest.approx(wanted) and found.pose[25:40].reshape(-1) == pytest.approx(
        of.hand_mean[:45]
    )


def test_a_frames_own_camera_goes_before_the_captures(folder: Path) -> None:
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    own = {"camera_rotation": turn, "camera_translation": np.array([1.0, 2.0, 3.0])}
    np.savez(folder / "fits" / "002.npz", **fit(2) | own)
    text = (folder / "capture.toml").read_text().replace("opengl", "opencv")
    (folder / "capture.toml").write_text(text + "translation = [0.0, 0.0, 6.0]\n")
    views = open_capture(folder).views
    assert views[2][:3, :3] == pytest.approx(np.diag([1, -1, -1]) @ turn) and views[2][:3, 3].tolist() == [1, -2, -3]
    assert views[1][:3, 3].tolist() == [0, 0, -6] and np.array_equal(views[1][:3, :3], OPENGL_FROM_OPENCV)


def video(path: Path, pictures: list[np.ndarray], form: str) -> None:
    """A lossless video."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, form
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "gray" if picture.ndim == 2 else "rgb24")))
        container.mux(stream.encode())


def test_frames_and_masks_may_be_videos(folder: Path) -> None:
    whole = open_capture(folder)
    pictures = [whole.picture(number) for number in range(8)]
    video(folder / "film.mkv", [picture[..., :3] for picture in pictures], "bgr0")
    video(folder / "masks.mkv", [picture[..., 3] for picture in pictures[:7]], "gray")
    text = (folder / "capture.toml").read_text()
    (folder / "capture.toml").write_text("frames = 'film.mkv'\nmasks = 'masks.mkv'\nfits = 'all.npz'\n" + text)
    np.savez(folder / "all.npz", **{name: np.stack([fit(k)[name] for k in range(8)]) for name in fit(0)})
    assert [(fault.where, fault.found) for fault in faults_of(folder)] == [("masks.mkv#7", "no mask")]
    video(folder / "masks.mkv", [picture[..., 3] for picture in pictures], "gray")
    capture = open_capture(folder)
    assert capture.names[2] == "film.mkv#2" and np.array_equal(capture.fits[6].pose, whole.fits[6].pose)
    for number in (5, 2, 2, 7):  # also backwards
        assert np.array_equal(capture.picture(number), pictures[number])


def test_a_mask_too_many_is_a_fault_where_it_may_belong_to_another_frame(folder: Path) -> None:
    """In a video, where masks are found by number; and in a folder, if two have the name of one frame."""
    masks = [open_capture(folder).picture(number)[..., 3] for number in range(8)]
    Image.fromarray(masks[0]).save(folder / "masks" / "000.jpg")
    assert [(fault.where, fault.found) for fault in faults_of(folder)] == [("masks/000.jpg", "a second mask")]
    video(folder / "masks.mkv", [*masks, masks[0]], "gray")
    text = (folder / "capture.toml").read_text()
    (folder / "capture.toml").write_text("masks = 'masks.mkv'\n" + text)
    assert [(fault.where, fault.found) for fault in faults_of(folder)] == [("masks.mkv", "9 masks for 8 frames")]


def test_a_video_that_got_shorter_has_no_such_picture(tmp_path: Path) -> None:
    grey = np.full((HEIGHT, WIDTH), 90, np.uint8)
    video(tmp_path / "masks.mkv", [grey] * 4, "gray")
    masks = open_pictures(tmp_path / "masks.mkv", "mask")
    video(tmp_path / "masks.mkv", [grey] * 2, "gray")
    assert np.array_equal(masks.read(1), grey)
    with pytest.raises(UnexpectedValue, match="found no picture 3, expected the 4 pictures that the video had"):
        masks.read(3)


def test_a_text_with_the_ending_of_a_video_is_refused(tmp_path: Path) -> None:
    video(tmp_path / "other.mkv", [np.zeros((HEIGHT, WIDTH), np.uint8)], "gray")
    (tmp_path / "masks.mkv").write_text("ffconcat version 1.0\nfile other.mkv\n")
    with pytest.raises(BadInputError, match="found text"):
        open_pictures(tmp_path / "masks.mkv", "mask")


TURN = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])


@pytest.mark.parametrize(
    ("matrix", "is_taken"),
    [
        (TURN, True),
        (np.round(rodrigues(np.array([0.4, -0.3, 0.7])), 3), True),
        (np.zeros((3, 3)), False),
        (1.02 * TURN, False),
        (np.diag([1.0, 1, -1]), False),
        (TURN + np.eye(3), False),
    ],
    ids=["turn", "three digits", "zeros", "scaled", "mirrored", "sheared"],
)
def test_only_a_rotation_is_taken_as_one(matrix: np.ndarray, is_taken: bool, folder: Path) -> None:
    own = {"camera_rotation": matrix, "camera_translation": np.zeros(3)}
    body = open_capture(folder).shaped.body
    found, faults = read_fit("a.npz", {name: np.asarray(value) for name, value in (fit(2) | own).items()}, body, True)
    assert (found is not None) == is_taken
    said = [] if is_taken else ["a matrix that is no rotation"]
    assert [fault.found for fault in faults] == said
    text = (folder / "capture.toml").read_text()
    (folder / "capture.toml").write_text(text + f"rotation = {matrix.tolist()}\n")
    if is_taken:
        read_capture_file(folder)
    else:
        assert [(fault.where, fault.found) for fault in faults_of(folder)] == [("capture.toml: camera.rotation", *said)]


def test_the_widest_gap_goes_over_the_turn() -> None:
    assert widest_gap_deg([-170, 100, -60, 20]) == 110  # from -170 to -60
    assert widest_gap_deg([170, -170, 0]) == 170
    assert widest_gap_deg([12]) == 360
    assert frames_by_side([0, 1, 95]) == {"front": 2, "left": 1, "back": 0, "right": 0}


def test_bodies_that_are_not_where_the_masks_are_are_a_fault(
    folder: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The masks are rectangles, no person's. The sheet shows it; texels are not counted, which takes seconds."""
    monkeypatch.setattr(check, "coverage_of", lambda _: SimpleNamespace(add=lambda *_: None, drawn=lambda *_: None))
    _, err = command("avatar", "check-data", folder, "--sheet", folder / "sheet.png", code=2)
    assert re.search(r"fits: found bodies that overlap the masks by a median IoU of 0\.[0-3]\d", err) and "axes" in err
    with Image.open(folder / "sheet.png") as sheet:
        assert sheet.size == (4 * 320, 2 * 213)
