"""What is foreseen of a scene before the run: its frames, the shapes that they ask for, and what a network needs."""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import Any

import pytest

from trilane.arrays import shape_buckets
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import reshaped
from trilane.pipeline.description import UnitSettings
from trilane.scene.crop import Rect
from trilane.scene.planner import (
    Demand,
    LookAhead,
    ShapeSet,
    choose_shapes,
    foreseen_changes,
    ideal_shape,
    larger_shapes,
)
from trilane.scene.schema import AvatarSpec, CameraSpec, OutputSpec, Scene
from trilane.scene.staging import Staged, stage_scene
from trilane.scene.tensor_budget import TensorBudget
from trilane.stages.avatar_assets import AvatarData, load_avatar
from trilane.stages.config import RunConfig
from trilane.stages.configure import configure
from trilane.stages.foresee import MB, Foreseen, Painted, bytes_per_pixel, foresee, foreseen_rects
from trilane.stages.run_options import RunOptions

OWN = TensorBudget(own=128 * 128, most=512 * 512)


@pytest.fixture
def avatar(tiny_bundle: Path) -> AvatarData:
    return load_avatar(load_bundle(tiny_bundle))


def staged(scene: Scene, avatar: AvatarData) -> Staged:
    return stage_scene(scene, [avatar.shaped] * len(scene.avatars), Path.cwd())


