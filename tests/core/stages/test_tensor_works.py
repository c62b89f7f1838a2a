"""How far a tensor may be stepped down: by the policy, by an error budget in dB, by what the avatars lose; by hand."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from datetime import date
from pathlib import Path

import pytest
from pydantic import ValidationError

from support.small_inputs import validated
from trilane.apps.run.report_facts import resolution_note, resolution_of
from trilane.avatars.bundle import load_bundle, write_manifest
from trilane.avatars.manifest import BySize
from trilane.avatars.validation import SizeLoss, _losses, curve_of, psnr_at, size_loss, tolerance_db
from trilane.errors import BadInputError
from trilane.scene.crop import Rect
from trilane.scene.schema import Scene
from trilane.scene.tensor_budget import TensorBudget
from trilane.stages.config import RunConfig
from trilane.stages.configure import configure
from trilane.stages.foresee import tensor_works
from trilane.stages.run_options import RunOptions
from trilane.units import work_of_side

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

    own = shutil.copytree(tiny_bundle, tmp_path / "my own")
    how = f"`trilane avatar validate '{own}'` first, then `trilane avatar validate '{own}' --sizes` measures them"
    assert size_loss(load_bundle(own), 1).source.endswith(how)
    manifest = load_bundle(own).manifest
    write_manifest(own, validated(load_bundle(own)))
    first = load_bundle(own)
    assert size_loss(first, 1).source.endswith(f"`trilane avatar validate '{own}' --sizes` measures them")
    sizes = {"64x64": 30.0, "32x64": 28.5, "32x32": 25.0}
    measured = BySize(date=date(2026, 3, 4), runtime="ort", seed=1, per_band=2, held_out=("a",), psnr_db=sizes)
    assert first.manifest.validation is not None
    write_manifest(own, manifest.model_copy(update={"validation": with_sizes(first.manifest.validation, measured)}))
    loss = size_loss(load_bundle(own), 1)
    assert loss.source == "from the avatar's validation of 2026-03-04, by tensor size"
    assert loss.by_work == {1000: 0.0, 500: 1.5, 250: 5.0}
    text = (own / "manifest.json").read_text().replace("28.5", "29.5")
    (own / "manifest.json").write_text(text)
    assert not size_loss(load_bundle(own), 1).by_work


def test_the_default_avatar_loses_more_the_smaller_its_tensor_is() -> None:
    loss = size_loss(load_bundle("default"), 1)
    assert 0 < loss.at(563) < loss.at(250) < 10  # type: ignore[operator]


def config(works: tuple[int, ...]) -> RunConfig:
    scene = Scene.model_validate({"size": "auto"})
    return RunConfig(scene=scene, out_dir=Path(), avatar_dirs=(), units={}, works=works, own_pixels=65536)


def test_frames_are_counted_by_size_with_what_it_costs() -> None:
    found = resolution_of({0: 3, 1: 3, 2: 1}, 4, config(ALL), [LOSS, LOSS])
    assert [(size.work, size.most_pixels, size.frames, size.psnr_loss_db) for size in found.sizes] == [
        (1.0, 102_400, 3, 0.0),  # 65,536 times 25 / 16
        (0.563, 57_651, 3, 1.0),
        (0.25, 25_600, 1, 3.0),
    ]
    assert (found.switches, found.loss_source) == (4, "from somewhere")
    note = resolution_note(found)
    assert note == (
        "resolution: to be in time 4 of 7 presented frames had smaller tensors: 3 of at most 57651 pixels an avatar, "
        "1.0 dB worse, 1 of at most 25600 pixels an avatar, 3.0 dB worse; 4 switches (error: from somewhere)"
    )
    unknown = resolution_of({1: 1}, 0, config(ALL), [LOSS, UNKNOWN])
    assert [size.psnr_loss_db for size in unknown.sizes] == [None] * 3
    assert "pixels an avatar; 0 switches" in resolution_note(unknown)
    assert resolution_note(resolution_of({0: 2}, 0, config(ALL), [LOSS])) == ""
    assert json.dumps(found.as_json()) and math.isfinite(found.sizes[2].psnr_loss_db)


#: PSNR by tensor, for bodies of 64², 128² and 256² pixels.
TABLE = {
    64: {64: 30.0, 128: 31.0, 256: 30.0},
    128: {64: 27.0, 128: 32.0, 256: 32.2},
    256: {64: 20.0, 128: 28.0, 256: 34.3},
}


def test_the_curve_has_the_smallest_tensor_within_the_tolerance() -> None:
    """Within 0.3 dB: 7/10 of the way to 128², which is the best; less than 128² by 0.1; and 6.0 of 6.3 dB to 256².

    The second row alone needs 128 x 2^-0.02 = 126.2, since 31.9 is 4.9 of 5 dB of the way from 64².
    """
    ways = ((64, 0.7), (64, 4.9 / 5), (128, 6.0 / 6.3))
    sides = [low * 2**part for low, part in ways]
    assert curve_of(TABLE, 0.3) == tuple(
        (picture**2, math.ceil(side**2)) for picture, side in zip(TABLE, sides, strict=True)
    )


def test_each_row_counts_by_itself() -> None:
    """A larger body may have a smaller tensor; the least tensor of all may be enough."""
    table = {64: {64: 20.0, 256: 30.0}, 128: {64: 30.0, 256: 20.0}}
    (_, far), (_, near) = curve_of(table, 0.3)
    assert (far, near) == (math.ceil((64 * 4 ** (9.7 / 10)) ** 2), 64 * 64)


def test_several_avatars_give_up_more_than_one() -> None:
    assert [tolerance_db(count) for count in (1, 2, 5)] == [0.04, 0.3, 0.3]
    loss = size_loss(load_bundle("default"), 1), size_loss(load_bundle("default"), 2)
    assert all(one[1] > two[1] for one, two in zip(loss[0].curve, loss[1].curve, strict=True))


def test_losses_of_a_table_are_means_over_the_bodies_whose_smaller_tensor_was_measured() -> None:
    """A quarter of the pixels is half a side: 128 / 2 and more were measured for the third body alone."""
    table = {64: {64: 30.0, 128: 31.0, 256: 31.0}, 256: {64: 20.0, 128: 28.0, 256: 36.0}}
    curve = curve_of(table, 0.3)
    assert curve[0][1] < 128 * 128
    pixels = curve[1][1]
    assert _losses(table, curve)[250] == pytest.approx(8.0, abs=0.01)
    log = math.log2(math.sqrt(curve[0][1] * 0.563) / 64)
    steep = 8.0 * -math.log2(math.sqrt(0.563))
    assert _losses(table, curve)[563] == pytest.approx((0.7 - log + steep) / 2, abs=0.01)
    assert psnr_at(table[256], pixels) == pytest.approx(35.7, abs=0.001)
    assert psnr_at(table[256], 63 * 63) is None and psnr_at(table[256], 257 * 257) is None


def test_a_table_in_a_valid_manifest_is_the_planners(tiny_bundle: Path, tmp_path: Path) -> None:
    """Changed by hand, it is nobody's."""
    from trilane.training.validate import with_sizes

    own = shutil.copytree(tiny_bundle, tmp_path / "own")
    write_manifest(own, validated(load_bundle(own)))
    manifest = load_bundle(own).manifest
    measured = BySize(
        date=date(2026, 3, 4), runtime="ort", seed=1, per_band=2, held_out=("a",), psnr_db_by_picture=TABLE
    )
    assert manifest.validation is not None
    write_manifest(own, manifest.model_copy(update={"validation": with_sizes(manifest.validation, measured)}))
    assert size_loss(load_bundle(own), 1).curve == curve_of(TABLE, 0.04)
    file = tmp_path / "scene.toml"
    file.write_text(f'size = "auto"\nframes = 2\n[[avatars]]\nbundle = "{own}"\n')
    config = configure(RunOptions(scene=str(file), runtime="ort"), tmp_path, lambda: None).config
    assert config.size_curves == (curve_of(TABLE, 0.04),) == config.tensor_budgets[0].curves
    file.write_text(file.read_text() + f'[[avatars]]\nbundle = "{own}"\nposition = [1.0, 0.0, 0.0]\n')
    both = configure(RunOptions(scene=str(file), runtime="ort"), tmp_path, lambda: None).config
    assert both.size_curves == (curve_of(TABLE, 0.3),), "two avatars share a tensor"
    text = (own / "manifest.json").read_text().replace("34.3", "31.3")
    (own / "manifest.json").write_text(text)
    assert size_loss(load_bundle(own), 1).curve == ()


@pytest.mark.parametrize(
    "said",
    [
        {},
        {"psnr_db": {"64x64": 30.0}, "psnr_db_by_picture": TABLE},
        {"psnr_db_by_picture": {64: {64: 30.0, 128: 31.0}, 128: {64: 30.0, 96: 31.0}}},
        {"psnr_db_by_picture": {64: {64: 30.0}}},
    ],
)
def test_a_table_is_whole_or_refused(said: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        BySize.model_validate(
            {"date": date(2026, 3, 4), "runtime": "ort", "seed": 1, "per_band": 2, "held_out": (), **said}
        )
