"""`trilane explain`: the plan of a scene, as a database explains a query, and the use of time in a run.

Rule: this module reads options and shows results; everything is decided and computed elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from trilane.apps.cli.commands import (
    Commands,
    JsonOption,
    PerformanceProfileOption,
    given,
    with_options,
)
from trilane.apps.cli.console import (
    print_json,
    print_verdict,
    shown_messages,
    spinner,
    stderr_console,
    stdout_console,
    without_controls,
)
from trilane.errors import BadInputError, did_you_mean
from trilane.stages.run_options import PROFILE_HELP, RunOptions
from trilane.units import PerformanceProfile

if TYPE_CHECKING:
    from rich.table import Table

app = Commands()
EPILOG = """\b
Examples:
  trilane explain
  trilane explain far --size auto
  trilane explain walk-past --output 1280x720 --fps 24
  trilane explain myscene.toml --picture plan.png
  trilane explain closeup --profile snapdragon-888 --json
  trilane explain runs/20261122T070136Z-default --slowest 20
  trilane explain /tmp/run --jobs jobs.csv
"""
MOST_ROWS = 24
SLOWEST: Final = 10
MOST_SLOWEST: Final = 1000
LEAST_SHARE: Final = 0.005  # of the frame time, for a row
READ_PLAN_SO = (
    "density: tensor pixels for one pixel of the picture, along a side; bound: the largest of these frames; measured: "
    "in the first of them"
)
RECTANGLES = "in blue how far each reaches with its clothes, in orange what the tensor shows"
ChipOption = Annotated[str, typer.Option("--profile", help=f"{PROFILE_HELP} The saved time is computed for it.")]
PictureOption = Annotated[Path | None, typer.Option(help=f"Draw bodies, {RECTANGLES}, here (.png).")]
CapOption = Annotated[PerformanceProfile, PerformanceProfileOption]
SceneOrRunArgument = Annotated[str, typer.Argument(help="A scene, by file (TOML) or name; or the folder of a run.")]
SlowestOption = Annotated[
    int, typer.Option(min=1, max=MOST_SLOWEST, help="For a run: number of the slowest frames to explain.")
]
JobsOption = Annotated[Path | None, typer.Option(help="For a run: file for a table of all jobs (.csv, .parquet).")]
#: Options of a run that its plan depends on.
OF_A_PLAN = frozenset({"motion", "camera", "avatar", "frames", "fps", "output", "size", "skinning", "cores"})
#: Options that mean something with a run folder.
OF_A_RUN = frozenset({"scene", "slowest", "jobs", "json"})
#: Options that mean nothing with a scene.
NOT_OF_A_SCENE = frozenset({"slowest", "jobs"})
READ_PATH_SO = (
    "a job begins when the last thing that it needs is there; the path goes on with the job that brought it, so that "
    "the rows sum to the frame time; it is one path through the whole run, to its last frame: what held the rate back"
)
SLOWEST_SO = (
    "each frame's own path, from the frame presented before it to its end, beside the medians of all frames: it may "
    "blame what the path through the whole run above does not, where other jobs hid that time"
)


@app.command(epilog=EPILOG)
@with_options(RunOptions, OF_A_PLAN)
def explain(
    options: RunOptions,
    *,
    ctx: typer.Context,
    scene: SceneOrRunArgument = "default",
    profile: ChipOption = "host",
    performance_profile: CapOption = PerformanceProfile.SUSTAINED_HIGH_PERFORMANCE,
    picture: PictureOption = None,
    slowest: SlowestOption = SLOWEST,
    jobs: JobsOption = None,
    json: JsonOption = False,
) -> None:
    """Explain the plan of a scene: what is modelled, what is left out, the error it costs and the work it saves.

    With a run folder, explain the time instead (docs/explain.md): the stage or wait that bounded the frame time, waits
    of jobs, and causes of slow frames.
    """
    folder = run_folder(scene)
    _refuse_options(given(ctx), of_a_run=folder is not None)
    if folder is not None:
        _explain_folder(folder, slowest, jobs, json)
        return
    from trilane.apps.explain.explanation import explain as explained
    from trilane.apps.explain.scene_plan import draw_plan
    from trilane.errors import BadInputError
    from trilane.stages.configure import configure
    from trilane.writing import require_writable

    if picture is not None:
        if picture.suffix.lower() not in (".png", ""):
            raise BadInputError("--picture", f"'{picture}'", "a name that ends in .png")
        require_writable(picture)
    with spinner("planning"):
        checked = configure(options.changed(scene=scene), Path.cwd())
        explanation = explained(checked, profile, str(performance_profile))
    for note in checked.notes:
        stderr_console().print(note, soft_wrap=True, markup=False)
    if picture is not None:
        draw_plan(explanation.plan, explanation.first_frames, picture)
        stderr_console().print(f"picture: {picture}\nin the picture: {RECTANGLES}", soft_wrap=True, markup=False)
    if json:
        print_json(explanation.document)
        return
    _show_plan(without_controls(explanation.document))


def _show_plan(document: dict[str, Any]) -> None:
    console, config = stdout_console(), document["config"]
    height, width = config["output"]
    console.print(
        f"Scene {document['scene']}: {config['frames']} frames of {width}x{height}, plan {config['plan']}, tensor size "
        f"{config['size']}, error budget {config['error_budget_px']:g} px",
        soft_wrap=True,
    )
    shapes = ", ".join(f"{h}x{w}" for h, w in document["shapes"])
    console.print(f"tensor shapes that are made ready: {shapes}", soft_wrap=True)
    for line in dict.fromkeys(_drawn(row) for row in document["avatars"]):
        console.print(line, soft_wrap=True, markup=False)
    console.print(_phase_table(document["phases"]))
    left = len(document["phases"]) - MOST_ROWS
    if left > 0:
        console.print(f"{left} more phases: --json has all of them")
    for line in (*_left_out(document["phases"]), _image(document["image"])):
        console.print(line, soft_wrap=True, markup=False)
    console.print(READ_PLAN_SO, soft_wrap=True)
    firsts = {phase["why"]: phase["first_frame"] for phase in reversed(document["phases"])}
    for why, first in sorted(firsts.items(), key=lambda one: one[1]):
        console.print(f"frame {first} and others like it: {why}", soft_wrap=True)
    console.print(f"placement: {document['placement']['why']}", soft_wrap=True, markup=False)
    for line in _totals(document["totals"], config):
        console.print(line, soft_wrap=True)


def _drawn(row: dict[str, Any]) -> str:
    """Say how an avatar is drawn in every frame; avatars of one bundle are drawn alike."""
    return (
        f"avatar {row['bundle']}: skinned by the {row['skinned_on']} unit; detail: {row['detail']}; "
        f"texture filter {row['texture_filter']}; expression: {row['expression']}"
    )


def _phase_table(phases: list[dict[str, Any]]) -> Table:
    from rich.table import Table

    table = Table("frames", "tensor", "density", "avatar: modelled, bound / measured px", "saved: kpixel, GMAC, ms")
    for phase in phases[:MOST_ROWS]:
        tensor, density = phase["tensor"], phase["density"]
        table.add_row(
            f"{phase['first_frame']}-{phase['last_frame']}",
            f"{tensor[0]}x{tensor[1]}" if tensor and phase["work"] == "full" else phase["work"],
            f"{density[0]:.2f}-{density[1]:.2f}" if density else "-",
            _modelled(phase["avatars"]) or "-",
            _saved(phase["saved"]),
        )
    return table


def _saved(saved: dict[str, float]) -> str:
    return f"{saved['pixels'] / 1000:.0f}, {saved['gmac']:.1f}, {saved['work_ms']:.1f}"


def _left_out(phases: list[dict[str, Any]]) -> list[str]:
    """Return a line for each way in which avatars are modelled, with the parts that it leaves out."""
    rows = [row for phase in phases for row in phase["avatars"]]
    lines = {}
    for row in rows:
        out = ", ".join(row["left_out"]) or "nothing that this body has"
        lines[row["modelled"], out] = f'"{row["modelled"]}" leaves out {out}'
    return list(lines.values())


def _image(image: dict[str, Any]) -> str:
    if image["work"] is None:
        return f"image: {image['source']}"
    loss = "an unknown loss" if image["psnr_loss_db"] is None else f"{image['psnr_loss_db']:.1f} dB lost"
    return f"image: {image['work']:.0%} of the pixels that the network was trained for, {loss} ({image['source']})"


def _modelled(rows: list[dict[str, Any]]) -> str:
    """Return a line for each way in which avatars are modelled, with the largest errors among these avatars."""
    lines = []
    for modelled in dict.fromkeys(_model(row) for row in rows):
        own = [row for row in rows if _model(row) == modelled]
        known = [row["measured_px"] for row in own if row["measured_px"] is not None]
        measured = f"{max(known):.2f}" if known else "-"
        names = ", ".join(row["name"] for row in own)
        lines.append(f"{names}: {modelled}, {max(row['bound_px'] for row in own):.2f} / {measured}")
    return "\n".join(lines)


def _model(row: dict[str, Any]) -> str:
    """Name the level of detail, and the level of the mesh unless it is the whole one."""
    mesh = row["mesh"]
    coarser = f"{mesh['triangles']} of {mesh['of']} triangles, " if mesh["level"] else ""
    return f"{coarser}{row['modelled']}"


def _totals(totals: dict[str, Any], config: dict[str, Any]) -> list[str]:
    """Compare the whole scene with the fixed square, in sentences."""
    share = 1 - totals["work_ms"] / totals["fixed_work_ms"]
    return [
        f"beside a fixed tensor of 512x512: {totals['pixels'] / totals['fixed_pixels']:.1%} of the tensor's pixels, "
        f"{totals['gmac']:.1f} of {totals['fixed_gmac']:.1f} GMAC",
        f"work of all stages: {totals['work_ms']:.0f} of {totals['fixed_work_ms']:.0f} ms, {share:.0%} saved "
        f"(computed by the profile {config['profile']}; `trilane bench planner` measures)",
    ]


def run_folder(name: str) -> Path | None:
    """Return the run folder that `trilane explain NAME` means, found as `trilane top` finds it; None for a scene.

    The name of a bundled scene means that scene. Raises BadInputError for a folder whose journal is a broken link, and
    for a name that is more like a run folder's than a scene's.
    """
    from trilane.apps.watch.followed_run import EXPECTED, follow, without_journal
    from trilane.pipeline.journal import NAME
    from trilane.scene.schema import scene_names

    folder = Path(name)
    if any((folder / file).exists() for file in ("report.json", NAME)):
        return folder
    if (folder / NAME).is_symlink():
        raise BadInputError(folder, without_journal(folder), EXPECTED)
    if folder.is_file() or name in scene_names():
        return None
    try:
        return follow(folder).folder
    except BadInputError as error:
        is_path = len(folder.parts) > 1 or folder.is_dir()
        if folder.suffix == ".toml" or did_you_mean(name, scene_names()) or not (is_path or error.remedy):
            return None  # the scene's own message names what was expected
        raise


def _refuse_options(typed: set[str], *, of_a_run: bool) -> None:
    """Raise BadInputError for options that only the other kind of `trilane explain` has."""
    useless = typed - OF_A_RUN if of_a_run else typed & NOT_OF_A_SCENE
    if useless:
        names = ", ".join(sorted(f"--{name.replace('_', '-')}" for name in useless))
        kind, expected = ("a run folder", "--slowest, --jobs or --json") if of_a_run else ("a scene", "a run folder")
        raise BadInputError("options", f"{names} with {kind}", expected)


def _explain_folder(folder: Path, slowest: int, jobs: Path | None, as_json: bool) -> None:
    """Print where the time of the run in `folder` went. `jobs`: file to write its jobs to. Raises BadInputError."""
    from trilane.apps.explain.explained_run import check_ending, explain_run, write_jobs
    from trilane.writing import require_writable

    if jobs is not None:
        check_ending(jobs)
        require_writable(jobs)
    with spinner("reading the journal"):
        document = explain_run(folder, slowest)
        count = write_jobs(folder, jobs) if jobs is not None else 0
    if jobs is not None:
        stderr_console().print(f"jobs: {jobs}, {count} rows", soft_wrap=True, markup=False)
    if as_json:
        print_json(document)
        return
    _show_run(without_controls(document))


def _show_run(document: Mapping[str, Any]) -> None:
    console = stdout_console()
    if document["verdict"] and not document["remark"]:
        print_verdict(document["verdict"]["lines"])
        console.print()
    for line in _head(document):
        console.print(line, soft_wrap=True, markup=False)
    if not document["budget"]:
        return
    console.print(_budget(document))
    for line in _shared(document["shared_cores"]):
        console.print(line, soft_wrap=True, markup=False)
    console.print(_waits(document["waits"]))
    for row in document.get("joins", ()):
        from trilane.apps.explain.joins import said

        console.print(said(row), soft_wrap=True, markup=False)
    console.print(_slowest(document))
    for line in document["advice"]:
        console.print(f"try: {line}", soft_wrap=True, markup=False)
    console.print(f"times: {document['sources']['frames, waits_ms, service_ms, preempted_ms']}", soft_wrap=True)


def _head(document: Mapping[str, Any]) -> Iterator[str]:
    if document["remark"]:
        yield document["remark"]
    frame_ms = document["frame_ms"]
    mean = "fewer than two frames: no frame time" if frame_ms is None else f"{frame_ms:.2f} ms a frame"
    scene = f"scene {document['scene']}, " if document["scene"] else ""
    yield f"Run {document['run']}: {scene}policy {document['policy']}, {document['frames']} frames, {mean}"
    if frame_ms and document["nobodys_ms"] >= LEAST_SHARE * frame_ms:
        yield (
            f"other programs: {document['nobodys_ms']:.1f} of {frame_ms:.1f} ms a frame were nobody's of this run: a "
            "stage on the path had no core, and no job of this run had it"
        )
    yield from _efficiency(document)
    if document["failure"]:
        yield f"the run failed: {document['failure']}"
    yield from (f"in the run: {message}" for message in shown_messages(document["messages"], document["failure"]))
    for name, facts in document["accuracy"].items():
        if "psnr_db_by_band" in facts:
            bands = ", ".join(f"{band} {value:.1f}" for band, value in facts["psnr_db_by_band"].items())
            yield f"avatar {name}: PSNR on held-out views, dB: {bands} ({facts['source']})"
        else:
            yield f"avatar {name}: {facts.get('source', 'no figures')} of accuracy"


def _efficiency(document: Mapping[str, Any]) -> Iterator[str]:
    """Say what bounded the run, and what all cores did."""
    if bound := document.get("bound"):
        from trilane.apps.explain.reasons import bound_text

        yield f"bound: {bound_text(bound)}"
    if document["cores"]:
        numbers, efficiency = ",".join(map(str, document["cores"]["numbers"])), document["machine_efficiency"]
        cpu_ms, had_ms = document["cores"]["cpu_ms"], document["cores"]["had_ms"]
        yield (
            f"cores {numbers}: jobs had {cpu_ms:.2f} of {had_ms:.2f} ms of CPU time a frame, {efficiency:.0%}; the "
            f"fullest {document['core_efficiency']:.0%}; the slowest unit {document['efficiency']:.0%}"
        )


def _budget(document: Mapping[str, Any]) -> Table:
    """Return a table of what bounded the frame time, by stage and cause."""
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
    small = [row for row in document["budget"] if row["share"] < LEAST_SHARE]
    for row in document["budget"]:
        if row["share"] >= LEAST_SHARE:
            table.add_row(f"{row['stage']} ({row['unit']})", row["why"], f"{row['ms']:.2f}", f"{row['share']:.1%}")
    if small:
        ms, share = (sum(row[key] for row in small) for key in ("ms", "share"))
        table.add_row("", f"smaller parts, {len(small)}: --json has them", f"{ms:.2f}", f"{share:.1%}")
    return table


def _shared(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Name the stages that had the core while the unit of another stage lacked it for a noticeable time."""
    for row in rows:
        if row["preempted_ms"] < LEAST_SHARE * row["service_ms"]:
            continue
        lead = f"{row['stage']}: {row['preempted_ms']:.2f} of {row['service_ms']:.2f} ms a job without a core"
        found = [
            f"{ms:.2f} ms of it {other} had it, on core"
            f"{'s' if len(row['shared'][other]) > 1 else ''} {','.join(map(str, row['shared'][other]))}"
            for other, ms in row["taken_ms"].items()
        ]
        found.append(f"{row['others_ms']:.2f} ms nobody of this run")
        yield f"{lead}; {'; '.join(found)}"


def _waits(rows: list[dict[str, Any]]) -> Table:
    from rich.table import Table

    table = Table("stage (unit)", "jobs", "wait, ms", "why, ms", title="Why jobs waited", title_justify="left")
    for row in rows:
        causes = ", ".join(f"{cause} {ms:.2f}" for cause, ms in row["causes_ms"].items() if ms >= 0.005)
        table.add_row(f"{row['stage']} ({row['unit']})", str(row["jobs"]), f"{row['wait_ms']:.2f}", causes or "-")
    return table


def _slowest(document: Mapping[str, Any]) -> Table:
    from rich.table import Table

    usual = document["usual"]["frame_ms"]
    title = f"The slowest frames (the median takes {usual:.2f} ms)"
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
    for row in document["slowest"]:
        reasons = [f"{reason['longer_ms']:.1f} ms: {reason['text']}" for reason in row["why"]]
        table.add_row(
            str(row["frame"]),
            f"{row['frame_ms']:.1f}",
            "-" if row["latency_ms"] is None else f"{row['latency_ms']:.1f}",
            "\n".join([*row["notes"], *reasons]) or "hardly longer than the median",
        )
    return table
