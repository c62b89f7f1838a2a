"""`trilane predict`: predictions for a configuration, a table of configurations, a pipeline file or several pipelines.

`trilane predict FILE.toml` predicts a pipeline file. `trilane predict SCENE --beside …` predicts several pipelines that
share one chip.

Rule: this module reads options and shows results; every figure comes from `trilane.hw_profiles`. `predict_output.py`
shows the predictions for a configuration or a table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from trilane.apps.cli.commands import Commands, JsonOption, with_options
from trilane.apps.cli.console import (
    print_json,
    print_verdict,
    say,
    spinner,
    stderr_console,
    stdout_console,
    without_controls,
)
from trilane.apps.cli.predict_output import draw, idle_causes, show_answer, show_networks, show_table
from trilane.apps.predict.asked_prediction import answer_of, application_of, predict_networks
from trilane.apps.predict.predict_options import PredictOptions
from trilane.errors import BadInputError
from trilane.hw_profiles.schema import SHARE_TEXT

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from trilane.hw_profiles.application import Plan, Variant
    from trilane.hw_profiles.prediction import ApplicationPrediction
    from trilane.hw_profiles.schema import Profile
    from trilane.hw_profiles.tenants import SharingPipeline


def predict_pipeline_file(options: PredictOptions, path: Path, as_json: bool) -> None:
    """Print the predictions for the pipeline file `path`, and for each variant of the file that a --set describes.

    Raises BadInputError for a faulty file or option.
    """
    from trilane.apps.predict.asked_file import predict_asked_file

    with spinner("predicting"):
        answer = predict_asked_file(options, path, say)
    if as_json:
        print_json(answer)
        return
    console, first = stdout_console(), answer["pipelines"][0]
    machine, requested = answer["machine"], first["frames"]["requested"]
    where = f"{machine['title']}, {answer['config']['performance_profile']}" if machine else "times of the file"
    name = without_controls(path.name)
    console.print(f"{name} (virtual clock), {where}; {requested} frames, seed {answer['config']['seed']}")
    if first["what_if"]:  # the file as it is has no prediction, because it lacks times
        console.print(f"with {without_controls(first['what_if'])}", soft_wrap=True)
    _show_file(console, first)
    if len(answer["pipelines"]) > 1:
        console.print(_what_ifs(answer["pipelines"]))
    for note in answer["notes"]:
        console.print(f"note            {note}", soft_wrap=True)


def _show_file(console: Console, answer: Mapping[str, Any]) -> None:
    print_verdict(answer["verdict"]["lines"])
    frame, latency, frames, needs = (answer[key] for key in ("frame_time_ms", "latency_ms", "frames", "needs_ms"))
    if rate := answer.get("rate"):
        console.print(rate["sentence"])
    rate_said = f", {answer['fps']:.1f} fps" if frame["samples"] else ""
    console.print(f"frame time      {_of_frames(frame)}{rate_said}")
    console.print(f"latency         {_of_frames(latency)}")
    dropped = sum(frames["dropped"].values())
    console.print(f"frames          {frames['presented']} of {frames['requested']} presented, {dropped} dropped")
    for cause, count in frames["dropped"].items():
        console.print(f"                {count} by {cause}")
    console.print(f"always fed      {_ms(needs['mean'])}{_span(needs['low'], needs['high'])} a frame")
    cycle = " -> ".join(answer["cycle"])
    limit = f", by {answer['limit'].replace('_', ' ')}: {cycle}" if cycle else ""
    console.print(f"period          {_ms(answer['period_ms'])} a frame{limit}", soft_wrap=True)
    console.print(_stages(answer))
    console.print(_units(answer))
    for reason in dict.fromkeys(
        reason for row in answer["stages"].values() if row["low_ms"] is None for reason in row["why"]
    ):
        console.print(f"no interval     {reason}", soft_wrap=True)
    for name, row in answer.get("streams", {}).items():
        age, behind = row["age_ms"], row["frames_behind"]
        said = (
            f"{_ms(age['mean'])} old, {behind['mean']:.1f} frames behind" if age["samples"] else "never there in time"
        )
        console.print(f"newest of       {name}: {said}")


def _of_frames(times: Mapping[str, Any]) -> str:
    if not times["samples"]:
        return "unknown: too few frames were presented"
    return f"{_ms(times['mean'])}{_span(times['low'], times['high'])}, p95 {_ms(times['p95'])}"


def _ms(value: float) -> str:
    return f"{_digits(value)} ms"


def _digits(value: float) -> str:
    """Return `value` with four significant digits; a larger number as a whole number, without an exponent."""
    return f"{value:.4g}" if value < 9999.5 else f"{value:.0f}"


def _span(low: float | None, high: float | None, share: str = f", {SHARE_TEXT}") -> str:
    """Return the interval from `low` to `high` in brackets, with the text `share` after the bounds.

    The result is "" if both bounds are equal, or if a bound is None, which means unknown.
    """
    return "" if low == high or low is None or high is None else f" ({_digits(low)} to {_digits(high)}{share})"


def _stages(answer: Mapping[str, Any]) -> Table:
    from rich.table import Table

    table = Table("stage", "unit", "alone, ms", "in the run, ms", "waits, ms", "time from")
    for name, row in answer["stages"].items():
        times = (_digits(row[key]["mean"]) for key in ("service_ms", "wait_ms"))
        alone = f"{_digits(row['alone_ms'])}{_span(row['low_ms'], row['high_ms'], '')}"
        table.add_row(name, row["unit"], alone, *times, row["source"])
    return table


def _units(answer: Mapping[str, Any]) -> Table:
    from rich.table import Table

    causes = idle_causes(row["idle"] for row in answer["units"].values())
    table = Table("unit", "busy", *causes)
    for name, row in answer["units"].items():
        table.add_row(name, f"{row['busy']:.1%}", *(f"{row['idle'].get(cause, 0.0):.1%}" for cause in causes))
    return table


def _what_ifs(answers: list[dict[str, Any]]) -> Table:
    """Return a table with a row for each --set. If the file has all times, the file itself has the first row."""
    from rich.table import Table

    table = Table("what if", "frame, ms", "fps", "latency, ms", "always fed, ms", "dropped", "holds")
    for answer in answers:
        rate, frame, latency = answer.get("rate"), answer["frame_time_ms"], answer["latency_ms"]
        table.add_row(
            without_controls(answer["what_if"]) or "the file",
            _digits(frame["mean"]) if frame["samples"] else "unknown",
            f"{answer['fps']:.1f}" if frame["samples"] else "unknown",
            _digits(latency["mean"]) if latency["samples"] else "unknown",
            _digits(answer["needs_ms"]["mean"]),
            f"{sum(answer['frames']['dropped'].values())}",
            "-" if rate is None else rate["sentence"].partition(": ")[2].partition(";")[0],
        )
    return table


def predict_pipelines(options: PredictOptions, as_json: bool) -> None:
    """Print the prediction for pipelines on one chip: the scene of `options`, and the pipelines of --beside.

    Raises BadInputError for an unknown chip, scene or edge, and for a faulty pipeline.
    """
    from trilane.apps.predict.asked_pipelines import answer_of, tenants
    from trilane.hw_profiles.profile_files import load_runnable
    from trilane.units import HOST

    scene = str(options.scene)
    chip, variant = load_runnable(options.profile), _variant(options.policy, options.edge)
    if chip.name == HOST and options.precision is None:
        from trilane.apps.predict.this_machine import with_first

        chip = with_first(chip, scene, say)
    with spinner("predicting"):
        found = tenants([scene, *options.beside], variant, options.numbers)
        answer = answer_of(chip, found, options)
        if options.trace is not None:
            _write_beside(chip, found, options, answer, options.trace)
    if as_json:
        print_json(answer)
        return
    _show_beside(answer)


def _write_beside(
    chip: Profile, found: Sequence[SharingPipeline], options: PredictOptions, answer: Mapping[str, Any], target: Path
) -> None:
    """Simulate the pipelines `found` on the shared `chip`, and write their runs as one trace to the file `target`.

    `options`: options of the prediction. `answer`: prediction, whose `machine` and `config` the trace gets.
    """
    from trilane.apps.explain.trace import write_predicted
    from trilane.hw_profiles.schema import corners_of
    from trilane.hw_profiles.shared_chip import together

    runs = together(chip, found, corners_of(chip, options.cap), options.turns, keep=True).runs
    named = {tenant.name: run for tenant, run in zip(found, runs, strict=True)}
    write_predicted(named, {key: answer[key] for key in ("machine", "config")}, target)


def _variant(policy: str | None, edge: str | None) -> Variant:
    """Return how the stages of the scenes are connected and scheduled. Raises BadInputError for an unknown edge.

    `policy`, `edge`: values of the options; None for the policy or edge of NEWEST. The policy `reference` gives
    REFERENCE, whatever `edge` is.
    """
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


def _show_beside(answer: dict[str, Any]) -> None:
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
    """Return the mean of `times` in ms as a text; a dash without samples."""
    return f"{times['mean']:.1f}" if times["samples"] else "-"


def _idle(answer: dict[str, Any]) -> Table:
    """Return a table of the units: busy share for all pipelines, and busy and idle shares for each pipeline."""
    from rich.table import Table

    rows = [row for one in answer["pipelines"] for row in one["units"].values()]
    causes = idle_causes(row["idle"] for row in rows)
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


app = Commands()

EPILOG = """\b
Examples:
  trilane predict
  trilane predict --encoder resnet18 --size 512 --channels 16
  trilane predict --unit gpu --norm instance --minutes 30
  trilane predict --policy pipelined --edge double --what-if
  trilane predict --policy latest --fps 24
  trilane predict --performance-profile burst --minutes 30 --plot temperature.svg
  trilane predict --avatar hiker --unit gpu
  trilane predict --policy latest --fps 24 --trace predicted.pftrace
  trilane predict --network midas.onnx --network unet.onnx --profile snapdragon-8-gen-3
  trilane predict --network net.onnx --input-shape image=1x3x224x224 --precision w8a8
  trilane predict --network net.onnx --runtime qnn_dlc --performance-profile sustained_high_performance
  trilane predict --network net.onnx --fps 30 --minutes 30
  trilane predict --network net.onnx --power-limit-w 3
  trilane predict --network unet.onnx --application --fps 30 --what-if
  trilane predict --table rows.csv --json
  trilane predict portrait --beside default --beside network.onnx@30
  trilane predict street.toml --profile snapdragon-8-gen-3
  trilane predict portrait --beside street.toml@15
  trilane predict street.toml --set stages.segmenter.unit=gpu --set run.fps=60,run.policy=latest
