"""What `trilane predict` shows: one answer, a table of answers, or a drawing over time.

Rule: nothing is computed here; the answers are those of `trilane.hw_profiles.predict`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from trilane.apps.cli.console import print_json, stdout_console
from trilane.units import BURST, SUSTAINED

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from trilane.hw_profiles.application import Plan
    from trilane.hw_profiles.schema import Profile

IDLE = ("starved", "blocked", "throttled", "preempted", "overhead")
SHOWN = ("bench_gpu_ms", "bench_dsp_ms", "app_gpu_ms", "app_dsp_ms", "confidence")


def show_table(profile: str, performance_profile: str, answers: list[dict[str, Any]], as_json: bool) -> None:
    """Print an answer for each row of a table.

    `profile`: hardware profile of the chip.
    `performance_profile`: under which the chip runs.
    `answers`: of `predict_table`.
    `as_json`: one JSON document, or a table for people.
    """
    from rich.table import Table

    from trilane.hw_profiles.configuration_table import KEYS

    if as_json:
        document = {"schema": 1, "clock": "virtual", "profile": profile, "performance_profile": performance_profile}
        print_json({**document, "rows": answers})
        return
    table = Table("encoder", "norm", "size", "ch", "layout", *SHOWN)
    for row in answers:
        figures = (*(f"{row[key]:.1f}" for key in SHOWN[:-1]), f"{row['confidence']:.2f}")
        table.add_row(*(str(row[key]) for key in KEYS), *figures)
    stdout_console().print(table)


def draw(chip: Profile, plan: Plan, asked: str, minutes: float, governor: str | None, path: Path) -> None:
    """Draw frame rate and temperature over time to `path`.

    `chip`: its hardware profile.
    `plan`: what runs on it.
    `asked`: performance profile to draw beside `burst` and `sustained_high_performance`.
    `minutes`: of virtual time.
    `governor`: that lowers the clocks; None for the profile's own.
    `path`: file to write.
    """
    from trilane.hw_profiles.over_time import over_time
    from trilane.hw_profiles.plot import plot_over_time

    names = dict.fromkeys((SUSTAINED, BURST, asked))
    runs = {name: over_time(chip, plan, name, minutes, governor) for name in names}
    net = plan.network
    size = f"{net.height}x{net.width}x{net.channels}"
    title = f"{chip.title}\n{', '.join(net.facts.values())}, {size} on the {plan.runtime}"
    plot_over_time(runs, chip.thermal.skin_limit_c.or_else(0.0), title, path)


def show_answer(answer: dict[str, Any], as_json: bool) -> None:
    """Print one answer of `predict`."""
    if as_json:
        print_json(answer)
        return
    console = stdout_console()
    _print_network(console, answer)
    _print_times(console, answer)
    if answer["temperature_c"]:
        heat, caps = answer["temperature_c"], answer["caps"]
        console.print(
            f"temperature     device {heat['device_max']:.1f} °C, junction {heat['junction_max']:.1f} °C; "
            f"lowered for heat {100 * caps['throttled_share']:.0f} % of the time"
        )
    error = f"±{100 * answer['expected_error']:.0f} % of the network's time"
    console.print(f"expected error  {error} (confidence {answer['confidence']:.2f})")
    console.print(_unit_table(answer))
    if not answer["accounts"]["agree"]:
        found = answer["accounts"]["largest_difference"]
        console.print(f"the shares of units, computed twice, differ by {found:.2%} of the time: please report this")
    if "alternatives" in answer:
        console.print(_alternatives_table(answer))


def _print_network(console: Console, answer: dict[str, Any]) -> None:
    config, network = answer["config"], answer["network"]
    name = ", ".join(str(config[key]) for key in ("avatar", "network", "encoder", "norm") if key in config)
    console.print(f"{answer['machine']['title']} (virtual clock), {config['performance_profile']}")
    console.print(
        f"{name}, {config['size']}x{config['channels']} {config['layout']} "
        f"on the {config['runtime']}: {network['gmac']:.1f} GMAC, {network['parameters_m']:.1f} M parameters"
    )
    console.print(f"network alone   {network['alone_ms']:.1f} ms")


def _print_times(console: Console, answer: dict[str, Any]) -> None:
    frame = answer["frame_time_ms"]
    capped = ", held by the display" if answer["display_capped"] else ""
    stray = f"averages over 20 frames stray from {frame['ema20_min']:.1f} to {frame['ema20_max']:.1f} ms"
    means = f"{frame['mean']:.1f} ms, {answer['fps']:.1f} fps{capped}; {stray}"
    if minutes := answer["config"]["minutes"]:
        console.print(
            f"application     settles at {answer['fps_settled']:.1f} fps, begins with {answer['fps_start']:.1f} fps"
        )
        console.print(f"over {f'{minutes:g} minutes':<11}{means}")
    else:
        console.print(f"application     {means}")
    console.print(f"latency         {answer['latency_ms']['mean']:.1f} ms")
    console.print(f"efficiency      {answer['efficiency']:.2f}")
    base = f"{answer['base_power_w']:.1f} W of it {answer['base_power_kind']} for all but the units"
    console.print(f"power           {answer['power_w']:.1f} W ({base}), {answer['energy_mj_per_frame']:.0f} mJ a frame")
    for note in answer["notes"]:
        console.print(f"note            {note}")


def _unit_table(answer: dict[str, Any]) -> Table:
    from rich.table import Table

    units = Table("unit", "busy", *IDLE)
    for name, unit in answer["units"].items():
        causes = (f"{100 * unit['idle'].get(cause, 0):.1f} %" for cause in IDLE)
        units.add_row(name, f"{100 * unit['busy']:.1f} %", *causes)
    return units


def _alternatives_table(answer: dict[str, Any]) -> Table:
    from rich.table import Table

    table = Table("what if", "policy", "edge", "frame, ms", "fps", "latency, ms")
    for row in answer["alternatives"]:
        names = (row["name"], row["policy"], row["edge"])
        table.add_row(*names, f"{row['frame_ms']:.1f}", f"{row['fps']:.1f}", f"{row['latency_ms']:.1f}")
    return table
