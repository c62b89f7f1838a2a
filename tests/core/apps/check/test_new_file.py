"""`trilane init`: the file that it writes is right, says what the files hold, and is never half there."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from support.pipeline_files import network
from trilane.apps.check.new_file import _free_name, write_new_file
from trilane.apps.run.run_file import pipeline_of
from trilane.errors import BadInputError
from trilane.pipeline.pipeline_file import read_pipeline


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a video of 48 x 32 pixels at 24 frames a second, and a network."""
    with av.open(str(tmp_path / "clip.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=Fraction(24), options={"g": "1"})
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        for level in (0, 80):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((32, 48, 3), level, np.uint8))))
        container.mux(stream.encode(None))
    onnx.save(network(16, "heat"), tmp_path / "det net.onnx")
    return tmp_path


def two_inputs(path: Path) -> None:
    """A network that adds two pictures of 8 x 8."""
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 3, 8, 8]) for name in ("a", "b", "sum")]
    graph = helper.make_graph([helper.make_node("Add", ["a", "b"], ["sum"])], "g", values[:2], values[2:])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)


def test_the_file_has_the_sizes_and_the_rate_of_the_files(folder: Path) -> None:
    two_inputs(folder / "add.onnx")
    out = folder / "new.toml"
    text = write_new_file(out, [folder / "det net.onnx", folder / "add.onnx"], folder / "clip.mp4", "gpu")
    assert out.read_text(encoding="utf-8") == text
    data = tomllib.loads(text)
    assert (data["run"], data["stages"]["camera"]["size"]) == ({"fps": 24}, "48x32")
    file = read_pipeline(out)
    read = {name: [(each.port, each.stage) for each in stage.inputs] for name, stage in file.stages.items()}
    assert read == {
        "camera": [],
        "det-net-in": [("", "camera")],
        "det-net": [("", "det-net-in")],
        "det-net-out": [("", "det-net")],
        "add-in0": [("", "camera")],
        "add-in1": [("", "camera")],
        "add": [("a", "add-in0"), ("b", "add-in1")],
        "add-out": [("", "add")],
    }
    assert {stage.unit for name, stage in file.stages.items() if name in ("det-net", "add")} == {"gpu"}


def test_names_beyond_the_basic_plane_are_written(folder: Path) -> None:
    name = "x\N{GRINNING FACE}\x7f"
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 3, "h", "w"])]
    values.append(helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 3, "h", "w"]))
    graph = helper.make_graph([helper.make_node("Relu", [name], ["y"])], "g", values[:1], values[1:])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), folder / "net.onnx")
    shapes = {name: (1, 3, 8, 8)}
    text = write_new_file(folder / "new.toml", [folder / "net.onnx"], folder / "clip.mp4", shapes=shapes)
    assert tomllib.loads(text)["stages"]["net"]["shapes"] == {name: "1x3x8x8"}


def test_one_network_twice_has_two_names(folder: Path) -> None:
    write_new_file(folder / "new.toml", [folder / "det net.onnx"] * 2, folder / "clip.mp4")
    assert {"det-net", "det-net-2"} <= read_pipeline(folder / "new.toml").stages.keys()


def test_any_number_of_networks_of_one_stem_have_names_of_their_own() -> None:
    """A name and its endings fit into 40 characters. `a-in` is also what the stage before `a` would be called."""
    names: set[str] = set()
    taken = [_free_name("x" * 50, ("", "-in", "-video"), names) for _ in range(120)]
    assert (len(set(taken)), len(names)) == (120, 360)
    assert (taken[0], taken[99]) == ("x" * 34, "x" * 30 + "-100")
    assert max(map(len, names)) == 40
    names = set()
    assert [_free_name(stem, ("", "-in"), names) for stem in ("a-in", "a", "a")] == ["a-in", "a-2", "a-3"]


def test_the_commented_stages_write_a_video(folder: Path) -> None:
    """Without their # they are stages that a run takes."""
    out = folder / "new.toml"
    text = write_new_file(out, [folder / "det net.onnx"] * 2, folder / "clip.mp4")
    assert "\n# for a video of what det-net finds (mask, or depth), take the # from the next two lines\n# det" in text
    out.write_text(text.replace("\n# det", "\ndet"), encoding="utf-8")
    stages = read_pipeline(out).stages
    drawn, video = stages["det-net-2-drawn"], stages["det-net-2-video"]
    assert [(each.port, each.stage, each.from_port) for each in drawn.inputs] == [
        ("frame", "camera", ""),
        ("mask", "det-net-2", "heat"),
    ]
    assert video.model_dump(include={"block", "path"}) == {"block": "encode", "path": "det-net-2-video.mp4"}
    made = pipeline_of(read_pipeline(out), folder)
    assert len(made.stages) == len(stages) == 11


