"""The stages of a pipeline file, each alone: what they write for what they read."""

from __future__ import annotations

import errno
import time
from pathlib import Path
from typing import Any

import av
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from PIL import Image

from support.ported_stages import Ported
from trilane.errors import BadInputError, TrilaneError
from trilane.stages.blocks import network, own_code, pictures, video
from trilane.stages.dsp.runtime import installed

RNG = np.random.default_rng(3)


def picture(height: int, width: int, channels: int = 3) -> NDArray[np.uint8]:
    return RNG.integers(0, 256, (height, width, channels), dtype=np.uint8)


# prepare


def test_a_float_network_gets_each_channel_normalised_and_first(tmp_path: Path) -> None:
    mean, sd = [0.5, 0.25, 0.1], [0.2, 0.5, 1.0]
    stage = Ported(pictures.build_prepare, {"": "u8 4x6x3"}, {"": "f32 1x3x4x6"}, tmp_path, mean=mean, sd=sd)
    shown = picture(4, 6)
    expected = [[[(int(shown[y, x, c]) / 255 - mean[c]) / sd[c] for x in range(6)] for y in range(4)] for c in range(3)]
    assert stage(shown)[0] == pytest.approx(np.array(expected), abs=1e-6)


def test_bytes_stay_bytes_and_signed_bytes_are_128_less(tmp_path: Path) -> None:
    shown = picture(4, 6)
    assert (Ported(pictures.build_prepare, {"": "u8 4x6x3"}, {"": "u8 1x4x6x3"}, tmp_path)(shown)[0] == shown).all()
    signed = Ported(pictures.build_prepare, {"": "u8 4x6x3"}, {"": "i8 1x3x4x6"}, tmp_path)(shown)[0]
    assert (signed == shown.astype(int).transpose(2, 0, 1) - 128).all()


def test_quantised_numbers_follow_step_and_zero_point_and_are_clipped(tmp_path: Path) -> None:
    """(255/255 - 0.5) / 0.25 = 2, over 0.01 is 200, and 10 more; byte 0 gives -200 + 10, below the least of int8."""
    keys = {"mean": [0.5], "sd": [0.25], "step": 0.01, "zero_point": 10}
    shown = np.array([[[255] * 3, [0] * 3, [128] * 3]], np.uint8)
    found = Ported(pictures.build_prepare, {"": "u8 1x3x3"}, {"": "i16 1x1x3x3"}, tmp_path, **keys, layout="nhwc")(
        shown
    )
    assert found[0, 0, :, 0].tolist() == [210, -190, round((128 / 255 - 0.5) / 0.25 / 0.01 + 10)]
    clipped = Ported(pictures.build_prepare, {"": "u8 1x3x3"}, {"": "i8 1x1x3x3"}, tmp_path, **keys, layout="nhwc")(
        shown
    )
    assert clipped[0, 0, :2, 0].tolist() == [127, -128]


def test_a_letterbox_keeps_the_shape_between_grey_bars_and_a_crop_its_middle(tmp_path: Path) -> None:
    """A white picture of 2 to 1 in a square of 8: two grey rows, four white ones, two grey ones."""
    white = np.full((4, 8, 3), 255, np.uint8)
    boxed = Ported(pictures.build_prepare, {"": "u8 4x8x3"}, {"": "u8 1x8x8x3"}, tmp_path, fit="letterbox")(white)[0]
    assert boxed[:, 0, 0].tolist() == [114, 114, 255, 255, 255, 255, 114, 114]
    sides = white.copy()
    sides[:, :2], sides[:, 6:] = 0, 0
    cut = Ported(pictures.build_prepare, {"": "u8 4x8x3"}, {"": "u8 1x4x4x3"}, tmp_path, fit="crop")(sides)[0]
    assert (cut == 255).all()
    stretched = Ported(pictures.build_prepare, {"": "u8 4x8x3"}, {"": "u8 1x4x4x3"}, tmp_path)(sides)[0]
    assert stretched[:, 0].max() < 128 < stretched[:, 1].min()


def test_a_grey_network_gets_luminance(tmp_path: Path) -> None:
    shown = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]]], np.uint8)
    found = Ported(pictures.build_prepare, {"": "u8 1x3x3"}, {"": "u8 1x1x1x3"}, tmp_path, layout="nchw")(shown)
    assert found.ravel().tolist() == [76, 150, 29]  # ITU-R 601-2, as Pillow rounds it


