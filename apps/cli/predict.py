"""`trilane predict`: a configuration, or a table of them, on a chip that is described by a hardware profile.

Rule: this module reads options; every figure comes from `trilane.hw_profiles`, and `predict_output.py` shows them.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import (
    ChannelsOption,
    Commands,
    EncoderOption,
    FixedSizeOption,
    JsonOption,
    NormOption,
    PerformanceProfileChoice,
    ProfileOption,
    given,
)
from trilane.apps.cli.console import say, stderr_console
from trilane.apps.cli.predict_output import draw, show_answer, show_networks, show_table
from trilane.apps.cli.predict_pipelines import (
    BesideOption,
    ChipOptions,
    SceneToPredict,
    SchedulerOptions,
    TurnsOption,
    predict_pipelines,
)
from trilane.apps.predict.asked_prediction import (
    answer_of,
    check_governor,
    engine_runtime_of,
    network_of,
    precision_of,
    predict_networks,
    reference_of,
    unit_of,
    usual_cap,
    usual_policy,
    variant_of,
    wanted_of,
)
from trilane.errors import BadInputError
from trilane.units import PerformanceProfile

if TYPE_CHECKING:
    from trilane.hw_profiles.application import Plan, Variant
    from trilane.hw_profiles.rates import Wanted
    from trilane.hw_profiles.schema import Profile

app = Commands()

EPILOG = """\b
Examples:
  trilane predict --encoder resnet18 --size 512 --channels 16
  trilane predict --runtime gpu --norm instance --minutes 30
  trilane predict --policy pipelined --edge double --what-if
  trilane predict --policy latest --fps 24
  trilane predict --performance-profile burst --minutes 30 --plot temperature.svg
  trilane predict --avatar default --runtime gpu
  trilane predict --policy latest --fps 24 --trace predicted.pftrace
  trilane predict --network midas.onnx --network unet.onnx --profile snapdragon-8-gen-3
  trilane predict --network net.onnx --input-shape image=1x3x224x224 --precision w8a8
  trilane predict --network net.onnx --engine-runtime qnn_dlc --performance-profile sustained_high_performance
  trilane predict --network net.onnx --fps 30 --minutes 30
  trilane predict --network net.onnx --power-limit-w 3
  trilane predict --network unet.onnx --application --fps 30 --what-if
  trilane predict --table rows.csv --json
  trilane predict portrait --beside default --beside network.onnx@30
