"""`bench infer`, `peers` and `roofline`: whole documents of runs whose times are told, worked out by hand."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import shape_inference

from trilane import machine
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import read_network
from trilane.bench import infer, peers, roofline
from trilane.bench.lib.interleaved_processes import ProcessVariant
from trilane.bench.lib.networks import NetworkFixture, fixture_of_file
from trilane.bench.roofline import Issued
from trilane.errors import BadInputError, MissingPartError, TrilaneError


class ToldRunners:
    """A double of `interleaved_processes.runners`: `ms(name, turn)` is what the runs of a turn take, turns from 0.

    `variants`: of each call. A variant starts up in 100 ms for each call so far, and its place in it.
    """

    def __init__(self, ms: Callable[[str, int], list[float]]) -> None:
        self._ms, self._turns = ms, dict[str, int]()
        self.variants: list[dict[str, ProcessVariant]] = []

    @contextmanager
    def __call__(self, variants: Mapping[str, ProcessVariant]) -> Iterator[dict[str, Any]]:
        self.variants.append(dict(variants))
        yield {name: self._runner(name, place) for place, name in enumerate(variants)}

    def _runner(self, name: str, place: int) -> Any:
        def answer(_count: float) -> list[float]:
            self._turns[name] = self._turns.get(name, -1) + 1
            return self._ms(name, self._turns[name])

        return SimpleNamespace(startup_ms=100.0 * len(self.variants) + place, run=answer, run_for=answer)


PEAK = {"int8_gmac_s": 1000.0, "int8_instruction_gmac_s": 4000.0}


@pytest.fixture
def network(tiny_quantised: Any, tmp_path: Path) -> Path:
    path = tmp_path / "network.onnx"
    onnx.save(tiny_quantised.network.model, path)
    return path


@pytest.fixture(autouse=True)
def peak(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """The peaks are told but to the tests of them; the machine has four cores."""
    if "rates" not in request.node.name:
        monkeypatch.setattr(roofline, "measure", lambda threads: {**PEAK, "threads": threads})
    monkeypatch.setattr(machine.here, "cores", lambda: (0, 1, 2, 5))


def test_a_file_in_batches_of_two(monkeypatch: pytest.MonkeyPatch, network: Path) -> None:
    """Three periods (2 / 0.75 rounded) of two runs: 8 and 12, 18 and 22, 28 and 32 ms for two frames each; the 90th
    percentile is half-way from 14 to 16, at place 4.5 of 0 to 5. The cache of compiled networks is the bench's own."""
    caches: set[str] = set()
    told = ToldRunners(lambda _, turn: caches.add(os.environ["XDG_CACHE_HOME"]) or [8.0 + 10 * turn, 12 + 10 * turn])
    monkeypatch.setattr(infer, "runners", told)
    monkeypatch.setattr(machine.here, "sensor_c", lambda: 41.5)
    monkeypatch.setenv("XDG_CACHE_HOME", "/before")
    result = infer.measure(str(network), batch=(2,), runtime=("ort",), threads=3, spin=True, seconds=2.0, period=0.75)
    fixture = fixture_of_file(read_network(network), 2)
    rate = fixture.gmac / 0.010
    assert result == {
        "rows": [
            {
                **{"network": str(network), "size": [64, 64], "parameters": fixture.parameters, "gmac": fixture.gmac},
                **{"runtime": "ort", "batch": 2, "startup_cold_ms": 100.0, "startup_warm_ms": 200.0, "frames": 12},
                **{"p50_ms": 10.0, "p90_ms": pytest.approx(15.0), "p99_ms": pytest.approx(15.9)},
                **{"min_ms": 4.0, "mean_ms": 10.0, "max_ms": 16.0, "temperature_c": 41.5},
                "periods": [{"min_ms": ms - 1, "mean_ms": ms, "max_ms": ms + 1} for ms in (5.0, 10.0, 15.0)],
                "share_of_roofline": pytest.approx(rate / 1000),
                "share_of_instruction_peak": pytest.approx(rate / 4000),
                "int8_over_fp32": None,
            }
        ],
        "roofline": {**PEAK, "threads": 3},
        "config": {"threads": 3, "spin": True, "seconds": 2.0},
    }
    (variant,) = told.variants[0].values()
    assert told.variants[0] == told.variants[1] and len(told.variants) == 2
    assert (variant.kind, variant.runtime, variant.threads, variant.spin) == ("runtime", "ort", 3, True)
    assert caches == {str(variant.network.parent / "cache")}
    assert not variant.network.parent.exists() and os.environ["XDG_CACHE_HOME"] == "/before"


