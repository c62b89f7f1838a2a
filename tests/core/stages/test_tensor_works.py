"""How far a tensor may be stepped down: by the policy, by an error budget in dB, by what the avatars lose; by hand."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from support.small_inputs import validated
from trilane.apps.run.report import Resolution
from trilane.apps.run.report_facts import resolution_note, resolution_of
from trilane.avatars.bundle import load_bundle, write_manifest
from trilane.avatars.manifest import BySize
from trilane.avatars.validation import SizeLoss, size_loss
from trilane.errors import BadInputError
from trilane.scene.crop import Rect
from trilane.scene.planner import TensorBudget, work_of_side
from trilane.scene.schema import Scene
from trilane.stages.config import RunConfig
from trilane.stages.configure import configure
from trilane.stages.foresee import tensor_works
from trilane.stages.run_options import RunOptions

ALL = (1000, 563, 250)
LOSS = SizeLoss("from somewhere", {1000: 0.0, 562: 1.0, 250: 3.0})
UNKNOWN = SizeLoss("avatar x: no figures by tensor size; `trilane avatar validate x --sizes` measures them", {})


def test_the_works_are_the_squares_of_the_sides() -> None:
    """0.75² = 0.5625, rounded up: 192 x 192 of 256 x 256 pixels is within it."""
    assert tuple(map(work_of_side, (1.0, 0.75, 0.5))) == ALL
    budget = TensorBudget(256 * 256, 512 * 512)
    assert budget.scaled(1000) == budget
    far = [Rect(0.0, 0.0, 0.1, 0.1)]
    assert 192 * 192 <= budget.scaled(563).of(far, (480, 640)) == 36_896 < 192 * 224


@pytest.mark.parametrize(
    ("policy", "budget", "losses", "works"),
    [
        ("pipelined", None, [LOSS], (1000,)),
        ("latest", None, [LOSS], ALL),
        ("deadline", None, [UNKNOWN], ALL),
        ("pipelined", 0.5, [LOSS], (1000,)),
        ("pipelined", 1.0, [LOSS], (563,)),
        ("sequential", 9.0, [LOSS], (250,)),
        ("latest", 1.5, [LOSS], (1000, 563)),
        ("latest", 9.0, [LOSS], ALL),
        ("pipelined", 9.0, [LOSS, SizeLoss("", {1000: 0.0, 562: 8.0, 250: 10.0})], (563,)),
        ("pipelined", 9.0, [SizeLoss("", {1000: 0.0, 900: 0.1})], (1000,)),
    ],
)
def test_works_by_hand(policy: str, budget: float | None, losses: Sequence[SizeLoss], works: tuple[int, ...]) -> None:
    scene = Scene.model_validate({"size": "auto"} | ({"error_budget_db": budget} if budget else {}))
    found, said = tensor_works(scene, policy, losses)
    assert found == works
    assert bool(said) == (budget is not None)


def test_what_is_said_of_a_budget_names_loss_and_source() -> None:
    scene = Scene.model_validate({"size": "auto", "error_budget_db": 2.5})
    assert tensor_works(scene, "pipelined", [LOSS])[1] == (
        "image error: tensors may have 56% of the pixels that the network was trained for, where they lose 1.0 dB of "
        "the 2.5 allowed (from somewhere)"
    )


def test_a_budget_without_figures_names_the_command(tiny_bundle: Path, tmp_path: Path) -> None:
    scene = Scene.model_validate({"size": "auto", "error_budget_db": 2.5})
    with pytest.raises(BadInputError, match=r"error_budget_db: .*`trilane avatar validate x --sizes` measures them"):
        tensor_works(scene, "pipelined", [LOSS, UNKNOWN])
    file = tmp_path / "scene.toml"
    file.write_text(f'size = "auto"\nerror_budget_db = 1.0\n[[avatars]]\nbundle = "{tiny_bundle}"\n')
    with pytest.raises(BadInputError, match=r"error_budget_db.*no valid validation.*--sizes") as caught:
        configure(RunOptions(scene=str(file), runtime="ort"), tmp_path, lambda: None)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(("said", "found"), [('"auto"', "0"), ('"256"', "size = .256")])
def test_a_budget_of_nothing_or_of_a_fixed_size_is_refused(said: str, found: str, tmp_path: Path) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(f"size = {said}\nerror_budget_db = {0 if said == chr(34) + 'auto' + chr(34) else 1}\n")
    with pytest.raises(BadInputError, match=found):
        configure(RunOptions(scene=str(file), runtime="ort"), tmp_path, lambda: None)


def test_a_loss_is_that_of_the_next_smaller_size_that_was_measured() -> None:
    assert [LOSS.at(work) for work in (1000, 999, 563, 562, 561, 250)] == [0.0, 1.0, 1.0, 1.0, 3.0, 3.0]
    assert LOSS.at(249) is None and UNKNOWN.at(1000) is None


def test_losses_are_read_from_a_validation_of_these_files(tiny_bundle: Path, tmp_path: Path) -> None:
    from trilane.training.validate import with_sizes

    own = shutil.copytree(tiny_bundle, tmp_path / "own")
    assert "validate" in size_loss(load_bundle(own)).source
    manifest = load_bundle(own).manifest
    write_manifest(own, validated(load_bundle(own)))
    first = load_bundle(own)
    assert size_loss(first).source.endswith(f"`trilane avatar validate {own} --sizes` measures them")
    sizes = {"64x64": 30.0, "32x64": 28.5, "32x32": 25.0}
    measured = BySize(date=date(2026, 3, 4), runtime="ort", seed=1, per_band=2, held_out=("a",), psnr_db=sizes)
    assert first.manifest.validation is not None
    write_manifest(own, manifest.model_copy(update={"validation": with_sizes(first.manifest.validation, measured)}))
    loss = size_loss(load_bundle(own))
    assert loss.source == "from the avatar's validation of 2026-03-04, by tensor size"
    assert loss.by_work == {1000: 0.0, 500: 1.5, 250: 5.0}
    text = (own / "manifest.json").read_text().replace("28.5", "29.5")
    (own / "manifest.json").write_text(text)
    assert not size_loss(load_bundle(own)).by_work


def test_the_default_avatar_loses_more_the_smaller_its_tensor_is() -> None:
    loss = size_loss(load_bundle("default"))
    assert 0 < loss.at(563) < loss.at(250) < 10  # type: ignore[operator]


def config(works: tuple[int, ...]) -> RunConfig:
    scene = Scene.model_validate({"size": "auto"})
    return RunConfig(scene=scene, out_dir=Path(), avatar_dirs=(), units={}, works=works, own_pixels=65536)


def test_frames_are_counted_by_size_with_what_it_costs() -> None:
    found = resolution_of({0: 3, 1: 3, 2: 1}, 4, config(ALL), [LOSS, LOSS])
    assert [(size["work"], size["most_pixels"], size["frames"], size["psnr_loss_db"]) for size in found["sizes"]] == [
        (1.0, 102_400, 3, 0.0),  # 65,536 times 25 / 16
        (0.563, 57_651, 3, 1.0),
        (0.25, 25_600, 1, 3.0),
    ]
    assert (found["switches"], found["loss_source"]) == (4, "from somewhere")
    note = resolution_note(Resolution.model_validate(found))
    assert note == (
        "resolution: to be in time 4 of 7 presented frames had smaller tensors: 3 of at most 57651 pixels an avatar, "
        "1.0 dB worse, 1 of at most 25600 pixels an avatar, 3.0 dB worse; 4 switches (error: from somewhere)"
    )
    unknown = resolution_of({1: 1}, 0, config(ALL), [LOSS, UNKNOWN])
    assert [size["psnr_loss_db"] for size in unknown["sizes"]] == [None] * 3
    assert "pixels an avatar; 0 switches" in resolution_note(Resolution.model_validate(unknown))
    assert resolution_note(Resolution.model_validate(resolution_of({0: 2}, 0, config(ALL), [LOSS]))) == ""
    assert json.dumps(found) and math.isfinite(found["sizes"][2]["psnr_loss_db"])


def test_a_picture_is_enlarged_in_linear_light_with_its_colours_times_alpha() -> None:
    """Two pixels, white and a black that is transparent, to four: white stays white, and alpha falls by quarters."""
    size_figures = pytest.importorskip("trilane.training.validate")
    picture = np.array([[[255, 255, 255, 255], [0, 0, 0, 0]]] * 2, np.uint8)
    larger = size_figures.enlarged(picture, (2, 4))
    assert larger[0, :, 3].tolist() == [255, 191, 64, 0]
    assert (larger[0, :3, :3] == 255).all()
    grey = np.array([[[0, 0, 0, 255], [255, 255, 255, 255]]] * 2, np.uint8)
    assert size_figures.enlarged(grey, (2, 4))[0, 1].tolist() == [137, 137, 137, 255]  # a quarter of the light
    assert size_figures.sizes_of((256, 256)) == [(256, 256), (192, 192), (128, 128)]
    assert size_figures.sizes_of((64, 64)) == [(64, 64), (32, 32)]
