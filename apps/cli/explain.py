"""`trilane explain`: where the time of a run went. `trilane plan`: what the run of a scene would model and leave out.

Rule: this module only reads options and shows results.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from trilane.apps.cli.commands import Commands, JsonOption, NewestRunArgument, PerformanceProfileOption, with_options
from trilane.apps.cli.console import (
    print_json,
    print_line,
    print_verdict,
    say,
    shown_messages,
    spinner,
    stdout_console,
    without_controls,
)
from trilane.errors import BadInputError
from trilane.stages.run_options import PROFILE_HELP, RunOptions
from trilane.units import NS_PER_MS, PerformanceProfile

if TYPE_CHECKING:
    from rich.table import Table

    from trilane.apps.explain.explained_run import ExplainedFrame, ExplainedRun
    from trilane.apps.explain.scene_plan import ImageSize, ModelledAvatar, PlanExplanation, ScenePhase

app = Commands()
EPILOG = """\b
Examples:
  trilane explain
  trilane explain runs/20261122T070136Z-default --slowest 20
  trilane explain walk --json
  trilane explain walk --frame 57
  trilane explain /tmp/run --jobs jobs.csv
"""
SLOWEST: Final = 10
MOST_SLOWEST: Final = 1000
LEAST_SHARE: Final = 0.005  # smallest share of the frame time that gets its own row
SlowestOption = Annotated[int, typer.Option(min=1, max=MOST_SLOWEST, help="Number of the slowest frames to explain.")]
FrameOption = Annotated[
    int | None, typer.Option(min=0, help="Say instead what became of this frame: its jobs, or why it was dropped.")
]
JobsOption = Annotated[Path | None, typer.Option(help="File for a table of all jobs (.csv, .parquet).")]
READ_PATH_SO = (
    "a job begins when the last thing that it needs is there; the path goes on with the job that brought it, so that "
    "the rows sum to the frame time; it is one path through the whole run, to its last frame: what held the rate back"
)
SLOWEST_SO = (
    "each frame's own path, from the frame presented before it to its end, beside the medians of all frames: it may "
    "blame what the path through the whole run above does not, where other jobs hid that time"
)


@app.command(epilog=EPILOG)
def explain(
    run: NewestRunArgument = None,
    slowest: SlowestOption = SLOWEST,
    frame: FrameOption = None,
    jobs: JobsOption = None,
    json: JsonOption = False,
) -> None:
    """Say where the time of a run went.

    The output is the stage or wait that bounded the run, why jobs waited, and why the slowest frames were slow
    (docs/explain.md). `trilane plan` explains a scene before it runs.
    """
    from trilane.apps.explain.explained_run import ExplainedRun, check_ending, explain_frame, explain_run, write_jobs
    from trilane.apps.watch.followed_run import follow
    from trilane.writing import require_writable

    if jobs is not None:
        check_ending(jobs)
        require_writable(jobs)
    folder = follow(run).folder
    with spinner("reading the journal"):
        explained = explain_run(folder, slowest) if frame is None else explain_frame(folder, frame)
        count = write_jobs(folder, jobs) if jobs is not None else 0
    if jobs is not None:
        say(f"jobs: {jobs}, {count} rows")
    if json:
        print_json(explained.as_json())
    elif isinstance(explained, ExplainedRun):
        _show_run(explained)
    else:
        _show_frame(explained)


def _show_frame(frame: ExplainedFrame) -> None:
    from rich.table import Table

    after = "" if frame.after_ms is None else f" {frame.after_ms:.1f} ms after its release"
    cause = "" if frame.cause is None else f", cause {frame.cause} (docs/policies-and-edges.md)"
    latency = "" if frame.latency_ms is None else f", latency {frame.latency_ms:.1f} ms"
    console = stdout_console()
    print_line(without_controls(f"Frame {frame.frame}: {frame.outcome}{after}{cause}{latency}"))
    if not frame.jobs:
        console.print("no job of it began")
        return
    table = Table("stage (unit)", "began, ms", "took, ms", "waited, ms", "why, ms")
    for row in frame.jobs:
        times = [f"{ms:.2f}" for ms in (row.begin_ms, row.took_ms, row.wait_ms)]
        table.add_row(*without_controls([f"{row.stage} ({row.unit})", *times, _causes(row.causes_ms)]))
    console.print(table)


def _causes(causes_ms: Mapping[str, float]) -> str:
    return ", ".join(f"{cause} {ms:.2f}" for cause, ms in causes_ms.items() if ms >= 0.005) or "-"


def _show_run(run: ExplainedRun) -> None:
    from trilane.apps.explain.explained_run import join_text
    from trilane.apps.run.verdict_facts import verdict_of

    console = stdout_console()
    if run.report and not run.remark:
        print_verdict(verdict_of(run.report, str(run.folder)).lines())
        console.print()
    for line in _head(run):
        print_line(without_controls(line))
    if not run.budget:
        return
    console.print(_budget(run))
    for line in _shared(run):
        print_line(without_controls(line))
    console.print(_waits(run))
    for stage, inputs in run.joins.items():
        print_line(without_controls(join_text(stage, inputs)))
    console.print(_slowest(run))
    for line in run.advice:
        print_line(without_controls(f"try: {line}"))
    print_line(f"times: {run.source}")


def _head(run: ExplainedRun) -> Iterator[str]:
    if run.remark:
        yield run.remark
    frame_ms, failure = run.frame_ms, run.report.failure if run.report else None
    mean = "fewer than two frames: no frame time" if frame_ms is None else f"{frame_ms:.2f} ms a frame"
    scene = f"scene {run.scene}, " if run.scene else ""
    yield f"Run {run.folder}: {scene}policy {run.begun.settings.policy}, {run.frames} frames, {mean}"
    for kind, counts in run.left.items():
        causes = ", ".join(f"{cause} {count}" for cause, count in counts.items())
        yield f"frames {kind}: {counts.total()} ({causes})"
    if frame_ms and run.nobodys_ms >= LEAST_SHARE * frame_ms:
        yield (
            f"other programs: {run.nobodys_ms:.1f} of {frame_ms:.1f} ms a frame were nobody's of this run: a "
            "stage on the path had no core, and no job of this run had it"
        )
    yield from _efficiency(run)
    if failure:
        yield f"the run failed: {failure}"
    yield from (f"in the run: {message}" for message in shown_messages(run.messages, failure))
    for name, facts in run.accuracy.items():
        if "psnr_db_by_band" in facts:
            bands = ", ".join(f"{band} {value:.1f}" for band, value in facts["psnr_db_by_band"].items())
            yield f"avatar {name}: PSNR on held-out views, dB: {bands} ({facts['source']})"
        else:
            yield f"avatar {name}: {facts.get('source', 'no figures')} of accuracy"


def _efficiency(run: ExplainedRun) -> Iterator[str]:
    """Yield a line on the bound of the run and a line on its efficiencies. Unknown facts have no line."""
    if bound := run.figures["bound"]:
        from trilane.apps.explain.reasons import bound_text

        yield f"bound: {bound_text(bound)}"
    if cores := run.cores:
        slowest, fullest, every = (run.figures[f"{of}efficiency"] for of in ("", "core_", "machine_"))
        numbers, cpu_ms, had_ms = ",".join(map(str, cores.numbers)), cores.cpu_ms, cores.had_ms
        yield (
            f"efficiency: {slowest:.0%} of the slowest unit, {fullest:.0%} of the fullest cores, {every:.0%} of all "
            f"(cores {numbers}: {cpu_ms:.2f} of {had_ms:.2f} ms a frame in jobs)"
        )


def _budget(run: ExplainedRun) -> Table:
    """Return a table of the frame time on the critical path.

    Each row has a stage, a cause, the milliseconds per frame and the share. The last row adds up the parts whose share
    is below LEAST_SHARE.
    """
    from rich.table import Table

    table = Table(
        "stage (unit)",
        "what",
        "ms a frame",
        "share",
        title="What bounded the frame time",
        title_justify="left",
        caption=READ_PATH_SO,
        caption_justify="left",
    )
    small = [row for row in run.budget if row.share < LEAST_SHARE]
    for row in run.budget:
        if row.share >= LEAST_SHARE:
            stage = without_controls(f"{row.stage} ({row.unit})")
            table.add_row(stage, row.why, f"{row.ms:.2f}", f"{row.share:.1%}")
    if small:
        ms, share = sum(row.ms for row in small), sum(row.share for row in small)
        table.add_row("", f"smaller parts, {len(small)}: --json has them", f"{ms:.2f}", f"{share:.1%}")
    return table


def _shared(run: ExplainedRun) -> Iterator[str]:
    """Yield a line for each stage whose jobs lacked a core for a noticeable time, with the stages that had the core."""
    for stage, taken in run.taken.items():
        if taken.preempted_ns < LEAST_SHARE * taken.service_ns:
            continue
        job_ms, found = taken.jobs * NS_PER_MS, []
        for other, ns in taken.of.items():
            cores = run.shared(taken.unit, other)
            on = f"core{'s' if len(cores) > 1 else ''} {','.join(map(str, cores))}"
            found.append(f"{ns / job_ms:.2f} ms of it {other} had it, on {on}")
        found.append(f"{taken.other_ns / job_ms:.2f} ms nobody of this run")
        without, service = taken.preempted_ns / job_ms, taken.service_ns / job_ms
        yield f"{stage}: {without:.2f} of {service:.2f} ms a job without a core; {'; '.join(found)}"


def _waits(run: ExplainedRun) -> Table:
    from rich.table import Table

    table = Table("stage (unit)", "jobs", "wait, ms", "why, ms", title="Why jobs waited", title_justify="left")
    for stage, unit in run.unit_of.items():
        wait_ms, causes_ms = run.waits(stage)
        cells = without_controls([f"{stage} ({unit})", str(run.jobs[stage]), f"{wait_ms:.2f}", _causes(causes_ms)])
        table.add_row(*cells)
    return table


def _slowest(run: ExplainedRun) -> Table:
    from rich.table import Table

    from trilane.apps.explain.reasons import notes, reasons

    title = f"The slowest frames (the median takes {run.usual.frame_ns / NS_PER_MS:.2f} ms)"
    table = Table(
        "frame",
        "ms",
        "latency, ms",
        "why",
        title=title,
        title_justify="left",
        caption=SLOWEST_SO,
        caption_justify="left",
    )
    for shown in run.slowest:
        latency_ns = shown.now.latency_ns
        why = [f"{reason.longer_ms:.1f} ms: {reason.text}" for reason in reasons(shown, run.usual)]
        table.add_row(
            str(shown.now.frame),
            f"{shown.frame_ns / NS_PER_MS:.1f}",
            "-" if latency_ns is None else f"{latency_ns / NS_PER_MS:.1f}",
            "\n".join(without_controls([*notes(shown), *why])) or "hardly longer than the median",
        )
    return table


EPILOG_PLAN = """\b
Examples:
  trilane plan
  trilane plan far --size auto
  trilane plan walk-past --picture 1280x720 --fps 24
  trilane plan myscene.toml --out plan.png
  trilane plan closeup --profile snapdragon-888 --json
