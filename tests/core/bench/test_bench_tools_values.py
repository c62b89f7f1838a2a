"""What benches lean on, told what to answer: LoadGen, networks that are made, the clock's loops on every core."""

from __future__ import annotations

import hashlib
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane import machine
from trilane.avatars.bundle import load_bundle
from trilane.bench.lib import instruction_sets, networks
from trilane.bench.lib.instruction_sets import KERNELS, Issued, measure_issued
from trilane.bench.lib.load import Load, Queries
from trilane.bench.lib.loadgen import LoadGenPlayer, load_generator
from trilane.errors import MissingPartError, TrilaneError


class LoadGen:
    """Stands for MLCommons' module: asks for `asks` samples, answers as it is told, writes `summary`."""

    TestScenario = SimpleNamespace(SingleStream="single", MultiStream="multi", Server="server", Offline="offline")
    TestMode = SimpleNamespace(PerformanceOnly="performance")
    TestSettings = LogSettings = LogOutputSettings = SimpleNamespace

    def __init__(self, summary: str = "Result is : VALID\n") -> None:
        self.summary, self.calls, self.completed = summary, [], []
        self.during: Any = lambda: None

    def ConstructSUT(self, issue: Any, flush: Any) -> str:  # noqa: N802 - its name
        self.issue = issue
        assert flush() is None
        return "system"

    def ConstructQSL(self, total: int, performance: int, load: Any, unload: Any) -> str:  # noqa: N802 - its name
        assert load([]) is unload([]) is None
        self.calls.append(("library", total, performance))
        return "library"

    def StartTestWithLogSettings(self, system: str, library: str, settings: Any, logs: Any) -> None:  # noqa: N802
        assert (system, library) == ("system", "library")
        self.settings, self.logs = settings, logs
        self.during()
        (Path(logs.log_output.outdir) / "mlperf_log_summary.txt").write_text(self.summary, encoding="utf-8")

    def DestroyQSL(self, library: str) -> None:  # noqa: N802 - its name
        self.calls.append(("destroyed", library))

    def DestroySUT(self, system: str) -> None:  # noqa: N802 - its name
        self.calls.append(("destroyed", system))

    def QuerySampleResponse(self, *what: int) -> tuple[int, ...]:  # noqa: N802 - its name
        return what

    def QuerySamplesComplete(self, responses: list[Any]) -> None:  # noqa: N802 - its name
        self.completed += responses


class Frames:
    """Stands for a run: each frame that is asked for is answered at once, until `most` were."""

    def __init__(self, player: LoadGenPlayer, most: int = 1000) -> None:
        self._player, self._most, self.next = player, most, 0

    def request(self, count: int) -> None:
        for _ in range(count):
            if self.next < self._most:
                self.next += 1
                self._player.answered(self.next - 1)


@pytest.fixture
def loadgen(monkeypatch: pytest.MonkeyPatch) -> LoadGen:
    told = LoadGen()
    monkeypatch.setitem(sys.modules, "mlperf_loadgen", told)
    return told


def samples(*ids: int) -> list[Any]:
    return [SimpleNamespace(id=each) for each in ids]


