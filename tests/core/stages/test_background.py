"""Backgrounds from files: the covering rule, order, repetition, bad files, and high range by its curves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from trilane.errors import BadInputError
from trilane.stages.gpu import video_reader
from trilane.stages.gpu.background import open_background, survey
from trilane.stages.gpu.video_reader import HLG, PQ, Pixels, VideoReader, fitted, pq_code, pq_light, roll_off, to_srgb


def test_picture_covers_the_output(tmp_path: Path) -> None:
    pixels = np.zeros((20, 80, 3), np.uint8)
    pixels[:, 30:50] = 200
    Image.fromarray(pixels).save(tmp_path / "wide.png")
    background = open_background(tmp_path / "wide.png", (40, 40), 30)
    picture = background.at(0.0)
    assert picture is not None
    assert picture.shape == (40, 40, 3)
    assert (np.abs(picture[:, 4:-4].astype(int) - 200) <= 1).all()
    assert background.at(1.0) is None


def test_folder_is_shown_in_order_and_again(tmp_path: Path) -> None:
    for name, level in (("b.png", 20), ("a.jpg", 10), ("c.png", 30)):
        Image.fromarray(np.full((8, 8, 3), level, np.uint8)).save(tmp_path / name)
    background = open_background(tmp_path, (8, 8), 10)
    shown = [background.at(step / 10) for step in range(5)]
    assert [int(picture[0, 0, 0]) for picture in shown if picture is not None] == [10, 20, 30, 10, 20]
    assert background.at(0.4) is None


@pytest.fixture(scope="module")
def ramp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of video at 30 frames a second, a key frame every 10; frame N has the grey value 40 + 3 N."""
    path = tmp_path_factory.mktemp("video") / "ramp.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"g": "10", "crf": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv444p"
        for number in range(60):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 40 + 3 * number, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize(
    "numbers",
    [
        pytest.param(range(60), id="forwards"),
        pytest.param(range(0, 150, 7), id="looped"),
        pytest.param([0, 20, 40, 59, *range(60)], id="measured before the run"),
        pytest.param(range(59, -1, -1), id="backwards"),
        pytest.param([130, 70, 69, 3, 140, 65, 64, 0], id="across loops"),
        pytest.param([47], id="after a restart of the unit"),
    ],
)
def test_every_frame_of_a_video_is_shown_at_its_own_time(ramp: Path, numbers: Sequence[int]) -> None:
    reader, picture = open_background(ramp, (48, 64), 30), None
    for number in numbers:
        due = reader.at(number / 30)
        picture = due if due is not None else picture
        assert picture is not None
        assert float(picture.mean()) == pytest.approx(40 + 3 * (number % 60), abs=2), number
    reader.close()


@pytest.mark.timeout(20)
def test_any_error_of_the_decoding_thread_reaches_the_reader(ramp: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = VideoReader(ramp, (48, 64))

    def broken(*_: Any) -> Any:
        raise MemoryError("no memory for a frame")

    monkeypatch.setattr(video_reader, "fitted", broken)
    with pytest.raises(MemoryError, match="no memory for a frame"):
        reader.at(1.9)
    reader.close()


class Turned:
    """A frame of 2 x 4 pixels, whose file says how it is to be turned; scaled by repeating pixels."""

    width, height = 4, 2

    def __init__(self, rotation: float) -> None:
        self.rotation, self.side_data = rotation, ()
        self.pixels = np.arange(8, dtype=np.uint8).reshape(2, 4)

    def reformat(self, width: int, height: int, format: str) -> Any:
        assert format == "rgb24" and width * self.height == height * self.width
        scale = width // self.width
        self.pixels = self.pixels.repeat(scale, 0).repeat(scale, 1)
        return self

    def to_ndarray(self) -> np.ndarray:
        return self.pixels[..., None].repeat(3, 2)


@pytest.mark.parametrize(
    ("rotation", "picture"),
    [
        (0, [[0, 1, 2, 3], [4, 5, 6, 7]]),
        (90, [[3, 7], [2, 6], [1, 5], [0, 4]]),  # counter-clockwise
        (-90, [[4, 0], [5, 1], [6, 2], [7, 3]]),
        (180, [[7, 6, 5, 4], [3, 2, 1, 0]]),
        (-180, [[7, 6, 5, 4], [3, 2, 1, 0]]),
        (270, [[4, 0], [5, 1], [6, 2], [7, 3]]),
        (89.6, [[3, 7], [2, 6], [1, 5], [0, 4]]),
    ],
)
def test_a_frame_is_turned_as_its_file_says(rotation: float, picture: list[list[int]]) -> None:
    wanted = np.array(picture, np.uint8)
    for scale in (1, 2):
        found = fitted(Turned(rotation), Pixels(), (wanted.shape[0] * scale, wanted.shape[1] * scale))
        assert np.array_equal(found[..., 1], wanted.repeat(scale, 0).repeat(scale, 1))


def test_a_frame_that_is_too_wide_or_too_high_loses_both_sides_equally() -> None:
    assert fitted(Turned(0), Pixels(), (2, 2))[..., 0].tolist() == [[1, 2], [5, 6]]
    # Twice the size, 4 x 8, of which the middle rows stay.
    assert fitted(Turned(0), Pixels(), (2, 8))[..., 0].tolist() == [[0, 0, 1, 1, 2, 2, 3, 3], [4, 4, 5, 5, 6, 6, 7, 7]]


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"0 1 2 3 0 0 0 1\n" * 50, "text"),
        ("Grüße\n".encode() * 50, "text"),
        (b"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n/etc/passwd\n", "text"),
        ("frame\n".encode("utf-16") * 50, "text in UTF-16"),
        (b"PK\x03\x04" + bytes(99), "a ZIP archive"),
    ],
)
def test_what_ffmpeg_would_show_though_it_is_no_video_is_refused(tmp_path: Path, content: bytes, found: str) -> None:
    (tmp_path / "a.txt").write_bytes(content)
    with pytest.raises(BadInputError) as refused:
        survey(tmp_path / "a.txt", 30.0)
    assert refused.value.found == found


