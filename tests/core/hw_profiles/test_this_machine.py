"""When this machine is measured, what of it is kept, and what is said where it cannot be; what measures is told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from trilane import machine
from trilane.apps.predict import asked_prediction, this_machine
from trilane.apps.predict.predict_options import PredictOptions
from trilane.avatars.bundle import load_bundle
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.application import REFERENCE
from trilane.hw_profiles.graph_file import read_graph
from trilane.hw_profiles.host_model import MODEL_ERROR
from trilane.hw_profiles.network_work import Network, count_work
from trilane.hw_profiles.profile_files import load_profile
from trilane.machine import Machine
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.rehearsal import Rehearsed
from trilane.pipeline.stage import UnitContext
from trilane.scheduler.placement import UnitWork
from trilane.stages import machine_facts
from trilane.stages.blocks import network as block
from trilane.stages.dsp import ort
from trilane.units import BURST

CORES = (0, 1, 2)
TOOK_NS = {1: [4_000_000, 5_000_000, 9_000_000], 2: [3_000_000, 3_000_000, 3_000_000]}


class Told(Machine):
    """A machine with these facts; its cache is below `root`."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.root = root
        self.fields, self.allowed = {"model name": "Zen", "flags": "avx2 fma"}, CORES

    def cores(self) -> tuple[int, ...]:
        return self.allowed

    def cpu_fields(self) -> dict[str, str]:
        return self.fields

    def cache_home(self) -> Path:
        return self.root / "cache"


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Told:
    found = Told(tmp_path)
    monkeypatch.setattr(machine, "here", found)
    return found


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """What was asked of what measures calls."""
    asked: list[tuple[Any, ...]] = []

    def calls(*what: Any) -> Any:
        asked.append(what)
        return {threads: TOOK_NS[threads] for threads in what[3]}

    monkeypatch.setattr(block, "_measured", calls)
    return asked


@pytest.fixture
def network(tiny_bundle: Path) -> Path:
    return tiny_bundle / "network.onnx"


def float_network(path: Path, shape: tuple[int, ...] = (1, 2, 4, 4), kind: int = TensorProto.FLOAT) -> Path:
    """The sum of an input and a constant."""
    given = [helper.make_tensor_value_info(name, kind, shape) for name in ("x", "y")]
    dtype = helper.tensor_dtype_to_np_dtype(kind)
    constant = onnx.numpy_helper.from_array(np.ones(shape, dtype), "one")
    node = helper.make_node("Add", ["x", "one"], ["y"])
    graph = helper.make_graph([node], "sum", given[:1], given[1:], [constant])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10), path)
    return path


def calls(path: Path, say: Callable[[], None] = lambda: None, runtime: str = "ort") -> block.Calls:
    return block.calls_of(path, {}, runtime, (1, 2), CORES, say)


@pytest.mark.usefixtures("told")
def test_calls_are_measured_once_and_it_is_said_before(measured: list[Any], network: Path) -> None:
    said: list[int] = []
    first = calls(network, lambda: said.append(len(measured)))
    assert (first.took_ns, first.runtime) == (TOOK_NS, "ort")
    assert first == calls(network, lambda: said.append(len(measured)))
    assert said == [0], "once, before anything was measured"
    assert measured == [(network, {}, "ort", (1, 2), CORES, True)]


