"""Every runtime: same picture, the slots' own memory, no allocation, integer layers, errors that name the node."""

from __future__ import annotations

import copy
import gc
import tracemalloc
from pathlib import Path

import numpy as np
import onnx
import psutil
import pytest
from onnx import helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from trilane.avatars.network_file import check_network, reshaped
from trilane.avatars.network_split import cuts, split
from trilane.errors import BadInputError, MissingPartError
from trilane.stages.dsp import runtime
from trilane.stages.dsp.runtime import RUNTIMES, RuntimeOptions, load_runtime
from trilane.training.quantising.quantise import quantise

#: The first whose DequantizeLinear the evaluator has; the operators used mean the same as in the files' own.
EVALUATOR_OPSET = 19

#: Largest and mean difference in bytes: the network rounds alike, but runtimes compute the sigmoid in different ways.
LIMITS = {"openvino": (1, 0.05), "ort": (0, 0.0), "qnn": (0, 0.0), "cuda": (1, 0.05)}
#: The emulator needs about 30 ms for a frame of the tiny network.
FRAMES = {"openvino": 1000, "ort": 1000, "qnn": 20, "cuda": 1000}
#: Bytes of the smallest Python object, and what the interpreter itself may come to hold meanwhile.
SMALLEST_OBJECT, INTERPRETERS_OWN = 16, 4096


@pytest.fixture
def name(request, skip_without):
    skip_without(request.param)
    return request.param


@pytest.fixture
def module(name):
    return load_runtime(name)


def assert_same(image, wanted, name):
    difference = np.abs(image.astype(int) - wanted)
    largest, mean = LIMITS[name]
    assert difference.max() <= largest
    assert difference.mean() <= mean


def tensor_of(network, frames):
    real = np.stack(frames)[:1] / network.input.scale + network.input.zero_point
    return np.clip(np.round(real), 0, 255).astype(np.uint8)


def reference(network, tensor):
    """The picture by the ONNX reference evaluator: operator definitions in NumPy, nothing fused."""
    model = copy.deepcopy(network.model)
    model.opset_import[0].version = EVALUATOR_OPSET
    return ReferenceEvaluator(model).run(None, {network.model.graph.input[0].name: tensor})[0]


def picture(module, network, tensor, threads=1):
    image = np.full((*network.shape[:3], 4), 77, np.uint8)
    module.load(network, RuntimeOptions(threads)).bind([tensor], [image]).run()
    return image


@pytest.mark.parametrize("threads", [1, 2])
def test_the_picture_is_the_definitions(name, module, tiny_quantised, tiny_frames, threads):
    network = tiny_quantised.network
    tensor = tensor_of(network, tiny_frames)
    assert_same(picture(module, network, tensor, threads), reference(network, tensor), name)


def test_every_bucket_shape_runs(name, module, tiny_quantised):
    for height, width in ((32, 96), (96, 32)):
        network = reshaped(tiny_quantised.network, height, width)
        tensor = np.random.default_rng(0).integers(0, 256, network.shape, dtype=np.uint8)
        assert_same(picture(module, network, tensor), reference(network, tensor), name)


def test_a_batch_gives_the_bytes_of_its_frames(module, tiny_quantised):
    single, three = (reshaped(tiny_quantised.network, 64, 64, batch=count) for count in (1, 3))
    tensor = np.random.default_rng(0).integers(0, 256, three.shape, dtype=np.uint8)
    pictures = picture(module, three, tensor)
    assert (pictures == np.concatenate([picture(module, single, frame[None]) for frame in tensor])).all()