"""
PLOT_MINUTES = 30.0


@app.command(epilog=EPILOG)
@with_options(PredictOptions)
def predict(options: PredictOptions, *, json: JsonOption = False) -> None:
    """Predict frame time, idleness, heat and energy on a chip, with the error to expect.

    Without options: the avatar, policy and edge of `trilane run`. With --encoder, --norm, --size or --channels: the
    published application with such a network. With --network: each network by itself, or with --application in the
    avatar's place. With a pipeline file: this pipeline, from the times of its stages (docs/pipeline-file.md).

    Without --performance-profile, a network by itself runs under burst, because published latencies do. On the profile
    `host` (this machine), everything runs under burst, because a run here has no cap.
    """
    from trilane.hw_profiles.profile_files import load_runnable

    options.check_together()
    if options.pipeline is not None:
        predict_pipeline_file(options, options.pipeline, json)
        return
    if options.scene is not None:
        predict_pipelines(options, json)
        return
    chip = load_runnable(options.profile)
    if options.table is not None:
        show_table(chip.name, options.cap, _predict_table(chip, options.table, options), json)
        return
    if options.is_bare:
        show_networks(chip, options, predict_networks(chip, options, say), json)
        return
    chip, plan = application_of(chip, options, say)
    answer = answer_of(chip, plan, options)
    if options.plot is not None:
        draw(chip, plan, options.cap, options.minutes or PLOT_MINUTES, options.governor, options.plot)
    if options.trace is not None:
        _write_trace(chip, plan, options, answer, options.trace)
    show_answer(answer, json)


def _write_trace(
    chip: Profile, plan: Plan, options: PredictOptions, answer: ApplicationPrediction, target: Path
) -> None:
    """Simulate the run behind the predicted busy and idle shares again, and write its trace to the file `target`.

    `chip`: hardware profile. `plan`: application on the chip. `options`: options of the prediction.
    `answer`: prediction, whose `machine` and `config` the trace gets.
    """
    from trilane.apps.explain.trace import write_predicted
    from trilane.hw_profiles.predict import predicted_run

    done = predicted_run(chip, plan, options.cap, options.wanted)
    write_predicted({chip.name: done}, answer.model_dump(include={"machine", "config"}, exclude_unset=True), target)


def _predict_table(chip: Profile, path: Path, options: PredictOptions) -> list[dict[str, Any]]:
    """Return a prediction for each row of the table in the file `path`, in the order of the rows.

    Raises BadInputError for a faulty table.
    """
    from rich.progress import Progress

    from trilane.hw_profiles.predict import predict_table
    from trilane.hw_profiles.reference_networks import read_table

    rows = read_table(path)
    console = stderr_console()
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("predicting", total=len(rows))
        answers = predict_table(
            chip, rows, options.cap, options.variant, lambda count: progress.update(task, completed=count)
        )
        return list(answers)