"""
MOST_ROWS = 24
READ_PLAN_SO = (
    "density: tensor pixels for one pixel of the picture, along a side; bound: the largest of these frames; measured: "
    "in the first of them"
)
RECTANGLES = "blue: a body with its clothes, orange: what the tensor shows"
OneSceneArgument = Annotated[str, typer.Argument(help="A scene, by file (TOML) or name.")]
ChipOption = Annotated[
    str, typer.Option("--profile", help=f"{PROFILE_HELP} The time that the plan saves is computed for this profile.")
]
OutOption = Annotated[
    Path | None, typer.Option("--out", help=f"File for a drawing of bodies (.png). {RECTANGLES.capitalize()}.")
]
CapOption = Annotated[PerformanceProfile, PerformanceProfileOption]
#: Options of a run that its plan depends on.
OF_A_PLAN = frozenset({"motion", "camera", "avatar", "frames", "fps", "picture", "size", "skinning", "cores"})


@app.command(epilog=EPILOG_PLAN)
@with_options(RunOptions, OF_A_PLAN)
def plan(
    options: RunOptions,
    *,
    scene: OneSceneArgument = "default",
    profile: ChipOption = "host",
    performance_profile: CapOption = PerformanceProfile.SUSTAINED_HIGH_PERFORMANCE,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Say what a scene models, what it leaves out, the error this costs and the work it saves.

    Nothing runs. `trilane explain` says where the time of a run went.
    """
    _refuse_other_things(Path(scene))
    from trilane.apps.explain.scene_plan import PlanExplanation, draw_plan
    from trilane.stages.configure import configure
    from trilane.writing import require_writable

    if out is not None:
        if out.suffix.lower() not in (".png", ""):
            raise BadInputError("--out", f"'{out}'", "a name that ends in .png")
        require_writable(out)
    with spinner("planning"):
        checked = configure(options.changed(scene=scene), Path.cwd())
        explanation = PlanExplanation(checked, profile, str(performance_profile))
    for note in checked.notes:
        say(note)
    if out is not None:
        draw_plan(explanation.plan, [phase.frames[0] for phase in explanation.phases], out)
        say(f"picture: {out}\nin the picture: {RECTANGLES}")
    if json:
        print_json(explanation.as_json())
        return
    _show_plan(explanation)


