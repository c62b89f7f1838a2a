"""`trilane run`: a scene through the three units, to a run folder and a table.

Rule: this file talks to the person; what is done is in `trilane.stages.configure` and `trilane.apps.run_job`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilane.apps.cli.console import JsonOption, print_json, stderr_console, stdout_console
from trilane.errors import BadInputError
from trilane.units import PerformanceProfile

if TYPE_CHECKING:
    from rich.progress import TaskID

    from trilane.apps.pace import Pace
    from trilane.apps.run_job import Hooks, Outcome
    from trilane.stages.config import RunConfig

app = typer.Typer(rich_markup_mode=None, add_completion=False)

EPILOG = """\b
Examples:
  trilane run
  trilane run --frames 60 --size 192 --out /tmp/run
  trilane run --motion walk.bvh --camera arkit.txt --frames 200 --json
  trilane run --latch 3
  trilane run --split /Concat_4_output_0_QuantizeLinear_Output=cpu
  trilane run --performance-profile sustained_high_performance
  trilane run --profile snapdragon-888 --pace --slow-motion 24 --frames 60
  trilane run myscene.toml --background street.mp4 --policy sequential
"""


class PolicyName(StrEnum):
    """Policies of the scheduler; the last two release frames at the scene's rate and may drop some."""

    PIPELINED = "pipelined"
    SEQUENTIAL = "sequential"
    LATEST = "latest"
    DEADLINE = "deadline"


@contextmanager
def _hooks() -> Iterator[Hooks]:
    """Messages, and a progress bar when stderr is a terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
    from rich.text import Text

    from trilane.apps.run_job import Hooks

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=stderr_console(), disable=not sys.stderr.isatty())
    tasks: dict[str, TaskID] = {}
    starting = bar.add_task("starting the units", total=None)

    def progress(what: str, presented: int, requested: int) -> None:
        if what not in tasks:
            bar.update(starting, visible=False)
            tasks[what] = bar.add_task(what, total=requested)
        bar.update(tasks[what], completed=presented)

    with bar:
        yield Hooks(progress, lambda text: bar.console.print(Text(text), soft_wrap=True))


def _print_outcome(outcome: Outcome, as_json: bool) -> None:
    from trilane.apps.cli.run_table import run_table

    if as_json:
        print_json(outcome.report.as_json())
    else:
        stdout_console().print(run_table(outcome.report))
    stderr_console().print(f"run folder: {outcome.folder}", soft_wrap=True, markup=False)


def _pace(config: RunConfig, profile: str | None, asked: bool, slow_motion: float) -> Pace | None:
    if (profile is not None) != asked:
        found = "--profile without --pace" if profile is not None else "--pace without --profile"
        remedy = "give both; `trilane predict --profile` answers without running"
        raise BadInputError("options", found, "both or neither", remedy)
    if profile is None:
        if slow_motion != 1.0:
            raise BadInputError("options", "--slow-motion without --pace", "--pace and --profile with it")
        return None
    from trilane.apps.pace import pace_of

    return pace_of(config, profile, slow_motion)


@app.command(epilog=EPILOG)
def run(
    scene: Annotated[str, typer.Argument(help="A scene file (TOML), or the name of one that comes along.")] = "default",
    motion: Annotated[str | None, typer.Option(help="SMPL-X .npy, AMASS .npz, .bvh, or builtin:NAME.")] = None,
    camera: Annotated[str | None, typer.Option(help="ARKit log, TUM, transforms.json, or builtin:NAME.")] = None,
    background: Annotated[str | None, typer.Option(help="room, or a video, image folder or picture.")] = None,
    avatar: Annotated[str | None, typer.Option(help="default, or the folder of an avatar.")] = None,
    frames: Annotated[int | None, typer.Option(help="How many frames to present.")] = None,
    size: Annotated[str | None, typer.Option(help="Tensor size: HxW, or a side S for areas up to SxS.")] = None,
    hud: Annotated[bool | None, typer.Option(help="Write frame, rate and age on the picture.")] = None,
    policy: Annotated[PolicyName, typer.Option(help="How frames are scheduled.")] = PolicyName.PIPELINED,
    runtime: Annotated[
        str, typer.Option(help="What runs the network: openvino, ort, qnn, cuda; auto: the fastest there is.")
    ] = "auto",
    skinning: Annotated[
        str, typer.Option(help="Which unit poses the vertices: cpu, gpu; auto: cpu when OpenGL is software.")
    ] = "auto",
    split: Annotated[
        list[str] | None,
        typer.Option(help="TENSOR=UNIT: cut the network there, the rest runs on UNIT. `trilane avatar split` lists."),
    ] = None,
    profile: Annotated[str | None, typer.Option(help="Hardware profile whose pace to keep; with --pace.")] = None,
    pace: Annotated[bool, typer.Option("--pace", help="Hold each job until its modelled time has passed.")] = False,
    slow_motion: Annotated[float, typer.Option(help="With --pace: times slower than the chip.")] = 1.0,
    latch: Annotated[
        float, typer.Option(min=0, max=1000, help="Sample poses late: ready so many ms before the raster; 0: at once.")
    ] = 0.0,
    performance_profile: Annotated[
        PerformanceProfile | None, typer.Option(help="Cap of the units: duty cycles of the host profile's corners.")
    ] = None,
    baseline: Annotated[int, typer.Option(min=0, help="Frames of the sequential run beside it; 0: none.")] = 60,
    out: Annotated[Path | None, typer.Option(help="Run folder to write; runs/TIME-SCENE when not given.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Run a scene on the three units and write a run folder.

    The folder holds report.json, video.mp4, contact.png, trace.pftrace (open it at ui.perfetto.dev) and events.jsonl.
    """
    from trilane.apps.run_folder import default_place
    from trilane.apps.run_job import Plan, run_to_folder
    from trilane.stages.configure import Request, configure, required_machine

    request = Request(
        scene, motion, camera, background, avatar, frames, size, runtime, hud, skinning, tuple(split or ())
    )
    checked = configure(request, Path.cwd())
    held = _pace(checked.config, profile, pace, slow_motion)
    if held is not None and split:
        raise BadInputError("options", "--split with --pace", "one of them", "a chip's pace is that of a whole network")
    if held is not None and performance_profile is not None:
        raise BadInputError("options", "--performance-profile with --pace", "one of them", "a pace is capped already")
    if held is not None:
        checked = checked.changed(pace_ns=dict(held.stage_ns))
    target = out or default_place(checked.config.scene.name)
    with _hooks() as hooks:
        for note in checked.notes:
            hooks.message(note)
        outcome = run_to_folder(
            checked,
            target,
            Plan(str(policy), baseline, held, performance_profile and str(performance_profile), latch),
            hooks,
            machine=required_machine(),
            starter=starter,
        )
    _print_outcome(outcome, as_json)
    if outcome.report.failure:
        stderr_console().print(f"the run failed: {outcome.report.failure}", soft_wrap=True, markup=False)
    raise typer.Exit(outcome.exit_code)
