"""The facts of a run that begins, and of one that is over. Rule: what is not known is left out, nothing is guessed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from trilane.apps.dashboard.controls import OF_A_NEW_RUN
from trilane.apps.dashboard.run_facts import RunFacts
from trilane.apps.report import Report, config_facts, read_report
from trilane.pipeline.journal import Begun
from trilane.stages.configure import Checked
from trilane.stages.run_options import NOTHING, RunOptions


def config_in_force(config: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """The value of each control that is set before a run.

    `config`: as in report.json, which says what an option left open. `options`: by name, as they were asked for.
    """
    scene = config["scene"]
    chosen = {**config, "size": scene["size"], "avatar": scene["avatars"][0]["bundle"]}
    return {name: chosen.get(name) or options.get(name) or NOTHING for name in OF_A_NEW_RUN}


def machine_line(machine: Mapping[str, Any]) -> str:
    """Processor and OpenGL driver in one line."""
    cpu, driver = machine["cpu"], machine.get("gl")
    cores = f"{len(cpu['cores_allowed'])} of {cpu['cores']} cores"
    drawn = f", {driver['renderer']}" if driver else ""
    return f"{cpu['model']}, {cores}{drawn}"


#: Of a report: how well a run used its cores, and what bounded it.
BOUND: Final = ("bottleneck", "bound", "efficiency", "core_efficiency", "machine_efficiency")


def facts_of_checked(name: str, checked: Checked, options: RunOptions, machine: Mapping[str, Any]) -> RunFacts:
    """Of a run that begins."""
    config = checked.config
    scene = config.scene
    said = config_facts(config, options.policy, options.edge)
    return RunFacts(
        name,
        scene.name,
        "host",
        machine_line(machine),
        scene.fps,
        (scene.output.width, scene.output.height),
        config_in_force(said, dict(options)),
        {"tensor_shapes": [list(shape) for shape in config.buckets], "notes": list(checked.notes)},
        checked.placement,
        checked.accuracy,
    )


def facts_of_report(name: str, report: Report) -> RunFacts:
    """What the report of a finished run says."""
    document = report.as_json()
    scene = document["config"]["scene"]
    caps = document["caps"]
    return RunFacts(
        name,
        scene["name"],
        report.clock,
        machine_line(document["machine"]),
        scene["fps"],
        (scene["output"]["width"], scene["output"]["height"]),
        config_in_force(document["config"], {**(document.get("options") or {}), **caps}),
        {**document["plan"], "notes": document["notes"]},
        document.get("placement"),
        document["accuracy"],
        {key: document.get(key) for key in BOUND} if report.bound is not None else None,
    )


def facts_of_folder(folder: Path, begun: Begun) -> RunFacts:
    """Of the run in `folder`: from its report, or, where it left none, what its journal begins with.

    Raises BadInputError for a report that cannot be read.
    """
    if (folder / "report.json").is_file():
        return facts_of_report(folder.name, read_report(folder))
    facts = begun.facts
    scene = (facts.get("config") or {}).get("scene") or {}
    output = scene.get("output") or {}
    machine = facts.get("machine")
    return RunFacts(
        folder.name,
        scene.get("name", folder.name),
        str(facts.get("clock", "host")),
        machine_line(machine) if machine else "",
        scene.get("fps", 30.0),
        (output.get("width", 640), output.get("height", 480)),
        {"policy": begun.settings.policy},
        {},
        None,
        facts.get("accuracy") or {},
    )
