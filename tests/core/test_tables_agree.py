"""Tables that have to agree with another one, or with what is asked for elsewhere."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from trilane.bench.lib.handoff_variants import BARE, CHANNELS, SLOT, WRITTEN
from trilane.body import body
from trilane.hw_profiles.host import RATES
from trilane.hw_profiles.operator_kinds import CLASSES, KIND_OF, LAYOUT_CHANGES, STATISTICS
from trilane.scene import camera_placement
from trilane.stages.machine_facts import OPTIONAL_PACKAGES

PROJECT = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.mark.parametrize("package", OPTIONAL_PACKAGES)
def test_an_optional_package_comes_with_the_extra_that_is_named(package: str) -> None:
    """`trilane doctor` names the extra that installs it."""
    wanted = PROJECT["optional-dependencies"][OPTIONAL_PACKAGES[package]]
    assert any(line.startswith(package) for line in wanted), wanted


def test_every_operator_has_a_class_that_there_is() -> None:
    assert set(KIND_OF.values()) <= set(CLASSES)
    assert {KIND_OF[name] for name in ("Add", "Sub", "Mul", "Div")} == {"elementwise"}
    assert {KIND_OF[name] for name in STATISTICS} == {"normalisation"}
    assert LAYOUT_CHANGES == ((0, 3, 1, 2), (0, 2, 3, 1))


def test_multiplications_in_a_cycle_follow_from_the_width_of_an_instruction() -> None:
    """FP32: two fused multiply-adds a cycle of 16, 8, 8 and 4 numbers, as two such units have; half of that in scalar.

    INT8: a dot product of bytes has four in the place of one FP32 number; AVX2 without it multiplies and adds in two.
    """
    assert {flag: fp32 for flag, (_, fp32) in RATES.items()} == {
        "avx512_vnni": 2 * 16,
        "avx_vnni": 2 * 8,
        "avx2": 2 * 8,
        "asimddp": 2 * 4,
        "": 4,
    }
    dot_product = {"avx512_vnni", "avx_vnni", "asimddp"}
    assert all(int8 == fp32 * (4 if flag in dot_product else 2) for flag, (int8, fp32) in RATES.items())


def test_a_body_may_have_three_texture_coordinates_for_each_face() -> None:
    """UVs are per corner, so a closed mesh without shared ones has three a triangle."""
    assert body._LIMITS == {"V": body.MAX_VERTICES, "F": body.MAX_FACES, "T": 3 * body.MAX_FACES}
    assert body._LIMITS["T"] > body._LIMITS["F"] >= body._LIMITS["V"]


def test_the_coarse_grid_of_camera_places() -> None:
    """From 7 m on one side to 7 m on the other in steps of half a metre, at each height of the eye."""
    eyes, scale = np.array([[1.0, 2.0, 3.0]]), np.ones(2)
    footage = camera_placement._Footage(np.zeros((1, 3, 4), np.float32), eyes, np.zeros((1, 8, 3)), scale)
    places = camera_placement._coarse_grid(footage)
    heights = len(camera_placement.EYE_HEIGHTS_M)
    assert places.shape == (29 * heights * 29, 3)
    assert sorted(set((places[:, 0] - 1.0).round(6))) == [k / 2 for k in range(-14, 15)]
    assert sorted(set((places[:, 2] - 3.0).round(6))) == [k / 2 for k in range(-14, 15)]
    assert (2.0 - places[:, 1]).min() == pytest.approx(0.8)
    assert (2.0 - places[:, 1]).max() == pytest.approx(3.6)


def test_hand_over_channels_have_the_names_that_people_see() -> None:
    assert list(CHANNELS) == [SLOT, BARE, "iceoryx2", "zeromq", "pipe", "pickled queue"]
    assert {BARE: 262_144} == WRITTEN
