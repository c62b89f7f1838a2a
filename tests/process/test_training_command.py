"""An avatar from nothing by the training command: eight samples, a few steps, quantised, validated, and run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from PIL import Image

from trilane.avatars.bundle import load_bundle
from trilane.training.train import main


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_an_avatar_is_made_and_what_made_it_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    work, out, sheet = tmp_path / "work", tmp_path / "avatar", tmp_path / "sheet.png"
    asked = ["--work", str(work), "--out", str(out), "--sheet", str(sheet), "--minutes", "0.02", "--samples", "8"]
    asked += ["--per-band", "1", "--width", "4", "--workers", "1", "--batch", "2", "--name", "nobody", "--seed", "3"]
    assert main(asked) == 0
    assert capsys.readouterr().out.strip() == str(out)
    assert json.loads((work / "dataset.json").read_text()) == {"samples": 8, "seed": 3}
    assert {path.name for path in work.iterdir()} >= {"training", "final.npz", "network.npz"}
    bundle = load_bundle(out)
    manifest = bundle.manifest
    steps = int(np.load(work / "final.npz")["steps"])
    facts = {"samples": 8, "steps": steps, "batch": 2, "seed": 3}
    assert facts.items() <= manifest.provenance.items()
    assert (manifest.name, manifest.network.width, manifest.network.encoder) == ("nobody", 4, "resnet18")
    assert "--samples 8" in manifest.training_command and str(tmp_path) not in manifest.training_command
    assert manifest.validation is not None and manifest.validation.integer.samples > 20
    assert manifest.validation.psnr_db_by_band.keys() == {"far", "full_body", "upper_body", "face"}
    with Image.open(sheet) as image:
        assert image.size == (6 * 192, 4 * 256)
    assert main([*asked, "--samples", "9"]) == 2
    assert "another --work folder" in capsys.readouterr().err