def test_the_shapes_are_those_of_frames_spread_over_the_scene(
    avatar: AvatarData, monkeypatch: pytest.MonkeyPatch
) -> None:
    """96 of 500 frames; each one's ideal shape by itself, and the choice among them."""
    scene = Scene(size="auto", frames=500, output=OutputSpec(width=320, height=240))
    place = staged(scene, avatar)
    frames = tuple(k * 500 // 96 for k in range(96))
    rows = list(foreseen_rects(scene, place, [avatar.shaped], frames))
    asked: list[Any] = []
    monkeypatch.setattr("trilane.stages.foresee.foreseen_rects", lambda *what: asked.append(what) or iter(rows))
    found = foresee(scene, place, [avatar.shaped], Painted([avatar.network]), [OWN])
    assert asked == [(scene, place, [avatar.shaped], frames)] and found.frames == frames
    seen = [list(rects.values()) for rects in rows if rects]
    assert found.seen == len(seen) > 90
    demands = [Demand(ideal_shape(rects, (240, 320), OWN), OWN.of(rects, (240, 320))) for rects in seen]
    first = choose_shapes(demands, bytes_per_pixel(avatar.network), 512 * MB)
    assert set(first.shapes) <= set(found.shapes.shapes) and found.shapes.unserved == first.unserved
    # What is beside them spares changes: each is the least shape that holds two of the first ones.
    further = set(found.shapes.shapes) - set(first.shapes)
    assert further <= set(larger_shapes(first.shapes, OWN.most_of(1)))
    assert further <= {shape for _, shape in found.changes[0]} <= set(found.shapes.shapes)
    looks = [LookAhead(frame, rects) for frame, rects in zip(frames, rows, strict=True)]
    expected = foreseen_changes(looks, (240, 320), found.shapes.shapes, OWN)
    assert found.changes == (tuple((frame / 30, shape) for frame, shape in expected),)


@pytest.mark.parametrize(("frames", "avatars", "looked_at"), [(500, 1, 96), (40, 1, 40), (500, 3, 32), (500, 8, 24)])
def test_so_many_frames_are_looked_at(
    avatar: AvatarData, monkeypatch: pytest.MonkeyPatch, frames: int, avatars: int, looked_at: int
) -> None:
    """96 over all avatars, but at least 24 of each, and no more than there are; nobody is in view of any."""
    monkeypatch.setattr("trilane.stages.foresee.foreseen_rects", lambda *what: [{} for _ in what[3]])
    specs = tuple(AvatarSpec(position=(0.5 * k - 2, 0, 0), motion="builtin:idle") for k in range(avatars))
    scene = Scene(size="auto", frames=frames, avatars=specs)
    found = foresee(scene, staged(scene, avatar), [avatar.shaped] * avatars, Painted([avatar.network]), [OWN])
    assert len(found.frames) == looked_at


@pytest.mark.parametrize(("frames", "is_foreseen"), [(96 * 15, True), (96 * 15 + 1, False)])
def test_changes_are_foreseen_where_looks_are_half_a_second_apart(
    avatar: AvatarData, monkeypatch: pytest.MonkeyPatch, frames: int, is_foreseen: bool
) -> None:
    """96 looks, 15 frames from one to the next at most; a size that has no shapes has the changes of the one before."""
    monkeypatch.setattr("trilane.stages.foresee.foreseen_rects", lambda *what: [{} for _ in what[3]])
    scene = Scene(size="auto", frames=frames, memory_mb=1)
    monkeypatch.setattr("trilane.stages.foresee.bytes_per_pixel", lambda _: MB / 1024)
    found = foresee(scene, staged(scene, avatar), [avatar.shaped], Painted([avatar.network]), [OWN, OWN.scaled(563)])
    assert found.changes == ((((0.0, (32, 32)),),) * 2 if is_foreseen else ())


def test_with_nobody_in_view_one_least_shape_is_made_ready(avatar: AvatarData) -> None:
    off, stays = AvatarSpec(position=(0.0, 0.0, 40.0)), CameraSpec(place="none")
    scene = Scene(size="auto", frames=50, avatars=(off,), camera=stays)
    found = foresee(scene, staged(scene, avatar), [avatar.shaped], Painted([avatar.network]), [OWN])
    assert (found.shapes.shapes, found.seen) == (((32, 32),), 0)


def test_a_networks_memory_is_all_its_bytes_twice(avatar: AvatarData) -> None:
    """By the shapes that ONNX infers for the file's own tensor, and again for a network without them."""
    network = avatar.network
    _, height, width, _ = network.shape
    values = [value.type.tensor_type for value in reshaped(network, height + 32, width).model.graph.value_info]
    sizes = [prod(dim.dim_value for dim in value.shape.dim) for value in values if value.elem_type in (2, 3)]
    expected = 2 * sum(sizes) / ((height + 32) * width)
    assert sizes
    del network.model.graph.value_info[:]
    assert bytes_per_pixel(network) == pytest.approx(expected)
    assert bytes_per_pixel(reshaped(network, height + 32, width)) == pytest.approx(expected)


@pytest.mark.parametrize("room", [False, True])
def test_smaller_sizes_never_pass_the_memory_of_the_scene(
    avatar: AvatarData, monkeypatch: pytest.MonkeyPatch, room: bool
) -> None:
    """One frame of a size of 128 x 128 pixels, and of 563 and 250 thousandths: each asks for one shape. With as much
    memory as the first takes, or a pixel less than it and the second, the second has none; the third is smaller."""
    scene = Scene(size="auto", frames=1, memory_mb=1)
    budgets = [OWN, OWN.scaled(563), OWN.scaled(250)]
    place = staged(scene, avatar)
    rects = list(next(foreseen_rects(scene, place, [avatar.shaped], (0,))).values())
    output = (scene.output.height, scene.output.width)
    first, second, third = (prod(ideal_shape(rects, output, budget)) for budget in budgets)
    assert first > second > third
    pixels = first + second - 1 if room else first
    monkeypatch.setattr("trilane.stages.foresee.bytes_per_pixel", lambda _: (MB - 0.5) / pixels)
    found = foresee(scene, place, [avatar.shaped], Painted([avatar.network]), budgets)
    assert [prod(shape) for shape in found.shapes.shapes] == ([third, first] if room else [first])
    assert found.shapes.memory_bytes <= MB and found.left_out == (1 if room else 2)
    sizes = f"memory: {found.left_out} of the smaller tensor sizes have no shape within memory_mb 1"
    assert found.notes(1, 512) == (found.note, sizes)


@pytest.mark.parametrize(("most", "limited"), [(128 * 128, 0), (128 * 128 - 1, 5), (32 * 32, 5)])
def test_frames_with_fewer_pixels_than_an_avatar_needs_are_counted(
    avatar: AvatarData, monkeypatch: pytest.MonkeyPatch, most: int, limited: int
) -> None:
    """Five of eight frames show one avatar, for which 128 x 128 pixels are enough."""
    small = Rect(-0.1, -0.1, 0.1, 0.1)
    monkeypatch.setattr("trilane.stages.foresee.foreseen_rects", lambda *_: [{0: small}] * 5 + [{}] * 3)
    scene = Scene(size="auto", frames=8, most_side=96)
    budget = TensorBudget(own=128 * 128, most=most)
    budgets = [budget, budget.scaled(250)]
    found = foresee(scene, staged(scene, avatar), [avatar.shaped], Painted([avatar.network]), budgets)
    assert found.limited == limited
    said = [note for note in found.notes(512, 96) if "most_side = 96" in note]
    assert len(said) == (limited > 0) and all("in 5 of 8 frames looked at" in note for note in said)


def test_a_network_that_takes_more_than_the_limit_is_told_of() -> None:
    found = Foreseen(ShapeSet(((64, 96),), 2_000_001, 0), (0,), 1)
    assert found.notes(3, 512) == (found.note,)
    assert found.notes(2, 512) == (
        found.note,
        "memory: the network may take 3 MB, more than memory_mb 2: one is always ready",
    )


def test_a_configuration_has_the_shapes_the_note_and_the_networks_pixels(tiny_bundle: Path, tmp_path: Path) -> None:
    asked = RunOptions(scene="default", avatar=str(tiny_bundle), frames=30, runtime="ort", size="auto")
    planned = configure(asked, tmp_path, lambda: {"hardware": False})
    assert planned.config.shapes and list(planned.config.shapes) == planned.config.buckets
    assert planned.config.own_pixels == 64 * 64
    assert planned.config.tensor_budgets == (TensorBudget(64 * 64, 512 * 512),)
    names = ", ".join(f"{height}x{width}" for height, width in planned.config.shapes)
    seen = f"somebody is seen in 30 of 30 frames looked at; {len(planned.config.changes[0]) - 1} changes foreseen"
    assert f"tensor: planned in shapes {names} ({seen})" in planned.notes
    fixed = configure(RunOptions(scene="default", avatar=str(tiny_bundle), runtime="ort"), tmp_path, lambda: None)
    assert (fixed.config.shapes, fixed.config.buckets) == ((), shape_buckets("256"))
    assert not any(note.startswith("tensor:") for note in fixed.notes)


@pytest.mark.parametrize(("plan", "budget"), [("planned", 0.75), ("fixed", 0.0)])
def test_a_fixed_plan_has_no_error_budget(plan: str, budget: float, tmp_path: Path) -> None:
    units = {unit: UnitSettings(cores=(0,), threads=1) for unit in ("cpu", "gpu", "dsp")}
    scene = Scene.model_validate({"plan": plan, "error_budget_px": 0.75})
    assert RunConfig(scene=scene, out_dir=tmp_path, avatar_dirs=(), units=units).budget_px == budget
