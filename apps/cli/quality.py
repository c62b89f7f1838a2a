"""`trilane quality`: differences between runtimes on a scene, and errors of hard cases with their bounds.

Rule: this module reads options and shows results; every figure comes from `trilane.apps.experiments`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, JsonOption, SceneArgument, SceneAvatarOption, SceneSizeOption
from trilane.apps.cli.console import print_json, print_line, say, stderr_console, stdout_console, stdout_kept
from trilane.errors import BadInputError
from trilane.units import RUNTIME_WORDS

app = Commands()
EPILOG = """\b
Examples:
  trilane quality
  trilane quality closeup --frames 20 --runtime ort --runtime openvino
  trilane quality closeup --by-cause --frames 2 --out errors
  trilane quality --hard-cases --json
"""
OUT_OF_BOUNDS, AUTO = 1, "auto"
SCENE, FRAMES, BY_CAUSE_FRAMES = "default", 8, 2
NUMBER_COLUMNS = ("name", "error", "bound", "unit", "from", "verdict")
HARD_COLUMNS = ("name", "error", "bound", "constant_error", "shifted_error", "swapped_error", "source", "verdict")
HEADS = {
    "mae": "MAE",
    "psnr_db": "PSNR dB",
    "ssim": "SSIM",
    "ms_ssim": "MS-SSIM",
    "flip": "FLIP",
    "iou": "mask IoU",
    "lpips": "LPIPS",
}


@app.command(epilog=EPILOG)
def quality(
    scene: SceneArgument = SCENE,
    avatar: SceneAvatarOption = None,
    size: SceneSizeOption = None,
    frames: Annotated[
        int | None, typer.Option(help="Number of frames, evenly spread over the scene.  [default: 8; by cause: 2]")
    ] = None,
    runtime: Annotated[
        list[str] | None,
        typer.Option(
            help=f"{RUNTIME_WORDS}, once for each; all installed ones if not given. Hard cases then leave "
            "out the emulator qnn, which takes minutes."
        ),
    ] = None,
    hard_cases: Annotated[
        bool,
        typer.Option(
            "--hard-cases",
            help="Instead: hard rotations, bodies, cameras, tensors and times against bounds that follow from "
            "analysis, and hard networks against float.",
        ),
    ] = False,
    by_cause: Annotated[
        bool,
        typer.Option(
            "--by-cause",
            help="Instead: the run's frames against the reference (float64, FP32 network), split by cause.",
        ),
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="With --by-cause: a folder for error heat maps, PNG.", show_default=False)
    ] = None,
    lpips_weights: Annotated[
        Path | None,
        typer.Option(help="With --by-cause: a file of LPIPS' weights, to measure LPIPS too.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare the runtimes with each other on a scene's frames, or errors in hard cases with their bounds.

    The exit code is 1 when a figure exceeds its bound. It is also 1 when the bound of a hard network is too wide to
    detect a wrong picture. Wrong pictures have a single colour, a shift by 8 pixels, or red and blue exchanged.
    """
    from trilane.stages.dsp.runtime import installed, resolve

    names = list(runtime or installed())
    for name in names:
        if not (by_cause and name == AUTO):  # --by-cause accepts the runtime `auto`, as a run does
            resolve(name)
    if not by_cause:
        _refuse_without_by_cause({"--out": out, "--lpips-weights": lpips_weights})
    if by_cause:
        _refuse_other_comparisons(hard_cases, runtime or [])
        asked = {"avatar": avatar, "size": size, "runtime": runtime[0] if runtime else AUTO}
        _show_by_cause(scene, asked, BY_CAUSE_FRAMES if frames is None else frames, out, lpips_weights, as_json)
        return
    if hard_cases:
        _refuse_a_scene(scene, {"--avatar": avatar, "--size": size, "--frames": frames})
        passed = _hard_cases([name for name in names if runtime or name != "qnn"], as_json)
    else:
        passed = _scene(scene, avatar, size, FRAMES if frames is None else frames, names, as_json)
    if not passed:
        raise typer.Exit(OUT_OF_BOUNDS)


def _refuse_without_by_cause(options: dict[str, Path | None]) -> None:
    """Raise BadInputError if an option is given that needs --by-cause.

    `options`: value of each such option, by its spelling; None for an option that is not given.
    """
    for name, value in options.items():
        if value is not None:
            raise BadInputError(name, str(value), "it beside --by-cause", "the other comparisons do not use it")


