"""What benches run in processes of their own, here in this one: the child of a variant, the stages of their runs."""

from __future__ import annotations

import multiprocessing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest

from trilane.bench import handoff
from trilane.bench.lib import interleaved_processes, networks
from trilane.bench.lib.interleaved_processes import KINDS, Runner, Variant
from trilane.errors import TrilaneError
from trilane.pipeline.description import UnitSettings
from trilane.pipeline.stage import UnitContext
from trilane.stages.dsp import runtime as runtimes
from trilane.transport.packets import SlotLayout, header_dtype, view_packet


class Pipe:
    """One end of a pipe: `answers` come, what is sent is kept."""

    def __init__(self, *answers: Any) -> None:
        self.answers, self.sent, self.waited = [*answers], [], []

    def poll(self, seconds: float) -> bool:
        self.waited.append(seconds)
        return bool(self.answers)

    def recv(self) -> Any:
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def send(self, what: Any) -> None:
        self.sent.append(what)


def runner(*answers: Any) -> tuple[Runner, Pipe]:
    pipe = Pipe(7, *answers)
    return Runner(pipe, "ours"), pipe  # type: ignore[arg-type]


def test_a_runner_asks_for_as_many_runs_as_half_the_time_that_is_left_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    """From 10 s on for 2 s: the first run alone; at 10.5 1.5 s are left and the last run took 50 ms, so 15; at 11.99
    10 ms are left, which 100 ms exceed, so 1; at 12 it is over."""
    looks = iter([10.0, 10.0, 10.5, 11.99, 12.0])
    monkeypatch.setattr(interleaved_processes, "time", SimpleNamespace(monotonic=lambda: next(looks)))
    ours, pipe = runner([50.0], [1.0] * 14 + [100.0], [3.0])
    assert ours.startup_ms == 7.0 and isinstance(ours.startup_ms, float)
    assert ours.run_for(2.0) == [50.0, *[1.0] * 14, 100.0, 3.0]
    assert pipe.sent == [1, 15, 1] and set(pipe.waited) == {300.0}


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        (["ValueError: bad"], "ours: ValueError: bad"),
        ([EOFError()], "ours: its process ended"),
        ([], "ours: no answer"),
    ],
)
def test_a_runner_that_does_not_answer_says_so(answers: list[Any], message: str) -> None:
    ours, _ = runner(*answers)
    with pytest.raises(TrilaneError, match=f"^{message}( in 300 s)?$"):
        ours.run(3)


def test_a_child_loads_warms_up_and_runs_as_often_as_it_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock stands still but for loading (2 s) and each run (its number in ms)."""
    ran: list[Variant] = []
    now = [0]

    def load(variant: Variant) -> Any:
        now[0] += 2_000_000_000

        def run() -> None:
            ran.append(variant)
            now[0] += len(ran) * 1_000_000

        return run

    clock = SimpleNamespace(perf_counter=lambda: now[0] / 1e9, perf_counter_ns=lambda: now[0])
    monkeypatch.setattr(interleaved_processes, "time", clock)
    monkeypatch.setitem(KINDS, "told", load)
    variant = Variant("told", Path("n.onnx"))
    pipe = Pipe(2, 3, EOFError())
    interleaved_processes.serve(pipe, variant)  # type: ignore[arg-type]
    assert pipe.sent == [2000.0, [4.0, 5.0], [6.0, 7.0, 8.0]]
    assert ran == [variant] * 8
    pipe = Pipe(1, ValueError("bad"))
    interleaved_processes.serve(pipe, variant)  # type: ignore[arg-type]
    assert pipe.sent[-1] == "ValueError: bad"
    broken = Pipe(BrokenPipeError())
    interleaved_processes.serve(broken, variant)  # type: ignore[arg-type]
    assert len(broken.sent) == 1


class Processes:
    """Stands for multiprocessing's context: each child answers with its start-up time on a thread."""

    def __init__(self) -> None:
        self.processes: list[Any] = []
        self.ours: list[Any] = []

    def Pipe(self) -> Any:  # noqa: N802 - multiprocessing's name
        ours, theirs = multiprocessing.Pipe()
        self.ours.append(ours)
        return ours, theirs

    def Process(self, target: Any, args: Any, daemon: bool) -> Any:  # noqa: N802 - multiprocessing's name
        pipe, variant = args
        done: list[Any] = []
        process = SimpleNamespace(
            target=target,
            daemon=daemon,
            variant=variant,
            done=done,
            start=lambda: pipe.send(float(variant.threads)),
            join=lambda seconds: done.append((seconds, self.ours[0].closed)),
            kill=lambda: done.append("killed"),
            pipe=pipe,
        )
        self.processes.append(process)
        return process


