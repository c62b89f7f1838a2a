"""What the controls of a new run may be set to here. Rule: what is in force is always among them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from trilane.apps.asked_run import AskedRun
from trilane.apps.dashboard.controls import NO_PROFILE
from trilane.avatars.bundle import BUILT_IN, MANIFEST
from trilane.scheduler.policy import POLICIES
from trilane.stages.dsp.runtime import installed
from trilane.units import PERFORMANCE_PROFILES

EDGES: Final = ("single", "double", "triple", "fifo:4", "orphan")
SIZES: Final = ("auto", "96", "128", "192", "256", "384", "512")
MOST_AVATARS: Final = 20


def choices_of(config: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """By control. `config`: what is in force."""
    choices = {
        "policy": tuple(POLICIES),
        "edge": EDGES,
        "performance_profile": (NO_PROFILE, *PERFORMANCE_PROFILES),
        "size": SIZES,
        "runtime": tuple(installed()),
        "avatar": (*BUILT_IN, *_neighbours(str(config["avatar"]))),
    }
    return {name: tuple(dict.fromkeys([*words, str(config[name])])) for name, words in choices.items()}


def reasons_against(asked: AskedRun) -> dict[str, str]:
    """Why a control of a new run cannot be used with what was asked for, by name."""
    if asked.paced_by is not None:
        return {"performance_profile": "the run is held to a chip's pace, which is capped already"}
    return {}


def _neighbours(avatar: str) -> Iterator[str]:
    """The folders of avatars beside that of `avatar`, where it is a folder."""
    folder = Path(avatar)
    if avatar not in BUILT_IN and folder.is_dir():
        yield from [str(manifest.parent) for manifest in sorted(folder.parent.glob(f"*/{MANIFEST}"))[:MOST_AVATARS]]
