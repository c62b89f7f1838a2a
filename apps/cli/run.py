"""`trilane run`: a scene through the three units, to a run folder and a table.

Rule: this file talks to the person; what is done is in `trilane.stages.configure` and `trilane.apps.run_job`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilane.apps.cli.commands import Commands
from trilane.apps.cli.console import print_json, stderr_console, stdout_console
from trilane.apps.cli.options import (
    PROFILE_HELP,
    RUNTIME_HELP,
    CameraOption,
    CoresOption,
    FpsOption,
    JsonOption,
    MotionOption,
    OutputOption,
    PerformanceProfileOption,
    SceneArgument,
    SceneAvatarOption,
    SceneSizeOption,
    SkinningOption,
)
from trilane.errors import BadInputError
from trilane.units import PerformanceProfile

if TYPE_CHECKING:
    from rich.progress import TaskID

    from trilane.apps.pace import Pace
    from trilane.apps.run_job import Hooks, Outcome, Plan
    from trilane.pipeline.unit_starter import UnitStarter
    from trilane.stages.config import RunConfig
    from trilane.stages.configure import Checked, GlFacts

app = Commands()

EPILOG = """\b
Examples:
  trilane run
  trilane run --frames 60 --size 192 --out /tmp/run
  trilane run --motion walk.bvh --camera arkit.txt --frames 200 --json
  trilane run --latch 3
  trilane run walk-past --policy latest --edge triple --fps 24 --output 1280x720
  trilane run --cores cpu=1 --cores gpu=0 --cores dsp=0,1
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


BackgroundOption = Annotated[str | None, typer.Option(help="room, or a video, image folder or picture.")]
EDGE_HELP = "Buffers between stages: single, double, triple, fifo:N, orphan or orphan:N (docs/policies-and-edges.md)."
EdgeOption = Annotated[str, typer.Option(help=EDGE_HELP)]
FramesOption = Annotated[int | None, typer.Option(help="How many frames to present.")]
HudOption = Annotated[bool | None, typer.Option(help="Write frame, rate and age on the picture.")]
POLICIES_HELP = (
    "pipelined: highest rate; sequential: one frame at a time; latest: newest pose wins; "
    "deadline: frames that would be late are dropped."
)
PolicyOption = Annotated[PolicyName, typer.Option(help=POLICIES_HELP)]
RuntimeOption = Annotated[str, typer.Option(help=f"What runs the network: {RUNTIME_HELP}")]
SplitOption = Annotated[
    list[str] | None,
    typer.Option(help="TENSOR=UNIT: cut the network there, the rest runs on UNIT. `trilane avatar split` lists."),
]
PacedProfileOption = Annotated[str | None, typer.Option("--profile", help=f"{PROFILE_HELP} With --pace.")]
PaceOption = Annotated[bool, typer.Option("--pace", help="Hold each job until its modelled time has passed.")]
SlowMotionOption = Annotated[float, typer.Option(help="With --pace: times slower than the chip.")]
LatchOption = Annotated[
    float, typer.Option(min=0, max=1000, help="Sample poses late: ready so many ms before the raster; 0: at once.")
]
CapOption = Annotated[PerformanceProfile | None, PerformanceProfileOption]
BaselineOption = Annotated[
    int, typer.Option(min=0, help="Frames of the `sequential` run of the same scene that follows; 0: none.")
]
FolderOption = Annotated[Path | None, typer.Option("--out", help="Run folder to write; runs/TIME-SCENE if none.")]


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


