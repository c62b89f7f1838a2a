"""What is loaded from files never changes afterwards."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
from typing import Any

import pytest

import trilane.avatars
import trilane.body
import trilane.scene

#: Those that a reader fills in step by step.
CHANGING = {"BvhJoint", "_Words", "_Hierarchy"}


@pytest.mark.parametrize("package", [trilane.avatars, trilane.body, trilane.scene])
def test_what_is_loaded_never_changes(package: Any) -> None:
    found = 0
    for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        for value in vars(importlib.import_module(info.name)).values():
            if isinstance(value, type) and dataclasses.is_dataclass(value) and value.__module__ == info.name:
                assert value.__dataclass_params__.frozen != (value.__name__ in CHANGING), value  # type: ignore[attr-defined]
                found += 1
    assert found >= 4
