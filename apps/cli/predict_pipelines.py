"""`trilane predict SCENE --beside …`: several pipelines on one chip, as options and as tables.

Rule: nothing is computed here; `apps/predict/asked_pipelines.py` reads the pipelines, and `hw_profiles/shared_chip.py`
answers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from trilane.apps.cli.console import print_json, print_verdict, say, spinner, stdout_console
from trilane.apps.cli.predict_output import IDLE
from trilane.errors import BadInputError

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from trilane.apps.predict.predict_options import PredictOptions
    from trilane.hw_profiles.application import Variant
    from trilane.hw_profiles.schema import Profile
    from trilane.hw_profiles.tenants import Pipeline


def predict_pipelines(options: PredictOptions, as_json: bool) -> None:
    """Print how the scene of `options` and the pipelines beside it do on one chip.

    Raises BadInputError for a fault in one of them.
    """
    from trilane.apps.predict.asked_pipelines import answer_of, tenants
    from trilane.hw_profiles.profile_files import load_runnable
    from trilane.units import HOST

    scene = str(options.scene)
    chip, variant = load_runnable(options.profile), _variant(options.policy or "", options.edge)
    if chip.name == HOST and options.precision is None:
        from trilane.apps.predict.this_machine import with_first

        chip = with_first(chip, scene, say)
    with spinner("predicting"):
        found = tenants([scene, *options.beside], variant, options.numbers)
        answer = answer_of(chip, found, options)
        if options.trace is not None:
            _write_trace(chip, found, options, answer, options.trace)
    if as_json:
        print_json(answer)
        return
    _show(answer)


def _write_trace(
    chip: Profile, found: Sequence[Pipeline], options: PredictOptions, answer: Mapping[str, Any], target: Path
) -> None:
    """Write the simulated runs of the pipelines as one trace."""
    from trilane.apps.explain.trace import write_predicted
    from trilane.hw_profiles.schema import corners_of
    from trilane.hw_profiles.shared_chip import together

    runs = together(chip, found, corners_of(chip, options.cap), options.turns, keep=True).runs
    named = {tenant.name: run for tenant, run in zip(found, runs, strict=True)}
    write_predicted(named, {key: answer[key] for key in ("machine", "config")}, target)


def _variant(policy: str, edge: str | None) -> Variant:
    """Return how the avatars' stages are joined. `policy`: "" where none was asked for."""
    from trilane.hw_profiles.application import REFERENCE
    from trilane.hw_profiles.tenants import NEWEST
    from trilane.transport.slots import edge_rule
    from trilane.unexpected_value import UnexpectedValue

    if policy == "reference":
        return REFERENCE
    try:
        edge_rule(edge or NEWEST.edge)
    except UnexpectedValue as error:
        raise BadInputError.at("--edge", error) from None
    return NEWEST._replace(policy=policy or NEWEST.policy, edge=edge or NEWEST.edge)


def _show(answer: dict[str, Any]) -> None:
    console, config = stdout_console(), answer["config"]
    console.print(f"{answer['machine']['title']} (virtual clock), {config['performance_profile']}")
    for row in answer["pipelines"]:
        alone = f"; alone {row['alone']['rate']['sentence']}" if len(answer["pipelines"]) > 1 else ""
        where = "" if row["precision"] is None else f", {row['unit']} in {row['precision']}"
        console.print(f"{row['name']}{where}: {row['rate']['sentence']}{alone}", soft_wrap=True)
        print_verdict(row["verdict"]["lines"])
    console.print(_pipelines(answer))
    console.print(_idle(answer))
    _show_chip(console, answer)
    for note in answer["notes"]:
        console.print(f"note            {note}", soft_wrap=True)


def _pipelines(answer: dict[str, Any]) -> Table:
    from rich.table import Table

    from trilane.hw_profiles.rates import wanted_drops

    minutes = answer["config"]["minutes"]
    settled = [f"after {minutes:g} min, ms"] if minutes else []
    table = Table(
        "pipeline", "asked fps", "frame, ms", *settled, "alone, ms", "response, ms", "in time", "late", "dropped"
    )
    for row in answer["pipelines"]:
        after = [f"{row['frame_ms_settled']:.1f}"] if minutes else []
        table.add_row(
            row["name"],
            f"{row['rate_fps']:g}",
            _mean(row["frame_time_ms"]),
            *after,
            _mean(row["alone"]["frame_time_ms"]),
            _mean(row["response_ms"]),
            f"{row['in_time']:.1%}",
            f"{row['deadline_misses']}",
            f"{wanted_drops(row['frames']['dropped'])}",
        )
    return table


def _mean(times: Mapping[str, float]) -> str:
    """Return the mean of some times in ms, a dash where there are none."""
    return f"{times['mean']:.1f}" if times["samples"] else "-"


def _idle(answer: dict[str, Any]) -> Table:
    """Return a table of each unit: its busy time for all, and its busy time and idle causes per pipeline."""
    from rich.table import Table

    rows = [row for one in answer["pipelines"] for row in one["units"].values()]
    causes = [*IDLE, *(["join"] if any("join" in row["idle"] for row in rows) else [])]
    table = Table("unit", "pipeline", "busy", *causes)
    for unit in dict.fromkeys([*answer["units"], *(row["hardware"] for row in rows)]):
        heads = iter([unit])
        if unit in answer["units"]:
            table.add_row(next(heads), "all", f"{answer['units'][unit]['busy']:.1%}")
        for one in answer["pipelines"]:
            for name, own in one["units"].items():
                if own["hardware"] == unit:
                    said = one["name"] if name == unit else f"{one['name']}: {name}"
                    shares = (f"{own['idle'].get(cause, 0.0):.1%}" for cause in causes)
                    table.add_row(next(heads, ""), said, f"{own['busy']:.1%}", *shares)
    return table


def _show_chip(console: Console, answer: dict[str, Any]) -> None:
    base = f"{answer['base_power_w']:.1f} W of it {answer['base_power_kind']} for all but the units"
    console.print(f"power           {answer['power_w']:.1f} W ({base})")
    if heat := answer["temperature_c"]:
        console.print(
            f"temperature     device {heat['device_max']:.1f} °C, junction {heat['junction_max']:.1f} °C; "
            f"lowered for heat {answer['caps']['throttled_share']:.0%} of the time"
        )
