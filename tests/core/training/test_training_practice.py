"""What a training says of itself: the device, its memory, the loss of the same samples, and a log for TensorBoard."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from trilane.apps.cli.avatar_train import EventLog  # noqa: E402
from trilane.errors import MissingPartError  # noqa: E402
from trilane.training.objective import (  # noqa: E402
    Objective,
    drawn_behind,
    loss_terms,
    total_loss,
)
from trilane.training.sample_files import U16, ShapeGroup, create_group  # noqa: E402
from trilane.training.step_loop import (  # noqa: E402
    chosen_device,
    device_words,
    memory_words,
    probe_loss,
)
from trilane.training.trainable_avatar import load_batch  # noqa: E402


@pytest.mark.parametrize(
    ("there", "asked", "device"),
    [
        (False, "auto", "cpu"),
        (False, "cpu", "cpu"),
        (True, "auto", "cuda"),
        (True, "cpu", "cpu"),
        (True, "cuda", "cuda"),
    ],
)
def test_auto_is_a_gpu_that_is_there(monkeypatch: pytest.MonkeyPatch, there: bool, asked: str, device: str) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    assert chosen_device(asked).type == device


def test_a_gpu_that_is_not_there_is_no_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(MissingPartError, match=r"finds no NVIDIA GPU .* install torch, with NVIDIA's driver"):
        chosen_device("cuda")


def test_device_and_memory_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    process = SimpleNamespace(memory_info=lambda: SimpleNamespace(rss=1_234_000_000))
    monkeypatch.setattr("trilane.training.step_loop.psutil.Process", lambda: process)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda _: 2_345_600_000)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "Nvidia X")
    cpu, gpu = torch.device("cpu"), torch.device("cuda")
    assert (device_words(cpu, 1), device_words(cpu, 2)) == ("1 thread of the CPU", "2 threads of the CPU")
    assert (device_words(gpu, 1), memory_words(cpu)) == ("the GPU Nvidia X", "1234 MB of memory")
    assert memory_words(gpu) == "1234 MB of memory, 2346 MB of the GPU's"


@pytest.fixture
def groups(tmp_path: Path) -> list[ShapeGroup]:
    """Seven samples of one shape, two of another; each has a colour of its own."""
    found = []
    for shape, count in (((16, 16), 7), ((32, 16), 2)):
        group = create_group(tmp_path, shape, np.zeros(count, np.int8))
        group.uv[:], group.covered[:] = U16 // 2, 1
        group.rgba[..., 3] = 255
        group.rgba[..., :3] = np.arange(1, count + 1)[:, None, None, None] * 10 * count
        found.append(group)
    return found


def painted(grey: float) -> Any:
    """A state whose average paints one `grey`."""

    def paint(_: Any, covered: Any) -> Any:
        return torch.full((len(covered), 4, *covered.shape[1:]), grey)

    objective = Objective({"composite": 2.0, "adversarial": 5.0}, None, Refused())  # type: ignore[arg-type]
    return SimpleNamespace(average=paint, objective=objective, device=torch.device("cpu"))


class Refused:
    def terms(self, *_: Any) -> Any:
        raise AssertionError("discriminators judge no probe")


def expected(groups: list[ShapeGroup], grey: float) -> float:
    """Over the first sample of each shape."""
    losses = []
    torch.manual_seed(0)
    for group in groups:
        target = load_batch(group, np.array([0]))[2]
        terms = loss_terms(torch.full_like(target, grey), target, drawn_behind(target))
        losses.append(float(total_loss(terms, {"composite": 2.0})))
    return float(np.mean(losses))


def test_the_probe_is_the_loss_of_the_same_samples_of_each_shape(groups: list[ShapeGroup]) -> None:
    for grey in (0.3, 0.9):
        assert probe_loss(painted(grey), groups) == pytest.approx(expected(groups, grey))
    assert expected(groups, 0.3) != pytest.approx(expected(groups, 0.9), rel=0.1)


def test_a_log_takes_back_what_was_logged_after_the_state(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[Any] = []
    module = ModuleType("torch.utils.tensorboard")
    module.SummaryWriter = lambda *words, **named: (
        asked.append((words, named))
        or SimpleNamespace(  # type: ignore[attr-defined]
            add_scalar=lambda *scalar: asked.append(scalar), close=lambda: asked.append("closed")
        )
    )
    monkeypatch.setitem(sys.modules, module.__name__, module)
    log = EventLog(tmp_path)
    log.close()
    assert asked == [], "without a step there is no file"
    log.write(8, {"overlap": 0.5}, 3.0)
    log.write(9, {"overlap": 0.25}, 2.0)
    log.close()
    assert asked[0] == ((str(tmp_path),), {"purge_step": 8, "flush_secs": 10})
    scalars = [("loss", 3.0, 8), ("terms/overlap", 0.5, 8), ("loss", 2.0, 9), ("terms/overlap", 0.25, 9)]
    assert asked[1:] == [*scalars, "closed"]


def test_tensorboard_reads_the_log(tmp_path: Path) -> None:
    reader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    for step in (1, 2):
        log = EventLog(tmp_path)
        log.write(step, {"overlap": 0.5 / step}, 3.0)
        log.close()
    found: Callable[[], Any] = reader.EventAccumulator(str(tmp_path)).Reload
    scalars = found().Scalars("terms/overlap")
    assert [(each.step, each.value) for each in scalars] == [(1, 0.5), (2, 0.25)]
