"""`trilane predict`: a configuration, or a table of them, on a chip that is described by a hardware profile.

Rule: this module reads options; every figure comes from `trilane.hw_profiles`, and `predict_output.py` shows them.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.beside import BesideOption, Joined, OnChip, SceneToPredict, TurnsOption, predict_pipelines
from trilane.apps.cli.commands import Commands, given
from trilane.apps.cli.console import stderr_console
from trilane.apps.cli.options import (
    ChannelsOption,
    EncoderOption,
    FixedSizeOption,
    JsonOption,
    NormOption,
    PerformanceProfileChoice,
    ProfileOption,
)
from trilane.apps.cli.predict_output import draw, show_answer, show_networks, show_table
from trilane.errors import BadInputError
from trilane.units import PerformanceProfile, UnitName

if TYPE_CHECKING:
    from trilane.hw_profiles.application import Plan, Variant
    from trilane.hw_profiles.network_work import Network
    from trilane.hw_profiles.rates import Wanted
    from trilane.hw_profiles.schema import EngineRuntime, Profile

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
HOST = "host"
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
#: How people call precisions -> as a hardware profile does.
PRECISIONS = {"w8a8": "int8", "int8": "int8", "float": "fp16", "fp16": "fp16", "fp32": "fp32"}

AvatarOption = Annotated[
    str | None, typer.Option(help="An avatar's network instead: `default`, or the folder of an avatar.")
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
    str,
    typer.Option("--policy", "--pipelining", help="reference, or a policy: sequential, pipelined, latest, deadline."),
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
    policy: PolicyOption = "reference",
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
    from trilane.hw_profiles.load import load_runnable

    networks = network or []
    bare = bool(networks) and not application
    _refuse_ignored(ctx, bare=bare)
    _check_application(application, len(networks))
    if (profile == HOST or bare) and "performance_profile" not in given(ctx):
        performance_profile = PerformanceProfile.BURST
    _check_governor(governor)
    if scene is not None or beside:
        chip_at = OnChip(profile, performance_profile, minutes, governor)
        predict_pipelines(scene, beside or [], given(ctx), chip_at, Joined(policy, edge, turns), trace, json)
        return
    wanted, shapes = _wanted(fps, power_limit_w), _shapes(input_shape or [], len(networks))
    chip, variant = load_runnable(profile), _variant(policy, edge, batch, fps)
    if table is not None:
        answers = _predict_table(chip, table, performance_profile, variant)
        show_table(chip.name, performance_profile, answers, json)
        return
    if bare:
        on = (_unit(runtime, "cpu"), _precision(precision), _engine_runtime(engine_runtime))
        over = (performance_profile, minutes, governor, wanted)
        show_networks(chip, over, _predict_networks(chip, networks, shapes, on, over), json)
        return
    chip, described = _network_of(chip, networks, shapes, avatar, layout, _unit(runtime), _precision(precision))
    plan = Plan(described or _reference(encoder, norm, size, channels, layout), _unit(runtime), variant, gpu_share)
    answer = _answer(chip, plan, performance_profile, minutes, governor, what_if, wanted)
    if plot is not None:
        draw(chip, plan, performance_profile, minutes or PLOT_MINUTES, governor, plot)
    if trace is not None:
        _write_trace(chip, plan, performance_profile, wanted, answer, trace)
    show_answer(answer, json)


def _refuse_ignored(ctx: typer.Context, *, bare: bool) -> None:
    """Raises BadInputError for options that another one leaves without effect. `bare`: a network by itself is asked."""
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


def _wanted(fps: float | None, power_limit_w: float | None) -> Wanted:
    from trilane.hw_profiles.application import LEAST_FPS, MOST_FPS
    from trilane.hw_profiles.rates import Wanted

    if fps is not None and not LEAST_FPS <= fps <= MOST_FPS:
        raise BadInputError("--fps", f"{fps:g}", f"{LEAST_FPS:g} to {MOST_FPS:g}")
    if power_limit_w is not None and not 0 < power_limit_w < float("inf"):
        raise BadInputError("--power-limit-w", f"{power_limit_w:g}", "watts above 0")
    return Wanted(fps, power_limit_w)


def _shapes(texts: list[str], networks: int) -> dict[str, tuple[int, ...]]:
    """Shapes of inputs by name."""
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


def _precision(text: str | None) -> str | None:
    if text is not None and text not in PRECISIONS:
        raise BadInputError("--precision", repr(text), "w8a8 (int8), float (fp16) or fp32")
    return None if text is None else PRECISIONS[text]


def _engine_runtime(text: str | None) -> EngineRuntime | None:
    from trilane.hw_profiles.schema import ENGINE_RUNTIMES

    found = next((runtime for runtime in ENGINE_RUNTIMES if runtime == text), None)
    if text is not None and found is None:
        raise BadInputError("--engine-runtime", repr(text), " or ".join(ENGINE_RUNTIMES))
    return found


def _check_governor(governor: str | None) -> None:
    from trilane.hw_profiles.throttling import GOVERNORS

    if governor is not None and governor not in GOVERNORS:
        raise BadInputError("--governor", repr(governor), " or ".join(GOVERNORS))


def _variant(policy: str, edge: str | None, batch: int, fps: float | None) -> Variant:
    from trilane.hw_profiles.application import REFERENCE, Variant

    if policy != "reference":
        return Variant(policy, edge or "double", batch, **({} if fps is None else {"fps": fps}))
    if edge not in (None, REFERENCE.edge):
        remedy = "choose a --policy of your own, such as pipelined"
        raise BadInputError("--edge", repr(edge), f"{REFERENCE.edge}, which the reference application has", remedy)
    return REFERENCE._replace(batch=batch)


def _unit(runtime: str, *more: str) -> Any:
    units = (*more, "gpu", "dsp")
    if runtime not in units:
        raise BadInputError("--runtime", repr(runtime), " or ".join(", ".join(units).rsplit(", ", 1)))
    return runtime


def _reference(encoder: str, norm: str, size: str, channels: int, layout: str) -> Network:
    from trilane.hw_profiles.configuration_table import spec_of
    from trilane.hw_profiles.reference_networks import reference_network

    cells = {"encoder": encoder, "norm": norm, "size": size, "channels": str(channels), "layout": layout}
    return reference_network(spec_of(cells, "options"))


def _predict_networks(
    chip: Profile,
    paths: list[Path],
    shapes: dict[str, tuple[int, ...]],
    on: tuple[UnitName, str | None, EngineRuntime | None],
    over: tuple[str, float, str | None, Wanted],
) -> list[dict[str, Any]]:
    """What is predicted of each network.

    `on`: unit, its precision and the runtime of its tensor engine. `over`: performance profile, minutes, governor, and
    what is wanted.
    """
    from trilane.hw_profiles.bare_network import in_precision, predict_network, under_runtime
    from trilane.hw_profiles.graph_file import read_graph
    from trilane.hw_profiles.network_work import constant_tensors

    graphs = [read_graph(path, shapes) for path in paths]
    inputs = {value.name for graph in graphs for value in graph.model.graph.input}
    if missing := [name for name in shapes if name not in inputs]:
        given = inputs.difference(*(constant_tensors(graph.model.graph) for graph in graphs))
        raise BadInputError("--input-shape", f"no input {missing[0]!r}", f"one of {', '.join(sorted(given))}")
    unit, precision, engine_runtime = on
    chips = [in_precision(chip, unit, graph.numbers, precision) for graph in graphs]
    chips = [under_runtime(each, unit, engine_runtime) for each in chips]
    return [predict_network(each, graph, unit, *over) for each, graph in zip(chips, graphs, strict=True)]


def _network_of(
    chip: Profile,
    networks: list[Path],
    shapes: dict[str, tuple[int, ...]],
    avatar: str | None,
    layout: str,
    unit: UnitName,
    precision: str | None,
) -> tuple[Profile, Network | None]:
    """The network of a file, or of an avatar, None when neither was named; and the chip in its precision."""
    from trilane.avatars.bundle import load_bundle
    from trilane.hw_profiles.bare_network import in_precision
    from trilane.hw_profiles.graph_file import read_graph
    from trilane.hw_profiles.image_network import image_network
    from trilane.hw_profiles.network_work import Network, count_work

    if layout not in ("packed", "split"):
        raise BadInputError("--layout", repr(layout), "packed or split")
    if networks:
        graph = read_graph(networks[0], shapes)
        return in_precision(chip, unit, graph.numbers, precision), image_network(graph, layout)
    chip = in_precision(chip, unit, "not said", precision)
    if avatar is None:
        return chip, None
    file = load_bundle(avatar or "default").read_network()
    _, height, width, channels = file.shape
    return chip, Network({"avatar": str(avatar)}, height, width, channels, layout, count_work(file.model))


def _answer(
    chip: Profile,
    plan: Plan,
    performance_profile: str,
    minutes: float,
    governor: str | None,
    what_if: bool,
    wanted: Wanted,
) -> dict[str, Any]:
    """The prediction, with the alternatives to it when they were asked for."""
    from trilane.hw_profiles import predict as predictions

    answer = predictions.predict(chip, plan, performance_profile, minutes, governor, wanted)
    if what_if:
        answer["alternatives"] = predictions.what_if(chip, plan.network, plan.runtime, performance_profile, wanted.fps)
    return answer


def _write_trace(
    chip: Profile, plan: Plan, performance_profile: str, wanted: Wanted, answer: dict[str, Any], target: Path
) -> None:
    """The simulated run that the prediction has its shares of time from, as a trace."""
    from trilane.apps.tracing.files import write_predicted
    from trilane.hw_profiles.predict import predicted_run

    done = predicted_run(chip, plan, performance_profile, wanted)
    write_predicted({chip.name: done}, {key: answer[key] for key in ("machine", "config")}, target)


def _predict_table(chip: Profile, path: Path, performance_profile: str, variant: Variant) -> list[dict[str, Any]]:
    """An answer for each row of the table."""
    from rich.progress import Progress

    from trilane.hw_profiles.configuration_table import read_table
    from trilane.hw_profiles.predict import predict_table

    rows = read_table(path)
    console = stderr_console()
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("predicting", total=len(rows))
        answers = predict_table(
            chip, rows, performance_profile, variant, lambda count: progress.update(task, completed=count)
        )
        return list(answers)
