"""`trilane bench`: measurements of this machine's speed and exactness, by name.

Rule: a bench is a line of `BENCHES` and a module with a function `measure`. The parameters of `measure` are the
command's options, whose types follow from their defaults. The docstrings of the module and of `measure` give the help.
`MEANINGS` explains each option for all benches. If a bench has an entry of its own for an option, this entry is used.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import print_json, stderr_console, stdout_console, stdout_kept
from trilane.apps.cli.main import lazy_group
from trilane.apps.predict.predict_options import ENCODER_HELP, NORM_HELP
from trilane.scheduler.policy import POLICY_WORDS
from trilane.stages.run_options import AS_IT_IS, CHANNELS_HELP, RUNTIME_HELP, SIZE_HELP, WIDTH_HELP
from trilane.transport.slots import EDGE_WORDS
from trilane.units import AVATARS_HELP, CALIBRATION_METHODS, RUNTIME_WORDS, either

#: Bench -> its module, and its line in `trilane bench --help`.
BENCHES = {
    "raster": ("trilane.bench.raster", "One packed pass against a pass for every four channels and a permute."),
    "readback": ("trilane.bench.readback", "Variants of moving pixels between GPU and slot."),
    "several": ("trilane.bench.several", "Image quality that an avatar loses because others share its tensor."),
    "filters": ("trilane.bench.filters", "MIP maps and anisotropy of the neural texture: cost and difference."),
    "infer": ("trilane.bench.infer", "A network, run continuously, on each runtime and in FP32."),
    "peers": ("trilane.bench.peers", "Trilane's runtimes beside the libraries' own examples and benchmark_app."),
    "roofline": ("trilane.bench.roofline", "The machine's INT8 and FP32 peaks and its memory bandwidth."),
    "pipeline": ("trilane.bench.pipeline", "Efficiency, idleness and gain of policies, edges and cores."),
    "placement": (
        "trilane.bench.placement",
        "Every placement of the units on the cores, compared with the chosen placement.",
    ),
    "scenario": ("trilane.bench.scenario", "MLPerf's load patterns, evaluated here and by MLCommons LoadGen."),
    "handoff": ("trilane.bench.handoff", "A slot from process to process, beside pickling, copying and iceoryx2."),
    "scheduler": ("trilane.bench.scheduler", "The scheduler in virtual time beside SimPy, and its determinism."),
    "planner": ("trilane.bench.planner", "Planned work against a fixed square: speed and image error."),
    "predict": (
        "trilane.apps.experiments.host_predicted",
        "Predictions for this machine, beside real runs and calls.",
    ),
    "sizes": ("trilane.apps.experiments.error_by_size", "What a speed costs in image error, by size and runtime."),
    "flicker": (
        "trilane.apps.experiments.flicker",
        "How much the error changes from frame to frame, by runtime, calibration and texture filter.",
    ),
}
METAVARS: dict[type, str] = {int: "N", float: "X", str: "TEXT"}
#: Largest number of columns. A table with more columns is printed transposed.
MOST_COLUMNS = 9
EPILOG = """\b
Examples:
  trilane bench raster --size 512 --channels 16 --json
  trilane bench several --views 20
  trilane bench pipeline --avatar default --avatar resnet18 --size 512x512
  trilane bench handoff
