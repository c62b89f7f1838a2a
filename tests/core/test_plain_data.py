"""What is handed about is plain data: nobody can change it behind another's back, and unknown keys are refused.

Rule: a dataclass that changes while it is used is on the list below; every other one is frozen.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pydantic

import trilane

#: Imported with an extra, a driver or a fork alone.
NEEDS_MORE = ("stages.dsp.openvino", "stages.dsp.qnn", "stages.dsp.cuda")
CHANGING = {
    "bench.scenario.Queries",
    "bench.scenario.LoadGenPlayer",
    "bench.scenario._Player",
    "training.step_loop.TrainingState",
    "training.mesh_levels.Corners",
    "apps.experiments.error_by_cause._Moved",
    "apps.experiments.error_by_cause._Pooled",
    "hw_profiles.governor.ThermalState",
    "hw_profiles.governor.Throttle",
    "pipeline.memory.ByteCounter",
    "scene.motion.bvh.BvhJoint",
    "scene.motion.bvh._Hierarchy",
    "scene.motion.bvh._Words",
    "scene.motion.pickled.StoredArray",
    "scene.motion.pickled._Kind",
    "scene.motion.pickled._Reader",
    "scene.motion.retarget.Retarget",
    "scheduler.recording.Recording",
    "scheduler.virtual._VirtualUnit",
    "stages.cpu.mesh_bounds._Extent",
}
#: Models that keep keys which they do not know: what other versions of Trilane have measured.
OPEN = {
    "apps.compare.sides.ComparedCounts",
    "apps.compare.sides.ComparedFigures",
    "apps.compare.sides.ComparedStage",
    "apps.compare.sides.ComparedUnit",
    "apps.compare.sides.ImportedTime",
    "apps.run.report._Accuracy",
    "apps.run.report._Avatar",
    "apps.run.report._Output",
    "apps.run.report._Part",
    "apps.run.report._Scene",
    "apps.run.report._WorstView",
    "apps.sweep.store.TrialRecord",
    "avatars.manifest.AccuracyFigures",
    "avatars.manifest.Validation",
}


def module_names() -> Iterator[str]:
    root = Path(trilane.__file__).parent
    for found in pkgutil.walk_packages([str(root)], "trilane."):
        name = found.name.removeprefix("trilane.")
        if not found.ispkg and name != "__main__" and not name.startswith(NEEDS_MORE):
            yield found.name


def classes() -> dict[str, Any]:
    """Every class by its module and name. A module whose packages are not installed is left out."""
    found = {}
    for name in module_names():
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError as error:
            if str(error.name).startswith("trilane"):
                raise
            continue
        for own, kind in inspect.getmembers(module, inspect.isclass):
            if kind.__module__ == name:
                found[f"{name.removeprefix('trilane.')}.{own}"] = kind
    return found


def test_plain_data_is_frozen_and_closed() -> None:
    known = classes()
    assert len(known) > 200
    data = {name: kind for name, kind in known.items() if dataclasses.is_dataclass(kind)}
    assert {name for name, kind in data.items() if not kind.__dataclass_params__.frozen} == CHANGING & data.keys()
    models = {name: kind.model_config for name, kind in known.items() if issubclass(kind, pydantic.BaseModel)}
    assert len(models) > 50
    assert all(config["frozen"] for config in models.values())
    assert {name for name, config in models.items() if config["extra"] != "forbid"} == OPEN
