"""The output of `trilane predict`: one prediction, a table of predictions, or a drawing over time.

Rule: nothing is computed here; the predictions come from `trilane.hw_profiles`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trilane.apps.cli.console import print_json, print_verdict, stdout_console
from trilane.apps.predict.predicted_verdict import document_of, predicted_verdict
from trilane.hw_profiles.schema import SHARE_TEXT
from trilane.units import BURST, SUSTAINED

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from trilane.apps.predict.predict_options import PredictOptions
    from trilane.hw_profiles.application import Plan
    from trilane.hw_profiles.prediction import ApplicationPrediction, NetworkPrediction, Throttling
    from trilane.hw_profiles.rates import HeldRate, Watts
    from trilane.hw_profiles.schema import Profile
    from trilane.pipeline.run_metrics import Temperature

    AnyPrediction = ApplicationPrediction | NetworkPrediction

MOST_EXPENSIVE = 10
RANGES = f"ranges in brackets hold {SHARE_TEXT}"
AT_RATE = ("holds", "dropped", "W")
SHOWN = ("bench_gpu_ms", "bench_dsp_ms", "app_gpu_ms", "app_dsp_ms", "confidence")


def show_table(profile: str, performance_profile: str, answers: list[dict[str, Any]], as_json: bool) -> None:
    """Print a prediction for each row of a table of configurations.

    `profile`: name of the chip's hardware profile. `performance_profile`: name of the performance profile.
    `answers`: predictions of `predict_table`, in the order of the rows.
    `as_json`: whether to print one JSON document, or a table for people.
    """
    from rich.table import Table

    from trilane.hw_profiles.reference_networks import KEYS

    if as_json:
        document = {"schema": 1, "clock": "virtual", "profile": profile, "performance_profile": performance_profile}
        print_json({**document, "rows": answers})
        return
    table = Table("encoder", "norm", "size", "ch", "layout", *SHOWN)
    for row in answers:
        confidence = "-" if row["confidence"] is None else f"{row['confidence']:.2f}"
        figures = (*(f"{row[key]:.1f}" for key in SHOWN[:-1]), confidence)
        table.add_row(*(str(row[key]) for key in KEYS), *figures)
    stdout_console().print(table)


def draw(chip: Profile, plan: Plan, asked: str, minutes: float, governor: str | None, path: Path) -> None:
    """Draw frame rate and temperature over time into the file `path`.

    `chip`: hardware profile of the chip. `plan`: application that runs on the chip.
    `asked`: performance profile to draw besides `burst` and `sustained_high_performance`.
    `minutes`: virtual minutes to draw. `governor`: name of the governor; None for the governor of `chip`.
    `path`: picture to write.
    """
    from trilane.hw_profiles.governor import over_time, plot_over_time

    names = dict.fromkeys((SUSTAINED, BURST, asked))
    runs = {name: over_time(chip, plan, name, minutes, governor) for name in names}
    net = plan.network
    size = f"{net.height}x{net.width}x{net.channels}"
    title = f"{chip.title}\n{', '.join(net.facts.values())}, {size} on the {plan.unit}"
    plot_over_time(runs, chip.thermal.skin_limit_c.or_else(0.0), title, path)


def show_networks(chip: Profile, options: PredictOptions, answers: Sequence[NetworkPrediction], as_json: bool) -> None:
    """Print the predictions for networks that run without the rest of the avatar's pipeline.

    `chip`: hardware profile of the chip. `options`: options of the prediction.
    `answers`: predictions of `predict_network`, one for each network and unit.
    `as_json`: whether to print one JSON document, or text and tables for people.
    """
    performance_profile, minutes, governor = options.cap, options.minutes, options.governor
    if as_json:
        config = {"performance_profile": performance_profile, "minutes": minutes, **options.wanted._asdict()}
        print_json(
            {
                "schema": 1,
                "clock": "virtual",
                "machine": {"profile": chip.name, "title": chip.title},
                "config": {**config, "governor": governor or chip.thermal.governor},
                "networks": [document_of(answer) for answer in answers],
            }
        )
        return
    console = stdout_console()
    console.print(f"{chip.title} (virtual clock), {performance_profile}; nothing else runs; {RANGES}")
    if len(options.units) > 1:
        console.print(_compared_units(answers))
        return
    for answer in answers:
        console.print()
        _print_bare(console, answer, minutes)
        console.print(_operator_table(answer))


def _compared_units(answers: Sequence[NetworkPrediction]) -> Table:
    """Return a table with a row for each network on each unit. `answers`: predictions of `predict_network`."""
    from rich.table import Table

    table = Table("network", "unit", "numbers", "ms", f"{SHARE_TEXT}, ms", "a second", "W", "rate")
    for answer in answers:
        table.add_row(
            Path(answer.file).name,
            answer.unit,
            answer.precision,
            f"{answer.network_ms:.2f}",
            _span(answer.low_ms, answer.high_ms, ".2f").strip(" ()") or "-",
            f"{answer.fps:.1f}",
            f"{answer.power.w:.2f}",
            answer.rate.sentence if answer.rate else "-",
        )
    return table


def _print_bare(console: Console, answer: NetworkPrediction, minutes: float) -> None:
    under = f" under {answer.engine_runtime}" if answer.engine_runtime else ""
    said = "" if answer.numbers == "w8a8" else f" (numbers of the file: {answer.numbers})"
    size = f"{answer.gmac:.3g} GMAC, {answer.parameters_m:.3g} M parameters, {len(answer.operators)} operators"
    console.print(f"{Path(answer.file).name} on the {answer.unit} in {answer.precision}{under}{said}: {size}")
    print_verdict(predicted_verdict(answer).lines())
    if minutes:
        _print_settled(console, answer, minutes)
    span = _span(answer.low_ms, answer.high_ms, ".2f", " ms")
    console.print(f"network alone   {answer.network_ms:.2f} ms{span}, {answer.fps:.1f} a second")
    for why in answer.why:
        console.print(f"                {why}")
    for kind in answer.without_rule:
        share = f"{100 * kind.share_of_elements:.1f} % of the moved elements"
        console.print(f"no rule for     {kind.op_type}: {kind.count} with {share}, priced as data movement")
    _print_wanted(console, answer)
    _print_power(console, answer)
    if answer.temperature_c and answer.caps:
        _print_heat(console, answer.temperature_c, answer.caps)


def _print_settled(console: Console, answer: AnyPrediction, minutes: float) -> None:
    name = f"after {minutes:g} min"
    console.print(f"{name:<16}{answer.fps_settled:.1f} fps, begins with {answer.fps_start:.1f} fps")


def _print_wanted(console: Console, answer: AnyPrediction) -> None:
    if rate := answer.rate:
        console.print(f"rate            {rate.sentence}")
        console.print(f"                {_reserve(rate)}")
    if limit := answer.power_limit:
        name = f"within {limit.limit_w:g} W"
        if not limit.fps:
            console.print(f"{name:<16}never: the device takes {limit.power_w:.2f} W when no unit works")
            return
        corners = ", ".join(f"{unit} {corner}" for unit, corner in limit.corners.items())
        span = _span(limit.low_fps, limit.high_fps, ".1f")
        reason = "its full speed" if limit.limited_by == "speed" else "by power"
        console.print(f"{name:<16}{limit.fps:.1f} fps{span}, {reason}, at {limit.power_w:.2f} W ({corners})")


def _reserve(rate: HeldRate) -> str:
    ends = (rate.reserve_low, rate.reserve_high)
    if rate.holds:
        low, high = (None if end is None else 100 * end for end in ends)
        return f"reserve {100 * rate.reserve:.0f} % of a frame's time{_span(low, high, '.0f', ' %')}"
    most, least = (None if end is None else 1 - end for end in ends)
    return f"needs {1 - rate.reserve:.2f} times a frame's time{_span(least, most, '.2f')}"


def _span(low: float | None, high: float | None, form: str, unit: str = "") -> str:
    """Return the interval from `low` to `high` in brackets; "" if a bound is None, which means unknown.

    `form`: format of a bound, such as ".1f". `unit`: text after the bounds.
    """
    return "" if low is None or high is None else f" ({low:{form}} to {high:{form}}{unit})"


def _print_power(console: Console, answer: AnyPrediction) -> None:
    power = answer.power
    units = ", ".join(f"{unit} {_watts(watts)}" for unit, watts in power.units.items())
    console.print(f"settled at      {_watts(power)} W: {units}")
    console.print(f"of it base      {_watts(power.base)} W, {power.base.kind}: memory, screen, radio")


def _watts(watts: Watts) -> str:
    return f"{watts.w:.2f}{_span(watts.low_w, watts.high_w, '.2f')}"


def _print_heat(console: Console, heat: Temperature, caps: Throttling) -> None:
    console.print(
        f"temperature     device {heat.device_max:.1f} °C, junction {heat.junction_max:.1f} °C; "
        f"lowered for heat {100 * caps.throttled_share:.0f} % of the time"
    )


def _operator_table(answer: NetworkPrediction) -> Table:
    from rich.table import Table

    table = Table("operator", "type", "ms", "share", "bound by")
    for row in sorted(answer.operators, key=lambda row: -row.ms)[:MOST_EXPENSIVE]:
        table.add_row(row.name, row.op_type, f"{row.ms:.3f}", f"{100 * row.share:.1f} %", row.bound)
    return table


def show_answer(answer: ApplicationPrediction, as_json: bool) -> None:
    """Print one prediction of the avatar's pipeline.

    `as_json`: whether to print the document of the prediction, or text and tables.
    """
    if as_json:
        print_json(document_of(answer))
        return
    console = stdout_console()
    print_verdict(predicted_verdict(answer).lines())
    _print_network(console, answer)
    _print_times(console, answer)
    if answer.timeline:
        _print_heat(console, answer.temperature_c, answer.caps)
    if answer.expected_error is not None:
        error = f"±{100 * answer.expected_error:.0f} % of the network's time"
        console.print(f"expected error  {error} (confidence {answer.confidence:.2f})")
    console.print(_unit_table(answer))
    if answer.alternatives:
        console.print(_alternatives_table(answer.alternatives))


def _print_network(console: Console, answer: ApplicationPrediction) -> None:
    config, network = answer.config, answer.network
    name = ", ".join(filter(None, (config.avatar, config.network, config.encoder, config.norm)))
    console.print(f"{answer.machine.title} (virtual clock), {config.performance_profile}; {RANGES}")
    console.print(
        f"{name}, {config.size}x{config.channels} {config.layout} "
        f"on the {config.unit}: {network.gmac:.1f} GMAC, {network.parameters_m:.1f} M parameters"
    )
    console.print(f"policy          {config.policy}, edge {config.edge}")
    if config.minutes:
        _print_settled(console, answer, config.minutes)
    span = _span(network.low_ms, network.high_ms, ".1f")
    console.print(f"network alone   {network.alone_ms:.1f} ms{span}")


def _print_times(console: Console, answer: ApplicationPrediction) -> None:
    frame, latency_ms = answer.frame_time_ms, answer.latency_ms.mean
    held = "the rate that was asked for" if answer.rate and answer.rate.holds else "the display"
    capped = f", held by {held}" if answer.is_capped_throughout else ""
    stray = f"averages over 20 frames {frame.ema20_min:.1f} to {frame.ema20_max:.1f} ms"
    means = f"{frame.mean:.1f} ms{_span(frame.low, frame.high, '.1f')}, {answer.fps:.1f} fps{capped}"
    console.print(f"{'over all' if answer.config.minutes else 'application':<16}{means}; {stray}")
    none = "none: no frame is in time, so the frame time is that of the longest stage"
    console.print(f"latency         {none if latency_ms is None else f'{latency_ms:.1f} ms'}")
    console.print(f"efficiency      {answer.efficiency:.2f}")
    _print_wanted(console, answer)
    console.print(f"power           {answer.power_w:.1f} W, {answer.energy_mj_per_frame:.0f} mJ a frame")
    _print_power(console, answer)
    for note in answer.notes:
        console.print(f"note            {note}")


def _unit_table(answer: ApplicationPrediction) -> Table:
    from rich.table import Table

    causes = idle_causes(unit.idle for unit in answer.units.values())
    units = Table("unit", "busy", *causes)
    for name, unit in answer.units.items():
        units.add_row(name, f"{100 * unit.busy:.1f} %", *(f"{100 * unit.idle.get(cause, 0):.1f} %" for cause in causes))
    return units


def idle_causes(units: Iterable[Mapping[str, float]]) -> list[str]:
    """Return the idle causes of all `units`, each once, in the order in which they are found.

    `units`: share of each cause, for each unit.
    """
    return [*dict.fromkeys(cause for idle in units for cause in idle)]


def _alternatives_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    from rich.table import Table

    at_rate = "holds" in rows[0]
    table = Table("what if", "policy", "edge", "frame, ms", "fps", "latency, ms", *(AT_RATE if at_rate else ()))
    for row in rows:
        names = (row["name"], row["policy"], row["edge"])
        figures = (
            f"{row['frame_ms']:.1f}",
            f"{row['fps']:.1f}",
            "none" if row["latency_ms"] is None else f"{row['latency_ms']:.1f}",
        )
        table.add_row(*names, *figures, *(_at_rate(row) if at_rate else ()))
    return table


def _at_rate(row: Mapping[str, Any]) -> tuple[str, str, str]:
    return "yes" if row["holds"] else "no", f"{100 * row['dropped']:.0f} %", f"{row['power_w']:.2f}"
