"""The document of `trilane check` about a scene: the pipeline of the scene's run, written as a pipeline file.

Rule: nothing runs here. If a chip is given, the stages get times as in `trilane predict SCENE`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from trilane.apps.check.checked_file import document_of
from trilane.apps.predict.asked_pipelines import asked, avatar
from trilane.errors import BadInputError
from trilane.files import read_bytes
from trilane.hw_profiles.profile_files import load_runnable
from trilane.hw_profiles.schema import corners_of
from trilane.hw_profiles.shared_chip import alone_ms
from trilane.hw_profiles.tenants import SKIPS
from trilane.pipeline.description import file_text, tables_of, unsaid
from trilane.pipeline.pipeline_file import FORM, IF_EMPTY, MOST_BYTES, TABLES, checked_tables
from trilane.scene.schema import scene_names
from trilane.scheduler.policy import POLICIES
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.configure import configure
from trilane.stages.run_options import RunOptions
from trilane.units import HOST, NS_PER_MS, SUSTAINED

DIGITS: Final = 6  # behind the point of a time in ms, because the scheduler counts nanoseconds


class CheckedScene(NamedTuple):
    """The check of a scene. `document`: as from `check_file`, with `notes`. `text`: the scene's pipeline as a file."""

    document: dict[str, Any]
    text: str


def is_scene(text: str) -> bool:
    """Return whether `text` is the name of a bundled scene, or of a TOML file without the tables of a pipeline."""
    path = Path(text)
    if text in scene_names():
        return True
    if path.suffix != ".toml" or not path.is_file():
        return False
    try:
        tables = tomllib.loads(read_bytes(path, MOST_BYTES, FORM, IF_EMPTY).decode())
    except (ValueError, RecursionError):
        return False
    return bool(tables) and not {*tables} & {*TABLES}


def check_scene(text: str, profile: str | None = None) -> CheckedScene:
    """Check a scene and return its pipeline. Raises BadInputError, or MissingPartError for a part that a run needs.

    `text`: name of a bundled scene, or a file.
    `profile`: chip for which the times of the stages are computed; without a chip, the stages have no times.
    """
    options = RunOptions(scene=text, skinning="gpu")
    checked = configure(options, Path.cwd())
    pipeline, scene = avatar_pipeline(checked.config, checked.assets, options.edge), checked.config.scene
    run: dict[str, Any] = {"policy": options.policy, "frames": scene.frames}
    if POLICIES[options.policy].paced:
        run["fps"] = scene.fps
    times: Mapping[str, float] = {}
    taken: Mapping[str, Any] = {}
    if profile is not None:
        times, taken = _priced(text, profile)
    tables = tables_of(pipeline, run, times, taken)
    document = document_of(checked_tables(tables, Path(f"{scene.name}.toml")))
    notes = [*unsaid(pipeline), *_said(profile, document["routes"][0]["share"])]
    period = document["period_ms"]
    head = [f"the pipeline of the scene {scene.name}, as `trilane run {text}` runs it"]
    if period is not None:
        head.append(f"period {period:.6g} ms or more, by {document['limit']}: {' -> '.join(document['cycle'])}")
    answer = {**document, "file": text, "imports": [], "notes": notes}
    return CheckedScene(answer, file_text(tables, [*head, *notes]))


def _priced(text: str, profile: str) -> tuple[Mapping[str, float], Mapping[str, Any]]:
    """Return two parts of the pipeline file: times of stages, and how many frames take the bypass.

    The first part has the mean time of a job by stage, in ms, over the frames that need the network. The second part
    has the key `pattern` or `share` of the bypass. Raises BadInputError.
    """
    chip = load_runnable(profile)
    if chip.name == HOST:
        remedy = f"`trilane predict {text} --profile {HOST}` measures this machine"
        raise BadInputError("--profile", HOST, "a chip, as nothing runs for a check", remedy)
    tenant = avatar(asked(text), text)
    means = alone_ms(chip, tenant, corners_of(chip, SUSTAINED))
    rounded = {stage: round(round(ms * NS_PER_MS) / NS_PER_MS, DIGITS) for stage, ms in means.items()}
    pattern = "".join(str(int(place == SKIPS)) for place in tenant.frames)
    return rounded, {"pattern": pattern} if "1" in pattern else {"share": 0}


def _said(profile: str | None, share: float | None) -> list[str]:
    """Return notes on the source of the stages' times, and on the share of frames that take the bypass."""
    if profile is None or share is None:
        return ["without times: --profile CHIP adds the times of a chip"]
    said = f"times are means of {profile}, {SUSTAINED}, for frames that the network paints"
    return [said, f"{share:.1%} of the scene's frames need no new picture and take the route"]
