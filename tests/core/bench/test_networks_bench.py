"""What the benches of networks lean on: runs in processes of their own, networks that are made, the clock's loops."""

from __future__ import annotations

import hashlib
import sys
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest

from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import read_network
from trilane.bench.lib import interleaved_processes, networks
from trilane.bench.lib.interleaved_processes import INPUTS, KINDS, SLOTS, ProcessVariant, Runner
from trilane.errors import MissingPartError, TrilaneError


class Pipe:
    """One end of a pipe: `answers` come, what is sent is kept."""

    def __init__(self, *answers: Any) -> None:
        self.answers, self.sent = [*answers], list[Any]()

    def poll(self, _seconds: float) -> bool:
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
    assert pipe.sent == [1, 15, 1]


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
    ran: list[ProcessVariant] = []
    now = [0]

    def load(variant: ProcessVariant) -> Any:
        now[0] += 2_000_000_000

        def run() -> None:
            ran.append(variant)
            now[0] += len(ran) * 1_000_000

        return iter(lambda: run, None)

    clock = SimpleNamespace(perf_counter=lambda: now[0] / 1e9, perf_counter_ns=lambda: now[0])
    monkeypatch.setattr(interleaved_processes, "time", clock)
    monkeypatch.setitem(KINDS, "told", load)
    variant = ProcessVariant("told", Path("n.onnx"))
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


@pytest.fixture
def network(tiny_quantised: Any, tmp_path: Path) -> Path:
    path = tmp_path / "network.onnx"
    onnx.save(tiny_quantised.network.model, path)
    return path


def test_every_kind_infers_the_same_bytes(network: Path, tiny_float: onnx.ModelProto, tmp_path: Path) -> None:
    """The libraries' first examples, beside a plain session; Trilane's way has nothing to answer."""
    onnxruntime = pytest.importorskip("onnxruntime")
    source = np.random.default_rng(1).integers(0, 256, (INPUTS, 1, 64, 64, 5), dtype=np.uint8)[0]
    plain = onnxruntime.InferenceSession(str(network), providers=["CPUExecutionProvider"])
    expected = plain.run(None, {plain.get_inputs()[0].name: source})[0]
    for threads in (1, None):
        (found,) = next(KINDS["ort"](ProcessVariant("ort", network, threads=threads)))()  # type: ignore[misc]
        assert np.array_equal(found, expected)
        assert next(KINDS["runtime"](ProcessVariant("runtime", network, "ort", threads)))() is None
    onnx.save(tiny_float, tmp_path / "float.onnx")
    (found,) = next(KINDS["ort"](ProcessVariant("ort", tmp_path / "float.onnx")))()  # type: ignore[misc]
    real = np.random.default_rng(1).normal(size=(INPUTS, 1, 5, 64, 64)).astype(np.float32)[0]
    plain = onnxruntime.InferenceSession(str(tmp_path / "float.onnx"), providers=["CPUExecutionProvider"])
    np.testing.assert_allclose(found, plain.run(None, {"tensor": real})[0], atol=1e-6)


def test_inputs_take_turns_and_so_do_slots(network: Path) -> None:
    """Each of INPUTS pictures is another one, and the next round has the same ones; Trilane's way binds SLOTS."""
    pytest.importorskip("onnxruntime")
    runs = KINDS["ort"](ProcessVariant("ort", network))
    pictures = [next(runs)()[0] for _ in range(2 * INPUTS)]  # type: ignore[index]
    assert len({picture.tobytes() for picture in pictures[:INPUTS]}) == INPUTS
    assert all(np.array_equal(*pair) for pair in zip(pictures[:INPUTS], pictures[INPUTS:], strict=True))
    bound = [run.__self__ for run in islice(KINDS["runtime"](ProcessVariant("runtime", network, "ort")), 2 * SLOTS)]  # type: ignore[attr-defined]
    assert len({id(one) for one in bound}) == SLOTS and bound[:SLOTS] == bound[SLOTS:]