@pytest.mark.parametrize(
    ("writes", "keys", "match"),
    [
        ("f32 2x3x4x4", {}, "found a network for 2 pictures at once"),
        ("f32 1x5x4x7", {}, "expected 1 or 3 channels, first or last"),
        ("f32 1x3x4x4", {"mean": [1.0, 2.0]}, r"tried.mean: found 2 values, expected 1 or 3"),
        ("i16 1x3x4x4", {}, r"tried.step: found nothing"),
        ("f32 12", {}, "expected one that reads pictures"),
    ],
)
def test_a_network_that_takes_no_such_picture_is_refused(
    writes: str, keys: dict[str, Any], match: str, tmp_path: Path
) -> None:
    with pytest.raises(BadInputError, match=match):
        Ported(pictures.build_prepare, {"": "u8 4x4x3"}, {"": writes}, tmp_path, **keys)


# networks


def saved(
    path: Path, kind: int, nodes: list[onnx.NodeProto], constants: dict[str, NDArray[Any]], inputs: int = 1
) -> None:
    shape = [1, 3, 2, 2]
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info(f"x{place}", kind, shape) for place in range(inputs)],
        [helper.make_tensor_value_info("y", kind, shape)],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)


@pytest.fixture(params=["ort", "openvino"])
def runtime(request: pytest.FixtureRequest) -> str:
    """A runtime on the cores, where it is installed."""
    if request.param not in installed():
        pytest.skip(f"{request.param} is not installed")
    return str(request.param)


@pytest.mark.parametrize(
    ("kind", "port", "dtype"),
    [
        (TensorProto.FLOAT, "f32", np.float32),
        (TensorProto.FLOAT16, "f16", np.float16),
        (TensorProto.UINT8, "u8", np.uint8),
        (TensorProto.INT8, "i8", np.int8),
    ],
)
def test_a_network_reads_and_writes_the_slots_in_its_own_numbers(
    kind: int, port: str, dtype: type[np.generic], runtime: str, tmp_path: Path
) -> None:
    """Max and Transpose take every type: the network swaps height and width, and cuts off below 3."""
    nodes = [
        helper.make_node("Max", ["x0", "three"], ["m"]),
        helper.make_node("Transpose", ["m"], ["y"], perm=[0, 1, 3, 2]),
    ]
    saved(tmp_path / "net.onnx", kind, nodes, {"three": np.array(3, dtype)})
    keys = {"onnx": "net.onnx", "runtime": runtime, "inputs": {"x0": f"{port} 1x3x2x2"}}
    stage = Ported(network.build, {"": f"{port} 1x3x2x2"}, {"y": f"{port} 1x3x2x2"}, tmp_path, **keys)
    given = np.arange(12).reshape(1, 3, 2, 2).astype(dtype)
    for values in (given, given[:, ::-1]):
        assert (stage(values) == np.maximum(values, 3).transpose(0, 1, 3, 2)).all()


def test_a_network_of_two_inputs_takes_them_by_name_and_an_absent_one_as_zeros(runtime: str, tmp_path: Path) -> None:
    nodes = [helper.make_node("Sub", ["x0", "x1"], ["y"])]
    saved(tmp_path / "net.onnx", TensorProto.FLOAT, nodes, {}, inputs=2)
    keys = {"onnx": "net.onnx", "runtime": runtime, "inputs": {"x0": "f32 1x3x2x2", "x1": "f32 1x3x2x2"}}
    reads = {"x1": "f32 1x3x2x2", "x0": "f32 12"}
    stage = Ported(network.build, reads, {"y": "f32 1x3x2x2"}, tmp_path, **keys)
    a, b = RNG.normal(size=(2, 12)).astype(np.float32)
    assert stage(a.reshape(1, 3, 2, 2), b).ravel().tolist() == (b - a).tolist()
    assert stage(None, b).ravel().tolist() == b.tolist()
    assert stage(a.reshape(1, 3, 2, 2), b).ravel().tolist() == (b - a).tolist()


def test_a_network_takes_a_picture_as_it_is(runtime: str, tmp_path: Path) -> None:
    saved(tmp_path / "net.onnx", TensorProto.FLOAT, [helper.make_node("Identity", ["x0"], ["y"])], {})
    keys = {"onnx": "net.onnx", "runtime": runtime, "inputs": {"x0": "f32 1x3x2x2"}}
    stage = Ported(network.build, {"": "u8 2x2x3"}, {"y": "f32 1x3x2x2"}, tmp_path, **keys)
    shown = picture(2, 2)
    assert stage(shown)[0] == pytest.approx(shown.transpose(2, 0, 1) / 255, abs=1e-6)