"""
FIXED_SIZE = "Tensor size in pixels: HEIGHTxWIDTH."
SQUARE_SIZE = "Side of the square tensor in pixels."
NAMED_RUNTIME = f"{RUNTIME_WORDS}."
DRIVER_THREADS = "Threads of the software OpenGL driver."
#: Option, or bench and option -> its line in `--help`.
MEANINGS = {
    "avatar": f"{AVATARS_HELP[:-1]}, or `resnet18`: the full-width network, untrained.",
    "avatars": "How many avatars share the tensor.",
    "beside": "A second avatar, which runs at the same time; both runs are compared with virtual time.",
    "beside_size": "Tensor size of the second avatar in pixels: HEIGHTxWIDTH, or a side.",
    "batch": "Frames inferred at once.",
    "calibration": f"Network of the avatar: {AS_IT_IS}, or quantised again by {either(CALIBRATION_METHODS)}.",
    "channels": CHANNELS_HELP,
    "cores": "Cores of the three units together; 0: all that this process may use.",
    "edge": f"Buffers between stages: {EDGE_WORDS}.",
    "encoder": ENCODER_HELP,
    "events": "Folder of a run, or its events.jsonl, to be replayed.",
    "frames": "Frames of each run.",
    "predict avatar": AVATARS_HELP,
    "predict frames": "Frames of each run, at least 100.",
    "predict seconds": "How long each network is called by itself.",
    "predict width": "Width of a further network, untrained; 64 is full.",
    "handoff frames": "Hand-overs in each round, of each variant and size.",
    "judge": "Evaluator of the run: trilane or loadgen.",
    "kib": "Size of the slot in KiB: 256, 1024, 4096 or 16384.",
    "limit_ms": "Longest latency that counts as in time, in the server scenario.",
    "finalists": "How many of the fastest placements are measured again, besides the chosen and the rule's placement.",
    "further": "Rounds in which only the finalists are measured, after the rounds of all placements.",
    "placement frames": "Frames of each whole run, at least 20.",
    "placement runs": "Whole runs of the chosen placement and of the rule's.",
    "margins": "Pixels of the tensor between two avatars.",
    "minutes": "Virtual minutes.",
    "network": "An .onnx file or an avatar, at its own size; if none, one of --encoder, --norm, --width and --size.",
    "norm": NORM_HELP,
    "period": "Seconds for which a runtime runs before the next runtime's turn.",
    "policy": f"{POLICY_WORDS}.",
    "rate": "Queries a second of the server scenario.",
    "repeats": "How often each variant runs.",
    "runtime": RUNTIME_HELP,
    "infer runtime": NAMED_RUNTIME,
    "samples": "Frames of a multi-stream query.",
    "out": "Folder for sheets of the pictures: full, fixed, planned; below: the truth, and differences times 8.",
    "pictures": "Frames whose image error is measured, evenly spread over the scene.",
    "planner frames": "Frames of each run, at least 20, evenly spread over the scene; all of a shorter one.",
    "sizes frames": "Frames whose error is measured, evenly spread over the scene.",
    "sizes rounds": "How often each frame is timed, by every size on every runtime in turn.",
    "sizes runtime": NAMED_RUNTIME,
    "flicker frames": "Frames that follow each other, from the first on.",
    "flicker runtime": NAMED_RUNTIME,
    "scene": "A bundled scene, or a scene file.",
    "scenario": "single-stream, multi-stream, server or offline.",
    "seconds": "How long each run lasts.",
    "infer seconds": "How long each network runs on each runtime.",
    "peers seconds": "How long each variant runs in a round.",
    "seed": "Seed of the random moments.",
    "seeds": "How many seeds are compared.",
    "size": SIZE_HELP,
    "sizes": "Sides of square tensors in pixels.",
    "spin": "Let the runtime's threads spin between jobs.",
    "texture_filter": "Of the neural texture: linear, mipmap or anisotropic.",
    "threads": "Threads of the runtime; 0: one for each core that this process may use.",
    "raster threads": DRIVER_THREADS,
    "readback threads": DRIVER_THREADS,
    "rounds": "Rounds: each runs every variant once.",
    "video": "Encode the video, as a run does.",
    "views": "How many moments of the motion.",
    "width": WIDTH_HELP,
    "infer size": FIXED_SIZE,
    "peers size": FIXED_SIZE,
    "raster size": SQUARE_SIZE,
}


def bench_command(name: str) -> Any:
    """Return the command of bench `name`. The command has an option for each parameter of the bench's `measure`."""
    module = importlib.import_module(BENCHES[name][0])
    measure = module.measure

    def run(json: bool, **asked: Any) -> None:
        show(name, measure, asked, json)

    asked = {p.name: (_option(name, p), p.default) for p in inspect.signature(measure).parameters.values()}
    options = {"json": (JsonOption, False), **asked}
    described: Any = run
    described.__signature__ = inspect.Signature(
        [
            inspect.Parameter(option, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
            for option, (kind, default) in options.items()
        ]
    )
    single = Commands()
    single.command(name, help=_help(name, module))(described)
    return typer.main.get_command(single)


app = Commands(
    cls=lazy_group({name: line for name, (_, line) in BENCHES.items()}, bench_command),
    no_args_is_help=True,
    epilog=EPILOG,
    help="Measure this machine; each result includes facts about it.",
)


@app.callback()
def bench() -> None:
    """Measure this machine; each result includes facts about it."""


def _help(name: str, module: ModuleType) -> str:
    """Return the help of bench `name`: its line in `BENCHES`, a question and an answer.

    The question is the first paragraph of the docstring of `module`. The answer is the docstring of `measure` up to the
    word `Raises`.
    """
    question = (inspect.getdoc(module) or "").split("\n\n")[0]
    answer = (inspect.getdoc(module.measure) or "").partition("Raises ")[0].rstrip()
    return f"{BENCHES[name][1]}\n\n{question}\n\n{answer}"


def _option(bench: str, parameter: inspect.Parameter) -> Any:
    """Return Typer's option for `parameter`, which is a parameter of `measure` in the module of bench `bench`.

    The option has the type of the parameter's default. If the default is a tuple, the option may be given several
    times, once for each value.
    """
    default = parameter.default
    several = isinstance(default, tuple)
    kind = type(default[0] if several else default)
    text = meaning(bench, parameter.name) + (" Once for each." if several else "")
    about = typer.Option(help=text, metavar=None if kind is bool else METAVARS[kind])
    return Annotated[list[kind] if several else kind, about]  # type: ignore[valid-type]


def show(name: str, measure: Callable[..., Mapping[str, Any]], asked: Mapping[str, Any], as_json: bool) -> None:
    """Run a bench and print its result with facts about the machine.

    `name`: name of the bench. `measure`: function of its module. `asked`: value of each option, by name.
    `as_json`: whether to print one JSON document, or tables for people.
    """
    from trilane.bench import check_limits
    from trilane.stages.machine_facts import machine_facts

    check_limits(asked)
    with stderr_console().status(f"measuring {name}"), stdout_kept():
        result = dict(measure(**asked))
    document = {"bench": name, **result, "machine": machine_facts(result.get("driver"))}
    if as_json:
        print_json(document)
        return
    rows = result.pop("rows", None) or result.pop("scenes", [])
    console = stdout_console()
    if rows:
        console.print(_table([flat(row) for row in rows]))
    for key, value in flat(result).items():
        if value and isinstance(value, list) and isinstance(value[0], Mapping):
            console.print(f"{key}:")
            console.print(_table([flat(row) for row in value]))
        else:
            console.print(f"{key}: {_text(value)}", soft_wrap=True)
    console.print(f"cpu: {document['machine']['cpu']['model']}, {document['machine']['cpu']['cores']} cores")


def flat(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return `data` without nested mappings. The key of an inner value is the outer key, a dot and the inner key."""
    joined: dict[str, Any] = {}
    for key, value in data.items():
        inner = flat(value) if isinstance(value, Mapping) else None
        joined.update({key: value} if inner is None else {f"{key}.{name}": each for name, each in inner.items()})
    return joined


def _table(rows: list[dict[str, Any]]) -> Any:
    from rich.table import Table

    columns = list(dict.fromkeys(key for row in rows for key in row))
    if len(columns) > MOST_COLUMNS:
        turned = Table(show_header=False)  # Rich adds a column for each cell of the longest row
        for column in columns:
            turned.add_row(column, *(_text(row.get(column, "")) for row in rows))
        return turned
    table = Table(*columns)
    for row in rows:
        table.add_row(*(_text(row.get(column, "")) for column in columns))
    return table


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def meaning(bench: str, option: str) -> str:
    """Return the line in `--help` for `option` of `bench`. Raises KeyError if `MEANINGS` has no such line."""
    return MEANINGS.get(f"{bench} {option}") or MEANINGS[option]