def test_what_cannot_be_drawn_has_no_stages_in_comments(folder: Path) -> None:
    values = [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 8, 8])]
    for shape in ([1, 1000, 1, 1], [2, 300, 4]):
        found = helper.make_tensor_value_info("y", TensorProto.FLOAT, shape)
        sizes = helper.make_tensor("sizes", TensorProto.INT64, [len(shape)], shape)
        made = helper.make_node("ConstantOfShape", ["sizes"], ["y"])
        used = helper.make_node("Relu", ["x"], ["z"])
        graph = helper.make_graph([made, used], "g", values, [found], [sizes])
        onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)]), folder / "odd.onnx")
        text = write_new_file(folder / f"{len(shape)}.toml", [folder / "odd.onnx"], folder / "clip.mp4")
        assert ("odd-video" in text) is (shape[-1] == 4)
        assert ("# odd finds f32 1x1000x1x1: a stage with python makes a mask or boxes of it" in text) is (
            shape[-1] == 1
        )
    assert 'boxes = "odd.y" }' in text


def test_the_times_that_a_chip_needs_are_said(folder: Path, command: Callable[..., tuple[str, str]]) -> None:
    """The file says which keys to write; with them it is predicted on a chip."""
    out = folder / "new.toml"
    text = write_new_file(out, [folder / "det net.onnx"], folder / "clip.mp4")
    assert "# on a chip, each block but discard needs time_ms = MS, or scale = { CHIP = FACTOR }" in text
    asked = ("predict", out, "--profile", "snapdragon-8-gen-3")
    error = " ".join(command(*asked, code=2)[1].split())
    keys = "stages.camera.time_ms=MS,stages.det-net-in.time_ms=MS"
    assert f"--set {keys};" in error
    command(*asked, "--set", keys.replace("MS", "2"))


def _without_weights(folder: Path) -> list[Path]:
    model = network(16, "heat")
    sizes = list(model.graph.initializer.pop().dims)
    model.graph.input.append(helper.make_tensor_value_info("weights", TensorProto.FLOAT, sizes))
    onnx.save(model, folder / "bare.onnx")
    return [folder / "bare.onnx"]


def _without_data(folder: Path) -> list[Path]:
    path = folder / "outside.onnx"
    onnx.save(network(16, "heat"), path, save_as_external_data=True, location="weights.bin", size_threshold=0)
    (folder / "weights.bin").unlink()
    return [path]


def test_weights_beside_the_network_are_taken(folder: Path) -> None:
    (path,) = _without_data(folder)
    onnx.save(network(16, "heat"), path, save_as_external_data=True, location="weights.bin", size_threshold=0)
    write_new_file(folder / "new.toml", [path], folder / "clip.mp4")


def _vector(folder: Path) -> list[Path]:
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 10]) for name in ("x", "y")]
    graph = helper.make_graph([helper.make_node("Relu", ["x"], ["y"])], "g", values[:1], values[1:])
    path = folder / "vector.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return [path]


@pytest.mark.parametrize(
    ("networks", "video", "out", "words"),
    [
        (lambda f: [f / "none.onnx"], "clip.mp4", "new.toml", "none.onnx"),
        (lambda f: [f / "clip.mp4"], "clip.mp4", "new.toml", "clip.mp4"),
        (lambda f: [f / "det net.onnx"], "det net.onnx", "new.toml", "a video"),
        (lambda f: [f / "det net.onnx"], "clip.mp4", "sub/new.toml", "outside"),
        (_vector, "clip.mp4", "new.toml", "vector"),
        (_without_weights, "clip.mp4", "new.toml", "bare.onnx without weights: 1 are inputs without values"),
        (_without_data, "clip.mp4", "new.toml", "without weights: they are in weights.bin, which is not there"),
    ],
)
def test_what_is_wrong_leaves_no_file(
    folder: Path, networks: Callable[[Path], list[Path]], video: str, out: str, words: str
) -> None:
    (folder / "sub").mkdir()
    with pytest.raises(BadInputError, match=words):
        write_new_file(folder / out, networks(folder), folder / video)
    assert not (folder / out).exists()


def test_nothing_is_overwritten(folder: Path) -> None:
    (folder / "new.toml").write_text("mine", encoding="utf-8")
    with pytest.raises(BadInputError, match="exists"):
        write_new_file(folder / "new.toml", [folder / "det net.onnx"], folder / "clip.mp4")
    assert (folder / "new.toml").read_text(encoding="utf-8") == "mine"
