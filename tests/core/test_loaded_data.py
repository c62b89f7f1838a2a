"""What is handed from one part to another is a value: it never changes afterwards."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
from collections.abc import Iterator
from types import ModuleType

import pytest

#: Those that are filled bit by bit, or count; each by its folder.
CHANGING = {
    "scheduler": {"Recording", "_VirtualUnit"},
    "scene": {"BvhJoint", "_Words", "_Hierarchy", "_Reader", "_Kind", "StoredArray", "Retarget"},
    "hw_profiles": {"ThermalState", "Throttle"},
    "stages": {"_Extent"},
    "training": {"TrainingState"},
    "pipeline": {"ByteCounter"},
    "bench": {"Signals", "_Player", "LoadGenVerdict", "LoadGenPlayer", "Queries"},
    "apps": {"_Moved", "_Pooled"},
}
FOLDERS = (
    *("transport", "scheduler", "body", "pipeline", "scene", "avatars", "hw_profiles", "stages", "training", "bench"),
    "apps",
)
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
    "starlette",
    "uvicorn",
    "websockets",
    "prometheus_client",
    "pyarrow",
    "pandas",
    "ray",
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
    found = {
        value.__name__: value.__dataclass_params__.frozen  # type: ignore[attr-defined]
        for module in modules(folder)
        for value in vars(module).values()
        if isinstance(value, type) and dataclasses.is_dataclass(value) and value.__module__ == module.__name__
    }
    assert len(found) >= 2
    assert {name for name, frozen in found.items() if not frozen} == CHANGING.get(folder, set()) & found.keys()
