"""`trilane predict`: a configuration, or a table of them, on a chip that is described by a hardware profile.

Rule: this module reads options; every figure comes from `trilane.hw_profiles`, and `predict_output.py` shows them.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.beside import BesideOption, Joined, OnChip, SceneToPredict, TurnsOption, predict_pipelines
from trilane.apps.cli.commands import Commands
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
from trilane.apps.cli.predict_output import draw, show_answer, show_table
from trilane.errors import BadInputError
from trilane.units import PerformanceProfile

if TYPE_CHECKING:
    from trilane.hw_profiles.application import Plan, Variant
    from trilane.hw_profiles.network_work import Network
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
  trilane predict --table rows.csv --json
  trilane predict portrait --beside default --beside network.onnx@30
"""
PLOT_MINUTES = 30.0
PACED = ("latest", "deadline")  # policies that release frames at a rate
HOST = "host"
OF_A_FILE = {"encoder", "norm", "size", "channels"}
#: Option: those that have no effect beside it.
IGNORED = {
    "avatar": OF_A_FILE,
    "network": OF_A_FILE,
    "table": OF_A_FILE
    | {"layout", "avatar", "network", "runtime", "minutes", "gpu_share", "governor", "what_if", "plot"},
}
WHY_IGNORED = {
    "avatar": "the avatar's network says so itself",
    "network": "the file says so itself",
    "table": "each row says so itself",
}

AvatarOption = Annotated[
    str | None, typer.Option(help="An avatar's network instead: `default`, or the folder of an avatar.")
]
NetworkOption = Annotated[Path | None, typer.Option(help="A quantised network instead: an ONNX file.")]
LayoutOption = Annotated[str, typer.Option(help="packed: one raster pass; split: one for every 4 channels.")]
UnitOption = Annotated[str, typer.Option("--runtime", help="Unit of the network: gpu or dsp.")]
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
    float | None, typer.Option("--fps", help="Frames released a second under latest and deadline; 30 if not given.")
]
GpuShareOption = Annotated[float, typer.Option(help="Share of the network that the GPU does for the DSP.")]
GovernorOption = Annotated[str | None, typer.Option(help="step_wise or power_allocator; the profile's if not given.")]
WhatIfOption = Annotated[bool, typer.Option("--what-if", help="Compare policies and edges for the same network.")]
PlotOption = Annotated[Path | None, typer.Option(help="Draw frame rate and temperature here (.png, .svg, .pdf).")]
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
    runtime: UnitOption = "dsp",
    minutes: MinutesOption = 0.0,
    policy: PolicyOption = "reference",
    edge: EdgeOption = None,
    batch: BatchOption = 1,
    fps: RateOption = None,
    gpu_share: GpuShareOption = 0.0,
    performance_profile: PerformanceProfileChoice = PerformanceProfile.SUSTAINED_HIGH_PERFORMANCE,
    governor: GovernorOption = None,
    what_if: WhatIfOption = False,
    plot: PlotOption = None,
    table: TableOption = None,
    json: JsonOption = False,
) -> None:
    """Predict frame time, idleness, heat and energy on a chip, with the error to expect.

    For the profile `host`, this machine, the performance profile is burst if none is given, as a run has no cap then.
    """
    from trilane.hw_profiles.application import Plan
    from trilane.hw_profiles.load import load_runnable

    _refuse_ignored(ctx)
    if profile == HOST and "performance_profile" not in _typed(ctx):
        performance_profile = PerformanceProfile.BURST  # as `trilane run` without a cap
    _check_governor(governor)
    if scene is not None or beside:
        chip_at = OnChip(profile, performance_profile, minutes, governor)
        predict_pipelines(scene, beside or [], _typed(ctx), chip_at, Joined(policy, edge, turns), json)
        return
    chip, variant = load_runnable(profile), _variant(policy, edge, batch, fps)
    if table is not None:
        answers = _predict_table(chip, table, performance_profile, variant)
        show_table(chip.name, performance_profile, answers, json)
        return
    file = _network_of(network, avatar, layout)
    plan = Plan(file or _reference(encoder, norm, size, channels, layout), _unit(runtime), variant, gpu_share)
    answer = _answer(chip, plan, performance_profile, minutes, governor, what_if)
    if plot is not None:
        draw(chip, plan, performance_profile, minutes or PLOT_MINUTES, governor, plot)
    show_answer(answer, json)


