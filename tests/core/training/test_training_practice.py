"""What a training says of itself: the device, its memory, the loss of the same samples, and a log for TensorBoard."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from trilane.apps.cli.avatar_train import EventLog  # noqa: E402
from trilane.errors import MissingPartError  # noqa: E402
from trilane.training.dataset import U16, ShapeGroup, create_group  # noqa: E402
from trilane.training.objective import (  # noqa: E402
    Objective,
    drawn_behind,
    loss_terms,
    total_loss,
)
from trilane.training.step_loop import (  # noqa: E402
    chosen_device,
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

    def paint(_: Any, covered: Any, __: int) -> Any:
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


def test_tensorboard_reads_the_log(tmp_path: Path) -> None:
    reader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    for step in (1, 2):
        log = EventLog(tmp_path)
        log.write(step, {"overlap": 0.5 / step}, 3.0)
        log.close()
    found: Callable[[], Any] = reader.EventAccumulator(str(tmp_path)).Reload
    scalars = found().Scalars("terms/overlap")
    assert [(each.step, each.value) for each in scalars] == [(1, 0.5), (2, 0.25)]