def test_runners_have_a_process_each_and_end_them_all(monkeypatch: pytest.MonkeyPatch) -> None:
    told = Processes()
    asked: list[str] = []
    monkeypatch.setattr(interleaved_processes.multiprocessing, "get_context", lambda how: asked.append(how) or told)
    variants = {"a": Variant("ort", Path("a"), threads=3), "b": Variant("ort", Path("b"), threads=4)}
    with interleaved_processes.runners(variants) as by_name:
        assert {name: each.startup_ms for name, each in by_name.items()} == {"a": 3.0, "b": 4.0}
        assert all(process.pipe.closed and process.done == [] for process in told.processes)
    assert asked == ["spawn"]
    assert [process.variant for process in told.processes] == [*variants.values()]
    for process in told.processes:
        assert (process.target, process.daemon) == (interleaved_processes.serve, True)
        assert process.done == [(5, True), "killed"]
    assert all(pipe.closed for pipe in told.ours)


@pytest.fixture
def network(tiny_quantised: Any, tmp_path: Path) -> Path:
    path = tmp_path / "network.onnx"
    onnx.save(tiny_quantised.network.model, path)
    return path


@pytest.mark.parametrize(("threads", "asked"), [(3, 3), (None, 1)])
def test_ours_is_bound_once_to_random_bytes(
    monkeypatch: pytest.MonkeyPatch, network: Path, threads: int | None, asked: int
) -> None:
    seen: list[Any] = []

    class Told:
        def load(self, file: Any, options: Any) -> Any:
            seen.append((file.shape, options.threads, options.spin))
            return SimpleNamespace(bind=lambda inputs, outputs: seen.extend((inputs, outputs)) or self)

        def run(self) -> None:
            seen.append("ran")

    monkeypatch.setattr(runtimes, "load_runtime", lambda name: seen.append(name) or Told())
    run = KINDS["runtime"](Variant("runtime", network, "ort", threads, spin=True))
    run()
    name, facts, (source,), (target,), ran = seen
    assert (name, facts, ran) == ("ort", ((1, 64, 64, 5), asked, True), "ran")
    assert (target.shape, target.dtype) == ((1, 64, 64, 4), np.uint8)
    assert np.array_equal(source, np.random.default_rng(1).integers(0, 256, (1, 64, 64, 5), dtype=np.uint8))


def test_onnx_runtime_is_asked_as_its_first_example_asks(
    monkeypatch: pytest.MonkeyPatch, network: Path, tiny_float: Any, tmp_path: Path
) -> None:
    import onnxruntime

    made: list[Any] = []
    session = onnxruntime.InferenceSession

    def kept(path: str, settings: Any, providers: list[str]) -> Any:
        made.append((path, settings.intra_op_num_threads, providers))
        return session(path, settings, providers=providers)

    monkeypatch.setattr(onnxruntime, "InferenceSession", kept)
    (found,) = KINDS["ort"](Variant("ort", network, threads=2))()  # type: ignore[misc]
    source = np.random.default_rng(1).integers(0, 256, (1, 64, 64, 5), dtype=np.uint8)
    plain = session(str(network), providers=["CPUExecutionProvider"])
    assert np.array_equal(found, plain.run(None, {plain.get_inputs()[0].name: source})[0])
    onnx.save(tiny_float, tmp_path / "float.onnx")
    (found,) = KINDS["ort"](Variant("ort", tmp_path / "float.onnx"))()  # type: ignore[misc]
    real = np.random.default_rng(1).normal(size=(1, 5, 64, 64)).astype(np.float32)
    plain = session(str(tmp_path / "float.onnx"), providers=["CPUExecutionProvider"])
    np.testing.assert_allclose(found, plain.run(None, {"tensor": real})[0], atol=1e-6)
    files = (str(network), 2), (str(tmp_path / "float.onnx"), 0)
    assert made == [(*file, ["CPUExecutionProvider"]) for file in files]