def _refuse_other_comparisons(hard_cases: bool, runtimes: list[str]) -> None:
    """Raise BadInputError if --hard-cases or several runtimes are given with --by-cause, which examines one run."""
    if hard_cases:
        raise BadInputError("--by-cause", "--hard-cases beside it", "one of them")
    if len(runtimes) > 1:
        found = ", ".join(runtimes)
        raise BadInputError("--runtime", found, "one runtime with --by-cause, that of the run", "leave the others out")


def _refuse_a_scene(scene: str, options: dict[str, object]) -> None:
    """Raise BadInputError if a scene or an option of a scene is given with --hard-cases, which has its own inputs.

    `scene`: value of the argument. `options`: values by spelling; None for an option that is not given.
    """
    asked = [name for name, value in options.items() if value is not None]
    if scene != SCENE or asked:
        found = ", ".join(asked) or scene
        raise BadInputError("--hard-cases", f"{found} beside it", "it alone", "hard cases have their own inputs")


def _hard_cases(names: list[str], as_json: bool) -> bool:
    from rich.progress import Progress

    from trilane.apps.experiments.hard_cases import INPUTS, NETWORKS, SOURCE, UNIT, hard_cases
    from trilane.apps.experiments.hard_numbers import COUNT, hard_numbers

    console = stderr_console()
    with stdout_kept(), Progress(console=console, disable=not console.is_terminal) as progress:
        numbers = list(progress.track(hard_numbers(), COUNT, description="hard numbers"))
        total = len(NETWORKS) * len(INPUTS) * len(names)
        networks = list(progress.track(hard_cases(names), total, description="hard networks"))
    rows = numbers + networks
    if as_json:
        print_json({"schema": 1, "hard_cases": rows})
    else:
        sources = dict.fromkeys(row["source"] for row in numbers)
        marks = {source: f"[{number}]" for number, source in enumerate(sources, start=1)}
        _print_rows([{**row, "from": marks[row["source"]]} for row in numbers], NUMBER_COLUMNS)
        for source, mark in marks.items():
            print_line(f"{mark} bound: {source}")
        _print_rows(networks, HARD_COLUMNS)
        print_line(f"{UNIT}; bound: {SOURCE}")
    failed = [row for row in rows if not row["passed"]]
    for row in failed:
        say(f"{row['name']}: {row['verdict']}")
    return not failed


def _scene(scene: str, avatar: str | None, size: str | None, frames: int, names: list[str], as_json: bool) -> bool:
    from trilane.apps.experiments.scene_pictures import runtime_differences
    from trilane.stages.configure import configure, required_machine
    from trilane.stages.run_options import RunOptions

    checked = configure(RunOptions(scene=scene, avatar=avatar, size=size, runtime="ort"), Path.cwd())
    machine = required_machine()
    with stderr_console().status(f"{frames} frames on {', '.join(names)}"), stdout_kept():
        result = runtime_differences(checked, names, frames)
    if as_json:
        print_json({"schema": 1, **result, "machine": machine})
    else:
        _print_rows(result["rows"], ("first", "second", "mean", "largest", "worst_frame"))
        bounds = result["bounds"]
        stdout_console().print(
            f"of 255, over {len(result['frames'])} frames, {result['sources']['rows']}; "
            f"bounds: mean {bounds['mean']}, largest {bounds['largest']}"
        )
    out = [sentence for row in result["rows"] for sentence in _out_of_bounds(row, result["bounds"])]
    for sentence in out:
        say(sentence)
    return not out


def _out_of_bounds(row: dict[str, Any], bounds: dict[str, float]) -> Iterator[str]:
    for figure, bound in bounds.items():
        if row[figure] > bound:
            yield f"out of bounds: {row['first']} and {row['second']}, {figure} {row[figure]:.3g}, expected {bound:g}"


def _print_rows(rows: list[dict[str, Any]], columns: tuple[str, ...]) -> None:
    from rich.table import Table

    table = Table(*columns)
    for row in rows:
        table.add_row(*(_shown(row[key]) for key in columns))
    stdout_console().print(table)


