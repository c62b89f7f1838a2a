"""The DSP unit: runtimes by their settings, what is compiled and cached, where tensors lie, and the infer stage."""

from __future__ import annotations

import hashlib
import importlib
import os
import shutil
import subprocess
import sys
from itertools import combinations
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import helper

from support.small_pipeline import assets_of
from trilane import machine
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import constants_of, reshaped
from trilane.avatars.network_split import cuts, split
from trilane.errors import BadInputError, MissingPartError, install_line
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.stage import UnitContext
from trilane.scene.schema import Scene
from trilane.stages.config import NetworkCut, RunConfig, pose_dtype
from trilane.stages.dsp import cuda, infer, ort, runtime
from trilane.stages.dsp.infer import InferStage, build
from trilane.stages.dsp.runtime import RUNTIMES, RuntimeOptions, copies_slots
from trilane.transport.packets import SlotLayout, view_packet


@pytest.fixture
def network(tiny_quantised: Any) -> Any:
    return tiny_quantised.network


class Noted:
    """An inference session that only keeps what it was made with."""

    made: list[Any]

    def __init__(self, model: bytes, settings: Any, **options: Any) -> None:
        type(self).made.append((model, settings, options))

    def get_providers(self) -> list[str]:
        return ["CPUExecutionProvider"]


def noted(monkeypatch: pytest.MonkeyPatch, **methods: Any) -> list[Any]:
    """Replace ONNX Runtime's session by `Noted`, and give the list of what is made."""
    made: list[Any] = []
    monkeypatch.setattr(onnxruntime, "InferenceSession", type("Session", (Noted,), {"made": made, **methods}))
    return made


# --- runtimes --------------------------------------------------------------------------------------------------------


def test_runtimes_are_modules_of_this_folder_and_say_what_they_need() -> None:
    found = {name: (entry.module, entry.package, entry.file) for name, entry in runtime.RUNTIMES.items()}
    assert found == {
        "openvino": ("trilane.stages.dsp.openvino", "openvino", ""),
        "ort": ("trilane.stages.dsp.ort", "onnxruntime", ""),
        "qnn": ("trilane.stages.dsp.qnn", "onnxruntime_qnn", ""),
        "cuda": ("trilane.stages.dsp.cuda", "onnxruntime", "capi/libonnxruntime_providers_cuda.so"),
    }
    assert "uninstall -y onnxruntime && " in runtime.RUNTIMES["cuda"].install()
    assert runtime.RUNTIMES["cuda"].install().count(" install onnxruntime-gpu") == 1
    assert runtime.RUNTIMES["ort"].install().endswith(" install onnxruntime")
    assert (RuntimeOptions().threads, RuntimeOptions().spin, RuntimeOptions().device) == (1, False, {})
    assert runtime.resolve("ort") == "ort"
    assert runtime.load_runtime("ort") is ort


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


@pytest.mark.parametrize(("threads", "spin"), [(1, False), (3, True)])
def test_ort_is_set_up_as_the_unit_says(threads: int, spin: bool) -> None:
    settings = ort.settings_of(RuntimeOptions(threads, spin))
    assert (settings.intra_op_num_threads, settings.inter_op_num_threads) == (threads, 1)
    assert settings.execution_mode == onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    assert settings.log_severity_level == 3
    assert settings.get_session_config_entry("session.intra_op.allow_spinning") == str(int(spin))
    assert ort.version() == f"onnxruntime {onnxruntime.__version__}"


def test_float_layers_are_named_except_those_that_may_be(network: Any) -> None:
    kinds = ["Conv", "FusedConv", "NhwcFusedConv", "ConvTranspose", "Gemm", "FusedGemm", "MatMul", "FusedMatMul"]
    nodes = [helper.make_node(kind, ["x"], [f"y{k}"], f"n{k}") for k, kind in enumerate([*kinds, "QLinearConv", "Add"])]
    model = helper.make_model(helper.make_graph(nodes, "g", [], []))
    source = SimpleNamespace(where="file.onnx", float_layers=frozenset({"n3"}))
    with pytest.raises(BadInputError, match="left in float: n0, n1, n2, n4, n5, n6, n7, expected integer layers"):
        ort.check_integer(model, source)  # type: ignore[arg-type]
    ort.check_integer(network.model, SimpleNamespace(where="", float_layers={n.name for n in network.model.graph.node}))  # type: ignore[arg-type]


