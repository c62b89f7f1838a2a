"""What the page is told of a run besides its course: configuration, plan, placement, error, machine.

Rule: what is not known is null; the words are those of report.json.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trilane.apps.report import Report, read_report
from trilane.apps.run_job import Plan
from trilane.pipeline.journal import Begun
from trilane.stages.configure import Checked


@dataclass(frozen=True)
class RunFacts:
    """`name` of the run folder; `scene`; `clock`: host or virtual; `machine`: a line for people.

    `fps`, `output` (width, height): of the scene. `config`: the value in force of each control.
    `plan`, `placement`, `accuracy`: as in report.json, and `notes` beside the plan.
    """

    name: str
    scene: str
    clock: str
    machine: str
    fps: float
    output: tuple[int, int]
    config: Mapping[str, Any]
    plan: Mapping[str, Any]
    placement: Mapping[str, Any] | None
    accuracy: Mapping[str, Any]

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> RunFacts:
        """The facts that were sent as `asdict` has them."""
        width, height = row["output"]
        return cls(**{**row, "output": (width, height)})

    def hello(self) -> dict[str, Any]:
        """Its part of the hello."""
        return {
            "name": self.name,
            "scene": self.scene,
            "clock": self.clock,
            "machine": self.machine,
            "fps": self.fps,
            "output": list(self.output),
        }

    def state(self, state: str, why: str = "") -> dict[str, Any]:
        """The message that says what the run does, and under what configuration."""
        facts = {"plan": self.plan, "placement": self.placement, "accuracy": self.accuracy}
        return {"type": "state", "is": state, "why": why, "config": self.config, **facts}


def config_in_force(config: Mapping[str, Any], performance_profile: str | None) -> dict[str, Any]:
    """The value of each control that is set before a run. `config`: as in report.json."""
    scene = config["scene"]
    return {
        "policy": config["policy"],
        "edge": config["edge"],
        "performance_profile": performance_profile or "none",
        "size": scene["size"],
        "runtime": config["runtime"],
        "avatar": scene["avatars"][0]["bundle"],
    }


def machine_line(machine: Mapping[str, Any]) -> str:
    """Processor and OpenGL driver in one line."""
    cpu, driver = machine["cpu"], machine.get("gl")
    cores = f"{len(cpu['cores_allowed'])} of {cpu['cores']} cores"
    drawn = f", {driver['renderer']}" if driver else ""
    return f"{cpu['model']}, {cores}{drawn}"


def facts_of_checked(name: str, checked: Checked, plan: Plan, machine: Mapping[str, Any]) -> RunFacts:
    """Of a run that begins."""
    config = checked.config
    scene = config.scene
    said = {**config.model_dump(mode="json", exclude={"out_dir", "window"}), "policy": plan.policy, "edge": plan.edge}
    return RunFacts(
        name,
        scene.name,
        "host",
        machine_line(machine),
        scene.fps,
        (scene.output.width, scene.output.height),
        config_in_force(said, plan.performance_profile),
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
        config_in_force(document["config"], caps.get("performance_profile")),
        {**document["plan"], "notes": document["notes"]},
        document.get("placement"),
        document["accuracy"],
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
