"""The infer stage: one network, which shape, which slot; transparent where nothing is visible."""

from __future__ import annotations

import shutil
import subprocess
import sys

import numpy as np
import onnx
import pytest

from support.small_pipeline import assets_of
from trilane import machine
from trilane.avatars.bundle import load_bundle
from trilane.avatars.integer_network import constants_of
from trilane.errors import BadInputError
from trilane.install import install_line
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.stage import UnitContext
from trilane.scene.schema import Scene
from trilane.stages.config import RunConfig
from trilane.stages.dsp import infer
from trilane.stages.dsp.infer import InferStage, build
from trilane.stages.dsp.runtime import RUNTIMES, copies_slots
from trilane.stages.packets import pose_dtype
from trilane.transport.packets import SlotLayout, view_packet

CHANNELS = 5


def slots(count, avatars, payload):
    layout = SlotLayout(pose_dtype(avatars), payload)
    return [view_packet(memoryview(bytearray(layout.slot_bytes)), layout) for _ in range(count)]


def make(folder, avatars=1, size="64", runtime="ort"):
    scene = Scene.model_validate({"size": size, "avatars": [{}] * avatars})
    units = {"dsp": UnitSettings(cores=(0,), threads=1)}
    config = RunConfig(scene=scene, out_dir=folder, avatar_dirs=(folder,) * avatars, units=units, runtime=runtime)
    stage = InferStage(config, load_bundle(folder).read_network())
    pixels = config.max_tensor_pixels * avatars
    inputs, outputs = slots(2, avatars, pixels * CHANNELS), slots(2, avatars, pixels * 4)
    stage.bind(inputs, outputs)
    return stage, inputs, outputs


def show(packet, shape, visible):
    packet.header["tensor_shape"] = shape
    packet.header["avatar_count"] = len(visible)
    packet.header["avatars"]["visible"][:] = visible


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
    """A tensor of 128 x 32 with 5 channels, a picture of 4, a header of 4816 bytes, and all that the network keeps."""
    monkeypatch.setattr(infer, "moved_of_kept", lambda size: kept * size)
    stage, inputs, _ = make(tiny_bundle)
    show(inputs[0], (128, 32), [1])
    model = load_bundle(tiny_bundle).read_network().model
    weights = kept * sum(onnx.numpy_helper.to_array(tensor).nbytes for tensor in constants_of(model).values())
    figures = stage.run(0, 0, 0)
    read, written = weights + 128 * 32 * 5, 128 * 32 * 4
    names = ("read", "written", "uploaded", "read_back", "least")
    assert [figures[f"bytes_{name}"] for name in names] == [4816 + read, 4816 + written, 0, 0, read + written]


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


def test_only_cuda_copies_slots():
    assert [name for name in RUNTIMES if copies_slots(name)] == ["cuda"]


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


def test_avatars_of_different_networks_are_refused(tiny_bundle, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(tiny_bundle, other)
    model = onnx.load(other / "network.onnx")
    model.doc_string = "another"
    onnx.save(model, other / "network.onnx")
    units = {"dsp": UnitSettings(cores=(0,), threads=1)}
    scene = Scene.model_validate({"size": "64", "avatars": [{}] * 2})
    config = RunConfig(scene=scene, out_dir=tmp_path, avatar_dirs=(tiny_bundle, other), units=units)
    with pytest.raises(BadInputError, match="one network for all avatars"):
        assets_of(config)


def test_one_network_is_loaded_once(tiny_bundle):
    assert make(tiny_bundle, avatars=3)[0].sessions == 3


def test_a_shape_that_is_no_bucket_is_named(tiny_bundle):
    stage, inputs, _ = make(tiny_bundle, size="64x64")
    show(inputs[0], (96, 96), [1])
    with pytest.raises(BadInputError, match="96x96"):
        stage.run(7, 0, 0)


def test_a_slot_that_is_too_small_is_refused(tiny_bundle):
    units = {"dsp": UnitSettings(cores=(0,), threads=1)}
    config = RunConfig(scene=Scene(size="64"), out_dir=tiny_bundle, avatar_dirs=(tiny_bundle,), units=units)
    with pytest.raises(ValueError, match="slot of 100 bytes"):
        InferStage(config, load_bundle(tiny_bundle).read_network()).bind(slots(1, 1, 100), slots(1, 1, 64 * 64 * 4))


def test_the_factory_builds_a_part_of_the_network(tiny_bundle):
    units = {"dsp": UnitSettings(cores=(0,), threads=1)}
    config = RunConfig(scene=Scene(size="64"), out_dir=tiny_bundle, avatar_dirs=(tiny_bundle,), units=units)
    unit = UnitContext("dsp", units["dsp"], assets_of(config))
    stage = build({"config": config.model_dump(mode="json"), "part": 0}, unit)
    stage.bind(slots(1, 1, 64 * 64 * CHANNELS), slots(1, 1, 64 * 64 * 4))
    assert stage.sessions == 3
    assert load_bundle(tiny_bundle).manifest.network.channels == CHANNELS


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
