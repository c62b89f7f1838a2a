"""The error of an avatar on frames of a capture: whole frames, against frame and mask, into the bundle's provenance."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("skimage")
pytest.importorskip("torch")

from support.small_inputs import write_capture_folder
from trilane.avatars.bundle import load_bundle
from trilane.avatars.manifest import CAPTURED
from trilane.avatars.validation import refused
from trilane.errors import BadInputError
from trilane.training import train
from trilane.training.capture.capture import open_capture
from trilane.training.capture.capture_samples import CaptureRenderer, ViewRule, moved, projected
from trilane.training.random_views import OUTPUT_ROWS
from trilane.training.train import error_facts, frame_errors, write_held_out_error


@pytest.fixture(scope="module")
def renderer(tmp_path_factory: pytest.TempPathFactory) -> CaptureRenderer:
    capture = open_capture(write_capture_folder(tmp_path_factory.mktemp("capture") / "mine"))
    return CaptureRenderer(capture, range(8), ViewRule(), threads=1)


def test_a_whole_frame_is_cropped_to_the_person(renderer: CaptureRenderer) -> None:
    """Every joint is in the crop, as far inside as the map says, and the scale is one for both sides of the screen."""
    sample = renderer.whole_sample(3, "128")
    assert sample is not None and (sample.picture, sample.mirrored) == (3, False)
    capture, shape = renderer.capture, sample.crop.shape
    joints = renderer._raster.posed(capture.fits[3]).joints.copy()
    clip = capture.file.camera.projection() @ capture.views[3]
    in_crop = projected(joints, sample.crop.projection @ capture.views[3], shape)
    assert moved(projected(joints, clip, capture.shape), sample.by) == pytest.approx(in_crop, abs=1e-6)
    assert (in_crop > 0).all() and (in_crop < shape[::-1]).all()
    x, y = np.diag(sample.by)[:2] * np.array([64 * 1.5 / OUTPUT_ROWS / 1.5, 64 / OUTPUT_ROWS])
    assert x == pytest.approx(y, rel=0.01) and sample.by[0, 1] == sample.by[1, 0] == 0


def test_the_error_is_of_what_the_bundle_paints(renderer: CaptureRenderer, monkeypatch: pytest.MonkeyPatch) -> None:
    """A painter that gives the truth back on frame 2, and 10 more in every colour on frame 5; frame 7 shows nobody."""
    asked: list[Any] = []

    def integer_painter(*words: Any) -> Any:
        asked.append(words)

        def paint(sample: Any, uv: Any) -> Any:
            assert uv.shape[:2] == sample.crop.shape
            truth = renderer.render(sample)[1].copy()
            truth[..., :3] = np.minimum(truth[..., :3], 245)
            whole[sample.picture] = truth
            return truth + np.array([10, 10, 10, 0], np.uint8) * (sample.picture == 5)

        return paint

    def rendered(sample: Any) -> Any:
        uv, rgba = CaptureRenderer.render(renderer, sample)
        return uv, np.dstack([np.minimum(rgba[..., :3], 245), rgba[..., 3]])

    whole: dict[int, Any] = {}
    doubled: Any = SimpleNamespace(
        whole_sample=lambda number, size: None if number == 7 else renderer.whole_sample(number, size), render=rendered
    )
    monkeypatch.setattr(train, "integer_painter", integer_painter)
    first, second = frame_errors("bundle", doubled, (2, 5, 7), 3)  # type: ignore[arg-type]
    assert asked == [(doubled, "bundle", "ort", 3)]
    assert (first.psnr_db, first.iou) == (100.0, 1.0)
    assert second.body_psnr_db == pytest.approx(20 * np.log10(255 / 10), abs=0.2) and second.iou == 1.0
    facts = error_facts((first, second))
    assert (facts["frames"], facts["runtime"], facts["size"], facts["iou"]) == (2, "ort", "256", 1.0)
    assert facts["body_psnr_db"] == pytest.approx((first.body_psnr_db + second.body_psnr_db) / 2, abs=1e-4)
    assert error_facts(()) == {"runtime": "ort", "size": "256", "frames": 0}


def test_the_figures_stand_in_the_provenance(tiny_bundle: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    shutil.copytree(tiny_bundle, folder)
    write_held_out_error(load_bundle(folder), {"psnr_db": 28.5})
    written = json.loads((folder / "manifest.json").read_text())
    before = json.loads((tiny_bundle / "manifest.json").read_text())
    assert written == before | {"provenance": before["provenance"] | {"held_out_error": {"psnr_db": 28.5}}}


def test_nothing_is_validated_against_clothes_that_the_person_does_not_wear(
    tiny_bundle: Path, tmp_path: Path, command: Any
) -> None:
    folder = tmp_path / "mine"
    shutil.copytree(tiny_bundle, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["provenance"]["body"] = CAPTURED
    (folder / "manifest.json").write_text(json.dumps(manifest))
    assert "found an avatar of a capture" in command("avatar", "validate", folder, code=2)[1]
    assert refused(load_bundle(folder))["why"].startswith("only frames of its person are known")
    assert refused(load_bundle(tiny_bundle))["why"].startswith("it was never validated")


def test_what_is_no_avatar_is_answered_with_the_way_to_one(tiny_bundle: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"found a body, which has no texture and no network.*docs/own-avatar\.md"):
        load_bundle(tiny_bundle / "body.npz")
    with pytest.raises(
        BadInputError, match=r"found a file, expected the folder of an avatar, or one of default, hiker, dancer; docs"
    ):
        load_bundle(tiny_bundle / "network.onnx")
    with pytest.raises(BadInputError, match=r"found a capture, which avatars are trained on.*docs/own-avatar\.md"):
        load_bundle(write_capture_folder(tmp_path / "capture"))
