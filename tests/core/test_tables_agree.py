"""Tables that have to agree with another one, or with what is asked for elsewhere."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from trilane.scene import camera_placement
from trilane.stages.machine_facts import OPTIONAL_PACKAGES

PROJECT = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.mark.parametrize("package", OPTIONAL_PACKAGES)
def test_an_optional_package_comes_with_the_extra_that_is_named(package: str) -> None:
    """`trilane doctor` names the extra that installs it."""
    wanted = PROJECT["optional-dependencies"][OPTIONAL_PACKAGES[package]]
    assert any(line.startswith(package) for line in wanted), wanted


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
