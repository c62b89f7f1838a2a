"""What is said of a background before a run: size, turn, rate, range; and what is refused then, not in the run."""

from __future__ import annotations

import os
import struct
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image, ImageOps

from trilane.errors import BadInputError
from trilane.scene.camera.path import CameraPath, one_lens
from trilane.scene.footage import Stored, filmed
from trilane.stages.gpu.background import check_pictures, open_background, survey
from trilane.stages.gpu.video_reader import Pixels, fitted, pq_code

WIDTH, HEIGHT, WHITE_PX = 64, 48, 16
LOOSE: Any = SimpleNamespace(is_held=False)


def grey(level: int, shape: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    return np.full((*shape, 3), level, np.uint8)


def write_video(path: Path, times_ms: list[int], white: bool = False, **stream: Any) -> Path:
    """One frame at each time, frame K of grey 10 K; `white`: but for its first columns."""
    with av.open(str(path), "w") as container:
        made = container.add_stream("mpeg4", rate=30)
        made.width, made.height, made.pix_fmt, made.time_base = WIDTH, HEIGHT, "yuv420p", Fraction(1, 1000)
        made.codec_context.time_base = Fraction(1, 1000)
        for key, value in stream.items():
            setattr(made.codec_context, key, value)
        for number, time_ms in enumerate(times_ms):
            pixels = grey(10 * number)
            pixels[:, : WHITE_PX * white] = 255
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = time_ms, Fraction(1, 1000)
            container.mux(made.encode(frame))
        container.mux(made.encode())
    return path


def test_a_steady_video(tmp_path: Path) -> None:
    found = survey(write_video(tmp_path / "a.mkv", [0, 100, 200, 300]), 30.0)
    assert (found.what, found.rate) == (("video of 64x48, mpeg4",), ("10/s",))
    assert found.stored == (Stored((48, 64)),)
    assert found.period_s == pytest.approx(0.4)
    assert (found.files, found.folder) == ((), "")


def test_a_video_of_a_variable_rate_keeps_its_times(tmp_path: Path) -> None:
    """Frames at 0, 0.1, 0.15, 0.4, 0.5 s: of each tenth the newest is shown, and the loop begins at 0.6 s."""
    path = write_video(tmp_path / "a.mkv", [0, 100, 150, 400, 500])
    found = survey(path, 30.0)
    assert found.rate == ("variable rate, 4 to 20/s, 8.33/s on average: its own times are kept",)
    assert found.period_s == pytest.approx(0.6)
    shown, background = [], open_background(path, (HEIGHT, WIDTH), 30.0)
    for tenth in range(13):
        due = background.at(tenth / 10 + 0.001)
        shown.append(shown[-1] if due is None else round(float(due.mean()) / 10))
    background.close()
    assert shown == [0, 1, 2, 2, 3, 4, 0, 1, 2, 2, 3, 4, 0]


def test_pixels_that_are_not_square(tmp_path: Path) -> None:
    """64 columns twice as wide as high are shown as 128, of which 16 are cut off at each end: 16 white ones stay."""
    path = write_video(tmp_path / "a.mkv", [0, 100], white=True, sample_aspect_ratio=Fraction(2, 1))
    assert survey(path, 30.0).stored == (Stored((48, 128)),)
    background = open_background(path, (48, 96), 30.0)
    shown = background.at(0.0)
    background.close()
    assert shown is not None and (shown[:, :14] > 220).all() and (shown[:, 18:] < 40).all()


def test_a_video_that_lies_in_its_file(tmp_path: Path) -> None:
    """The matrix of an MP4's track says a quarter clockwise: what is left in the file is on top."""
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        pixels = grey(20)
        pixels[:, : WIDTH // 2] = 220
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
    content = path.read_bytes()
    matrix = content.index(b"tkhd") + 44
    quarter = np.array([0, 1 << 16, 0, -1 << 16, 0, 0, HEIGHT << 16, 0, 1 << 30], ">i4").tobytes()
    path.write_bytes(content[:matrix] + quarter + content[matrix + 36 :])
    found = survey(path, 30.0)
    assert (found.what, found.stored) == (("video of 48x64, turned by 90 degrees, mpeg4",), (Stored((48, 64), 1),))
    background = open_background(path, (WIDTH, HEIGHT), 30.0)
    shown = background.at(0.0)
    background.close()
    assert shown is not None
    assert float(shown[: WIDTH // 2 - 2].mean()) == pytest.approx(220, abs=3)
    assert float(shown[WIDTH // 2 + 2 :].mean()) == pytest.approx(20, abs=3)


def write_deep(path: Path, light: float, transfer: int) -> Path:
    """A video of 10 bits, all of PQ's code of `light`, BT.2020, of the narrow range."""
    code = round(64 + 876 * float(pq_code(np.array(light))))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p10le"
        codec = stream.codec_context
        codec.color_trc, codec.color_primaries, codec.colorspace, codec.color_range = transfer, 9, 9, 1
        frame = av.VideoFrame(WIDTH, HEIGHT, "yuv420p10le")
        for plane, value in zip(frame.planes, (code, 512, 512), strict=True):
            plane.update(np.full(plane.buffer_size // 2, value, "<u2").tobytes())
        frame.color_trc, frame.color_primaries, frame.colorspace, frame.color_range = transfer, 9, 9, 1
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_high_range_is_tone_mapped_and_said(tmp_path: Path) -> None:
    """White paper, 203 cd/m2, is grey 146 when its code is taken for sRGB's; mapped it is white, with room for more."""
    path = write_deep(tmp_path / "a.mkv", 203.0, 16)
    assert survey(path, 30.0).what[1].startswith("high range (PQ, 10 bits): tone mapped by ITU-R BT.2390")
    background = open_background(path, (HEIGHT, WIDTH), 30.0)
    picture = background.at(0.0)
    background.close()
    assert picture is not None and picture.shape == (HEIGHT, WIDTH, 3) and picture.dtype == np.uint8
    assert float(picture.mean()) == pytest.approx(229, abs=2)


def test_ten_bits_of_the_usual_range_are_said(tmp_path: Path) -> None:
    assert survey(write_deep(tmp_path / "a.mkv", 203.0, 1), 30.0).what[1] == "10 bits a colour: shown with 8"


def test_a_video_that_was_cut_off_is_refused(tmp_path: Path) -> None:
    """An MP4 whose index stands first and names more frames than the file still has."""
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        random = np.random.default_rng(0)
        for _ in range(20):
            pixels = random.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
    assert survey(path, 30.0).period_s == pytest.approx(20 / 30)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 3 // 4])
    with pytest.raises(BadInputError, match=r"a\.mp4: found 1\d of the 20 frames that it names"):
        survey(path, 30.0)


def test_a_picture_that_lies_in_its_file(tmp_path: Path) -> None:
    """EXIF 6: to be turned clockwise by a quarter; stored 8x6, shown 6x8, its left column on top."""
    pixels = np.zeros((6, 8, 3), np.uint8)
    pixels[:, 0] = 200
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif)
    found = survey(tmp_path / "a.png", 30.0)
    assert found.what == ("picture of 6x8, turned by 90 degrees",)
    assert found.stored == (Stored((6, 8), 1),)
    shown = open_background(tmp_path / "a.png", (8, 6), 30.0).at(0.0)
    assert shown is not None and (shown[0] == 200).all() and not shown[1:].any()
    camera: Any = SimpleNamespace(is_held=False, optics=SimpleNamespace(turned=(3,)))
    shown = open_background(tmp_path / "a.png", (8, 6), 30.0, camera).at(0.0)
    assert shown is not None and (shown[7] == 200).all() and not shown[:7].any()


def tagged(path: Path, pixels: np.ndarray, tag: int) -> np.ndarray:
    """Written to `path`; what Pillow shows of it."""
    exif = Image.Exif()
    exif[0x0112] = tag
    Image.fromarray(pixels).save(path, exif=exif)
    with Image.open(path) as image:
        return np.asarray(ImageOps.exif_transpose(image))


@pytest.mark.parametrize("tag", range(1, 9))
def test_every_tag_turns_and_mirrors_as_pillow_does(tmp_path: Path, tag: int) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    upright = tagged(tmp_path / "a.png", pixels, tag)
    (stored,) = survey(tmp_path / "a.png", 30.0).stored
    assert stored.shown() == upright.shape[:2]
    shown = open_background(tmp_path / "a.png", stored.shown(), 30.0).at(0.0)
    assert shown is not None and np.array_equal(shown, upright)


@pytest.mark.parametrize("tag", range(1, 9))
def test_every_tag_is_obeyed_before_a_recorded_camera_too(tmp_path: Path, tag: int) -> None:
    """Of each picture of a folder, which the camera's file does not name, whatever the first one's is."""
    pixels = np.random.default_rng(0).integers(0, 255, (8, 8, 3), dtype=np.uint8)
    shown = [tagged(tmp_path / f"{number}.png", pixels, one) for number, one in enumerate((tag, 1, 5))]
    path = CameraPath(np.zeros(1), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 3)), one_lens(50.0, 0.1, 10.0), ())
    camera, _ = filmed(path, survey(tmp_path, 1.0), (8, 8))
    background = open_background(tmp_path, (8, 8), 1.0, camera)
    for number, upright in enumerate(shown):
        assert np.array_equal(background.at(float(number)), upright)  # type: ignore[arg-type]


@pytest.mark.parametrize("x", [(1, 0), (0, 1), (-1, 0), (0, -1)])
@pytest.mark.parametrize("is_mirrored", [False, True])
def test_a_video_is_turned_and_mirrored_as_its_matrix_says(
    tmp_path: Path, x: tuple[int, int], is_mirrored: bool
) -> None:
    """(x, y) is shown at (a x + c y, b x + d y), y down: where its white columns, at the left, and black rows, at the
    top, are seen tells all of it. The matrix is written into the header of the track."""
    y = (x[1], -x[0]) if is_mirrored else (-x[1], x[0])
    path = write_video(tmp_path / "a.mp4", [0, 33])
    content = bytearray(path.read_bytes())
    at = content.index(b"tkhd") + 44
    content[at : at + 36] = struct.pack(">9i", x[0] << 16, x[1] << 16, 0, y[0] << 16, y[1] << 16, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
    pixels = grey(100)
    pixels[:, :WHITE_PX], pixels[:WHITE_PX] = 255, 0
    marked = av.VideoFrame.from_ndarray(pixels, format="rgb24")
    turned = SimpleNamespace(
        width=WIDTH, height=HEIGHT, rotation=frame.rotation, side_data=frame.side_data, reformat=marked.reformat
    )
    shape = (HEIGHT, WIDTH) if x[0] else (WIDTH, HEIGHT)
    shown = fitted(turned, Pixels(), shape)[..., 1]
    left, top = ((-side[0], -side[1]) for side in (x, y))  # the ways to both sides, as they are shown
    middle = np.array([shape[1], shape[0]]) / 2
    for way, level in ((left, 255), (top, 0)):
        column, row = (middle + np.array(way) * (middle - 4)).astype(int)
        assert abs(int(shown[row, column]) - level) < 12


def test_sixteen_bits_of_grey_are_brought_to_eight(tmp_path: Path) -> None:
    """Pillow would show all above 255 of 65535 as white."""
    Image.fromarray(np.full((8, 8), 128 * 257, np.uint16)).save(tmp_path / "a.png")
    shown = open_background(tmp_path / "a.png", (8, 8), 30.0).at(0.0)
    assert shown is not None and (shown == 128).all()


@pytest.mark.parametrize(
    ("name", "found", "remedy"),
    [("a.heic", "an HEIF photo", "export it as JPEG"), ("a.tif", "numbers with fractions", "8 or 16 bits")],
)
def test_pictures_that_would_be_shown_wrongly_are_refused(tmp_path: Path, name: str, found: str, remedy: str) -> None:
    Image.fromarray(np.ones((8, 8), np.float32)).save(tmp_path / name, format="TIFF")
    with pytest.raises(BadInputError, match=f"{found}.*{remedy}"):
        survey(tmp_path / name, 30.0)


def folder_of(path: Path, numbers: range | list[int]) -> Path:
    path.mkdir()
    for number in numbers:
        Image.fromarray(grey(number)).save(path / f"f{number:03}.png")
    return path


def test_a_folder_with_a_hole_keeps_its_times(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "f", [8, 9, 10, 13])
    found = survey(folder, 10.0)
    assert found.what == ("folder of 4 pictures of 64x48",)
    assert found.rate == ("10/s", "2 numbers missing (11 to 12): the picture before is held")
    assert (found.period_s, found.files[3], found.folder) == (pytest.approx(0.6), "f013.png", str(folder))
    background, shown = open_background(folder, (8, 8), 10.0), []
    for tenth in range(8):
        due = background.at(tenth / 10)
        shown.append(None if due is None else int(due[0, 0, 0]))
    assert shown == [8, 9, 10, None, None, 13, 8, 9]


def test_a_broken_picture_that_the_run_shows_is_found_before(tmp_path: Path) -> None:
    """Picture 7 has a good head and lacks its end; a run of seven frames does not come to it."""
    folder = folder_of(tmp_path / "f", range(12))
    whole = (folder / "f007.png").read_bytes()
    (folder / "f007.png").write_bytes(whole[:-30])
    assert survey(folder, 10.0).stored[7] == Stored((48, 64))
    check_pictures(folder, 10.0, 7, LOOSE)
    for frames in (8, 300):
        with pytest.raises(BadInputError, match=r"f007\.png: found no readable picture"):
            check_pictures(folder, 10.0, frames, LOOSE)
    held: Any = SimpleNamespace(is_held=True, pictures=(str(folder / "f001.png"), str(folder / "f007.png")))
    with pytest.raises(BadInputError, match=r"f007\.png"):
        check_pictures(folder, 10.0, 1, held)
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)).save(tmp_path / "a.jpg")
    check_pictures(tmp_path / "a.jpg", 10.0, 1, LOOSE)
    (tmp_path / "a.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[:-500])
    with pytest.raises(BadInputError, match=r"a\.jpg: found no readable picture"):
        check_pictures(tmp_path / "a.jpg", 10.0, 1, LOOSE)


def test_a_pipe_in_a_folder_is_not_waited_for(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "f", [1, 2])
    os.mkfifo(folder / "f003.png")
    with pytest.raises(BadInputError, match=r"f003\.png: found a device, a pipe or a socket"):
        survey(folder, 30.0)


def test_pictures_one_folder_below_are_pointed_at(tmp_path: Path) -> None:
    folder_of(tmp_path / "images", [1])
    with pytest.raises(BadInputError, match=r"found no pictures, .*; did you mean .*/images\?"):
        survey(tmp_path, 30.0)


@pytest.mark.parametrize(("name", "codec", "pixels"), [("a.mp4", "libx264", "yuv420p"), ("a.gif", "gif", "rgb8")])
def test_what_is_foreseen_of_a_loop_is_what_is_played(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    """Frames are stored in another order than shown; frame K, of grey 40 + 8 K, comes at K / 25 s, again and again."""
    path = tmp_path / name
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25, options={"bf": "3"} if codec == "libx264" else {})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pixels
        for number in range(20):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(grey(40 + 8 * number), format="rgb24")))
        container.mux(stream.encode(None))
    found = survey(path, 30.0)
    assert found.period_s == pytest.approx(0.8)
    background, picture = open_background(path, (HEIGHT, WIDTH), 30.0), None
    for number in range(70):
        due = background.at(number / 25 + 1e-4)
        picture = due if due is not None else picture
        assert picture is not None and float(picture.mean()) == pytest.approx(40 + 8 * (number % 20), abs=4), number
    assert background._period_s == pytest.approx(found.period_s)  # type: ignore[attr-defined]
    background.close()


def test_a_folder_of_several_sizes(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "f", [1, 2])
    Image.fromarray(grey(1, (10, 20))).save(folder / "f003.png")
    assert survey(folder, 30.0).what == ("folder of 3 pictures of 2 sizes, the first 64x48",)