"""
PLOT_MINUTES = 30.0
OF_A_FILE = {"encoder", "norm", "size", "channels"}
OF_THE_APPLICATION = {"layout", "policy", "edge", "batch", "gpu_share", "what_if", "plot", "trace"}
#: Option: those that have no effect beside it.
IGNORED = {
    "avatar": OF_A_FILE | {"input_shape"},
    "network": OF_A_FILE | {"avatar"},
    "table": OF_A_FILE
    | {"layout", "avatar", "network", "application", "runtime", "minutes", "gpu_share", "governor", "what_if", "plot"}
    | {"fps", "power_limit_w", "precision", "input_shape", "trace"},
}
WHY_IGNORED = {
    "avatar": "the avatar's network says so itself",
    "network": "the file says so itself",
    "table": "each row says so itself",
}

AvatarOption = Annotated[
    str | None, typer.Option(help="An avatar's network instead: `default`, `hiker`, or the folder of an avatar.")
]
NetworkOption = Annotated[
    list[Path] | None,
    typer.Option(help="A network by itself, without raster and composite: an ONNX file. May be given again."),
]
ApplicationOption = Annotated[
    bool, typer.Option("--application", help="The application with the --network instead of the network by itself.")
]
ShapeOption = Annotated[
    list[str] | None,
    typer.Option("--input-shape", help="Shape of an input of a --network: NAME=1x3x224x224. May be given again."),
]
PrecisionOption = Annotated[
    str | None, typer.Option(help="w8a8 (int8), float (fp16) or fp32; as the network says and its unit has it.")
]
EngineRuntimeOption = Annotated[
    str | None,
    typer.Option(help="Of a tensor engine that runs a --network by itself: tflite (if not given) or qnn_dlc."),
]
PowerOption = Annotated[
    float | None, typer.Option("--power-limit-w", help="Also the highest rate within so many watts of the device.")
]
LayoutOption = Annotated[str, typer.Option(help="packed: one raster pass; split: one for every 4 channels.")]
UnitOption = Annotated[
    str, typer.Option("--runtime", help="Unit of the network: gpu or dsp; cpu too for a --network by itself.")
]
MinutesOption = Annotated[float, typer.Option(help="Virtual minutes with heat; 0: settled, without heat.")]
PolicyOption = Annotated[
    str | None,
    typer.Option(
        "--policy",
        "--pipelining",
        help="reference (if not given), or sequential, pipelined (if not given, on host), latest, deadline.",
    ),
]
EdgeOption = Annotated[
    str | None, typer.Option(help="Buffers between stages: single, double (if not given), triple, fifo:N, orphan.")
]
BatchOption = Annotated[int, typer.Option(help="Frames per job of the network.")]
RateOption = Annotated[
    float | None,
    typer.Option("--fps", help="A rate: does it hold, at which power? latest and deadline have 30 without."),
]
GpuShareOption = Annotated[float, typer.Option(help="Share of the network that the GPU does for the DSP.")]
GovernorOption = Annotated[str | None, typer.Option(help="step_wise or power_allocator; the profile's if not given.")]
WhatIfOption = Annotated[
    bool, typer.Option("--what-if", help="Compare policies and edges for the same network, at --fps all.")
]
PlotOption = Annotated[Path | None, typer.Option(help="Draw frame rate and temperature here (.png, .svg, .pdf).")]
TraceOption = Annotated[
    Path | None, typer.Option("--trace", help="Write the simulated run here, for ui.perfetto.dev (docs/trace.md).")
]
TableOption = Annotated[Path | None, typer.Option(help="CSV of configurations: one answer per row.")]


@app.command(epilog=EPILOG)
def predict(
    ctx: typer.Context,
    scene: SceneToPredict = None,
    beside: BesideOption = None,
    turns: TurnsOption = "round-robin",
    profile: ProfileOption = "snapdragon-888",
    encoder: EncoderOption = "resnet18",
    norm: NormOption = "batch",
    size: FixedSizeOption = "512",
    channels: ChannelsOption = 16,
    layout: LayoutOption = "packed",
    avatar: AvatarOption = None,
    network: NetworkOption = None,
    application: ApplicationOption = False,
    input_shape: ShapeOption = None,
    precision: PrecisionOption = None,
    engine_runtime: EngineRuntimeOption = None,
    runtime: UnitOption = "dsp",
    minutes: MinutesOption = 0.0,
    policy: PolicyOption = None,
    edge: EdgeOption = None,
    batch: BatchOption = 1,
    fps: RateOption = None,
    power_limit_w: PowerOption = None,
    gpu_share: GpuShareOption = 0.0,
    performance_profile: PerformanceProfileChoice = PerformanceProfile.SUSTAINED_HIGH_PERFORMANCE,
    governor: GovernorOption = None,
    what_if: WhatIfOption = False,
    plot: PlotOption = None,
    trace: TraceOption = None,
    table: TableOption = None,
    json: JsonOption = False,
) -> None:
    """Predict frame time, idleness, heat and energy on a chip, with the error to expect.

    Without --network, or with --application: the avatar's application. With --network: each network by itself.

    The performance profile is burst, if none is given, for a network by itself, as published latencies are, and for the
    profile `host`, this machine, where a run has no cap.
    """
    from trilane.hw_profiles.application import Plan
    from trilane.hw_profiles.profile_files import load_runnable

    networks = network or []
    bare = bool(networks) and not application
    _refuse_ignored(ctx, bare=bare)
    _check_application(application, len(networks))
    if "performance_profile" not in given(ctx):
        performance_profile = PerformanceProfile(usual_cap(profile, bare=bare))
    check_governor(governor)
    if scene is not None or beside:
        chip_at = ChipOptions(profile, performance_profile, minutes, governor)
        predict_pipelines(
            scene, beside or [], given(ctx), chip_at, SchedulerOptions(policy or "", edge, turns), trace, json
        )
        return
    wanted, shapes = wanted_of(fps, power_limit_w), _shapes(input_shape or [], len(networks))
    chip, variant = load_runnable(profile), variant_of(policy or usual_policy(profile), edge, batch, fps)
    if table is not None:
        answers = _predict_table(chip, table, performance_profile, variant)
        show_table(chip.name, performance_profile, answers, json)
        return
    if bare:
        on = (unit_of(runtime, "cpu"), precision_of(precision), engine_runtime_of(engine_runtime))
        over = (performance_profile, minutes, governor, wanted)
        show_networks(chip, over, predict_networks(chip, networks, shapes, on, over, say), json)
        return
    chip, described = network_of(chip, networks, shapes, avatar, layout, unit_of(runtime), precision_of(precision), say)
    plan = Plan(described or reference_of(encoder, norm, size, channels, layout), unit_of(runtime), variant, gpu_share)
    answer = answer_of(chip, plan, performance_profile, minutes, governor, what_if, wanted)
    if plot is not None:
        draw(chip, plan, performance_profile, minutes or PLOT_MINUTES, governor, plot)
    if trace is not None:
        _write_trace(chip, plan, performance_profile, wanted, answer, trace)
    show_answer(answer, json)


def _refuse_ignored(ctx: typer.Context, *, bare: bool) -> None:
    """Raises BadInputError for options that another one leaves without effect. `bare`: whether networks are alone."""
    typed = given(ctx)
    for option, others in IGNORED.items():
        if option in typed and (useless := typed & others):
            names = ", ".join(sorted(f"--{name.replace('_', '-')}" for name in useless))
            raise BadInputError("options", f"{names} beside --{option}", "one or the other", WHY_IGNORED[option])
    if "engine_runtime" in typed and not bare:
        remedy = "the application runs as its profile says"
        raise BadInputError("options", "--engine-runtime", "a --network by itself beside it", remedy)
    if bare and "table" not in typed and (useless := typed & OF_THE_APPLICATION):
        names = ", ".join(sorted(f"--{name.replace('_', '-')}" for name in useless))
        remedy = "they are of the application: add --application for it with this network"
        raise BadInputError("options", f"{names} with a network by itself", "it without them", remedy)


def _check_application(application: bool, networks: int) -> None:
    if application and networks != 1:
        remedy = "it says that the application runs the network of the file"
        raise BadInputError("options", f"--application with {networks} networks", "one --network", remedy)


def _shapes(texts: list[str], networks: int) -> dict[str, tuple[int, ...]]:
    """Read the shapes of inputs, by name."""
    if texts and not networks:
        raise BadInputError("options", "--input-shape without --network", "a network whose input it is")
    shapes = {}
    for text in texts:
        found = re.fullmatch(r"(.+)=(\d{1,9}(?:x\d{1,9})*)", text)
        if found is None or 0 in (sizes := tuple(map(int, found[2].split("x")))):
            raise BadInputError("--input-shape", repr(text), "a name and sizes, such as image=1x3x224x224")
        if found[1] in shapes:
            raise BadInputError("--input-shape", f"{found[1]!r} twice", "each input once")
        shapes[found[1]] = sizes
    return shapes


def _write_trace(
    chip: Profile, plan: Plan, performance_profile: str, wanted: Wanted, answer: dict[str, Any], target: Path
) -> None:
    """Write the simulated run, from which the prediction has its shares of time, as a trace."""
    from trilane.apps.explain.trace import write_predicted
    from trilane.hw_profiles.predict import predicted_run

    done = predicted_run(chip, plan, performance_profile, wanted)
    write_predicted({chip.name: done}, {key: answer[key] for key in ("machine", "config")}, target)


def _predict_table(chip: Profile, path: Path, performance_profile: str, variant: Variant) -> list[dict[str, Any]]:
    """Return an answer for each row of the table."""
    from rich.progress import Progress

    from trilane.hw_profiles.predict import predict_table
    from trilane.hw_profiles.reference_networks import read_table

    rows = read_table(path)
    console = stderr_console()
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("predicting", total=len(rows))
        answers = predict_table(
            chip, rows, performance_profile, variant, lambda count: progress.update(task, completed=count)
        )
        return list(answers)