@app.command(epilog=EPILOG)
def run(
    scene: SceneArgument = "default",
    motion: MotionOption = None,
    camera: CameraOption = None,
    background: BackgroundOption = None,
    avatar: SceneAvatarOption = None,
    frames: FramesOption = None,
    fps: FpsOption = None,
    output: OutputOption = None,
    size: SceneSizeOption = None,
    hud: HudOption = None,
    policy: PolicyOption = PolicyName.PIPELINED,
    edge: EdgeOption = "double",
    runtime: RuntimeOption = "auto",
    skinning: SkinningOption = "auto",
    split: SplitOption = None,
    cores: CoresOption = None,
    profile: PacedProfileOption = None,
    pace: PaceOption = False,
    slow_motion: SlowMotionOption = 1.0,
    latch: LatchOption = 0.0,
    performance_profile: CapOption = None,
    baseline: BaselineOption = 60,
    out: FolderOption = None,
    as_json: JsonOption = False,
) -> None:
    """Run a scene on the three units and write a run folder.

    The folder holds report.json, video.mp4, contact.png, trace.pftrace (open it at ui.perfetto.dev) and events.jsonl.
    docs/report.md explains every key, the policies and the edges.
    """
    with _early_processes() as (starter, gl):
        from trilane.apps.run_job import Plan
        from trilane.stages.configure import Request, configure, requested_edge

        cuts, rule = tuple(split or ()), requested_edge(edge)
        request = Request(scene, motion, camera, background, avatar, frames, size, runtime, hud, skinning, cuts)
        request = replace(request, fps=fps, output=output, cores=tuple(cores or ()), policy=str(policy))
        checked = configure(request, Path.cwd(), gl)
        chip_pace = _pace(checked.config, profile, pace, slow_motion)
        cap = performance_profile and str(performance_profile)
        _refuse_beside_pace(chip_pace, cuts, cap)
        outcome = _run(checked, out, Plan(str(policy), baseline, chip_pace, cap, latch, rule), starter, gl)
    _print_outcome(outcome, as_json)
    raise typer.Exit(outcome.exit_code)


@contextmanager
def _early_processes() -> Iterator[tuple[UnitStarter, GlFacts]]:
    """The fork server, which imports what the units need while this process goes on, and what it says of OpenGL.

    The driver is looked at in a process of its own, because it may crash.
    """
    from trilane.pipeline.unit_starter import UnitStarter
    from trilane.stages.factories import PRELOAD

    with UnitStarter(PRELOAD) as starter, closing(starter.call("trilane.stages.machine_facts:open_gl")) as gl:
        yield starter, cache(gl.result)


def _pace(config: RunConfig, profile: str | None, asked: bool, slow_motion: float) -> Pace | None:
    """The pace of the chip `profile`, when `--pace` was `asked` for. Raises BadInputError."""
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


def _refuse_beside_pace(pace: Pace | None, cuts: tuple[str, ...], cap: str | None) -> None:
    """Raises BadInputError for an option that a chip's pace leaves no room for."""
    if pace is not None and cuts:
        raise BadInputError("options", "--split with --pace", "one of them", "a chip's pace is that of a whole network")
    if pace is not None and cap is not None:
        raise BadInputError("options", "--performance-profile with --pace", "one of them", "a pace is capped already")


def _run(checked: Checked, out: Path | None, plan: Plan, starter: UnitStarter, gl: GlFacts) -> Outcome:
    """Run `checked` as `plan` says, to the folder `out` or the default one."""
    from trilane.apps.made import made_facts
    from trilane.apps.run_folder import default_place
    from trilane.apps.run_job import run_to_folder
    from trilane.stages.configure import required_machine

    if plan.pace is not None:
        checked = checked.changed(pace_ns=dict(plan.pace.stage_ns))
    target = out or default_place(checked.config.scene.name)
    with _hooks() as hooks:
        for note in checked.notes:
            hooks.message(note)
        try:
            made = made_facts(["trilane", *sys.argv[1:]])
            machine = required_machine(gl)
            return run_to_folder(checked, target, plan, hooks, machine=machine, made=made, starter=starter)
        except KeyboardInterrupt:
            hooks.message("interrupted: nothing was written")
            raise


def _print_outcome(outcome: Outcome, as_json: bool) -> None:
    """The report or its table on stdout; the folder, and why a run failed, on stderr."""
    from trilane.apps.cli.run_table import run_table

    report = outcome.report
    if as_json:
        print_json(report.as_json())
    else:
        stdout_console().print(run_table(report))
    stderr_console().print(f"run folder: {outcome.folder}", soft_wrap=True, markup=False)
    if report.failure:
        stderr_console().print(f"the run failed: {report.failure}", soft_wrap=True, markup=False)
