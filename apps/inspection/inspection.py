"""What is said of one file, as plain data for people and for JSON.

Rule: a file is usable when the reader that a run would use takes it; a problem is that reader's own sentence.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from trilane.arrays import F64
from trilane.body.joints import BODY_JOINTS
from trilane.errors import BadInputError
from trilane.scene.recordings import NOTHING, Detected


@dataclass(frozen=True)
class Length:
    """`samples`: usable frames or poses. `rate_hz`: of the median step, None for a single one."""

    samples: int
    seconds: float
    rate_hz: float | None

    @classmethod
    def of(cls, times_s: F64) -> Length:
        """Of increasing times (N,)."""
        steps = np.diff(times_s)
        rate = 1 / float(np.median(steps)) if len(steps) else None
        return cls(len(times_s), float(times_s[-1] - times_s[0]), rate)


@dataclass(frozen=True)
class Inspection:
    """`what`: in words. `problem`: why it is not usable, empty when it is. `advice`: how to use it, or what to do.

    `notes`: as a run prints them. `draw`: the contact sheet, None where there is nothing to draw.
    """

    kind: str
    what: str
    problem: str = ""
    advice: str = ""
    detected: Detected = NOTHING
    length: Length | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    draw: Callable[[], Image.Image] | None = None

    @property
    def usable(self) -> bool:
        return not self.problem

    def document(self, file: Path, sheet: Path | None) -> dict[str, Any]:
        """As JSON has it. `sheet`: where the contact sheet was written."""
        found = {key: value for key, value in asdict(self.detected).items() if key not in ("joints", "unmapped")}
        mapped = dict(self.detected.joints)
        missing = [name for name in BODY_JOINTS if name not in mapped] if mapped else []
        return {
            "file": str(file),
            "kind": self.kind,
            "what": self.what,
            "usable": self.usable,
            "problem": self.problem,
            "advice": self.advice,
            "detected": found,
            "length": asdict(self.length) if self.length else {"samples": None, "seconds": None, "rate_hz": None},
            "joints": {"mapped": mapped, "unmapped": list(self.detected.unmapped), "missing": missing},
            "facts": dict(self.facts),
            "notes": list(self.notes),
            "sheet": str(sheet) if sheet else None,
        }


def used(option: str, file: Path) -> str:
    """The command that takes `file`, behind `option` or by itself, as a shell reads it."""
    return shlex.join(["trilane", "run", *([option] if option else []), str(file)])


def refused(kind: str, what: str, error: BadInputError, file: Path) -> Inspection:
    """Of a file that its reader refuses."""
    where = error.where
    for itself in (str(file), str(file.absolute())):
        if where.startswith(itself):
            where = where.removeprefix(itself).lstrip(", :/")
    place = f"{where}: " if where else ""
    return Inspection(kind, what, f"{place}found {error.found}, expected {error.expected}", error.remedy)