def test_parts_give_the_bytes_of_the_whole(module, tiny_quantised):
    network = tiny_quantised.network
    tensor = np.random.default_rng(0).integers(0, 256, network.shape, dtype=np.uint8)
    places = [cut.at for cut in cuts(network)]
    first, second = split(network, [places[len(places) // 2]])
    known = dict.fromkeys(first.crossing_in, tensor) | {
        name: np.empty(shape, np.uint8) for name, shape in first.outputs.items()
    }
    image = np.empty((*network.shape[:3], 4), np.uint8)
    for part, made in ((first, [known[name] for name in first.outputs]), (second, [image])):
        module.load(part, RuntimeOptions()).bind([known[name] for name in part.inputs], made).run()
    assert (image == picture(module, network, tensor)).all()


def test_a_damaged_compiled_network_of_qnn_is_compiled_again(skip_without, tiny_quantised, monkeypatch, tmp_path):
    skip_without("qnn")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    module, network = load_runtime("qnn"), tiny_quantised.network
    tensor = np.random.default_rng(0).integers(0, 256, network.shape, dtype=np.uint8)
    first = picture(module, network, tensor)
    (compiled,) = (tmp_path / "trilane" / "qnn").iterdir()
    assert (picture(module, network, tensor) == first).all()
    compiled.write_bytes(b"damaged")
    assert (picture(module, network, tensor) == first).all()
    assert len(compiled.read_bytes()) > 1000


def test_qnn_writes_contexts_for_chips_that_it_knows(skip_without, tiny_quantised, tmp_path):
    skip_without("qnn")
    module, path = load_runtime("qnn"), tmp_path / "out.onnx"
    module.write_context(tiny_quantised.network, "sm8350", path)
    assert path.stat().st_size > 1000
    with pytest.raises(BadInputError, match=r"soc: found 'sm1', expected one of sm8350"):
        module.write_context(tiny_quantised.network, "sm1", path)


def test_a_binding_reads_and_writes_the_slots_themselves(module, tiny_quantised, tiny_frames):
    """Bytes written into the slot after it was bound are what is read; the bound address is what is written."""
    network = tiny_quantised.network
    slot_in, slot_out = np.zeros(network.shape, np.uint8), np.zeros((*network.shape[:3], 4), np.uint8)
    addresses = slot_in.ctypes.data, slot_out.ctypes.data
    binding = module.load(network, RuntimeOptions()).bind([slot_in], [slot_out])
    binding.run()
    empty = slot_out.copy()
    slot_in[:] = tensor_of(network, tiny_frames)
    binding.run()
    assert (slot_out == picture(module, network, slot_in)).all()
    assert (slot_out != empty).any()
    assert addresses == (slot_in.ctypes.data, slot_out.ctypes.data)


def test_bindings_of_one_session_do_not_mix(module, tiny_quantised):
    network = tiny_quantised.network
    session = module.load(network, RuntimeOptions())
    rng = np.random.default_rng(3)
    inputs = [rng.integers(0, 256, network.shape, dtype=np.uint8) for _ in range(2)]
    images = [np.zeros((*network.shape[:3], 4), np.uint8) for _ in range(2)]
    bindings = [session.bind([tensor], [image]) for tensor, image in zip(inputs, images, strict=True)]
    for binding in bindings:
        binding.run()
    for tensor, image in zip(inputs, images, strict=True):
        assert (image == picture(module, network, tensor)).all()


def test_frames_allocate_nothing(name, module, tiny_quantised):
    """What leaks grows in every round; what other threads of this process do, only in some."""
    network = tiny_quantised.network
    tensor, image = np.zeros(network.shape, np.uint8), np.zeros((*network.shape[:3], 4), np.uint8)
    binding = module.load(network, RuntimeOptions()).bind([tensor], [image])
    rounds = [_growth(binding, FRAMES[name]) for _ in range(5)]
    assert min(resident for resident, _ in rounds) <= 0
    assert min(traced for _, traced in rounds) < max(SMALLEST_OBJECT * FRAMES[name], INTERPRETERS_OWN)


def _growth(binding, frames):
    """Bytes by which resident and Python's own memory grow in `frames` runs."""
    gc.collect()
    tracemalloc.start()
    binding.run()
    resident, traced = psutil.Process().memory_info().rss, tracemalloc.get_traced_memory()[0]
    for _ in range(frames):
        binding.run()
    grown = psutil.Process().memory_info().rss - resident, tracemalloc.get_traced_memory()[0] - traced
    tracemalloc.stop()
    return grown


def test_a_layer_left_in_float_is_named(module, tiny_quantised):
    """Weights that are no quantised tensor leave their convolution in float."""
    model = copy.deepcopy(tiny_quantised.network.model)
    conv = next(node for node in model.graph.node if node.name == "level")
    model.graph.initializer.append(numpy_helper.from_array(np.ones((8, 16, 3, 3), np.float32) / 99, "plain"))
    conv.input[1] = "plain"
    with pytest.raises(BadInputError, match="level"):
        module.load(check_network(model, "network.onnx"), RuntimeOptions())


def test_a_layer_left_in_float_on_purpose_runs(module, tiny_float, tiny_frames):
    network = quantise(tiny_float, tiny_frames, keep_float=["deep"]).network
    tensor = tensor_of(network, tiny_frames)
    assert np.abs(picture(module, network, tensor).astype(int) - reference(network, tensor)).mean() <= 1


def test_a_graph_that_does_not_run_is_named(module, tiny_quantised):
    model = copy.deepcopy(tiny_quantised.network.model)
    next(node for node in model.graph.node if node.op_type == "Concat").attribute[0].CopyFrom(
        helper.make_attribute("axis", 7)
    )
    with pytest.raises(BadInputError, match="joined"):
        module.load(check_network(model, "network.onnx"), RuntimeOptions())


def test_unknown_runtimes_are_refused():
    with pytest.raises(BadInputError, match="tpu"):
        runtime.resolve("tpu")


def test_an_absent_runtime_says_how_to_get_it(monkeypatch):
    entry = runtime.RuntimeEntry("trilane.stages.dsp.none", "no_such_package", lambda: "pip install it")
    monkeypatch.setitem(RUNTIMES, "none", entry)
    with pytest.raises(MissingPartError, match="pip install it"):
        load_runtime("none")


def test_a_package_without_the_part_that_a_runtime_needs_is_absent(monkeypatch):
    entry = runtime.RuntimeEntry("trilane.stages.dsp.none", "onnxruntime", lambda: "pip install more", "capi/none.so")
    monkeypatch.setitem(RUNTIMES, "none", entry)
    with pytest.raises(MissingPartError, match=r"onnxruntime with capi/none\.so.*pip install more"):
        load_runtime("none")
    assert "none" not in runtime.installed() and "ort" in runtime.installed()


def test_the_wrong_file_is_named(tmp_path: Path, tiny_float: onnx.ModelProto):
    with pytest.raises(BadInputError, match="FLOAT"):
        check_network(tiny_float, str(tmp_path))