def test_a_network_of_several_outputs_writes_those_that_are_read(runtime: str, tmp_path: Path) -> None:
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["rows", 3]) for name in ("x", "y", "z")]
    nodes = [helper.make_node("Neg", ["x"], ["y"]), helper.make_node("Abs", ["x"], ["z"])]
    graph = helper.make_graph(nodes, "g", values[:1], values[1:])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, tmp_path / "net.onnx")
    keys = {"onnx": "net.onnx", "runtime": runtime, "inputs": {"x": "f32 2x3"}}
    given = np.array([[1, -2, 3], [-4, 5, -6]], np.float32)
    assert (Ported(network.build, {"": "f32 2x3"}, {"z": "f32 2x3"}, tmp_path, **keys)(given) == np.abs(given)).all()
    both = Ported(network.build, {"": "f32 2x3"}, {"y": "f32 2x3", "z": "f32 2x3"}, tmp_path, **keys)
    assert (both(given) == -given).all()


def test_a_file_that_is_no_network_is_refused(runtime: str, tmp_path: Path) -> None:
    (tmp_path / "net.onnx").write_bytes(b"\x08\x01")
    keys = {"onnx": "net.onnx", "runtime": runtime, "inputs": {"x": "f32 4"}}
    with pytest.raises(BadInputError, match=r"expected a network that (ONNX Runtime|OpenVINO) loads"):
        Ported(network.build, {"": "f32 4"}, {"y": "f32 4"}, tmp_path, **keys)


# overlay


def test_the_largest_of_several_channels_is_drawn_but_for_the_background(tmp_path: Path) -> None:
    classes = np.array([[0, 1], [2, 2]])
    scores = np.eye(3, dtype=np.float32)[np.kron(classes, np.ones((4, 4), int))].transpose(2, 0, 1)[None]
    stage = Ported(
        pictures.build_overlay, {"frame": "u8 2x2x3", "mask": "f32 1x3x8x8"}, {"": "u8 2x2x3"}, tmp_path, alpha=1.0
    )
    shown = picture(2, 2)
    colours = pictures.class_colours()
    assert (stage(shown, scores) == np.array([[shown[0, 0], colours[1]], [colours[2], colours[2]]])).all()
    half = Ported(pictures.build_overlay, {"frame": "u8 2x2x3", "mask": "u8 2x2"}, {"": "u8 2x2x3"}, tmp_path)
    drawn = half(np.zeros((2, 2, 3)), np.array([[0, 1], [1, 0]], np.uint8))
    assert (drawn == np.where(np.eye(2)[..., None] > 0, 0, colours[1] // 2)).all()


def test_a_box_is_a_frame_in_pixels_or_in_shares_and_only_with_a_score(tmp_path: Path) -> None:
    reads = {"frame": "u8 10x20x3", "boxes": "f32 2x5"}
    stage = Ported(pictures.build_overlay, reads, {"": "u8 10x20x3"}, tmp_path)
    pixels = np.array([[4, 2, 14, 9, 0.9], [0, 0, 20, 10, 0.0]], np.float32)
    drawn = stage(np.zeros((10, 20, 3)), pixels).any(axis=2)
    expected = np.zeros((10, 20), bool)
    expected[2:9, 4:14] = True
    expected[4:7, 6:12] = False
    assert (drawn == expected).all()
    shares = pixels * np.array([1 / 20, 1 / 10, 1 / 20, 1 / 10, 1], np.float32)
    assert (stage(np.zeros((10, 20, 3)), shares).any(axis=2) == expected).all()
    assert not stage(np.zeros((10, 20, 3)), np.full((2, 5), np.nan, np.float32)).any()
    assert not stage(np.zeros((10, 20, 3)), None).any()


def test_infinite_depths_are_the_ends_of_the_finite_ones(tmp_path: Path) -> None:
    """Blue (0, 0, 255) is the least depth, and red (255, 0, 0) the largest."""
    reads = {"frame": "u8 2x5x3", "depth": "f32 2x5"}
    stage = Ported(pictures.build_overlay, reads, {"": "u8 2x5x3"}, tmp_path, alpha=1.0)
    depth = np.array([[2.0, 4.0, np.inf, -np.inf, np.nan]] * 2, np.float32)
    red, blue = [255, 0, 0], [0, 0, 255]
    assert stage(np.zeros((2, 5, 3)), depth)[1].tolist() == [blue, red, red, blue, blue]
    assert stage(np.zeros((2, 5, 3)), np.full((2, 5), np.inf, np.float32))[1].tolist() == [blue] * 5


# own code


def own(tmp_path: Path, code: str, reads: dict[str, str], writes: dict[str, str], **settings: Any) -> Ported:
    """A stage of `code`; each call has a module of its own, so that none is found among those imported before."""
    name = f"own{time.monotonic_ns()}"
    (tmp_path / f"{name}.py").write_text(f"import numpy as np\n{code}")
    return Ported(own_code.build, reads, writes, tmp_path, python=f"{name}:make", settings=settings)


@pytest.fixture(autouse=True)
def importable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))