def test_each_network_is_set_against_itself_in_float(monkeypatch: pytest.MonkeyPatch, network: Path) -> None:
    """Eight milliseconds a batch of two frames beside twelve a frame: three times as fast, and one row for each."""
    file = read_network(network)

    def untrained(encoder: str, norm: str, width: int, size: tuple[int, int], *, batch: int) -> NetworkFixture:
        assert (norm, width, size) == ("n", 9, (64, 96))
        return NetworkFixture({"encoder": encoder}, fixture_of_file(file, batch).integer, 7, 2.0)

    told = ToldRunners(lambda name, _: [12.0] if name == infer.FP32 else [8.0])
    monkeypatch.setattr(infer, "untrained", untrained)
    monkeypatch.setattr(infer, "untrained_float", lambda *_: onnx.ModelProto())
    monkeypatch.setattr(infer, "runners", told)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    result = infer.measure(
        encoder=("a", "b"), norm=("n",), width=9, size=("64x96",), batch=(2,), runtime=("ort",), seconds=1, period=1
    )
    assert [(row["encoder"], row["runtime"], row["batch"]) for row in result["rows"]] == [
        (encoder, *way) for encoder in "ab" for way in (("ort", 2), (infer.FP32, 1))
    ]
    ours, float_row = result["rows"][:2]
    assert (ours["int8_over_fp32"], ours["share_of_roofline"]) == (3.0, pytest.approx(2 / 0.004 / 1000))
    assert (float_row["p50_ms"], float_row["frames"], ours["frames"]) == (12.0, 1, 2)
    assert "share_of_roofline" not in float_row and (ours["parameters"], ours["gmac"]) == (7, 2.0)
    fp32 = told.variants[0][infer.FP32]
    assert (fp32.kind, fp32.threads, result["config"]["threads"]) == ("ort", 4, 4)
    assert "XDG_CACHE_HOME" not in os.environ


def test_a_bundle_is_measured_by_its_name_and_an_unknown_peak_leaves_its_share_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(roofline, "measure", lambda _: {"int8_gmac_s": 10.0, "int8_instruction_gmac_s": None})
    monkeypatch.setattr(infer, "runners", ToldRunners(lambda *_: [5.0]))
    (row,) = infer.measure("default", runtime=("ort",), threads=1, seconds=1, period=1)["rows"]
    assert row["network"] == load_bundle("default").read_network().where
    assert row["share_of_instruction_peak"] is None


@pytest.mark.parametrize(
    ("measure", "asked", "words"),
    [
        (infer.measure, {"size": ("6",), "runtime": ("ort",)}, "--size"),
        (infer.measure, {"network": "default", "seconds": 2, "period": 3}, "--period: found 3, .* at most --seconds 2"),
        (peers.measure, {"size": "6"}, "--size"),
    ],
)
def test_what_cannot_be_measured_is_refused(
    measure: Any, asked: dict[str, Any], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peers, "resolve", lambda _: None)
    with pytest.raises(BadInputError, match=words):
        measure(**asked)


STATS = json.dumps({"execution_results": {"latency (ms)": "25.0"}})
#: Stands for OpenVINO's tool: notes its arguments, and writes what is told where it is asked to.
APP = """#!{python}
import pathlib, sys
pathlib.Path({notes!r}).write_text(" ".join(sys.argv[1:]))
folder = pathlib.Path(sys.argv[sys.argv.index("-report_folder") + 1])
{stats!r} and (folder / "benchmark_report.json").write_text({stats!r})
sys.exit({code})
"""


def told_app(monkeypatch: pytest.MonkeyPatch, folder: Path, stats: str, code: int = 0) -> Path:
    """Put the double in place; return the file with its last arguments."""
    notes, tool = folder / "notes.txt", folder / "benchmark_app"
    tool.write_text(APP.format(python=sys.executable, notes=str(notes), stats=stats, code=code), encoding="utf-8")
    tool.chmod(0o700)
    monkeypatch.setattr(machine.here, "program", lambda *_, **__: str(tool))
    return notes


