"""What is handed about is plain data: nobody can change it behind another's back, and unknown keys are refused.

Rule: a dataclass that changes while it is used is on the list below; every other one is frozen.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import pkgutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pydantic

import trilane

#: Folders whose modules need no extra and start nothing.
FOLDERS = ("apps", "avatars", "body", "hw_profiles", "pipeline", "scene", "scheduler", "stages", "transport")
#: Imported with an extra, a driver or a fork alone.
NEEDS_MORE = ("stages.dsp.openvino", "stages.dsp.qnn", "stages.dsp.cuda")
CHANGING = {
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
OPEN = {"avatars.manifest.Figures", "avatars.manifest.Validation"}


def module_names() -> Iterator[str]:
    """Of the modules in these folders and beside them."""
    root = Path(trilane.__file__).parent
    for found in pkgutil.iter_modules([str(root)], "trilane."):
        if not found.ispkg and not found.name.endswith("__main__"):
            yield found.name
    for folder in FOLDERS:
        for found in pkgutil.walk_packages([str(root / folder)], f"trilane.{folder}."):
            if not found.ispkg and not found.name.removeprefix("trilane.").startswith(NEEDS_MORE):
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
    assert {name for name, kind in data.items() if not kind.__dataclass_params__.frozen} == CHANGING
    models = {name: kind.model_config for name, kind in known.items() if issubclass(kind, pydantic.BaseModel)}
    assert len(models) > 50
    assert all(config["frozen"] for config in models.values())
    assert {name for name, config in models.items() if config["extra"] != "forbid"} == OPEN


def test_the_schema_of_a_report_is_held(check_printed: Callable[[str, str], None]) -> None:
    """Every key of report.json with its type and its default, and what lies inside: programs read them."""
    from trilane.apps.run.report import Report

    schema = Report.model_json_schema()
    kinds = {"Report": schema, **schema["$defs"]}
    lines = []
    for kind, about in sorted(kinds.items()):
        for key, value in about["properties"].items():
            said = {name: text for name, text in value.items() if name != "title"}
            needed = "needed " if key in about.get("required", ()) else ""
            lines.append(f"{kind}.{key}: {needed}{json.dumps(said, sort_keys=True)}")
    check_printed("report-schema", "\n".join(lines))
