"""The DSP unit: runtimes by their settings, what is compiled and cached, where tensors lie, and the infer stage."""

from __future__ import annotations

import shutil
import subprocess
import sys
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper

from support.small_pipeline import packet, packets
from trilane import machine
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import constants_of, reshaped
from trilane.avatars.network_split import cuts, split
from trilane.errors import BadInputError, MissingPartError, install_line
from trilane.pipeline.description import UnitSettings
from trilane.scene.schema import Scene
from trilane.stages.config import NetworkCut, RunConfig, network_parts, pose_dtype
from trilane.stages.dsp import infer, ort, runtime
from trilane.stages.dsp.infer import InferStage


@pytest.fixture
def network(tiny_quantised: Any) -> Any:
    return tiny_quantised.network


# --- runtimes --------------------------------------------------------------------------------------------------------


def test_a_part_of_a_package_counts_as_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pack" / "sub").mkdir(parents=True)
    (tmp_path / "pack" / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    entry = runtime.RuntimeEntry("m", "pack", lambda: "line", "sub/lib.so")
    assert not entry.is_installed
    (tmp_path / "pack" / "sub" / "lib.so").touch()
    assert entry.is_installed
    assert runtime.RuntimeEntry("m", "pack", lambda: "line").is_installed
    monkeypatch.setitem(runtime.RUNTIMES, "odd", runtime.RuntimeEntry("m", "no_such", lambda: "line"))
    with pytest.raises(MissingPartError, match="needs the package no_such"):
        runtime.resolve("odd")
    assert "odd" not in runtime.installed()


def test_float_layers_are_named_except_those_that_may_be(network: Any) -> None:
    kinds = ["Conv", "FusedConv", "NhwcFusedConv", "ConvTranspose", "Gemm", "FusedGemm", "MatMul", "FusedMatMul"]
    nodes = [helper.make_node(kind, ["x"], [f"y{k}"], f"n{k}") for k, kind in enumerate([*kinds, "QLinearConv", "Add"])]
    model = helper.make_model(helper.make_graph(nodes, "g", [], []))
    source = SimpleNamespace(where="file.onnx", float_layers=frozenset({"n3"}))
    with pytest.raises(BadInputError, match="left in float: n0, n1, n2, n4, n5, n6, n7, expected integer layers"):
        ort.check_integer(model, source)  # type: ignore[arg-type]
    ort.check_integer(network.model, SimpleNamespace(where="", float_layers={n.name for n in network.model.graph.node}))  # type: ignore[arg-type]


# --- parts -----------------------------------------------------------------------------------------------------------


def test_tensors_of_a_cut_lie_on_their_own_cache_lines() -> None:
    shapes = {"a": (1, 3, 5, 7), "b": (1, 64), "c": (2, 1)}
    assert infer.extent(shapes) == 128 + 64 + 64
    assert infer.extent({}) == 0
    payload = np.arange(200, dtype=np.uint8)
    found = infer.views(payload, shapes)
    assert {name: array.shape for name, array in found.items()} == shapes
    assert [int(array.flat[0]) for array in found.values()] == [0, 128, 192]
    found["c"][:] = 9
    assert payload[192:195].tolist() == [9, 9, 194]
    assert list(infer.views(payload[:194], shapes)) == ["a", "b", "c"]
    with pytest.raises(ValueError, match="a slot of 193 bytes, 194 needed"):
        infer.views(payload[:193], shapes)


def configured(folder: Path, at: list[str] | tuple[str, ...] = (), size: str = "64x64") -> RunConfig:
    units = {name: UnitSettings(cores=(0,), threads=1) for name in ("cpu", "gpu", "dsp")}
    where = ("cpu", "gpu", "dsp")
    made = tuple(NetworkCut(at=name, unit=where[k % 3]) for k, name in enumerate(at))  # type: ignore[arg-type]
    return RunConfig(scene=Scene(size=size), out_dir=folder, avatar_dirs=(folder,), units=units, cuts=made)


def test_parts_of_a_shape_are_the_same_from_the_cache(network: Any, tmp_path: Path) -> None:
    at = [cut.at for cut in cuts(network)][1:4:2]
    config = configured(tmp_path, at)
    expected = split(reshaped(network, 32, 96), at)
    for _ in range(2):
        found = infer.parts_for(config, network, (32, 96))
        assert [part.model for part in found] == [part.model for part in expected]
        for part, same in zip(found, expected, strict=True):
            assert part.where == network.where
            for name in ("inputs", "outputs", "crossing_in", "crossing_out"):
                assert list(getattr(part, name).items()) == list(getattr(same, name).items())
    assert len(infer.parts_for(configured(tmp_path), network, (32, 96))) == 1
    other = infer.parts_for(config, network, (96, 32))
    assert other[0].crossing_in != expected[0].crossing_in


def test_a_cut_needs_room_for_the_shape_that_needs_most(network: Any, tmp_path: Path) -> None:
    at = [cut.at for cut in cuts(network)][1:4:2]
    config = configured(tmp_path, at, size="64")
    sizes = [
        [infer.extent(part.crossing_out) for part in split(reshaped(network, *shape), at)[:-1]]
        for shape in config.buckets
    ]
    assert infer.crossing_bytes(config, network) == np.max(sizes, axis=0).tolist()
    assert infer.crossing_bytes(configured(tmp_path), network) == []


# --- the stage -------------------------------------------------------------------------------------------------------


def slot(payload: int, shape: tuple[int, int], visible: int = 1) -> Any:
    made = packet(payload)
    made.header["tensor_shape"], made.header["avatars"]["visible"] = shape, visible
    return made


def test_three_parts_in_a_row_give_the_bytes_of_the_whole(tiny_bundle: Path) -> None:
    """Tensors that a later part reads are handed on: the skip of the U-Net crosses both cuts."""
    whole = load_bundle(tiny_bundle).read_network()
    pairs = combinations([cut.at for cut in cuts(whole)], 2)
    at = next(pair for pair in pairs if set((middle := split(whole, pair)[1]).crossing_out) - set(middle.outputs))
    config, shape = configured(tiny_bundle, at), (64, 64)
    between = infer.crossing_bytes(config, whole)
    edges = [64 * 64 * 5, *between, 64 * 64 * 4]
    slots = [slot(size, shape) for size in edges]
    slots[0].payload[:] = np.random.default_rng(0).integers(0, 256, edges[0])
    passed = 0
    for number in range(3):
        stage = InferStage(config, [whole], number)
        stage.bind([slots[number]], [slots[number + 1]])
        slots[number + 1].payload[:] = 77
        assert stage.run(0, 0, 0)["inferred"] == 1
        passed += len(stage._bindings[0, shape, 0, 0].passed)
        assert stage.sessions == 1
        stage.close()
        assert stage.sessions == 0
    expected = slot(edges[-1], shape)
    alone = InferStage(configured(tiny_bundle), [whole])
    alone.bind([slots[0]], [expected])
    alone.run(0, 0, 0)
    assert passed > 0
    assert np.array_equal(slots[-1].payload, expected.payload)
    assert expected.payload.std() > 1


CHANNELS = 5


def make(folder, avatars=1, size="64", runtime="ort"):
    scene = Scene.model_validate({"size": size, "avatars": [{}] * avatars})
    units = {"dsp": UnitSettings(cores=(0,), threads=1)}
    config = RunConfig(scene=scene, out_dir=folder, avatar_dirs=(folder,) * avatars, units=units, runtime=runtime)
    stage = InferStage(config, [load_bundle(folder).read_network()])
    pixels = config.max_tensor_pixels * avatars
    inputs, outputs = (packets(pose_dtype(avatars), 2, pixels * channels) for channels in (CHANNELS, 4))
    stage.bind(inputs, outputs)
    return stage, inputs, outputs


def show(slot, shape, visible):
    slot.header["tensor_shape"] = shape
    slot.header["avatar_count"] = len(visible)
    slot.header["avatars"]["visible"][:] = visible


def run_alone(folder, shape, tensor):
    """The picture of one tensor in a stage of its own."""
    stage, inputs, outputs = make(folder, size=f"{shape[0]}x{shape[1]}")
    inputs[0].payload[: tensor.size] = tensor.ravel()
    show(inputs[0], shape, [1])
    stage.run(0, 0, 0)
    return outputs[0].payload[: shape[0] * shape[1] * 4].copy()


def random_tensor(shape, seed):
    return np.random.default_rng(seed).integers(0, 256, (*shape, CHANNELS), dtype=np.uint8)


def test_each_shape_and_slot_has_its_own_session(tiny_bundle):
    stage, inputs, outputs = make(tiny_bundle)
    assert stage.sessions == 3
    for shape, i, o in (((64, 64), 0, 1), ((32, 128), 1, 0), ((128, 32), 1, 1)):
        tensor = random_tensor(shape, i + o)
        inputs[i].payload[: tensor.size] = tensor.ravel()
        show(inputs[i], shape, [1])
        assert stage.run(0, i, o)["inferred"] == 1
        assert (outputs[o].payload[: shape[0] * shape[1] * 4] == run_alone(tiny_bundle, shape, tensor)).all()


@pytest.mark.parametrize("kept", [0, 1])
def test_the_bytes_of_an_inference_are_tensor_picture_and_weights(tiny_bundle, monkeypatch, kept):
    """A tensor of 128 x 32 with 5 channels, a picture of 4, a header of 4824 bytes, and all that the network keeps."""
    monkeypatch.setattr(infer, "moved_of_kept", lambda size: kept * size)
    stage, inputs, _ = make(tiny_bundle)
    show(inputs[0], (128, 32), [1])
    model = load_bundle(tiny_bundle).read_network().model
    weights = kept * sum(onnx.numpy_helper.to_array(tensor).nbytes for tensor in constants_of(model).values())
    figures = stage.run(0, 0, 0)
    read, written = weights + 128 * 32 * 5, 128 * 32 * 4
    names = ("read", "written", "uploaded", "read_back", "least")
    assert [figures[f"bytes_{name}"] for name in names] == [4824 + read, 4824 + written, 0, 0, read + written]


def test_a_device_that_copies_slots_is_given_the_tensor_and_gives_the_picture(tiny_bundle, monkeypatch):
    """Its weights stay with it."""
    monkeypatch.setattr(infer, "copies_slots", lambda _: True)
    monkeypatch.setattr(infer, "has_device", lambda _: True)
    monkeypatch.setattr(infer, "moved_of_kept", lambda size: size)
    stage, inputs, _ = make(tiny_bundle)
    show(inputs[0], (64, 64), [1])
    figures = stage.run(0, 0, 0)
    assert (figures["bytes_uploaded"], figures["bytes_read_back"]) == (64 * 64 * 5, 64 * 64 * 4)
    assert figures["bytes_least"] == 64 * 64 * 9


def test_nothing_visible_is_transparent_and_not_inferred(tiny_bundle):
    stage, inputs, outputs = make(tiny_bundle)
    outputs[0].payload[:] = 9
    show(inputs[0], (0, 0), [0])
    assert stage.run(0, 0, 0)["inferred"] == 0
    assert not outputs[0].payload.any()


def test_avatars_share_one_inference(tiny_bundle):
    shape = (64, 64)
    stage, inputs, outputs = make(tiny_bundle, avatars=3)
    tensor = random_tensor(shape, 0)
    inputs[0].payload[: tensor.size] = tensor.ravel()
    show(inputs[0], shape, [1, 0, 1])
    assert stage.run(0, 0, 0)["inferred"] == 1
    found = outputs[0].payload[: shape[0] * shape[1] * 4]
    assert (found == run_alone(tiny_bundle, shape, tensor)).all()


def other_network(folder, tmp_path):
    """A copy of the bundle in `folder` whose network has other weights."""
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    model = onnx.load(other / "network.onnx")
    weights = next(one for one in model.graph.initializer if len(one.dims) == 4)
    turned = onnx.numpy_helper.to_array(weights)[::-1].copy()
    weights.CopyFrom(onnx.numpy_helper.from_array(turned, weights.name))
    onnx.save(model, other / "network.onnx")
    return other


@pytest.mark.parametrize(("visible", "inferred"), [([1, 1, 1], [0, 1]), ([0, 1, 0], [1]), ([1, 0, 1], [0])])
def test_each_network_paints_its_own_tensor(tiny_bundle, tmp_path, visible, inferred):
    """Three avatars, the second of another network; who is not in view costs no inference."""
    folders = [tiny_bundle, other_network(tiny_bundle, tmp_path)]
    networks = [load_bundle(folder).read_network() for folder in folders]
    scene = Scene.model_validate({"size": "64x64", "avatars": [{}] * 3})
    config = RunConfig(
        scene=scene,
        out_dir=tmp_path,
        avatar_dirs=(folders[0], folders[1], folders[0]),
        units={"dsp": UnitSettings(cores=(0,), threads=1)},
        networks=(0, 1, 0),
    )
    stage, shape = InferStage(config, networks), (64, 64)
    source, target = packet(64 * 64 * 16 * 2, 3), packet(64 * 64 * 4 * 2, 3)
    stage.bind([source], [target])
    assert stage.sessions == 2
    tensors = [random_tensor(shape, number) for number in range(2)]
    for tensor, part in zip(tensors, network_parts(source.payload, 2, [shape], 16), strict=True):
        part[: tensor.size] = tensor.ravel()
    target.payload[:] = 7
    show(source, shape, visible)
    assert stage.run(0, 0, 0)["inferred"] == len(inferred)
    expected = [run_alone(folder, shape, tensor) for folder, tensor in zip(folders, tensors, strict=True)]
    assert (expected[0] != expected[1]).any()
    for number, part in enumerate(network_parts(target.payload, 2, [shape], 4)):
        assert (part == (expected[number] if number in inferred else 7)).all()


def test_a_shape_that_is_no_bucket_is_named(tiny_bundle):
    stage, inputs, _ = make(tiny_bundle, size="64x64")
    show(inputs[0], (96, 96), [1])
    with pytest.raises(BadInputError, match="96x96"):
        stage.run(7, 0, 0)


def test_an_error_of_openvino_is_a_part_of_a_sentence() -> None:
    error = RuntimeError("Exception from core.cpp:105:\nUnable to read the model. Please check it.\n\n")
    said = str(BadInputError("a.onnx", runtime.said_by_openvino(error), "a network that OpenVINO loads"))
    text = "Exception from core.cpp:105: Unable to read the model. Please check it"
    assert said == f"a.onnx: found {text}, expected a network that OpenVINO loads"


def test_openvino_is_loaded_without_its_telemetry() -> None:
    """Imported by itself it tells its maker's server; this is its own stand-in, which does nothing."""
    if not machine.here.has_package("openvino"):
        pytest.skip(f"OpenVINO is not installed: {install_line('openvino')}")
    program = (
        "import trilane.stages.dsp.openvino, sys\n"
        "print(sys.modules['openvino_telemetry'], sys.modules['openvino.tools.ovc.telemetry_utils'].tm.__name__)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == ["None", "openvino.tools.ovc.telemetry_stub"]