@pytest.mark.parametrize(
    ("summary", "valid"),
    [("x\nResult is : VALID\n", True), ("Result is : INVALID\n", False), ("no such line", False)],
)
def test_loadgen_asks_and_judges(loadgen: LoadGen, summary: str, valid: bool) -> None:
    """Eight frames to warm up are nobody's sample; those after it are answered by their own ids."""
    loadgen.summary = summary
    player = LoadGenPlayer(Load("server", 1.5, 20.0, 30.0, 5, 7), Queries())
    loadgen.during = lambda: (loadgen.issue(samples(70, 71)), loadgen.issue(samples(90)))
    frames = Frames(player)
    player.play(frames)  # type: ignore[arg-type]
    assert frames.next == 11 and loadgen.completed == [(70, 0, 0), (71, 0, 0), (90, 0, 0)]
    assert (player.verdict.valid, player.verdict.summary) == (valid, summary)
    assert len(player.queries.latencies_ms) == 3
    assert vars(loadgen.settings) == {
        "scenario": "server",
        "mode": "performance",
        "min_duration_ms": 1500,
        "min_query_count": 662,
        "server_target_qps": 20.0,
        "server_target_latency_ns": 30_000_000,
        "server_target_latency_percentile": 0.99,
        "single_stream_target_latency_percentile": 0.99,
        "multi_stream_target_latency_percentile": 0.99,
        "multi_stream_samples_per_query": 5,
        "offline_expected_qps": 20.0,
        "schedule_rng_seed": 7,
    }
    assert loadgen.logs.enable_trace is loadgen.logs.log_output.copy_summary_to_stdout is False
    folder = Path(loadgen.logs.log_output.outdir)
    assert not folder.exists() and re.fullmatch(r"trilane-loadgen-\w{8}", folder.name)
    assert loadgen.calls == [("library", 64, 64), ("destroyed", "library"), ("destroyed", "system")]


@pytest.mark.parametrize(
    ("scenario", "name"), [("single-stream", "single"), ("multi-stream", "multi"), ("offline", "offline")]
)
def test_each_scenario_has_its_name_in_loadgen(loadgen: LoadGen, scenario: str, name: str) -> None:
    player = LoadGenPlayer(Load(scenario, 0.0101), Queries())
    settings = player._settings(loadgen)
    assert (settings.scenario, settings.min_duration_ms) == (name, 11)


@pytest.mark.parametrize(
    ("causes", "words"), [({}, "^the run ended before LoadGen had its answers$"), ({"a": 2}, "a 2")]
)
def test_samples_that_nobody_will_answer_are_completed_once(
    loadgen: LoadGen, causes: dict[str, int], words: str
) -> None:
    """Of four the first is answered; the run ends or drops a frame, and a later query is completed as it comes."""
    player = LoadGenPlayer(Load("offline", 1.0), Queries())

    def during() -> None:
        loadgen.issue(samples(1, 2, 3, 4))
        assert loadgen.completed == [(1, 0, 0)]
        if causes:
            player.unanswered(causes)
        else:
            player.ended()
        player.answered(9)
        player.ended()
        loadgen.issue(samples(5))

    loadgen.during = during
    with pytest.raises(TrilaneError, match=words):
        player.play(Frames(player, 9))  # type: ignore[arg-type]
    assert loadgen.completed == [(n, 0, 0) for n in (1, 2, 3, 4, 5)]
    assert loadgen.calls[1:] == [("destroyed", "library"), ("destroyed", "system")]
    quiet = LoadGenPlayer(Load("offline", 1.0), Queries())
    quiet.ended()
    assert quiet.queries.over and len(loadgen.completed) == 5


def test_without_loadgen_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mlperf_loadgen", None)
    with pytest.raises(MissingPartError, match=r"^LoadGen is not installed; .*loadgen"):
        load_generator()


def test_an_untrained_network_is_what_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work by PyTorch's modules at 64 x 64, scaled to the tensor; five frames to calibrate, the same every time."""
    torch = pytest.importorskip("torch")
    from trilane.training import network
    from trilane.training.network import UNet

    exported: list[Any] = []
    asked: list[Any] = []
    monkeypatch.setattr(network, "export_onnx", lambda network, *side: exported.append((network, side)) or "small")
    quantised = SimpleNamespace(network="quantised")
    monkeypatch.setattr(networks, "quantise", lambda *what: asked.append(what) or quantised)
    monkeypatch.setattr(networks, "reshaped", lambda *what: asked.append(what) or "integer")
    torch.manual_seed(5)
    found = networks.untrained("mobilenetv3", "instance", 4, (96, 160), channels=8, batch=3)
    label = {"encoder": "mobilenetv3", "norm": "instance", "width": 4, "size": [96, 160], "channels": 8}
    assert (found.label, found.integer) == (label, "integer")
    assert exported[0][1] == (64, 64) and not exported[0][0].training
    (small, frames), resized = asked
    assert small == "small" and resized == ("quantised", 96, 160, 3)
    rng = np.random.default_rng(0)
    assert len(frames) == 5 and all(frame.dtype == np.float32 for frame in frames)
    assert all(np.array_equal(frame, rng.normal(size=(64, 64, 8)).astype(np.float32)) for frame in frames)
    torch.manual_seed(0)
    twin = UNet("mobilenetv3", "instance", 4, 8)
    assert all(torch.equal(a, b) for a, b in zip(twin.parameters(), exported[0][0].parameters(), strict=True))
    assert found.parameters == sum(each.numel() for each in twin.parameters())
    plain = networks.untrained_float("mobilenetv3", "instance", 4, (96, 160))
    assert plain == "small" and exported[1][1] == (96, 160)
    first = next(each for each in exported[1][0].modules() if isinstance(each, torch.nn.Conv2d))
    assert first.weight.shape[1] == 16