def test_peers_run_interleaved_on_the_same_files(
    monkeypatch: pytest.MonkeyPatch, network: Path, tmp_path: Path
) -> None:
    """1 G in 20 ms is 50 G/s, in both rounds; ONNX Runtime in float takes 60, and 80 in the second."""
    ms = {"trilane ort": 30.0, "trilane openvino": 20.0, "onnxruntime fp32": 60.0}
    told = ToldRunners(lambda name, turn: [ms.get(name, 40.0) + (20 * turn if "fp32" in name else 0)] * (2 + turn))
    monkeypatch.setattr(peers, "runners", told)
    monkeypatch.setattr(peers, "resolve", lambda _: None)
    monkeypatch.setattr(peers, "untrained", lambda *_: NetworkFixture({}, read_network(network), 7, 1.0))
    monkeypatch.setattr(peers, "untrained_float", lambda *_: onnx.ModelProto())
    notes = told_app(monkeypatch, tmp_path, STATS)
    result = peers.measure(width=5, size="64x64", rounds=2, seconds=1)
    integer = told.variants[0]["trilane ort"].network
    plain = integer.with_name("float.onnx")
    assert not integer.parent.exists()
    assert told.variants == [
        {
            "trilane ort": ProcessVariant("runtime", integer, "ort", 4),
            "trilane openvino": ProcessVariant("runtime", integer, "openvino", 4),
            "onnxruntime fp32": ProcessVariant("ort", plain),
            "onnxruntime int8": ProcessVariant("ort", integer),
            "openvino int8": ProcessVariant("openvino", integer),
        }
    ]
    assert notes.read_text().startswith(f"-m {integer} -d CPU -hint none -api sync -nthreads 4 -nstreams 1 -t 1 ")
    assert result["ratios"] == pytest.approx(
        {
            **{"ort_over_fp32": 7 / 3, "openvino_over_fp32": 3.5, "openvino_of_roofline": 0.05},
            **{"openvino_of_instruction_peak": 0.0125, "openvino_over_benchmark_app": 1.25},
        }
    )
    assert (result["low"]["openvino_over_fp32"], result["high"]["openvino_over_fp32"]) == (3.0, 4.0)
    assert (result["low"]["ort_over_fp32"], result["high"]["ort_over_fp32"]) == (2.0, pytest.approx(8 / 3))
    medians = {"trilane ort": 30, "trilane openvino": 20, "onnxruntime fp32": 80, "onnxruntime int8": 40}
    medians |= {"openvino int8": 40, "benchmark_app": 25}
    assert result["rows"] == [
        {"way": name, "median_ms": ms, "runs": 2 if name == "benchmark_app" else 5} for name, ms in medians.items()
    ]
    assert result["roofline"] == {**PEAK, "threads": 4}
    assert result["config"] == {"width": 5, "size": "64x64", "threads": 4, "rounds": 2, "seconds": 1}


@pytest.mark.parametrize(("stats", "code"), [("{}", 0), ("no JSON", 0), ("", 0), (STATS, 3)])
def test_openvinos_tool_may_fail(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, stats: str, code: int) -> None:
    told_app(monkeypatch, tmp_path, stats, code)
    with pytest.raises(TrilaneError, match="benchmark_app failed: "):
        peers._benchmark_app(tmp_path / "n.onnx", 1, 1)
    monkeypatch.setattr(machine.here, "program", lambda *_, **__: None)
    with pytest.raises(MissingPartError, match=r"benchmark_app is not there.*openvino"):
        peers._benchmark_app(tmp_path / "n.onnx", 1, 1)


