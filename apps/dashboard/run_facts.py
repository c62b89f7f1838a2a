"""What the page is told of a run besides its course: configuration, plan, placement, error, machine.

Rule: what is not known is null; the words are those of report.json.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class RunFacts:
    """`name` of the run folder; `scene`; `clock`: host or virtual; `machine`: a line for people.

    `fps`, `output` (width, height): of the scene. `config`: the value in force of each control.
    `plan`, `placement`, `accuracy`: as in report.json, and `notes` beside the plan. `bound`: of a run that is over, as
    there, with its efficiencies.
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
    bound: Mapping[str, Any] | None = None

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
        facts = {"plan": self.plan, "placement": self.placement, "accuracy": self.accuracy, "bound": self.bound}
        return {"type": "state", "is": state, "why": why, "config": self.config, **facts}