READS = {"a": "f32 3", "b": "f32 3"}


def test_code_gets_its_ports_by_name_and_returns_them_by_name(tmp_path: Path) -> None:
    code = (
        "def make(settings):\n    def work(a, b):\n"
        "        return {'both': a + b * settings['times'], 'none': np.array([b is None])}\n    return work\n"
    )
    stage = own(tmp_path, code, READS, {"both": "f32 3", "none": "bool 1"}, times=np.float32(2).item())
    assert stage(np.ones(3), np.arange(3)).tolist() == [1, 3, 5]
    assert not stage.written["none"][0]


def test_code_may_fill_the_slot_itself_and_may_get_nothing(tmp_path: Path) -> None:
    code = (
        "class make:\n    def __init__(self, settings): pass\n    def __call__(self, a, b, out):\n"
        "        out['y'][...] = -1 if b is None else a\n"
    )
    stage = own(tmp_path, code, READS, {"y": "f32 3"})
    assert stage(np.arange(3), np.ones(3)).tolist() == [0, 1, 2]
    assert stage(np.arange(3), None).tolist() == [-1, -1, -1]


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("return {'y': np.zeros(3)}", "found|returned f64 3 for port y, expected f32 3"),
        ("return {'y': np.zeros((1, 3), np.float32)}", "returned f32 1x3 for port y, expected f32 3"),
        ("return {'z': a}", "returned a dict of z, expected y"),
        ("return None", "returned NoneType for port y, expected f32 3"),
        ("a[0] = 1", r"stages.tried: ValueError: .*read-only at .*/own\d+\.py, line 4"),
        ("return a[b]", r"stages.tried: IndexError: .* at .*/own\d+\.py, line 4"),
    ],
)
def test_what_is_wrong_with_code_names_the_stage_and_the_line(line: str, match: str, tmp_path: Path) -> None:
    stage = own(
        tmp_path, f"def make(settings):\n    def work(a, b):\n        {line}\n    return work\n", READS, {"y": "f32 3"}
    )
    with pytest.raises(TrilaneError, match=match.removeprefix("found|")):
        stage(np.zeros(3), np.zeros(3))


def test_a_module_that_is_missing_later_is_told_with_the_line_that_imports_it(tmp_path: Path) -> None:
    code = "def make(settings):\n    def work(a, b):\n        import nowhere_at_all\n    return work\n"
    stage = own(tmp_path, code, READS, {"y": "f32 3"})
    expected = r"stages.tried: ModuleNotFoundError: No module named 'nowhere_at_all' at .*/own\d+\.py, line 4$"
    with pytest.raises(TrilaneError, match=expected):
        stage(np.zeros(3), np.zeros(3))


@pytest.mark.parametrize(
    ("code", "match"),
    [
        ("def other(settings): ...", r"tried.python: found no function 'make' in own\d+, expected one of other$"),
        ("def make(settings): return 3", "found make returned int, expected something callable"),
        ("import nowhere_at_all", "found no module 'nowhere_at_all'"),
        ("1 / 0", r"stages.tried: ZeroDivisionError: division by zero at .*, line 2"),
    ],
)
def test_code_that_cannot_be_made_is_refused_by_name(code: str, match: str, tmp_path: Path) -> None:
    with pytest.raises(TrilaneError, match=match):
        own(tmp_path, code, READS, {"y": "f32 3"})


# video, loads


