"""`trilane plan`: what a scene models and what it leaves out, as a database explains a query.

Rule: this module reads options and shows results; everything is decided and computed elsewhere.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, JsonOption, PerformanceProfileOption, with_options
from trilane.apps.cli.console import print_json, spinner, stderr_console, stdout_console, without_controls
from trilane.errors import BadInputError
from trilane.stages.run_options import PROFILE_HELP, RunOptions
from trilane.units import PerformanceProfile

if TYPE_CHECKING:
    from rich.table import Table

app = Commands()
EPILOG = """\b
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


@app.command(epilog=EPILOG)
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
    from trilane.apps.explain.explanation import explain
    from trilane.apps.explain.scene_plan import draw_plan
    from trilane.stages.configure import configure
    from trilane.writing import require_writable

    if out is not None:
        if out.suffix.lower() not in (".png", ""):
            raise BadInputError("--out", f"'{out}'", "a name that ends in .png")
        require_writable(out)
    with spinner("planning"):
        checked = configure(options.changed(scene=scene), Path.cwd())
        explanation = explain(checked, profile, str(performance_profile))
    for note in checked.notes:
        stderr_console().print(note, soft_wrap=True, markup=False)
    if out is not None:
        draw_plan(explanation.plan, explanation.first_frames, out)
        stderr_console().print(f"picture: {out}\nin the picture: {RECTANGLES}", soft_wrap=True, markup=False)
    if json:
        print_json(explanation.document)
        return
    _show_plan(without_controls(explanation.document))


def _refuse_other_things(path: Path) -> None:
    """Raise BadInputError for what people may take for a scene: a pipeline file, and the folder of a run."""
    from trilane.pipeline.pipeline_file import is_pipeline_file

    if is_pipeline_file(path):
        raise BadInputError(path, "a pipeline file", "a scene", f"`trilane check {path}` says what a pipeline needs")
    if path.is_dir():
        raise BadInputError(path, "a folder", "a scene", f"`trilane explain {path}` is for the folder of a run")


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