def _shown(value: Any) -> str:
    if value is None:
        return "no number"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _show_by_cause(
    scene: str, request: dict[str, Any], frames: int, out: Path | None, lpips_weights: Path | None, as_json: bool
) -> None:
    """Measure the error of a run's frames, split by cause, and print the errors.

    `scene`: name or file of the scene. `request`: further options of the run, by name. `frames`: number of frames.
    `out`: folder for heat maps; None for no heat maps. `lpips_weights`: file with the weights of LPIPS; None if LPIPS
    is not measured. `as_json`: whether to print one JSON document, or tables for people.

    Raises BadInputError for wrong options or files, and MissingPartError if a part that the run needs is missing.
    """
    from trilane.apps.experiments.error_by_cause import error_by_cause
    from trilane.apps.experiments.picture_errors import Lpips
    from trilane.stages.configure import configure, required_machine
    from trilane.stages.run_options import RunOptions
    from trilane.writing import write_folder

    lpips = None if lpips_weights is None else Lpips(lpips_weights)
    checked = configure(RunOptions(scene=scene, **request), Path.cwd())
    machine = required_machine()
    if out is not None:
        with write_folder(out):
            pass  # raises an error about the folder before the long work
    with stdout_kept():
        result = error_by_cause(checked, frames, out, _tracked, lpips)
    if as_json:
        print_json({"schema": 1, **result, "machine": machine})
    else:
        _print_causes(result)
    if out is not None:
        say(f"heat maps: {out}")


def _tracked(numbers: Sequence[int]) -> Iterable[int]:
    from rich.progress import track

    console = stderr_console()
    return track(numbers, "frames", console=console, disable=not console.is_terminal)


def _print_causes(result: dict[str, Any]) -> None:
    from rich.table import Table

    console = stdout_console()
    config, sums, whole = result["config"], result["sums"], result["whole"]
    print_line(
        f"{config['scene']}, plan {config['plan']}, size {config['size']}, {config['runtime']}: "
        f"frames {', '.join(map(str, result['frames']))}; measured in this run",
    )
    shown = [name for name in HEADS if name != "lpips" or whole["lpips"] is not None]
    heads = (HEADS[name] for name in shown)
    alone = Table("each cause alone", *heads, "moved mm (px)", title="against the reference")
    for row in result["causes"]:
        moved = row["moved"]
        said = "" if moved is None else f"{moved['largest_mm']:.3g} ({moved['largest_px']:.3g})"
        alone.add_row(row["cause"], *_cells(row["alone"], shown), said)
    alone.add_row("the run", *_cells(whole, shown), "", style="bold")
    for name, figures in (result["truth"] or {}).items():
        alone.add_row(f"{name} against truth", *_cells(figures, shown), "")
    console.print(alone)
    if result["empty_frames"]:
        print_line(f"nobody is in view in frames {', '.join(map(str, result['empty_frames']))}")
    order = Table("in order", "MAE adds", "mean square adds", "share", "so far: MAE", "PSNR dB", "SSIM", "FLIP")
    for row in result["causes"]:
        adds, far = row["adds"], row["so_far"]
        share = adds["product"] / whole["square"] if whole["square"] else 0.0
        so_far = [_number(far[name]) for name in ("mae", "psnr_db", "ssim", "flip")]
        order.add_row(row["cause"], _number(adds["mae"]), _number(adds["square"]), f"{share:.1%}", *so_far)
    console.print(order)
    for line in _sums(sums, whole, result):
        print_line(line)


def _sums(sums: dict[str, Any], whole: dict[str, Any], result: dict[str, Any]) -> list[str]:
    left, alone = sums["left_in_order"], sums["left_alone"]
    return [
        f"in order, exact by construction: MAE {sums['in_order']['mae']:.4g} of {whole['mae']:.4g} (left "
        f"{left['mae']:.1e}), mean square {sums['in_order']['square']:.4g} of {whole['square']:.4g} "
        f"(left {left['square']:.1e})",
        f"alone, not exact: MAE {sums['alone']['mae']:.4g} (left {alone['mae']:.2g}), mean square "
        f"{sums['alone']['square']:.4g} (left {alone['square']:.2g})",
        f"the run's own frames differ from the sequence's end by {result['remainder']['mae']:.2g} (MAE); "
        "MAE in steps of 1/255, mean square in their squares",
        f"reference network: {result['network']}",
    ]


def _cells(figures: dict[str, float | None], shown: Sequence[str]) -> list[str]:
    return [_number(figures.get(name)) for name in shown]


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
