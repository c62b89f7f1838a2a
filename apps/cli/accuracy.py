"""`trilane accuracy`: how far runtimes are from each other on a scene; what is left of numbers on hard cases.

Rule: this module reads options and shows results; every figure comes from `trilane.apps.experiments`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from trilane.apps.cli.accuracy_by_cause import Files, show_by_cause
from trilane.apps.cli.commands import Commands
from trilane.apps.cli.console import print_json, stderr_console, stdout_console, stdout_kept
from trilane.apps.cli.options import JsonOption, SceneArgument, SceneAvatarOption, SceneSizeOption
from trilane.errors import BadInputError

app = Commands()

EPILOG = """\b
Examples:
  trilane accuracy
  trilane accuracy closeup --frames 20 --runtime ort --runtime openvino
  trilane accuracy closeup --by-cause --frames 2 --out errors
  trilane accuracy --hard-cases --json
"""
OUT_OF_BOUNDS = 1
SCENE, FRAMES, BY_CAUSE_FRAMES = "default", 8, 2
NUMBER_COLUMNS = ("name", "error", "bound", "unit", "from", "verdict")
HARD_COLUMNS = ("name", "error", "bound", "constant_error", "shifted_error", "swapped_error", "source", "verdict")


@app.command(epilog=EPILOG)
def accuracy(
    scene: SceneArgument = SCENE,
    avatar: SceneAvatarOption = None,
    size: SceneSizeOption = None,
    frames: Annotated[
        int | None, typer.Option(help="How many frames, evenly spread over the scene.  [default: 8; by cause: 2]")
    ] = None,
    runtime: Annotated[
        list[str] | None,
        typer.Option(
            help="ort, openvino, qnn or cuda, once for each; all that are installed if none, on hard cases but the "
            "emulator qnn, which takes minutes."
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
        typer.Option(help="With --by-cause: a file of LPIPS' weights, which is said then.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare the runtimes with each other on a scene's frames, or hard cases with their bounds.

    Exit code 1 when a figure is out of its bound, or when a wrong picture would keep a hard network's bound: one of a
    single colour, one shifted by 8 pixels, or one with red and blue exchanged.
    """
    from trilane.stages.dsp.runtime import installed

    names = list(runtime or installed())
    if not by_cause:
        _refuse_without_by_cause({"--out": out, "--lpips-weights": lpips_weights})
    if by_cause:
        _refuse_other_comparisons(hard_cases, runtime or [])
        asked = {"avatar": avatar, "size": size, "runtime": runtime[0] if runtime else "auto"}
        show_by_cause(scene, asked, BY_CAUSE_FRAMES if frames is None else frames, Files(out, lpips_weights), as_json)
        return
    if hard_cases:
        _refuse_a_scene(scene, {"--avatar": avatar, "--size": size, "--frames": frames})
        passed = _hard_cases([name for name in names if runtime or name != "qnn"], as_json)
    else:
        passed = _scene(scene, avatar, size, FRAMES if frames is None else frames, names, as_json)
    if not passed:
        raise typer.Exit(OUT_OF_BOUNDS)


def _refuse_without_by_cause(options: dict[str, Path | None]) -> None:
    """Raises BadInputError for options that only --by-cause knows."""
    for name, value in options.items():
        if value is not None:
            raise BadInputError(name, str(value), "it beside --by-cause", "the other comparisons do not use it")


def _refuse_other_comparisons(hard_cases: bool, runtimes: list[str]) -> None:
    """Raises BadInputError for what cannot stand beside --by-cause: it looks at one run."""
    if hard_cases:
        raise BadInputError("--by-cause", "--hard-cases beside it", "one of them")
    if len(runtimes) > 1:
        found = ", ".join(runtimes)
        raise BadInputError("--runtime", found, "one runtime with --by-cause, that of the run", "leave the others out")


def _refuse_a_scene(scene: str, options: dict[str, object]) -> None:
    """Hard cases bring their own inputs. Raises BadInputError for what they would leave aside."""
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
        marks = {source: f"[{number}]" for number, source in enumerate(dict.fromkeys(_sources(numbers)), start=1)}
        _print([{**row, "from": marks[row["source"]]} for row in numbers], NUMBER_COLUMNS)
        for source, mark in marks.items():
            stdout_console().print(f"{mark} bound: {source}", soft_wrap=True, markup=False)
        _print(networks, HARD_COLUMNS)
        stdout_console().print(f"{UNIT}; bound: {SOURCE}", soft_wrap=True, markup=False)
    failed = [row for row in rows if not row["passed"]]
    for row in failed:
        stderr_console().print(f"{row['name']}: {row['verdict']}", soft_wrap=True, markup=False)
    return not failed


def _sources(rows: list[dict[str, Any]]) -> Iterator[str]:
    return (row["source"] for row in rows)


def _scene(scene: str, avatar: str | None, size: str | None, frames: int, names: list[str], as_json: bool) -> bool:
    from trilane.apps.experiments.accuracy import runtime_differences
    from trilane.stages.configure import configure, required_machine
    from trilane.stages.run_options import RunOptions

    checked = configure(RunOptions(scene=scene, avatar=avatar, size=size, runtime="ort"), Path.cwd())
    machine = required_machine()
    with stderr_console().status(f"{frames} frames on {', '.join(names)}"), stdout_kept():
        result = runtime_differences(checked, names, frames)
    if as_json:
        print_json({"schema": 1, **result, "machine": machine})
    else:
        _print(result["rows"], ("first", "second", "mean", "largest", "worst_frame"))
        bounds = result["bounds"]
        stdout_console().print(
            f"of 255, over {len(result['frames'])} frames, {result['sources']['rows']}; "
            f"bounds: mean {bounds['mean']}, largest {bounds['largest']}"
        )
    out = [sentence for row in result["rows"] for sentence in _out_of_bounds(row, result["bounds"])]
    for sentence in out:
        stderr_console().print(sentence, soft_wrap=True, markup=False)
    return not out


def _out_of_bounds(row: dict[str, Any], bounds: dict[str, float]) -> Iterator[str]:
    for figure, bound in bounds.items():
        if row[figure] > bound:
            yield f"out of bounds: {row['first']} and {row['second']}, {figure} {row[figure]:.3g}, expected {bound:g}"


def _print(rows: list[dict[str, Any]], columns: tuple[str, ...]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(*columns)
    for row in rows:
        table.add_row(*(Text(_shown(row[key])) for key in columns))
    stdout_console().print(table)


def _shown(value: Any) -> str:
    if value is None:
        return "no number"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