def _refuse_ignored(ctx: typer.Context) -> None:
    """Raises BadInputError for options that another one leaves without effect."""
    typed = _typed(ctx)
    for option, others in IGNORED.items():
        if option in typed and (useless := typed & others):
            names = ", ".join(sorted(f"--{name.replace('_', '-')}" for name in useless))
            raise BadInputError("options", f"{names} beside --{option}", "one or the other", WHY_IGNORED[option])


def _typed(ctx: typer.Context) -> set[str]:
    """The parameters that the command line gives."""
    sources = {name: ctx.get_parameter_source(name) for name in ctx.params}
    return {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}


def _check_governor(governor: str | None) -> None:
    from trilane.hw_profiles.throttling import GOVERNORS

    if governor is not None and governor not in GOVERNORS:
        raise BadInputError("--governor", repr(governor), " or ".join(GOVERNORS))


def _variant(policy: str, edge: str | None, batch: int, fps: float | None) -> Variant:
    from trilane.hw_profiles.application import REFERENCE, Variant

    if fps is not None and policy not in PACED:
        remedy = "the others take a frame as soon as they can"
        raise BadInputError("options", f"--fps with --policy {policy}", f"--policy {' or '.join(PACED)}", remedy)
    if policy != "reference":
        return Variant(policy, edge or "double", batch, **({} if fps is None else {"fps": fps}))
    if edge not in (None, REFERENCE.edge):
        remedy = "choose a --policy of your own, such as pipelined"
        raise BadInputError("--edge", repr(edge), f"{REFERENCE.edge}, which the reference application has", remedy)
    return REFERENCE._replace(batch=batch)


def _unit(runtime: str) -> Any:
    if runtime not in ("gpu", "dsp"):
        raise BadInputError("--runtime", repr(runtime), "gpu or dsp")
    return runtime


def _reference(encoder: str, norm: str, size: str, channels: int, layout: str) -> Network:
    from trilane.hw_profiles.configuration_table import spec_of
    from trilane.hw_profiles.reference_networks import reference_network

    cells = {"encoder": encoder, "norm": norm, "size": size, "channels": str(channels), "layout": layout}
    return reference_network(spec_of(cells, "options"))


def _network_of(path: Path | None, avatar: str | None, layout: str) -> Network | None:
    """The network of a file, or of an avatar; None when neither was named."""
    from trilane.avatars.bundle import load_bundle
    from trilane.avatars.network_file import read_network
    from trilane.hw_profiles.network_work import Network, count_work

    if path is None and avatar is None:
        return None
    if path is not None and avatar is not None:
        raise BadInputError("options", "--network and --avatar", "one of them")
    if layout not in ("packed", "split"):
        raise BadInputError("--layout", repr(layout), "packed or split")
    file = read_network(path) if path is not None else load_bundle(avatar or "default").read_network()
    _, height, width, channels = file.shape
    facts = {"network": str(path)} if path is not None else {"avatar": str(avatar)}
    return Network(facts, height, width, channels, layout, count_work(file.model))


def _answer(
    chip: Profile, plan: Plan, performance_profile: str, minutes: float, governor: str | None, what_if: bool
) -> dict[str, Any]:
    """The prediction, with the alternatives to it when they were asked for."""
    from trilane.hw_profiles import predict as predictions

    answer = predictions.predict(chip, plan, performance_profile, minutes, governor)
    if what_if:
        answer["alternatives"] = predictions.what_if(chip, plan.network, plan.runtime, performance_profile)
    return answer


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
