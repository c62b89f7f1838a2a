"""Tables that have to agree with another one, or with what is asked for elsewhere."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from trilane.stages.dsp.runtime import RUNTIMES
from trilane.stages.machine_facts import OPTIONAL_PACKAGES
from trilane.units import RUNTIMES as NAMES

PROJECT = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.mark.parametrize("package", OPTIONAL_PACKAGES)
def test_an_optional_package_comes_with_the_extra_that_is_named(package: str) -> None:
    """`trilane doctor` names the extra that installs it."""
    wanted = PROJECT["optional-dependencies"][OPTIONAL_PACKAGES[package]]
    assert any(line.startswith(package) for line in wanted), wanted


def test_every_runtime_is_named_where_people_choose() -> None:
    assert set(NAMES) == {*RUNTIMES}
