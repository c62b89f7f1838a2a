"""`trilane run`: a scene through the three units, to a run folder and a table.

Rule: this file talks to the person; what is done is in `trilane.apps.asked_run`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.asked_run import MOST_CHECKED, MOST_LATCH_MS
from trilane.apps.cli.commands import Commands
from trilane.apps.cli.console import print_json, stderr_console, stdout_console
from trilane.apps.cli.options import (
    PROFILE_HELP,
    RUNTIME_HELP,
    WIDTH_HELP,
    CameraOption,
    CoresOption,
    FpsOption,
    JsonOption,
    MotionOption,
    OutputOption,
    PerformanceProfileOption,
    PortOption,
    SceneArgument,
    SceneAvatarOption,
    SceneSizeOption,
    SkinningOption,
)
from trilane.apps.remake import MOST_WIDTH, Remake, check_remake
from trilane.errors import BadInputError
from trilane.units import PerformanceProfile

if TYPE_CHECKING:
    from rich.progress import TaskID

    from trilane.apps.asked_run import AskedRun
    from trilane.apps.run_job import Hooks, Outcome

app = Commands()

EPILOG = """\b
Examples:
  trilane run
  trilane run --frames 60 --size 192 --out /tmp/run
  trilane run --motion walk.bvh --camera arkit.txt --frames 200 --json
  trilane run --latch 3
  trilane run --no-video --baseline 0 --frames 1000000
  trilane run walk-past --policy latest --edge triple --fps 24 --output 1280x720
  trilane run --cores cpu=1 --cores gpu=0 --cores dsp=0,1
  trilane run --split /Concat_4_output_0_QuantizeLinear_Output=cpu
  trilane run --performance-profile sustained_high_performance
  trilane run --check 4
  trilane run --calibration entropy:10 --check 4
  trilane run --width 8 --channels 8
  trilane run --dashboard
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
    float,
    typer.Option(min=0, max=MOST_LATCH_MS, help="Sample poses late: ready so many ms before the raster; 0: at once."),
]
CapOption = Annotated[PerformanceProfile | None, PerformanceProfileOption]
VideoOption = Annotated[bool, typer.Option("--video/--no-video", help="Encode the frames; not for runs that last.")]
DashboardOption = Annotated[
    bool, typer.Option("--dashboard", help="Show the run in a browser; without --frames it runs until Ctrl-C.")
]
BaselineOption = Annotated[
    int, typer.Option(min=0, help="Frames of the `sequential` run of the same scene that follows; 0: none.")
]
CheckOption = Annotated[
    int,
    typer.Option(
        min=0,
        max=MOST_CHECKED,
        help="Frames to compare with the truth or the float path when the run is over; 0: none.",
    ),
]


def _checked_channels(channels: int | None) -> int | None:
    """Looked at with the options, so that a sweep refuses a wrong one before its first trial."""
    check_remake(Remake(channels=channels))
    return channels


def _checked_calibration(text: str | None) -> str | None:
    """As `_checked_channels`."""
    check_remake(Remake(calibration=text))
    return text


RemadeWidthOption = Annotated[
    int | None,
    typer.Option(min=1, max=MOST_WIDTH, help=f"{WIDTH_HELP} Of another width than the avatar's it is untrained."),
]
RemadeChannelsOption = Annotated[
    int | None,
    typer.Option(
        callback=_checked_channels, help="Of the neural texture: 4, 8, 12, 16; of others than the avatar's: untrained."
    ),
]
CalibrationOption = Annotated[
    str | None,
    typer.Option(
        callback=_checked_calibration,
        help="Quantise the avatar's network anew: minmax, percentile or entropy, or METHOD:VIEWS; 5 views if none.",
    ),
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
    width: RemadeWidthOption = None,
    channels: RemadeChannelsOption = None,
    calibration: CalibrationOption = None,
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
    check: CheckOption = 0,
    out: FolderOption = None,
    video: VideoOption = True,
    dashboard: DashboardOption = False,
    port: PortOption = None,
    as_json: JsonOption = False,
) -> None:
    """Run a scene on the three units and write a run folder.

    The folder holds report.json, video.mp4, contact.png, trace.pftrace (open it at ui.perfetto.dev), events.jsonl and
    journal.msgpack, which is written while the run goes on.
    docs/report.md explains every key, the policies and the edges.
    """
    from trilane.apps.asked_run import AskedRun, run_asked

    if port is not None and not dashboard:
        raise BadInputError("options", "--port without --dashboard", "both or neither")
    if check and dashboard:
        raise BadInputError(
            "options", "--check with --dashboard", "one of them", "a run that is steered has no reference"
        )
    cuts, cap = tuple(split or ()), performance_profile and str(performance_profile)
    _check_pace(profile, pace, slow_motion, cuts, cap)
    request: dict[str, Any] = {
        "scene": scene,
        "motion": motion,
        "camera": camera,
        "background": background,
        "avatar": avatar,
        "frames": frames,
        "size": size,
        "runtime": runtime,
        "hud": hud,
        "skinning": skinning,
        "split": cuts,
        "fps": fps,
        "output": output,
        "cores": tuple(cores or ()),
        "policy": str(policy),
    }
    paced_by = None if profile is None else (profile, slow_motion)
    command = ("trilane", *sys.argv[1:])
    asked = AskedRun(
        request,
        edge,
        baseline,
        paced_by,
        cap,
        latch,
        out,
        command,
        has_video=video,
        check=check,
        remake=Remake(width, channels, calibration),
    )
    outcome = _run_live(asked, port) if dashboard else run_asked(asked, _hooks)
    _print_outcome(outcome, as_json)
    raise typer.Exit(outcome.exit_code)


def _run_live(asked: AskedRun, port: int | None) -> Outcome:
    from trilane.apps.dashboard.serve import require_server

    require_server()
    from trilane.apps.dashboard.live_run import run_live

    return run_live(asked, _hooks, port, lambda text: stderr_console().print(text, soft_wrap=True, markup=False))


def _check_pace(profile: str | None, asked: bool, slow_motion: float, cuts: tuple[str, ...], cap: str | None) -> None:
    """Raises BadInputError for options of a chip's pace that lack another, or that it leaves no room for."""
    if (profile is not None) != asked:
        found = "--profile without --pace" if profile is not None else "--pace without --profile"
        remedy = "give both; `trilane predict --profile` answers without running"
        raise BadInputError("options", found, "both or neither", remedy)
    if profile is None:
        if slow_motion != 1.0:
            raise BadInputError("options", "--slow-motion without --pace", "--pace and --profile with it")
        return
    if cuts:
        raise BadInputError("options", "--split with --pace", "one of them", "a chip's pace is that of a whole network")
    if cap is not None:
        raise BadInputError("options", "--performance-profile with --pace", "one of them", "a pace is capped already")


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