def test_rates_are_work_over_the_best_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of 9, 5 and 7 ms in the first round, 6 in the others: 5 counts. Four layers of (side x channels x kernel)^2
    each; a product of 1536^3. AVX2 has 32 a cycle at the nearest documented rate."""
    told = ToldRunners(lambda _, turn: [9.0, 5.0, 7.0] if turn == 0 else [6.0])
    monkeypatch.setattr(roofline, "runners", told)
    monkeypatch.setattr(roofline, "installed", lambda: ["ort", "qnn", "openvino"])
    monkeypatch.setattr(roofline, "cpu_facts", lambda: {"flags": ["avx2"]})
    monkeypatch.setattr(roofline, "_memory_gb_s", lambda: 12.5)
    monkeypatch.setattr(roofline, "measure_issued", lambda *_: Issued(0.9, 2.0, 1.9, 2.1))
    result = roofline.measure(threads=3)
    work = {(32, 256, 3): 4 * 24576**2, (64, 128, 3): 4 * 24576**2, (64, 512, 1): 4 * 32768**2}
    assert result["rows"] == [
        {"kernel": f"{name} {side}x{side}x{channels} {k}x{k}", "gmac_s": pytest.approx(macs / 1e9 / 0.005)}
        for (side, channels, k), macs in work.items()
        for name in ("ort", "openvino")
    ]
    best, peak = 4 * 32768**2 / 1e9 / 0.005, 32 * 2.0 * 3
    assert (result["int8_gmac_s"], result["int8_instruction_gmac_s"]) == (pytest.approx(best), peak)
    assert result["layer_of_instruction"] == pytest.approx(best / peak)
    assert result["fp32_gmac_s"] == pytest.approx(1536**3 / 1e9 / 0.005)
    assert (result["memory_gb_s"], result["threads"]) == (12.5, 3)
    instructions = result["instructions"]
    assert [instructions[f"clock_{key}"] for key in ("ghz", "low_ghz", "high_ghz")] == [2.0, 1.9, 2.1]
    assert [instructions[key] for key in ("set", "cores", "gmac_s")] == ["AVX2", 3, peak]
    assert instructions["issued_macs_a_cycle"] == pytest.approx(28.8)
    for name, variant in told.variants[0].items():
        assert (variant.kind, variant.threads) == (name.split()[0], 3)
    assert (told.variants[1]["fp32"].kind, told.variants[1]["fp32"].threads) == ("ort", 3)


def test_a_copy_is_read_and_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock's looks are 3, 1, 2, 5, 4 and 6 s apart: at best 2 x 8e6 bytes in 1 s."""
    told = iter([at for gap in (3.0, 1.0, 2.0, 5.0, 4.0, 6.0) for at in (10.0, 10.0 + gap)])
    monkeypatch.setattr(roofline, "time", SimpleNamespace(perf_counter=lambda: next(told)))
    monkeypatch.setattr(roofline, "COPY_BYTES", 8_000_000)
    assert roofline._memory_gb_s() == pytest.approx(0.016)


def test_the_float_peak_is_of_one_matrix_product(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roofline, "MATRIX", 5)
    model = roofline._product()
    weights = np.random.default_rng(0).normal(size=(5, 5)).astype(np.float32)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    source = np.arange(25, dtype=np.float32).reshape(5, 5)
    assert np.allclose(session.run(["y"], {"x": source})[0], source @ weights, rtol=1e-5, atol=1e-4)


def test_the_layers_are_convolutions_between_bytes() -> None:
    """Bytes in and out of the same shape, four convolutions of (c,c,k,k) that keep the size; ONNX Runtime runs them."""
    model = shape_inference.infer_shapes(roofline._layers(8, 16, 3), check_type=True, strict_mode=True)
    shapes = {
        value.name: [dim.dim_value for dim in value.type.tensor_type.shape.dim]
        for value in (*model.graph.input, *model.graph.output, *model.graph.value_info)
    }
    assert shapes["x"] == shapes["y"] == [1, 8, 8, 16]
    assert [shapes[f"conv{i}"] for i in range(4)] == [[1, 16, 8, 8]] * 4
    assert [node.op_type for node in model.graph.node].count("Conv") == 4
    weights = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    assert np.array_equal(weights["w"], np.random.default_rng(0).integers(-63, 64, (16, 16, 3, 3)))
    assert weights["w_scale"] == pytest.approx(0.05 / 12) and not weights["w_zero"].any() and weights["zero"] == 0
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    source = np.random.default_rng(0).integers(0, 256, (1, 8, 8, 16), dtype=np.uint8)
    found = session.run(None, {"x": source})[0]
    real = source.astype(np.float64) * 0.05
    for _ in range(4):
        padded = np.pad(real, ((0, 0), (1, 1), (1, 1), (0, 0)))
        windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))
        out = np.einsum("nhwcyx,ocyx->nhwo", windows, weights["w"] * 0.05 / 12)
        real = np.clip(np.rint(out / 0.05), 0, 255) * 0.05
    assert np.abs(found - np.rint(real / 0.05)).max() <= 1, "halves may round to either side in float32"


@pytest.mark.parametrize("ignored", [{"encoder": ("mit_b0",)}, {"norm": ("none",)}, {"width": 8}, {"size": ("64x64",)}])
def test_a_network_of_a_file_takes_no_settings_of_another(network: Path, ignored: dict[str, Any]) -> None:
    with pytest.raises(BadInputError, match="no --encoder, --norm, --width or --size with it"):
        infer.measure(str(network), **ignored)
