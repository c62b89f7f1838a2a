"""What the controls of a new run may be set to here. Rule: what is in force is always among them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from trilane.apps.dashboard.controls import OF_A_NEW_RUN
from trilane.avatars.bundle import BUILT_IN, MANIFEST
from trilane.stages.dsp.runtime import installed
from trilane.stages.run_options import RunOptions, option_of

MOST_AVATARS: Final = 20


def choices_of(config: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """By control. `config`: what is in force."""
    found = {"runtime": installed(), "avatar": (*BUILT_IN, *_neighbours(str(config["avatar"])))}
    choices = {}
    for name in OF_A_NEW_RUN:
        offered = option_of(RunOptions.model_fields[name]).offered or ()
        choices[name] = tuple(dict.fromkeys([*offered, *found.get(name, ()), str(config[name])]))
    return choices


def reasons_against(options: RunOptions) -> dict[str, str]:
    """Why a control of a new run cannot be used beside `options`, by name."""
    if options.pace:
        return {"performance_profile": "the run is held to a chip's pace, which is capped already"}
    return {}


def _neighbours(avatar: str) -> Iterator[str]:
    """The folders of avatars beside that of `avatar`, where it is a folder."""
    folder = Path(avatar)
    if avatar not in BUILT_IN and folder.is_dir():
        yield from [str(manifest.parent) for manifest in sorted(folder.parent.glob(f"*/{MANIFEST}"))[:MOST_AVATARS]]