def test_multiply_accumulates_of_a_pixel_by_hand() -> None:
    """64 x 64: 8 x 9 x 4 weights at every fourth pixel, 16 x 8 at each of those, and none of another kind."""
    torch = pytest.importorskip("torch")
    conv = torch.nn.Conv2d(4, 8, 3, stride=(2, 2), padding=1)
    network = torch.nn.Sequential(
        conv, torch.nn.ReLU(), torch.nn.Conv2d(8, 16, (1, 1)), torch.nn.BatchNorm2d(16)
    ).eval()
    assert networks._defined_macs(network, torch, 4) == (9 * 4 * 8 + 8 * 16) / 4
    slim = torch.nn.Conv2d(4, 2, (1, 64), bias=False)
    assert networks._defined_macs(slim, torch, 4) == 64 * 1 * (4 * 2 * 64) / 64**2
    assert not slim._forward_hooks


def test_without_pytorch_untrained_networks_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingPartError, match=r"^untrained networks need PyTorch; .*train"):
        networks.untrained("resnet18", "batch", 4, (64, 64))


def test_the_full_width_bundle_is_made_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tiny_quantised: Any
) -> None:
    """The default avatar's body and texture round a network of the asked settings, kept by its content."""
    made: list[Any] = []

    def untrained(*asked: Any) -> Any:
        made.append(asked)
        return SimpleNamespace(integer=tiny_quantised.network)

    written: list[Any] = []

    def write(folder: Path, *what: Any, offsets: Any) -> None:
        written.append((folder, *what, offsets))
        folder.mkdir(parents=True)
        (folder / networks.MANIFEST).touch()

    monkeypatch.setattr(networks, "untrained", untrained)
    monkeypatch.setattr(networks, "cache_dir", lambda name: tmp_path / name)
    monkeypatch.setattr(networks, "write_bundle", write)
    folder = networks.full_width_bundle()
    assert folder.parent == tmp_path / "bench"
    default = load_bundle("default")
    worn = default.read_body().offsets
    content = default.read_texture().astype(np.float16).tobytes() + default.body_path.read_bytes()
    content += b"" if worn is None else worn.tobytes()
    assert folder.name == f"resnet18-batch-64-{hashlib.sha256(content).hexdigest()[:12]}"
    ((place, manifest, body, texture, network, offsets),) = written
    assert np.array_equal(offsets, worn) if worn is not None else offsets is None
    assert (place, body, network) == (folder, default.body_path, tiny_quantised.network)
    assert texture.dtype == np.float16 and np.array_equal(texture, default.read_texture().astype(np.float16))
    assert made == [("resnet18", "batch", 64, (64, 64), texture.shape[2])]
    entry = manifest.network
    assert (manifest.name, entry.encoder, entry.norm, entry.width) == ("resnet18", "resnet18", "batch", 64)
    assert manifest.provenance == {"weights": "untrained: for speed alone"}
    assert networks.full_width_bundle() == folder and len(made) == 1
    monkeypatch.setattr(networks, "cache_dir", lambda _: None)
    with pytest.raises(TrilaneError, match="the cache folder cannot be written"):
        networks.full_width_bundle()


