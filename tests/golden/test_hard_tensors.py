"""Hard values are packed to the byte by the GPU unit's own pass, and faults of a shader break rows."""

from __future__ import annotations

from typing import Any

import pytest

from trilane.apps.experiments.hard_numbers import NUMBERS, STEPS, tensor_cases
from trilane.avatars.bundle import bundle_folder
from trilane.body.body import ShapedBody, load_body
from trilane.stages.gpu import opengl

EXACT = "uvec4(clamp(roundEven(real / scale) + zero_point, 0.0, 255.0))"


@pytest.fixture(scope="module")
def shaped() -> ShapedBody:
    return load_body(bundle_folder("default") / "body.npz").shape()


def failing(shaped: ShapedBody, gl: Any) -> set[str]:
    return {case.name for case in tensor_cases(shaped, gl) if not case.holds}


def test_hard_values_keep_their_bounds(shaped: ShapedBody, gl: Any) -> None:
    cases = list(tensor_cases(shaped, gl))
    assert [case.name for case in cases if not case.holds] == []
    assert len(cases) == len(STEPS) + len(NUMBERS) + 4


@pytest.mark.parametrize(
    ("fault", "rows"),
    [
        (
            "uvec4(clamp(trunc(real / scale) + zero_point, 0.0, 255.0))",
            ("seven tenths of a step", "seven tenths below 0", "halves above 0"),
        ),
        ("uvec4(clamp(floor(real / scale + 0.5) + zero_point, 0.0, 255.0))", ("halves above 0",)),
        ("uvec4(ivec4(roundEven(real / scale) + zero_point)) & 255u", ("just over the highest byte",)),
    ],
    ids=["truncates", "rounds halves up", "does not clamp"],
)
def test_a_wrong_shader_fails(
    fault: str, rows: tuple[str, ...], shaped: ShapedBody, gl: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = opengl.shader_source

    def spoilt(name: Any, **defines: int | str) -> str:
        text = source(name, **defines)
        return text.replace(EXACT, fault) if name == "packed_tensor.frag" else text

    assert EXACT in source("packed_tensor.frag")
    monkeypatch.setattr(opengl, "shader_source", spoilt)
    assert {f"packing {row}" for row in rows} <= failing(shaped, gl)
