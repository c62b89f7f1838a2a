"""A training of about a minute on 32 synthetic frames: the loss falls fivefold, and a run shows the avatar."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.training.training_settings import SHORT, parsed_settings, settings_text

#: As many steps as about half a minute of a processor's time takes, so that the test does not depend on its load.
STEPS = 60
LEAST_FALL = 5.0


def command(*words: object) -> dict[str, Any]:
    line = [sys.executable, "-m", "trilane", *map(str, words), "--json"]
    found: dict[str, Any] = json.loads(subprocess.run(line, check=True, capture_output=True, text=True).stdout)
    return found


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_minute_lowers_the_loss_fivefold_and_a_run_shows_the_avatar(tmp_path: Path) -> None:
    capture, avatar, config = tmp_path / "capture", tmp_path / "avatar", tmp_path / "training.toml"
    values = {"start": "new", "loss": "thesis", "samples": 200, "device": "cpu"}
    config.write_text(settings_text(parsed_settings(values | SHORT | {"steps": STEPS}, "a test")))
    command("avatar", "create-data", capture, "--frames", 32, "--seed", 3)
    trained = command("avatar", "train", capture, "--out", avatar, "--config", config)
    assert trained["loss"]["before"] >= LEAST_FALL * trained["loss"]["after"]
    ran = command("run", "--avatar", avatar, "--frames", 4, "--out", tmp_path / "run")
    assert ran["config"]["scene"]["avatars"][0]["bundle"] == str(avatar)
    assert (tmp_path / "run" / "contact.png").stat().st_size > 0