def test_what_cores_do_is_the_median_of_bursts_and_the_mean_of_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """A burst is 1e6 cycles: 166666 turns of 6. On core 2 the clock's loop takes 0.5 ns for each of its cycles (2 GHz),
    on core 5 0.25 ns; twelve instructions a turn, each three cycles, and 12 a turn in 6 or 12 cycles."""
    turns = 1_000_000 // 6
    chain = turns * 12 * 3
    code: list[bytes] = []
    asked: list[Any] = []

    class Code:
        def __init__(self, text: bytes) -> None:
            self.is_clock = len(code) % 2 == 1
            code.append(text)

        def __enter__(self) -> Code:
            return self

        def __exit__(self, *_: object) -> None:
            asked.append("freed")

        def ns(self, count: int) -> float:
            assert count == turns
            slow = asked[-1] == 2
            cycle_ns = 0.5 if slow else 0.25
            return chain * cycle_ns if self.is_clock else turns * (6 if slow else 12) * cycle_ns

    class Pool:
        def __init__(self, count: int) -> None:
            assert count == 2

        def __enter__(self) -> Pool:
            return self

        def __exit__(self, *_: object) -> None:
            """Nothing to end."""

        def map(self, work: Any, cores: Any) -> Any:
            return map(work, cores)

    monkeypatch.setattr(instruction_sets, "_Code", Code)
    monkeypatch.setattr(instruction_sets, "ThreadPoolExecutor", Pool)
    barrier = SimpleNamespace(wait=lambda: None)
    monkeypatch.setattr(instruction_sets, "threading", SimpleNamespace(Barrier=lambda n: asked.append(n) or barrier))
    monkeypatch.setattr(instruction_sets.os, "sched_setaffinity", lambda pid, cores: asked.extend((pid, *cores)))
    monkeypatch.setattr(machine.here, "architecture", lambda: "x86_64")
    found = measure_issued("AVX-VNNI", [2, 5])
    assert found == Issued(*(pytest.approx(value) for value in (1.5, 3.0, 3.0, 3.0)))
    assert asked == [2, 0, 2, "freed", "freed", 0, 5, "freed", "freed"]
    kernel = KERNELS["AVX-VNNI"]
    assert code == [instruction_sets.rate_loop(kernel), instruction_sets.clock_loop(kernel)] * 2


@pytest.mark.parametrize(("refused", "words"), [(0, ""), (1, "the tiles of AMX are refused")])
def test_tiles_are_asked_for_where_a_set_has_them(monkeypatch: pytest.MonkeyPatch, refused: int, words: str) -> None:
    calls: list[Any] = []
    libc = SimpleNamespace(syscall=lambda *what: calls.append(what) or refused)
    monkeypatch.setattr(
        instruction_sets.ctypes, "CDLL", lambda name, use_errno: libc if (name, use_errno) == (None, True) else None
    )
    monkeypatch.setattr(instruction_sets, "_on_core", lambda *_: (1.0, [2.0, 4.0, 3.0]))
    monkeypatch.setattr(machine.here, "architecture", lambda: "x86_64")
    if refused:
        with pytest.raises(OSError, match=words):
            measure_issued("AMX-INT8", [0])
    else:
        assert measure_issued("AMX-INT8", [0]) == Issued(1.0, 3.0, 2.0, 4.0)
    assert calls == [(158, 0x1023, 18)]
    measure_issued("AVX2", [0])
    assert len(calls) == 1


@pytest.mark.skipif(machine.here.architecture() != "x86_64", reason="the loops are machine code of x86")
def test_a_loop_runs_as_often_as_it_is_told() -> None:
    """Machine code by hand: `imul` alone is on every x86-64 core. Three cycles of at most 10 GHz each."""
    kernel = instruction_sets.Kernel("480fafc0", sequences=1, imuls=1, cycles=3, after="")
    with instruction_sets._Code(instruction_sets.clock_loop(kernel)) as code:
        assert code.ns(200_000) > 200_000 * 2 * 3 / 10
    assert code._memory.closed
