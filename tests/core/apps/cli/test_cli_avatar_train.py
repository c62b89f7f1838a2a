"""`trilane avatar train`: what it asks of the training, what it shows of it, and what it says without PyTorch."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import trilane.training
from trilane import machine
from trilane.apps.cli import avatar_train
from trilane.training.training_settings import OptimiserOptions, TrainingSettings, parsed_settings, settings_text

Command = Callable[..., tuple[str, str]]


class Training(ModuleType):
    """In place of `train`: notes what it is asked, and tells the listener what a training would."""

    def __init__(self) -> None:
        super().__init__("trilane.training.train")
        self.asked: list[Any] = []

    def TrainingPlaces(self, *places: Any) -> Any:  # noqa: N802
        return places

    def train_avatar(self, places: Any, settings: TrainingSettings, listener: Any) -> dict[str, Any]:
        self.asked.append((places, settings))
        listener.say("3 steps: about 2.0 min")
        assert list(listener.track("drawing", iter([4, 5]), 2)) == [4, 5]
        for step, loss in ((1, 2.0), (2, 1.0), (3, 0.5)):
            listener.trained(step, 3, {"composite": 0.25, "overlap": 0.125}, loss)
        return {"avatar": str(places[1]), "steps": 3}


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch) -> Training:
    double = Training()
    monkeypatch.setitem(sys.modules, double.__name__, double)
    monkeypatch.setattr(trilane.training, "train", double, raising=False)
    monkeypatch.setattr(machine.here, "has_package", lambda _: True)
    return double


def test_options_are_settings_and_go_before_those_of_a_file(
    training: Training, tmp_path: Path, command: Command
) -> None:
    (tmp_path / "training.toml").write_text(settings_text(parsed_settings({"seed": 7, "batch": 3, "steps": 40}, "")))
    words = ("avatar", "train", "their", "--out", tmp_path / "mine")
    out, _ = command(*words, "--json")
    assert json.loads(out) == {"avatar": str(tmp_path / "mine"), "steps": 3}
    command(*words, "--config", tmp_path / "training.toml", "--seed", 8, "--work", "there")
    command(
        *words,
        "--start",
        "new",
        "--width",
        8,
        "--minutes",
        2,
        "--samples",
        50,
        "--threads",
        2,
        "--steps",
        30,
        "--device",
        "cpu",
    )
    command(*words, "--config", tmp_path / "training.toml", "--loss", "thesis", "--vgg", "vgg.pth")
    folder = (Path("their"), tmp_path / "mine", tmp_path / "mine-work", "mine", None)
    begun: dict[str, Any] = {
        "seed": 7,
        "batch": 3,
        "steps": 40,
        "network_rate": 1.5e-3,
        "texture_rate": 4e-4,
        "weight_decay": 1e-3,
    }
    begun["optimiser"] = OptimiserOptions().model_dump()
    wanted = {"start": "new", "width": 8, "minutes": 2.0, "samples": 50, "threads": 2, "steps": 30, "device": "cpu"}
    assert training.asked == [
        (folder, parsed_settings({}, "")),
        ((*folder[:2], Path("there"), "mine", None), parsed_settings({"seed": 8, "batch": 3, "steps": 40}, "")),
        (folder, parsed_settings(wanted, "")),
        ((*folder[:4], Path("vgg.pth")), parsed_settings(begun | {"loss": "thesis"}, "")),
    ]


@pytest.mark.usefixtures("training")
def test_losses_and_the_time_that_is_left_are_shown(
    command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A line at the first step, after each half minute and at the last; the loss follows slowly."""
    times = iter([100.0, 100.0, 131.0, 140.0])
    monkeypatch.setattr(avatar_train.time, "monotonic", lambda: next(times))
    _, err = command("avatar", "train", "their", "--out", tmp_path / "mine")
    assert err.splitlines() == [
        "3 steps: about 2.0 min",
        "step 1 of 3: loss 2.000, composite 0.250, overlap 0.125",
        "step 2 of 3: loss 1.950, composite 0.250, overlap 0.125, 31 s left",
        "step 3 of 3: loss 1.877, composite 0.250, overlap 0.125, 0 s left",
    ]


def test_without_pytorch_the_lines_that_install_it_are_said(
    command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for missing, words in (
        ("torch", ("training needs torch", "--index-url https://download.pytorch.org/whl/cpu (CPU) or ", "NVIDIA GPU")),
        ("skimage", ("training needs skimage", "[train]")),
    ):
        monkeypatch.setattr(machine.here, "has_package", lambda name, missing=missing: name != missing)
        _, err = command("avatar", "train", "their", "--out", tmp_path / "mine", code=3)
        assert all(word in err for word in words), err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--samples", 2), "options: samples: found 2, expected greater than or equal to 8"),
        (("--minutes", "nan"), "options: minutes: found nan, expected above 0, at most 100000 minutes"),
        (("--minutes", 0), "options: minutes: found 0, expected above 0, at most 100000 minutes"),
        (("--minutes", "soon"), "--minutes: found 'soon', expected a number"),
        (("--start", "old"), "options: start: found 'old', expected 'default', 'hiker', 'dancer' or 'new'"),
        (("--loss", "tesis"), "options: loss: found 'tesis', expected one of default, thesis; did you mean 'thesis'"),
        (("--width", 8), "--width: found 8, expected 16 of a trained network; or --start new"),
        (("--config", "nothing.toml"), "nothing.toml: found no such file"),
    ],
)
def test_wrong_settings_are_refused(command: Command, tmp_path: Path, words: tuple[Any, ...], said: str) -> None:
    _, err = command("avatar", "train", "their", "--out", tmp_path / "mine", *words, code=2)
    assert said in " ".join(err.split())