@pytest.mark.parametrize("changed", ["model", "flags", "cores", "package", "runtime", "network"])
def test_another_fact_is_measured_again(
    changed: str, told: Told, measured: list[Any], network: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls(network)
    path, runtime = network, "ort"
    match changed:
        case "model" | "flags":
            told.fields |= {"model name" if changed == "model" else "flags": "avx2"}
        case "cores":
            told.allowed = (0, 1)
        case "package":
            monkeypatch.setattr(machine_facts, "package_version", lambda _: "0.1")
        case "runtime":
            runtime = "openvino"
        case _:
            path = float_network(tmp_path / "other.onnx")
    for _ in range(2):
        calls(path, runtime=runtime)
        assert len(measured) == 2


@pytest.mark.usefixtures("told")
def test_where_nothing_can_be_kept_it_is_measured_each_time(
    measured: list[Any], network: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trilane.cache.cache_dir", lambda _: None)
    assert [calls(network).took_ns for _ in range(2)] == [TOOK_NS] * 2
    assert len(measured) == 2


@pytest.mark.usefixtures("told")
def test_a_network_of_floats_runs_in_onnx_runtime(measured: list[Any], tmp_path: Path) -> None:
    assert calls(float_network(tmp_path / "net.onnx"), runtime="openvino").runtime == "ort"
    assert measured[0][2] == "ort"


@pytest.mark.usefixtures("told")
def test_a_stage_of_a_pipeline_file_is_measured_in_its_own_runtime(measured: list[Any], network: Path) -> None:
    """Also a network of integers, and the two measurements are kept apart."""
    as_stage = lambda runtime: block.calls_of(network, {}, runtime, (1,), CORES, lambda: None, as_stage=True)  # noqa: E731
    assert [calls(network).runtime, as_stage("ort").runtime, as_stage("openvino").runtime] == ["ort", "ort", "openvino"]
    assert [(asked[2], asked[5]) for asked in measured] == [("ort", True), ("ort", False), ("openvino", False)]


def built(path: Path, shapes: Any = None, is_avatar: bool = False) -> Any:
    unit = UnitContext("dsp", UnitSettings(cores=(0,), threads=1), {})
    return block.build_calls(
        {"path": str(path), "shapes": shapes or {}, "runtime": "ort", "is_avatar": is_avatar}, unit
    )


@pytest.mark.parametrize("kind", [TensorProto.FLOAT, TensorProto.INT64, TensorProto.FLOAT16, TensorProto.UINT8])
def test_frames_are_calls_with_distinct_inputs_in_turn(
    kind: int, network: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four, then the first again; a network of integers is bound to them."""
    seen: list[bytes] = []

    def bound(engine: ort.OrtSession, inputs: dict[str, Any], outputs: dict[str, Any]) -> Callable[[], None]:
        (given,) = inputs.values()
        found = np.empty_like(given)
        call = real(engine, inputs, {**outputs, "y": found})

        def checked() -> None:
            call()
            assert np.array_equal(found, given + given.dtype.type(1))
            seen.append(given.tobytes())

        return checked

    class Session:
        def bind(self, inputs: Any, outputs: Any) -> Any:
            assert inputs[0].shape == (1, 64, 64, 5) and outputs[0].shape == (1, 64, 64, 4)
            return SimpleNamespace(run=lambda: seen.append(inputs[0].tobytes()))

    real = ort.OrtSession.bound
    monkeypatch.setattr(ort.OrtSession, "bound", bound)
    is_ours = kind == TensorProto.UINT8
    if is_ours:
        monkeypatch.setattr(block, "load_runtime", lambda _: SimpleNamespace(load=lambda *_: Session()))
    stage = built(network if is_ours else float_network(tmp_path / "net.onnx", kind=kind), is_avatar=is_ours)
    stage.bind([], [])
    for frame in range(5):
        assert stage.run(frame, None, None) == {}
    stage.close()
    assert len({*seen[-5:-1]}) == 4 and seen[-5] == seen[-1]


def test_what_is_no_number_or_has_no_shape_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="input x of type 4"):
        built(float_network(tmp_path / "net.onnx", kind=TensorProto.UINT16))
    path = float_network(tmp_path / "open.onnx")
    model = onnx.load(path)
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_param = "n"
    onnx.save(model, path)
    with pytest.raises(BadInputError, match="in a fixed shape"):
        built(path)
    built(path, {"x": [1, 2, 4, 4]}).run(0, None, None)


@pytest.mark.usefixtures("told")
def test_a_file_has_the_median_of_its_calls(measured: list[Any], network: Path) -> None:
    """The unit for networks has one thread of three cores: 5 ms. With told numbers of threads it has those."""
    graph, said = read_graph(network), list[str]()
    chip = this_machine.with_file(load_profile("host"), graph, {}, said.append)
    found: Any = chip.units["dsp"].measured
    assert this_machine.price(chip, graph.work, "dsp", this_machine.corners_of(chip, BURST)).total_ms == pytest.approx(
        5.0
    )
    assert found.said.startswith("measured on this machine at ") and "calls of the network by itself" in found.said
    assert said == [this_machine.MEASURING.format("network.onnx")] and "at most half a minute" in said[0]
    assert measured[0][3:5] == ((1,), CORES)
    both: Any = this_machine.with_file(load_profile("host"), graph, {}, said.append, (1, 2)).units["dsp"].measured
    assert set(both.slower) == {1, 2} and found.error == both.error


@pytest.mark.usefixtures("told")
def test_what_cannot_be_measured_stays_as_it_is_and_is_said(
    measured: list[Any], network: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph, said, host = read_graph(network), list[str](), load_profile("host")
    assert this_machine.with_file(host, graph._replace(numbers="not said"), {}, said.append) == host
    monkeypatch.setattr(this_machine, "LONGEST_CALL_MS", 0.0)
    assert this_machine.with_file(host, graph, {}, said.append) == host
    monkeypatch.setattr(this_machine, "LONGEST_CALL_MS", 1e9)

    def fails(*_: object, **__: object) -> None:
        raise TrilaneError("the unit ended")

    monkeypatch.setattr(this_machine, "calls_of", fails)
    assert this_machine.with_file(host, graph, {}, said.append) == host
    assert measured == []
    assert [text.removeprefix("not measured on this machine: ") for text in said] == [
        "the file has no weights",
        "a call is expected to take 0 s, which is too long",
        "the unit ended",
    ]


@pytest.fixture
def rehearsed(tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A rehearsal of three frames whose network is of 96x64; what it was asked is under `asked`."""
    asked: dict[str, Any] = {}
    one = [1_000_000] * 3
    took_ns = {"pose": one, "raster": one, "infer": [5_000_000] * 3, "composite": one, "present": one}
    times = {"dsp": {1: UnitWork(5_000_000, 5_000_000), 2: UnitWork(3_000_000, 3_000_000)}}

    def configure(request: Any, _: Path) -> Any:
        asked["request"] = request
        assets = load_bundle(tiny_bundle).read_network()
        return SimpleNamespace(config=SimpleNamespace(runtime="ort", avatar_dirs=(1,)), assets=assets)

    def rehearse(_checked: Any, _starter: Any, driver: str, say: Any) -> Any:
        asked["driver"] = driver
        say("anything")
        if "fails" in asked:
            raise TrilaneError("no driver")
        return Rehearsed(times, took_ns), "noon"

    monkeypatch.setattr(this_machine, "configure", configure)
    monkeypatch.setattr(this_machine, "networks_of", lambda assets: [assets])
    monkeypatch.setattr(this_machine, "rehearsed", rehearse)
    monkeypatch.setattr(this_machine, "one_shape", lambda _: (96, 64))
    monkeypatch.setattr(this_machine, "gl_facts", lambda: {"vendor": "Mesa"})
    return asked


def test_an_avatar_has_what_a_run_of_it_is_placed_by(rehearsed: Any, tiny_bundle: Path) -> None:
    """The run's driver is part of the key under which it is kept; the network has the run's usual shape."""
    said: list[str] = []
    chip, network = this_machine.with_avatar(load_profile("host"), str(tiny_bundle), said.append)
    assert rehearsed["request"].avatar == str(tiny_bundle) and rehearsed["driver"] == "{'vendor': 'Mesa'}"
    assert (network.height, network.width, network.channels) == (96, 64, 5)
    found: Any = chip.units["dsp"].measured
    assert set(found.slower) == {1, 2} and found.error == pytest.approx(MODEL_ERROR)
    assert found.said == "measured on this machine at noon: frames of a run, one at a time, with ort"
    assert chip.application.composite_ms.or_else(0) == 1.0
    assert said == [this_machine.MEASURING.format("the stages")]
    rehearsed["fails"] = True
    host = load_profile("host")
    assert this_machine.with_avatar(host, str(tiny_bundle), said.append)[0] == host
    assert said[-1] == "not measured on this machine: no driver"


@pytest.mark.usefixtures("told")
def test_a_file_in_the_application_has_its_own_calls_and_the_stages_of_the_default_avatar(
    rehearsed: Any, measured: list[Any], network: Path
) -> None:
    graph = read_graph(network)
    chip = this_machine.with_file_in_application(load_profile("host"), graph, {}, lambda _: None)
    found: Any = chip.units["dsp"].measured
    assert rehearsed["request"].avatar == "default" and measured[0][3] == (1, 2)
    assert "calls of the network" in found.said and chip.application.composite_ms.or_else(0) == 1.0
    rehearsed["fails"] = True
    host = load_profile("host")
    assert this_machine.with_file_in_application(host, graph, {}, lambda _: None) == host


@pytest.mark.usefixtures("told")
def test_of_several_pipelines_the_first_is_measured(rehearsed: Any, measured: list[Any], network: Path) -> None:
    host = load_profile("host")
    assert this_machine.with_first(host, f"{network}@12", lambda _: None).units["dsp"].measured is not None
    assert len(measured) == 1 and "request" not in rehearsed
    assert this_machine.with_first(host, "crowd@12", lambda _: None).units["dsp"].measured is not None
    assert rehearsed["request"].scene == "crowd" and len(measured) == 1


@pytest.mark.parametrize(
    ("profile", "unit", "precision", "is_measured"),
    [
        ("host", "dsp", None, True),
        ("host", "gpu", None, False),
        ("host", "dsp", "fp16", False),
        ("qcs6490", "dsp", None, False),
    ],
)
def test_only_what_this_machine_would_run_is_measured(
    profile: str, unit: Any, precision: Any, is_measured: bool, tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    work = count_work(load_bundle(tiny_bundle).read_network().model)
    network = Network({}, 64, 64, 5, "packed", work)
    monkeypatch.setattr(this_machine, "with_avatar", lambda chip, *_: asked.append("avatar") or (chip, network))
    monkeypatch.setattr(this_machine, "with_file", lambda chip, *_: asked.append("file") or chip)
    monkeypatch.setattr(this_machine, "with_file_in_application", lambda chip, *_: asked.append("both") or chip)
    chip, files = load_profile(profile), [tiny_bundle / "network.onnx"]
    same = {"unit": unit, "precision": precision}
    asked_prediction.application_of(chip, PredictOptions(avatar=str(tiny_bundle), **same))
    asked_prediction.application_of(chip, PredictOptions(network=files, application=True, **same))
    asked_prediction.predict_networks(chip, PredictOptions(network=files, **same))
    assert asked == (["avatar", "both", "file"] if is_measured else [])


def test_this_machine_has_the_policy_of_a_run() -> None:
    assert PredictOptions(profile="host", encoder="resnet18").variant.policy == "pipelined"
    assert PredictOptions(profile="qcs6490", encoder="resnet18").variant == REFERENCE
    assert PredictOptions(profile="qcs6490").variant == PredictOptions(profile="host").variant
