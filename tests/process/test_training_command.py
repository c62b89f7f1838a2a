"""A bundled avatar is trained further by its own settings, made small: a few samples and steps; then it is measured."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.avatars.bundle import bundle_folder, load_bundle
from trilane.training.training_settings import parsed_settings, read_settings, settings_text


def command(*words: object, code: int = 0) -> Any:
    line = [sys.executable, "-m", "trilane", *map(str, words), "--json"]
    done = subprocess.run(line, check=False, capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    return json.loads(done.stdout) if code == 0 else " ".join(done.stderr.split())


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_bundled_avatar_is_trained_further_by_its_settings(tmp_path: Path) -> None:
    out, work, config = tmp_path / "further", tmp_path / "further-work", tmp_path / "few.toml"
    settings = read_settings(bundle_folder("hiker") / "training.toml").model_dump(by_alias=True, exclude_none=True)
    few = {"look": "hiker", "threads": 1, "samples": 8, "steps": 10, "batch": 2, "stand_off": False, "device": "cpu"}
    alone = {"batches": settings["batches"] | {"look_repeats": ()}}
    config.write_text(settings_text(parsed_settings(settings | few | alone, "a test")))
    trained = command("avatar", "train", "--config", config, "--out", out)
    assert (trained["avatar"], trained["steps"]) == (str(out), 10)
    assert read_settings(out / "training.toml") == read_settings(config)
    bundle, before = load_bundle(out), load_bundle("hiker")
    facts = {"samples": 8, "steps": 10, "batch": 2, "seed": 37, "look": "hiker"}
    assert facts.items() <= bundle.manifest.provenance.items()
    assert bundle.manifest.betas == before.manifest.betas
    assert bundle.manifest.training_command == "trilane avatar train --config training.toml"
    changed = np.abs(bundle.read_texture() - before.read_texture())
    assert 0 < changed.mean() < 0.1, "ten steps change the texture that it had"
    words = ("avatar", "validate", out, "--float-network", work / "network.npz", "--per-band", 1, "--seed", 1)
    validation = command(*words, "--runtime", "ort")["validation"]
    assert validation["psnr_db_by_band"].keys() == {"far", "full_body", "upper_body", "face"}
    assert validation["float"]["samples"] == validation["integer"]["samples"] == 4
    refused = command("avatar", "train", "--config", config, "--out", out, "--samples", 9, code=2)
    assert "another --work folder" in refused