@pytest.mark.parametrize(("threads", "settings"), [(2, {"INFERENCE_NUM_THREADS": 2}), (None, {})])
def test_openvino_is_asked_as_its_first_example_asks(
    monkeypatch: pytest.MonkeyPatch, network: Path, threads: int | None, settings: dict[str, int]
) -> None:
    pytest.importorskip("openvino")
    seen: list[Any] = []

    class Core:
        def compile_model(self, *asked: Any) -> Any:
            seen.append(asked)
            request = SimpleNamespace(infer=lambda feed: seen.append(feed) or "answer")
            return SimpleNamespace(
                input=lambda place: SimpleNamespace(shape=[1, 2, 3, 4 + place]), create_infer_request=lambda: request
            )

    monkeypatch.setattr(runtimes, "quiet_openvino", lambda: SimpleNamespace(Core=Core))
    run = KINDS["openvino"](Variant("openvino", network, threads=threads))
    assert run() == "answer"
    asked, feed = seen
    assert asked == (str(network), "CPU", settings)
    assert np.array_equal(feed[0], np.random.default_rng(1).integers(0, 256, (1, 2, 3, 4), dtype=np.uint8))


def test_a_slot_is_written_whole_and_read_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr(handoff.time, "sleep", slept.append)
    layout = SlotLayout(header_dtype(), 64)
    slots = [view_packet(memoryview(bytearray(layout.slot_bytes)), layout) for _ in range(2)]
    pipeline = handoff.handoff_pipeline(64)
    assert [(stage.name, stage.unit) for stage in pipeline.stages] == [*handoff.STAGES]
    assert [edge.payload_bytes for edge in pipeline.edges] == [0, 64, 0]
    unit = UnitContext("a", UnitSettings(cores=(0,), threads=1), {})
    by_name = {stage.name: handoff.build(stage.settings, unit) for stage in pipeline.stages}
    for name, stage in by_name.items():
        stage.bind(slots if name == "infer" else [], slots if name == "raster" else [])
    assert by_name["pose"].run(255, None, 0) == {} and slept == [0.001] and not slots[0].payload.any()
    assert by_name["raster"].run(255, 0, 1) == {}
    assert (slots[1].payload == 4).all() and not slots[0].payload.any()
    assert by_name["infer"].run(255, 1, None) == {}
    by_name["present"].run(255, 1, None)
    with pytest.raises(TrilaneError, match="a slot of 64 bytes holds others than were written"):
        by_name["infer"].run(256, 1, 0)
    with pytest.raises(TrilaneError, match="64 bytes"):
        by_name["infer"].run(255, 0, None)
    slots[1].payload[63] = 5
    with pytest.raises(TrilaneError, match="64 bytes"):
        handoff.check_bytes(slots[1].payload, 4)
    assert slept == [0.001]


def test_a_file_has_the_work_of_its_layers(network: Path) -> None:
    """By hand, of the tiny network at 64 x 64: four convolutions of 3 x 3."""
    from trilane.avatars.network_file import read_network

    fixture = networks.fixture_of_file(read_network(network), batch=3)
    sizes = ((32, 5, 8), (16, 8, 8), (32, 16, 8), (64, 8, 4))
    assert fixture.gmac == pytest.approx(sum(9 * side**2 * c_in * c_out for side, c_in, c_out in sizes) / 1e9)
    assert fixture.integer.shape == (3, 64, 64, 5) and fixture.label["size"] == [64, 64]
    assert fixture.label["network"] == read_network(network).where
    tensor = networks.random_tensor(fixture.integer)  # type: ignore[arg-type]
    assert tensor.shape == (3, 64, 64, 5) and tensor.dtype == np.uint8 and (tensor.min(), tensor.max()) == (0, 255)
