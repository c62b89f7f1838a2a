"""`trilane explain`: what is modelled of a scene, as a database explains a query; where the time of a run went.

Rule: this module reads options and shows results; everything is decided and computed elsewhere.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, given
from trilane.apps.cli.console import print_json, spinner, stderr_console, stdout_console, without_controls
from trilane.apps.cli.explain_run import MOST_SLOWEST, SLOWEST, explain_folder, refuse_options, run_folder
from trilane.apps.cli.options import (
    CameraOption,
    CoresOption,
    FpsOption,
    JsonOption,
    MotionOption,
    OutputOption,
    PerformanceProfileOption,
    SceneAvatarOption,
    SceneSizeOption,
    SkinningOption,
)
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
READ_SO = (
    "density: tensor pixels for one pixel of the picture, along a side; bound: the largest of these frames; measured: "
    "in the first of them"
)

RECTANGLES = "in blue how far each reaches with its clothes, in orange what the tensor shows"

ChipOption = Annotated[str, typer.Option("--profile", help=f"{PROFILE_HELP} Its times are those that are saved.")]
FramesOption = Annotated[int | None, typer.Option(min=1, help="How many frames to look at; the scene's if none.")]
PictureOption = Annotated[Path | None, typer.Option(help=f"Draw bodies, {RECTANGLES}, here (.png).")]
CapOption = Annotated[PerformanceProfile, PerformanceProfileOption]
SceneOrRunArgument = Annotated[str, typer.Argument(help="A scene, by file (TOML) or name; or the folder of a run.")]
SlowestOption = Annotated[
    int, typer.Option(min=1, max=MOST_SLOWEST, help="Of a run: how many of the slowest frames are explained.")
]
JobsOption = Annotated[Path | None, typer.Option(help="Of a run: write every job here (.csv, .parquet).")]


@app.command(epilog=EPILOG)
def explain(
    ctx: typer.Context,
    scene: SceneOrRunArgument = "default",
    motion: MotionOption = None,
    camera: CameraOption = None,
    avatar: SceneAvatarOption = None,
    frames: FramesOption = None,
    fps: FpsOption = None,
    output: OutputOption = None,
    size: SceneSizeOption = None,
    skinning: SkinningOption = "auto",
    cores: CoresOption = None,
    profile: ChipOption = "host",
    performance_profile: CapOption = PerformanceProfile.SUSTAINED_HIGH_PERFORMANCE,
    picture: PictureOption = None,
    slowest: SlowestOption = SLOWEST,
    jobs: JobsOption = None,
    json: JsonOption = False,
) -> None:
    """Explain the plan of a scene: what is modelled, what is left out, the error it costs and the work it saves.

    With a run folder instead: which stage or wait bounded the frame time, why jobs waited, and why the slowest frames
    were slow (docs/explain.md).
    """
    folder = run_folder(scene)
    refuse_options(given(ctx), of_a_run=folder is not None)
    if folder is not None:
        explain_folder(folder, slowest, jobs, json)
        return
    from trilane.apps.explanation import explain as explained
    from trilane.apps.plan_picture import draw_plan
    from trilane.errors import BadInputError
    from trilane.stages.configure import configure
    from trilane.writing import require_writable

    if picture is not None:
        if picture.suffix.lower() not in (".png", ""):
            raise BadInputError("--picture", f"'{picture}'", "a name that ends in .png")
        require_writable(picture)
    with spinner("planning"):
        options = RunOptions(
            scene=scene,
            motion=motion,
            camera=camera,
            avatar=avatar,
            frames=frames,
            fps=fps,
            output=output,
            size=size,
            skinning=skinning,
            cores=tuple(cores or ()),
        )
        checked = configure(options, Path.cwd())
        explanation = explained(checked, profile, str(performance_profile))
    for note in checked.notes:
        stderr_console().print(note, soft_wrap=True, markup=False)
    if picture is not None:
        draw_plan(explanation.plan, explanation.first_frames, picture)
        stderr_console().print(f"picture: {picture}\nin the picture: {RECTANGLES}", soft_wrap=True, markup=False)
    if json:
        print_json(explanation.document)
        return
    _show(without_controls(explanation.document))


def _show(document: dict[str, Any]) -> None:
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
    console.print(_table(document["phases"]))
    left = len(document["phases"]) - MOST_ROWS
    if left > 0:
        console.print(f"{left} more phases: --json has all of them")
    for line in (*_left_out(document["phases"]), _image(document["image"])):
        console.print(line, soft_wrap=True, markup=False)
    console.print(READ_SO, soft_wrap=True)
    firsts = {phase["why"]: phase["first_frame"] for phase in reversed(document["phases"])}
    for why, first in sorted(firsts.items(), key=lambda one: one[1]):
        console.print(f"frame {first} and others like it: {why}", soft_wrap=True)
    console.print(f"placement: {document['placement']['why']}", soft_wrap=True, markup=False)
    for line in _totals(document["totals"], config):
        console.print(line, soft_wrap=True)


def _drawn(row: dict[str, Any]) -> str:
    """How an avatar is drawn in every frame; avatars of one bundle are drawn alike."""
    return (
        f"avatar {row['bundle']}: skinned by the {row['skinned_on']} unit; detail: {row['detail']}; "
        f"texture filter {row['texture_filter']}; expression: {row['expression']}"
    )


def _table(phases: list[dict[str, Any]]) -> Table:
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
    """A line for each way in which avatars are modelled: what it leaves out of them."""
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
    """A line for each way in which avatars are modelled, with the largest errors of those that are modelled so."""
    lines = []
    for modelled in dict.fromkeys(row["modelled"] for row in rows):
        own = [row for row in rows if row["modelled"] == modelled]
        known = [row["measured_px"] for row in own if row["measured_px"] is not None]
        measured = f"{max(known):.2f}" if known else "-"
        names = ", ".join(row["name"] for row in own)
        lines.append(f"{names}: {modelled}, {max(row['bound_px'] for row in own):.2f} / {measured}")
    return "\n".join(lines)


def _totals(totals: dict[str, Any], config: dict[str, Any]) -> list[str]:
    """The whole scene beside the fixed square, as sentences."""
    share = 1 - totals["work_ms"] / totals["fixed_work_ms"]
    return [
        f"beside a fixed tensor of 512x512: {totals['pixels'] / totals['fixed_pixels']:.1%} of the tensor's pixels, "
        f"{totals['gmac']:.1f} of {totals['fixed_gmac']:.1f} GMAC",
        f"work of all stages: {totals['work_ms']:.0f} of {totals['fixed_work_ms']:.0f} ms, {share:.0%} saved "
        f"(computed by the profile {config['profile']}; `trilane bench planner` measures)",
    ]