def shown(transfer: str, red: float, green: float, blue: float, is_wide: bool = True) -> list[int]:
    codes = np.array([[[red, green, blue]]]) * 65535
    return to_srgb(codes.round().astype(np.uint16), transfer, is_wide)[0, 0].tolist()


def code_of(light: float) -> float:
    """PQ of BT.2100, table 4."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    y = (light / 10000) ** m1
    return ((c1 + c2 * y) / (1 + c3 * y)) ** m2


def srgb(light: float) -> float:
    return 255 * (12.92 * light if light <= 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize(
    ("light", "code"), [(0.0, 0.0), (100.0, 0.508), (203.0, 0.581), (1000.0, 0.752), (10000.0, 1.0)]
)
def test_the_curve_of_pq(light: float, code: float) -> None:
    assert float(pq_code(np.array(light))) == pytest.approx(code, abs=6e-4)
    assert code_of(light) == pytest.approx(float(pq_code(np.array(light))), abs=1e-7)
    assert float(pq_light(pq_code(np.array(light)))) == pytest.approx(light, abs=1e-6)


def test_light_below_the_knee_is_kept_and_the_peak_is_white() -> None:
    """The knee is at 1.5 * 0.581 / 0.752 - 0.5 = 0.659 of the peak's code, which is 89 cd/m2."""
    for light in (0.5, 20.0, 85.0):
        assert float(roll_off(np.array(light))) == pytest.approx(light / 203, rel=1e-6)
    assert float(roll_off(np.array(1000.0))) == pytest.approx(1.0)
    lights = np.linspace(0.1, 1000, 500)
    assert (np.diff(roll_off(lights)) > 0).all()


def test_greys_of_pq() -> None:
    for light in (1.0, 20.0, 85.0):
        grey = shown(PQ, *[code_of(light)] * 3)
        assert grey == pytest.approx([srgb(light / 203)] * 3, abs=1.5)
    assert shown(PQ, 0, 0, 0) == [0, 0, 0]
    assert shown(PQ, *[code_of(1000)] * 3) == [255] * 3 == shown(PQ, 1, 1, 1)


def test_white_is_the_same_in_both() -> None:
    """BT.2408: white is at 58 % of PQ and at 75 % of HLG, 203 cd/m2. BT.2390's spline at it, by hand, gives 160."""
    peak, most = code_of(1000), code_of(203) / code_of(1000)
    knee = 1.5 * most - 0.5
    t = (most - knee) / (1 - knee)
    rolled = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * most
    low, high = 0.0, 1000.0
    for _ in range(60):
        low, high = ((low + high) / 2, high) if code_of((low + high) / 2) < rolled * peak else (low, (low + high) / 2)
    assert low == pytest.approx(160, abs=1)
    assert shown(PQ, *[code_of(203)] * 3) == pytest.approx([srgb(low / 203)] * 3, abs=1.5)
    assert shown(HLG, 0.75, 0.75, 0.75) == pytest.approx([srgb(low / 203)] * 3, abs=1.5)


def test_the_curve_and_the_system_gamma_of_hlg() -> None:
    """At half of the code the scene has 1/12 of its light: 1000 * (1/12)^1.2 = 50.7 cd/m2."""
    assert shown(HLG, 0.5, 0.5, 0.5) == pytest.approx([srgb(1000 * (1 / 12) ** 1.2 / 203)] * 3, abs=1.5)
    assert shown(HLG, 1, 1, 1) == [255] * 3


def test_wide_primaries_are_brought_to_those_of_srgb() -> None:
    """sRGB's own red of 40 cd/m2, in BT.2020 (0.6274, 0.0691, 0.0164), comes back as red; with its hue."""
    wide = [code_of(40 * share) for share in (0.6274, 0.0691, 0.0164)]
    assert shown(PQ, *wide) == pytest.approx([srgb(40 / 203), 0, 0], abs=4)
    assert shown(PQ, code_of(40), 0, 0, is_wide=False) == pytest.approx([srgb(40 / 203), 0, 0], abs=1.5)
    assert math.isclose(sum((1.6605, -0.5876, -0.0728)), 1.0, abs_tol=2e-4)
