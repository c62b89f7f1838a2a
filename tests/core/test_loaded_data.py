"""What is handed from one part to another is a value: it never changes afterwards."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
from collections.abc import Iterator
from types import ModuleType

import pytest

#: Those that somebody fills in or counts on, step by step.
CHANGING = {
    *("BvhJoint", "_Words", "_Hierarchy"),
    *("ThermalState", "Throttle", "_Extent"),
    *("Signals", "_Player", "LoadGenVerdict", "LoadGenPlayer", "Queries"),
}
FOLDERS = ("avatars", "body", "scene", "hw_profiles", "stages", "training", "transport", "pipeline", "bench", "apps")
#: What a module may need that is not installed everywhere.
EXTRAS = {
    "torch",
    "scipy",
    "skimage",
    "simpy",
    "mlperf_loadgen",
    "matplotlib",
    "iceoryx2",
    "onnxruntime_qnn",
    "openvino",
}


def modules(folder: str) -> Iterator[ModuleType]:
    package = importlib.import_module(f"trilane.{folder}")
    for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        try:
            yield importlib.import_module(info.name)
        except ImportError as error:
            if (error.name or "").split(".")[0] not in EXTRAS:
                raise


@pytest.mark.parametrize("folder", FOLDERS)
def test_values_never_change(folder: str) -> None:
    found = 0
    for module in modules(folder):
        for value in vars(module).values():
            if isinstance(value, type) and dataclasses.is_dataclass(value) and value.__module__ == module.__name__:
                assert value.__dataclass_params__.frozen != (value.__name__ in CHANGING), value  # type: ignore[attr-defined]
                found += 1
    assert found >= 2