@pytest.mark.parametrize("threads", [2, None])
def test_openvino_infers_nearly_the_same(network: Path, threads: int | None) -> None:
    """Its sums round elsewhere: few bytes are off, by a step or two."""
    pytest.importorskip("openvino")
    (ours,) = next(KINDS["ort"](ProcessVariant("ort", network)))()  # type: ignore[misc]
    (theirs,) = next(KINDS["openvino"](ProcessVariant("openvino", network, threads=threads)))().values()  # type: ignore[attr-defined]
    steps = np.abs(np.asarray(theirs).astype(int) - ours)
    assert (steps > 0).mean() < 0.05 and steps.max() <= 4


def test_a_file_has_the_work_of_its_layers(network: Path) -> None:
    """By hand, of the tiny network at 64 x 64: four convolutions of 3 x 3."""
    fixture = networks.fixture_of_file(read_network(network), batch=3)
    sizes = ((32, 5, 8), (16, 8, 8), (32, 16, 8), (64, 8, 4))
    assert fixture.gmac == pytest.approx(sum(9 * side**2 * c_in * c_out for side, c_in, c_out in sizes) / 1e9)
    assert fixture.integer.shape == (3, 64, 64, 5) and fixture.label["size"] == [64, 64]
    assert fixture.label["network"] == read_network(network).where
    tensor = networks.random_tensors(fixture.integer, 2)
    assert tensor.shape == (2, 3, 64, 64, 5) and tensor.dtype == np.uint8 and (tensor.min(), tensor.max()) == (0, 255)


def test_an_untrained_network_is_what_is_asked_for() -> None:
    """The same weights every time; the float network has those that are quantised."""
    torch = pytest.importorskip("torch")
    from trilane.training.network import UNet

    settings, size = ("mobilenetv3", "instance", 4), (96, 160)
    found = networks.untrained(*settings, size, channels=8, batch=3)
    assert found.label == dict(zip(("encoder", "norm", "width"), settings, strict=True)) | {
        **{"size": [96, 160], "channels": 8},
    }
    assert found.integer.shape == (3, 96, 160, 8)
    torch.manual_seed(0)
    twin = UNet(*settings, 8).eval()
    assert found.parameters == sum(each.numel() for each in twin.parameters())
    assert found.gmac == networks._defined_macs(twin, torch, 8) * 96 * 160 / 1e9
    first, second = (networks.untrained_float(*settings, size).SerializeToString() for _ in range(2))
    assert first == second


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


def test_the_full_width_bundle_is_made_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The default avatar's body and texture round a network of the asked settings, kept by its content."""
    made: list[Any] = []

    def untrained(*asked: Any) -> Any:
        made.append(asked)
        return SimpleNamespace(integer=load_bundle("default").read_network())

    monkeypatch.setattr(networks, "untrained", untrained)
    monkeypatch.setattr(networks, "cache_dir", lambda name: tmp_path / name)
    folder = networks.full_width_bundle()
    default, written = load_bundle("default"), load_bundle(folder)
    texture, worn = default.read_texture().astype(np.float16), default.read_body().offsets
    content = texture.tobytes() + default.body_path.read_bytes() + (b"" if worn is None else worn.tobytes())
    assert folder == tmp_path / "bench" / f"resnet18-batch-64-{hashlib.sha256(content).hexdigest()[:12]}"
    assert np.array_equal(written.read_texture(), texture)
    assert made == [("resnet18", "batch", 64, (64, 64), texture.shape[2])]
    entry = written.manifest.network
    assert (written.manifest.name, entry.encoder, entry.norm, entry.width) == ("resnet18", "resnet18", "batch", 64)
    assert written.manifest.provenance == {"weights": "untrained: for speed alone"}
    assert networks.full_width_bundle() == folder and len(made) == 1
    monkeypatch.setattr(networks, "cache_dir", lambda _: None)
    with pytest.raises(TrilaneError, match="the cache folder cannot be written"):
        networks.full_width_bundle()
