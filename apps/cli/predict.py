"""`trilane predict`: a configuration, or a table of them, on a chip that is described by a hardware profile.

Rule: this module reads options and shows results; every figure comes from `trilane.hw_profiles`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.console import JsonOption, print_json, stderr_console, stdout_console
from trilane.errors import BadInputError
from trilane.units import BURST, SUSTAINED

if TYPE_CHECKING:
    from trilane.hw_profiles.application import Plan, Variant
    from trilane.hw_profiles.network_work import Network
    from trilane.hw_profiles.schema import Profile

app = typer.Typer(rich_markup_mode=None, add_completion=False)

EPILOG = """\b
Examples:
  trilane predict --encoder resnet18 --size 512 --channels 16
  trilane predict --runtime gpu --norm instance --minutes 30
  trilane predict --policy pipelined --edge double --what-if
  trilane predict --performance-profile burst --minutes 30 --plot heat.svg
  trilane predict --avatar default --runtime gpu
  trilane predict --table rows.csv --json
"""
PLOT_MINUTES = 30.0
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


@app.command(epilog=EPILOG)
def predict(
    ctx: typer.Context,
    profile: Annotated[str, typer.Option(help="Hardware profile: a name or a TOML file.")] = "snapdragon-888",
    encoder: Annotated[str, typer.Option(help="resnet18, mobilenetv2, mobilenetv3, efficientnet-lite0")] = "resnet18",
    norm: Annotated[str, typer.Option(help="batch, instance, group")] = "batch",
    size: Annotated[str, typer.Option(help="Tensor: one side, or HEIGHTxWIDTH.")] = "512",
    channels: Annotated[int, typer.Option(help="Channels of the neural texture, 1 to 16.")] = 16,
    layout: Annotated[str, typer.Option(help="packed: one raster pass; split: one per 4 channels.")] = "packed",
    avatar: Annotated[
        str | None, typer.Option(help="An avatar's network instead: `default` or a bundle folder.")
    ] = None,
    network: Annotated[Path | None, typer.Option(help="A quantised network instead: an ONNX file.")] = None,
    runtime: Annotated[str, typer.Option(help="Unit of the network: gpu or dsp.")] = "dsp",
    minutes: Annotated[float, typer.Option(help="Virtual minutes with heat; 0: settled, without.")] = 0.0,
    policy: Annotated[
        str,
        typer.Option(
            "--policy", "--pipelining", help="reference, or a policy: sequential, pipelined, latest, deadline."
        ),
    ] = "reference",
    edge: Annotated[
        str | None, typer.Option(help="Buffers between stages: single, double (if not given), triple, fifo:N, orphan.")
    ] = None,
    batch: Annotated[int, typer.Option(help="Frames per job of the network.")] = 1,
    gpu_share: Annotated[float, typer.Option(help="Share of the network that the GPU does for the DSP.")] = 0.0,
    performance_profile: Annotated[str, typer.Option(help="burst, sustained_high_performance, ...")] = SUSTAINED,
    governor: Annotated[
        str | None, typer.Option(help="step_wise or power_allocator; the profile's if not given.")
    ] = None,
    what_if: Annotated[bool, typer.Option("--what-if", help="Compare ways of working for the same network.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Draw frame rate and heat here (.png, .svg, .pdf).")] = None,
    table: Annotated[Path | None, typer.Option(help="CSV of configurations: one answer per row.")] = None,
    json: JsonOption = False,
) -> None:
    """Predict frame time, idleness, heat and energy on a chip, with the error to expect."""
    from trilane.hw_profiles.application import Plan
    from trilane.hw_profiles.load import load_runnable
    from trilane.hw_profiles.predict import predict as predict_one
    from trilane.hw_profiles.predict import what_if as alternatives
    from trilane.hw_profiles.throttling import GOVERNORS

    _refuse_ignored(ctx)
    if governor is not None and governor not in GOVERNORS:
        raise BadInputError("--governor", repr(governor), " or ".join(GOVERNORS))
    chip = load_runnable(profile)
    way = _way(policy, edge, batch)
    if table is not None:
        _predict_table(chip, table, performance_profile, way, json=json)
        return
    if network is not None or avatar is not None:
        subject = _network_of(network, avatar, layout)
    else:
        subject = _reference(encoder, norm, size, channels, layout)
    plan = Plan(subject, _unit(runtime), way, gpu_share)
    answer = predict_one(chip, plan, performance_profile, minutes, governor)
    if what_if:
        answer["alternatives"] = alternatives(chip, subject, plan.runtime, performance_profile)
    if plot is not None:
        _draw(chip, plan, performance_profile, minutes or PLOT_MINUTES, governor, plot)
    if json:
        print_json(answer)
    else:
        _show(answer)


def _refuse_ignored(ctx: typer.Context) -> None:
    """Options that another one leaves without effect."""
    sources = {name: ctx.get_parameter_source(name) for name in ctx.params}
    given = {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}
    for option, others in IGNORED.items():
        if option in given and (useless := given & others):
            names = ", ".join(sorted(f"--{name.replace('_', '-')}" for name in useless))
            raise BadInputError("options", f"{names} beside --{option}", "one or the other", WHY_IGNORED[option])


def _way(policy: str, edge: str | None, batch: int) -> Variant:
    from trilane.hw_profiles.application import REFERENCE, Variant

    if policy != "reference":
        return Variant(policy, edge or "double", batch)
    if edge not in (None, REFERENCE.edge):
        remedy = "choose a --policy of your own, such as pipelined"
        raise BadInputError("--edge", repr(edge), f"{REFERENCE.edge}, which the reference application has", remedy)
    return REFERENCE._replace(batch=batch)


def _reference(encoder: str, norm: str, size: str, channels: int, layout: str) -> Network:
    from trilane.hw_profiles.configuration_table import spec_of
    from trilane.hw_profiles.reference_networks import reference_network

    cells = {"encoder": encoder, "norm": norm, "size": size, "channels": str(channels), "layout": layout}
    return reference_network(spec_of(cells, "options"))


def _network_of(path: Path | None, avatar: str | None, layout: str) -> Network:
    """The network of a file, or of an avatar."""
    from trilane.avatars.bundle import load_bundle
    from trilane.avatars.network_file import read_network
    from trilane.hw_profiles.network_work import Network, count_work

    if path is not None and avatar is not None:
        raise BadInputError("options", "--network and --avatar", "one of them")
    if layout not in ("packed", "split"):
        raise BadInputError("--layout", repr(layout), "packed or split")
    file = read_network(path) if path is not None else load_bundle(avatar or "default").read_network()
    _, height, width, channels = file.shape
    facts = {"network": str(path)} if path is not None else {"avatar": str(avatar)}
    return Network(facts, height, width, channels, layout, count_work(file.model))


def _unit(runtime: str) -> Any:
    if runtime not in ("gpu", "dsp"):
        raise BadInputError("--runtime", repr(runtime), "gpu or dsp")
    return runtime


def _predict_table(chip: Profile, path: Path, performance_profile: str, way: Variant, *, json: bool) -> None:
    from rich.progress import Progress

    from trilane.hw_profiles.configuration_table import read_table
    from trilane.hw_profiles.predict import predict_table

    rows = read_table(path)
    console = stderr_console()
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("predicting", total=len(rows))
        answers = list(
            predict_table(chip, rows, performance_profile, way, lambda done: progress.update(task, completed=done))
        )
    if json:
        document = {"schema": 1, "clock": "virtual", "profile": chip.name, "performance_profile": performance_profile}
        print_json({**document, "rows": answers})
    else:
        _show_table(answers)


SHOWN = ("bench_gpu_ms", "bench_dsp_ms", "app_gpu_ms", "app_dsp_ms", "confidence")


def _show_table(answers: list[dict[str, Any]]) -> None:
    from rich.table import Table

    from trilane.hw_profiles.configuration_table import KEYS

    table = Table("encoder", "norm", "size", "ch", "layout", *SHOWN)
    for row in answers:
        table.add_row(
            *(str(row[key]) for key in KEYS), *(f"{row[key]:.1f}" for key in SHOWN[:-1]), f"{row['confidence']:.2f}"
        )
    stdout_console().print(table)


def _draw(chip: Profile, plan: Plan, asked: str, minutes: float, governor: str | None, path: Path) -> None:
    from trilane.hw_profiles.over_time import over_time
    from trilane.hw_profiles.plot import plot_over_time

    names = dict.fromkeys((SUSTAINED, BURST, asked))
    runs = {name: over_time(chip, plan, name, minutes, governor) for name in names}
    net = plan.network
    title = (
        f"{chip.title}\n{', '.join(net.facts.values())}, {net.height}x{net.width}x{net.channels} on the {plan.runtime}"
    )
    plot_over_time(runs, chip.thermal.skin_limit_c.or_else(0.0), title, path)


def _named(config: dict[str, Any]) -> str:
    return ", ".join(str(config[key]) for key in ("avatar", "network", "encoder", "norm") if key in config)


def _show(answer: dict[str, Any]) -> None:
    from rich.table import Table

    console = stdout_console()
    config, frame, network = answer["config"], answer["frame_time_ms"], answer["network"]
    console.print(f"{answer['machine']['title']} (virtual clock)")
    console.print(
        f"{_named(config)}, {config['size']}x{config['channels']} {config['layout']} "
        f"on the {config['runtime']}: {network['gmac']:.1f} GMAC, {network['parameters_m']:.1f} M parameters"
    )
    console.print(f"network alone   {network['alone_ms']:.1f} ms")
    capped = ", held by the display" if answer["display_capped"] else ""
    console.print(
        f"application     {frame['mean']:.1f} ms, {answer['fps']:.1f} fps{capped}; averages over 20 frames stray from "
        f"{frame['ema20_min']:.1f} to {frame['ema20_max']:.1f} ms"
    )
    console.print(f"latency         {answer['latency_ms']['mean']:.1f} ms")
    console.print(f"efficiency      {answer['efficiency']:.2f}")
    console.print(f"power           {answer['power_w']:.1f} W, {answer['energy_mj_per_frame']:.0f} mJ a frame")
    if answer["temperature_c"]:
        heat, caps = answer["temperature_c"], answer["caps"]
        console.print(
            f"temperature     device {heat['device_max']:.1f} °C, junction {heat['junction_max']:.1f} °C; "
            f"throttled {100 * caps['throttled_share']:.0f} % of the time"
        )
    console.print(f"expected error  ±{100 * answer['expected_error']:.0f} % (confidence {answer['confidence']:.2f})")
    units = Table("unit", "busy", "starved", "blocked", "throttled", "overhead")
    for name, unit in answer["units"].items():
        idle = unit["idle"]
        causes = (f"{100 * idle.get(cause, 0):.1f} %" for cause in ("starved", "blocked", "throttled", "overhead"))
        units.add_row(name, f"{100 * unit['busy']:.1f} %", *causes)
    console.print(units)
    if "alternatives" in answer:
        others = Table("what if", "frame, ms", "fps", "latency, ms")
        for row in answer["alternatives"]:
            others.add_row(row["name"], f"{row['frame_ms']:.1f}", f"{row['fps']:.1f}", f"{row['latency_ms']:.1f}")
        console.print(others)