def _refuse_other_things(path: Path) -> None:
    """Raise BadInputError if `path` is a pipeline file or a folder, which people may confuse with a scene."""
    from trilane.pipeline.pipeline_file import is_pipeline_file

    if is_pipeline_file(path):
        raise BadInputError(path, "a pipeline file", "a scene", f"`trilane check {path}` says what a pipeline needs")
    if path.is_dir():
        raise BadInputError(path, "a folder", "a scene", f"`trilane explain {path}` is for the folder of a run")


def _show_plan(plan: PlanExplanation) -> None:
    from trilane.apps.explain.scene_plan import EXPRESSION

    console, scene = stdout_console(), plan.checked.config.scene
    height, width = plan.plan.output
    shapes = ", ".join(f"{h}x{w}" for h, w in plan.checked.config.buckets)
    drawn = (
        f"skinned by the {plan.skinned_on} unit; detail: {plan.detail}; texture filter {scene.texture_filter}; "
        f"expression: {EXPRESSION}"
    )
    for line in (
        f"Scene {scene.name}: {scene.frames} frames of {width}x{height}, plan {scene.plan}, tensor size {scene.size}, "
        f"error budget {scene.error_budget_px:g} px",
        f"tensor shapes that are made ready: {shapes}",
        *dict.fromkeys(f"avatar {avatar.bundle}: {drawn}" for avatar in scene.avatars),
    ):
        print_line(without_controls(line))
    console.print(_phase_table(plan.phases))
    left = len(plan.phases) - MOST_ROWS
    if left > 0:
        console.print(f"{left} more phases: --json has all of them")
    for line in (*_left_out(plan.phases), _image(plan.image), READ_PLAN_SO):
        print_line(without_controls(line))
    firsts = {phase.why: phase.frames[0].frame for phase in reversed(plan.phases)}
    for why, first in sorted(firsts.items(), key=lambda one: one[1]):
        print_line(f"frame {first} and others like it: {why}")
    print_line(without_controls(f"placement: {plan.placement['why']}"))
    planned, fixed = plan.planned, plan.fixed
    print_line(
        f"beside a fixed tensor of 512x512: {planned.pixels / fixed.pixels:.1%} of the tensor's pixels, "
        f"{planned.gmac:.1f} of {fixed.gmac:.1f} GMAC"
    )
    print_line(
        f"work of all stages: {planned.work_ms:.0f} of {fixed.work_ms:.0f} ms, "
        f"{1 - planned.work_ms / fixed.work_ms:.0%} saved "
        f"(computed by the profile {without_controls(plan.profile)}; `trilane bench planner` measures)"
    )