def test_ort_loads_what_it_is_given_and_names_the_file_of_what_fails(network: Any, monkeypatch: Any) -> None:
    paths = []

    def write(_self: Any, model: bytes, settings: Any, providers: Any) -> None:
        paths.append(Path(settings.optimized_model_filepath))
        onnx.save(helper.make_model(helper.make_graph([], "g", [], [])), paths[-1])
        assert model == network.model.SerializeToString() and providers == ["CPUExecutionProvider"]

    noted(monkeypatch, __init__=write)
    assert isinstance(ort.load(network, RuntimeOptions()), ort.OrtSession)
    assert paths[0].name == "optimised.onnx" and not paths[0].parent.exists()

    def fail(*_: Any, **__: Any) -> None:
        raise ort.state.Fail("no such operator")

    noted(monkeypatch, __init__=fail)
    with pytest.raises(BadInputError, match=r"no such operator.*that ONNX Runtime loads"):
        ort.load(network, RuntimeOptions())


def test_cuda_takes_all_nodes_or_none(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    cuda._check_gpu.cache_clear()
    made = noted(monkeypatch)
    with pytest.raises(MissingPartError, match=r"no NVIDIA GPU.*onnxruntime-gpu"):
        cuda.load(network, RuntimeOptions())
    probe, settings, options = made.pop()
    assert [node.op_type for node in onnx.load_from_string(probe).graph.node] == ["Identity"]
    onnx.checker.check_model(onnx.load_from_string(probe))
    told = onnx.load_from_string(probe)  # versions that ONNX Runtime has known for years, whatever this onnx writes
    assert [(each.domain, each.version) for each in told.opset_import] == [("", 17)] and told.ir_version == 8
    assert settings.log_severity_level == 4 and options == {"providers": ["CUDAExecutionProvider"]}
    made = noted(monkeypatch, get_providers=lambda _self: ["CUDAExecutionProvider", "CPUExecutionProvider"])
    session = cuda.load(network, RuntimeOptions(device={"device_id": "1"}))
    assert isinstance(session, ort.OrtSession)
    model, settings, options = made[-1]
    assert model == network.model.SerializeToString()
    assert options == {"providers": [("CUDAExecutionProvider", {"device_id": "1"})]}
    assert settings.log_severity_level == 3
    assert settings.get_session_config_entry("session.disable_cpu_ep_fallback") == "1"

    def fail(*_: Any, **__: Any) -> None:
        raise ort.state.Fail("node x")

    noted(monkeypatch, __init__=fail)
    with pytest.raises(BadInputError, match=r"node x.*on the GPU as a whole"):
        cuda.load(network, RuntimeOptions())
    cuda._check_gpu.cache_clear()
    assert cuda.version() == f"onnxruntime {onnxruntime.__version__} for CUDA"


class Settings:
    """ONNX Runtime's options, as `qnn` sets them."""

    def __init__(self) -> None:
        self.log_severity_level, self.devices, self.entries = 0, (None, {}), {}  # type: ignore[var-annotated]

    def add_provider_for_devices(self, devices: Any, options: Any) -> None:
        self.devices = devices, dict(options)

    def add_session_config_entry(self, key: str, value: str) -> None:
        self.entries[key] = value


@pytest.fixture
def qnn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The module `qnn` over a stand-in of Qualcomm's package; its sessions write what they compile."""
    package: Any = ModuleType("onnxruntime_qnn")
    package.__version__ = "9.9"
    package.get_ep_name, package.get_library_path = lambda: "QNN", lambda: "/lib/qnn.so"
    package.get_qnn_htp_path = lambda: "/lib/htp.so"
    monkeypatch.setitem(sys.modules, "onnxruntime_qnn", package)
    monkeypatch.delitem(sys.modules, "trilane.stages.dsp.qnn", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    registered: list[Any] = []
    devices = [SimpleNamespace(ep_name=name) for name in ("CPU", "QNN", "QNN")]
    monkeypatch.setattr(
        onnxruntime, "register_execution_provider_library", lambda *a: registered.append(a), raising=False
    )
    monkeypatch.setattr(onnxruntime, "get_ep_devices", lambda: devices, raising=False)
    monkeypatch.setattr(onnxruntime, "SessionOptions", Settings)
    module: Any = importlib.import_module("trilane.stages.dsp.qnn")
    module.registered, module.found = registered, devices
    yield module
    sys.modules.pop("trilane.stages.dsp.qnn", None)


def compiling(self: Any, model: bytes, settings: Any) -> None:
    """A session that writes its context, and refuses one that is damaged."""
    if model == b"damaged":
        raise ort.state.InvalidProtobuf("damaged")
    if "ep.context_file_path" in settings.entries:
        Path(settings.entries["ep.context_file_path"]).write_bytes(b"compiled")
    self.made.append((model, settings, {}))


def test_qnn_compiles_once_for_all_nodes(
    qnn: Any, network: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made = noted(monkeypatch, __init__=compiling)
    assert isinstance(qnn.load(network, RuntimeOptions()), ort.OrtSession)
    ((model, settings, _),) = made
    assert model == network.model.SerializeToString()
    assert qnn.registered == [("QNN", "/lib/qnn.so")]
    devices, options = settings.devices
    assert devices == qnn.found[1:2]
    assert options == {
        "backend_path": "/lib/htp.so",
        "soc_model": "30",
        "htp_arch": "68",
        "htp_performance_mode": "burst",
    }
    path = Path(settings.entries.pop("ep.context_file_path"))
    assert settings.entries == {
        "session.disable_cpu_ep_fallback": "1",
        "ep.context_enable": "1",
        "ep.context_embed_mode": "1",
    }
    assert settings.log_severity_level == 3
    (stored,) = (tmp_path / "cache" / "trilane" / "qnn").iterdir()
    assert stored.suffix == ".onnx" and stored != path and stored.read_bytes() == b"compiled"
    qnn.load(network, RuntimeOptions())
    assert made[1][0] == b"compiled" and made[1][1].entries == {"session.disable_cpu_ep_fallback": "1"}
    stored.write_bytes(b"damaged")
    qnn.load(network, RuntimeOptions())
    assert stored.read_bytes() == b"compiled"
    qnn.load(network, RuntimeOptions(device={"htp_arch": "73"}))
    assert made[-1][1].devices[1]["htp_arch"] == "73"
    assert len(list(stored.parent.iterdir())) == 2
    assert qnn.version() == "onnxruntime-qnn 9.9"
    parts_of_key = (network.digest, qnn.version(), machine.here.architecture(), "a=1", "b=2")
    assert qnn._key(network, {"b": "2", "a": "1"}) == hashlib.sha256("\n".join(parts_of_key).encode()).hexdigest()


def test_qnn_writes_contexts_for_chips_that_it_knows(qnn: Any, network: Any, monkeypatch: Any, tmp_path: Path) -> None:
    made = noted(monkeypatch, __init__=compiling)
    qnn.write_context(network, "sm8350", tmp_path / "out.onnx")
    assert (tmp_path / "out.onnx").read_bytes() == b"compiled"
    assert made[0][1].devices[1] == {"backend_path": "/lib/htp.so", "soc_model": "30", "htp_arch": "68"}
    with pytest.raises(BadInputError, match=r"soc: found 'sm1', expected one of sm8350"):
        qnn.write_context(network, "sm1", tmp_path / "other.onnx")
    monkeypatch.setattr(qnn, "cache_entry", lambda *_names: None)
    qnn.load(network, RuntimeOptions())
    assert made[-1][1].entries == {"session.disable_cpu_ep_fallback": "1"}
    with pytest.raises(BadInputError, match="as a whole"):
        qnn._session("here", b"damaged", {}, {})
    qnn._devices.cache_clear()
    monkeypatch.setattr(onnxruntime, "get_ep_devices", lambda: qnn.found[:1], raising=False)
    with pytest.raises(MissingPartError, match="no HTP device"):
        qnn._devices()


# --- OpenVINO --------------------------------------------------------------------------------------------------------


class Core:
    """OpenVINO's core: notes what is compiled and imported."""

    def __init__(self) -> None:
        self.calls: list[Any] = []

    def get_property(self, device: str, name: str) -> str:
        return f"{device} {name}"

    def read_model(self, model: bytes) -> bytes:
        return model

    def compile_model(self, model: bytes, device: str, settings: Any) -> Any:
        self.calls.append(("compile", model, device, settings))
        if model == b"":
            raise RuntimeError("bad model")
        blob = SimpleNamespace(getvalue=lambda: b"blob of " + model[:8])
        return SimpleNamespace(export_model=lambda: blob, get_runtime_model=lambda: SimpleNamespace(get_ops=list))

    def import_model(self, blob: Any, device: str, settings: Any) -> Any:
        self.calls.append(("import", blob.read(), device, settings))
        return "imported"


@pytest.fixture
def vino(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    pytest.importorskip("openvino")
    from trilane.stages.dsp import openvino

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    core = Core()
    monkeypatch.setattr(openvino, "_core", lambda: core)
    return SimpleNamespace(module=openvino, core=core, folder=tmp_path / "trilane" / "openvino")


def test_openvino_compiles_once_and_reads_what_it_stored(vino: Any, network: Any, monkeypatch: Any) -> None:
    settings = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": 2,
        "NUM_STREAMS": 1,
        "ENABLE_CPU_PINNING": False,
    }
    model = network.model.SerializeToString()
    vino.module.load(network, RuntimeOptions(2))
    assert vino.core.calls == [("compile", model, "CPU", settings)]
    (stored,) = vino.folder.iterdir()
    blob = b"blob of " + model[:8]
    assert stored.read_bytes() == hashlib.sha256(blob).digest() + blob
    names = ("CPU FULL_DEVICE_NAME", "CPU OPTIMIZATION_CAPABILITIES")
    key = (network.digest, vino.module.version(), *names, *(f"{k}={v}" for k, v in settings.items()))
    assert stored.name == hashlib.sha256("\n".join(key).encode()).hexdigest() + ".blob"
    assert vino.module.load(network, RuntimeOptions(2))._compiled == "imported"
    assert vino.core.calls[1:] == [("import", blob, "CPU", settings)]
    stored.write_bytes(stored.read_bytes() + b"x")
    vino.module.load(network, RuntimeOptions(2))
    assert vino.core.calls[2][0] == "compile" and len(vino.core.calls) == 3
    vino.module.load(network, RuntimeOptions(1))
    assert vino.core.calls[3][0] == "compile" and len(list(vino.folder.iterdir())) == 2
    monkeypatch.setattr(vino.module, "cache_entry", lambda *_names: None)
    vino.module.load(network, RuntimeOptions(2))
    assert vino.core.calls[4][0] == "compile"


def test_openvino_waits_for_no_pipe_in_its_cache(vino: Any, network: Any) -> None:
    vino.module.load(network, RuntimeOptions(2))
    (stored,) = vino.folder.iterdir()
    stored.unlink()
    os.mkfifo(stored)
    vino.module.load(network, RuntimeOptions(2))
    assert [call[0] for call in vino.core.calls] == ["compile", "compile"]
    assert stored.is_fifo()


def test_openvino_without_room_for_its_cache_and_with_a_bad_model(vino: Any, network: Any, monkeypatch: Any) -> None:
    def full(*_: Any) -> None:
        raise BadInputError("disk", "full", "room")

    monkeypatch.setattr(vino.module, "write_bytes", full)
    vino.module.load(network, RuntimeOptions())
    bad = SimpleNamespace(where="w", digest="d", model=SimpleNamespace(SerializeToString=lambda: b""))
    with pytest.raises(BadInputError, match=r"bad model.*that OpenVINO loads"):
        vino.module.load(bad, RuntimeOptions())


def test_openvino_layers_in_float_are_named(vino: Any) -> None:
    def op(name: str, **info: str) -> Any:
        values = {key: SimpleNamespace(astype=lambda _kind, value=value: value) for key, value in info.items()}
        return SimpleNamespace(get_rt_info=lambda: values, get_friendly_name=lambda: name)

    ops = [
        op("a", layerType="Convolution", runtimePrecision="f32"),
        op("b", layerType="Convolution", runtimePrecision="I8"),
        op("c", layerType="Deconvolution", runtimePrecision="U8"),
        op("d", layerType="Eltwise", runtimePrecision="f32"),
        op("e/WithoutBiases", layerType="FullyConnected", runtimePrecision="bf16"),
        op("f", layerType="MatMul"),
        op("g", layerType="Deconvolution", runtimePrecision="f32"),
        op("h"),
    ]
    compiled = SimpleNamespace(get_runtime_model=lambda: SimpleNamespace(get_ops=lambda: ops))
    source = SimpleNamespace(where="file.onnx", float_layers=frozenset({"g"}))
    with pytest.raises(BadInputError, match="left in float: a, e, f, expected integer layers"):
        vino.module._check_integer(compiled, source)
    source.float_layers = frozenset("aefg")
    vino.module._check_integer(compiled, source)


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
    layout = SlotLayout(pose_dtype(1), payload)
    made = view_packet(memoryview(bytearray(layout.slot_bytes)), layout)
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
        stage = InferStage(config, whole, number)
        stage.bind([slots[number]], [slots[number + 1]])
        slots[number + 1].payload[:] = 77
        assert stage.run(0, 0, 0)["inferred"] == 1
        passed += len(stage._bindings[shape, 0, 0].passed)
        assert stage.sessions == 1
        stage.close()
        assert stage.sessions == 0
    expected = slot(edges[-1], shape)
    alone = InferStage(configured(tiny_bundle), whole)
    alone.bind([slots[0]], [expected])
    alone.run(0, 0, 0)
    assert passed > 0
    assert np.array_equal(slots[-1].payload, expected.payload)
    assert expected.payload.std() > 1


@pytest.mark.parametrize("slots", [(None, 0), (0, None)])
def test_inference_needs_both_slots(tiny_bundle: Path, slots: Any) -> None:
    with pytest.raises(AssertionError):
        InferStage(configured(tiny_bundle), load_bundle(tiny_bundle).read_network()).run(0, *slots)


@pytest.mark.parametrize(("name", "at_once"), [("ort", 3), ("openvino", 3), ("cuda", 1), ("qnn", 1)])
def test_networks_are_compiled_at_once_where_the_runtime_may(
    tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch, name: str, at_once: int
) -> None:
    """As many as the process has cores; each shape is run once, on the unit's threads."""
    asked, ran = [], []
    options: list[Any] = []
    session = SimpleNamespace(bind=lambda *_: SimpleNamespace(run=lambda: ran.append(1)))
    module = SimpleNamespace(load=lambda _part, given: options.append(given) or session)
    pool = infer.ThreadPoolExecutor
    monkeypatch.setattr(infer, "ThreadPoolExecutor", lambda count: asked.append(count) or pool(count))
    monkeypatch.setattr(infer, "resolve", lambda given: given)
    monkeypatch.setattr(infer, "load_runtime", lambda _name: module)
    monkeypatch.setattr(machine.here, "cores", lambda: (0, 1, 2))
    config = configured(tiny_bundle, size="64").model_copy(update={"runtime": name})
    config.units["dsp"] = UnitSettings(cores=(0,), threads=2, spin=True)
    stage = InferStage(config, load_bundle(tiny_bundle).read_network())
    stage.bind([slot(64 * 64 * 5, (64, 64))] * 2, [slot(64 * 64 * 4, (64, 64))] * 2)
    assert asked == [at_once] and len(ran) == 3 and stage.sessions == 3
    assert [(o.threads, o.spin) for o in options] == [(2, True)] * 3
    assert len(stage._bindings) == 12
    unseen = slot(64 * 64 * 5, (9, 9))
    stage._inputs = [unseen]
    with pytest.raises(BadInputError, match=r"frame 8: found tensor shape 9x9, expected one of 32x128, 64x64, 128x32"):
        stage.run(8, 0, 0)


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
    with pytest.raises(BadInputError, match="one network for all avatars") as refused:
        assets_of(config)
    made = f"`trilane avatar create {other} --network {tiny_bundle / 'network.onnx'} --out NEW`"
    assert refused.value.remedy.startswith("give each avatar a scene of its own, or name one avatar twice; " + made)


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