def written_video(path: Path, count: int, fps: int = 25) -> None:
    """A video whose picture n is grey of 5 n."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = 32, 16, "yuv420p"
        for number in range(count):
            grey = np.full((16, 32, 3), 5 * number, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="rgb24")))
        container.mux(stream.encode())


def test_a_frame_of_a_video_is_found_by_its_number_and_the_video_begins_again(tmp_path: Path) -> None:
    written_video(tmp_path / "v.mp4", 40)
    assert video.footage(tmp_path / "v.mp4") == (40, 25.0)
    stage = Ported(video.build_video, {}, {"": "u8 16x32x3"}, tmp_path, path="v.mp4")
    try:
        for frame in (0, 1, 2, 7, 30, 39, 40, 45, 3):
            assert stage(frame=frame).mean() == pytest.approx(5 * (frame % 40), abs=2), frame
    finally:
        stage.stage.close()


def test_a_run_at_half_the_rate_shows_every_second_picture(tmp_path: Path) -> None:
    written_video(tmp_path / "v.mp4", 40)
    stage = Ported(video.build_video, {}, {"": "u8 16x32x3"}, tmp_path, path="v.mp4", fps=12.5)
    try:
        assert [round(stage(frame=frame).mean() / 10) for frame in (0, 1, 5, 9)] == [0, 1, 5, 9]
    finally:
        stage.stage.close()


def test_pictures_of_a_folder_are_shown_by_name_at_one_size(tmp_path: Path) -> None:
    for number, size in enumerate([(8, 8), (4, 12), (20, 10)]):
        Image.new("RGB", size, (50 * number, 0, 0)).save(tmp_path / f"{number}.png")
    stage = Ported(video.build_video, {}, {"": "u8 6x6x3"}, tmp_path, path=".")
    assert [int(stage(frame=frame)[0, 0, 0]) for frame in range(4)] == [0, 50, 100, 0]
    assert video.footage(tmp_path) == (3, None)
    (tmp_path / "no").mkdir()
    with pytest.raises(BadInputError, match="found no pictures"):
        video.footage(tmp_path / "no")
    (tmp_path / "no.mp4").write_bytes(b"\0nothing")
    with pytest.raises(BadInputError, match="no readable video"):
        video.footage(tmp_path / "no.mp4")


def test_a_single_photo_is_shown_again_and_again(tmp_path: Path) -> None:
    """FFmpeg reads a larger JPEG with its reader of numbered pictures, which opens other files."""
    noise = np.random.default_rng(1).integers(0, 255, (240, 320, 3), np.uint8)
    Image.fromarray(noise).resize((1280, 960)).save(tmp_path / "photo.jpg")
    assert video.footage(tmp_path / "photo.jpg") == (1, None)
    stage = Ported(video.build_video, {}, {"": "u8 16x32x3"}, tmp_path, path="photo.jpg")
    assert np.array_equal(stage(frame=0), stage(frame=7))


def test_a_text_that_names_another_video_is_refused(tmp_path: Path) -> None:
    written_video(tmp_path / "other.mp4", 2)
    (tmp_path / "list.txt").write_text("ffconcat version 1.0\nfile other.mp4\n")
    with pytest.raises(BadInputError, match=r"list\.txt: found text, expected a video"):
        video.footage(tmp_path / "list.txt")
    with pytest.raises(BadInputError, match=r"list\.txt: found text, expected a video"):
        Ported(video.build_video, {}, {"": "u8 16x32x3"}, tmp_path, path="list.txt", fps=25.0)
    # A byte that no text has makes the head look like a video's, but FFmpeg still takes the list.
    (tmp_path / "list.mp4").write_text("ffconcat version 1.0\n#\x01\nfile other.mp4\n")
    with pytest.raises(BadInputError, match=r"list\.mp4: found no readable video"):
        video.footage(tmp_path / "list.mp4")


def test_a_folder_is_in_the_order_of_numbers_and_refused_if_it_cannot_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in (2, 10):
        Image.new("RGB", (4, 4), (20 * number, 0, 0)).save(tmp_path / f"frame{number}.png")
    stage = Ported(video.build_video, {}, {"": "u8 4x4x3"}, tmp_path, path=".")
    assert [int(stage(frame=frame)[0, 0, 0]) for frame in range(2)] == [40, 200]
    (tmp_path / "frame3.png").mkdir()
    with pytest.raises(BadInputError, match=r"frame3\.png: found a folder"):
        video.footage(tmp_path)

    def refuse(_: Path) -> Any:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(BadInputError, match="no readable folder \\(permission denied\\)"):
        video.footage(tmp_path)


@pytest.mark.parametrize(("height", "width"), [(1, 8), (8, 1)])
def test_a_picture_too_small_for_a_video_is_refused(height: int, width: int, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=f"tried.in: found a picture of {width}x{height} pixels"):
        Ported(video.build_encode, {"": f"u8 {height}x{width}x3"}, {}, tmp_path, segments="s", fps=30.0)


def test_a_made_up_load_takes_its_time_of_the_core(tmp_path: Path) -> None:
    stage = Ported(own_code.build_load, {"": "u8 1"}, {}, tmp_path, block="busy", load_ms=20.0)
    before = time.thread_time()
    stage(np.zeros(1))
    assert 0.02 <= time.thread_time() - before < 0.03