def _phase_table(phases: Sequence[ScenePhase]) -> Table:
    from rich.table import Table

    table = Table("frames", "tensor", "density", "avatar: modelled, bound / measured px", "saved: kpixel, GMAC, ms")
    for phase in phases[:MOST_ROWS]:
        tensor, density, saved = phase.frames[0].plan.shape, phase.density, phase.saved
        table.add_row(
            f"{phase.frames[0].frame}-{phase.frames[-1].frame}",
            f"{tensor[0]}x{tensor[1]}" if tensor and phase.work == "full" else phase.work,
            f"{density[0]:.2f}-{density[1]:.2f}" if density else "-",
            _modelled(phase.avatars) or "-",
            f"{saved['pixels'] / 1000:.0f}, {saved['gmac']:.1f}, {saved['work_ms']:.1f}",
        )
    return table


def _left_out(phases: Sequence[ScenePhase]) -> list[str]:
    """Return a line for each level of detail in use. The line names the parts of the body that the level leaves out."""
    rows = [(row.modelled, ", ".join(row.left_out)) for phase in phases for row in phase.avatars]
    return [f'"{level}" leaves out {out or "nothing that this body has"}' for level, out in dict.fromkeys(rows)]


def _image(image: ImageSize) -> str:
    if image.work is None:
        return f"image: {image.source}"
    loss = "an unknown loss" if image.psnr_loss_db is None else f"{image.psnr_loss_db:.1f} dB lost"
    return f"image: {image.work:.0%} of the pixels that the network was trained for, {loss} ({image.source})"


def _modelled(rows: Sequence[ModelledAvatar]) -> str:
    """Return a text with a line for each level of detail among the avatars of a phase.

    Each line ends with the largest bound on its avatars' errors and the largest measured error, both in pixels.
    """
    lines = []
    for modelled in dict.fromkeys(_model(row) for row in rows):
        own = [row for row in rows if _model(row) == modelled]
        known = [row.measured_px for row in own if row.measured_px is not None]
        measured = f"{max(known):.2f}" if known else "-"
        names = without_controls(", ".join(row.name for row in own))
        lines.append(f"{names}: {modelled}, {max(row.bound_px for row in own):.2f} / {measured}")
    return "\n".join(lines)


def _model(row: ModelledAvatar) -> str:
    """Return an avatar's level of detail in words. For a coarser mesh, the level of the mesh comes first."""
    mesh = row.mesh
    coarser = f"mesh level {mesh['level']} ({mesh['triangles']} of {mesh['of']} triangles), " if mesh["level"] else ""
    return f"{coarser}{row.modelled}"
