"""`trilane predict FILE.toml`: a pipeline of one's own on a chip, as text and tables.

Rule: nothing is computed here; `apps/predict/asked_file.py` reads what is asked, `hw_profiles` answers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from trilane.apps.cli.console import print_json, print_verdict, say, spinner, stdout_console, without_controls

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from trilane.apps.predict.predict_options import PredictOptions

IDLE = ("starved", "blocked", "join", "throttled", "overhead")


def predict_pipeline_file(options: PredictOptions, path: Path, as_json: bool) -> None:
    """Print what the pipeline of a file and its variants do on a chip. Raises BadInputError."""
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
    console.print(f"{name} (virtual clock), {where}; {requested} frames, seed {answer['config']['seed']}", markup=False)
    if first["what_if"]:  # the file itself lacks times
        console.print(f"with {without_controls(first['what_if'])}", markup=False, soft_wrap=True)
    _show(console, first)
    if len(answer["pipelines"]) > 1:
        console.print(_what_ifs(answer["pipelines"]))
    for note in answer["notes"]:
        console.print(f"note            {note}", soft_wrap=True)


def _show(console: Console, answer: Mapping[str, Any]) -> None:
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
        console.print(f"                {count} by {cause}", markup=False)
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
    """Return four digits, without an exponent."""
    return f"{value:.4g}" if value < 1e4 else f"{value:.0f}"


def _span(low: float | None, high: float | None, share: str = ", 80 %") -> str:
    """Return an interval in brackets; nothing where it is a point or unknown."""
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

    table = Table("unit", "busy", *IDLE)
    for name, row in answer["units"].items():
        table.add_row(name, f"{row['busy']:.1%}", *(f"{row['idle'].get(cause, 0.0):.1%}" for cause in IDLE))
    return table


def _what_ifs(answers: list[dict[str, Any]]) -> Table:
    """Return a row for the file as it is, and one for each --set."""
    from rich.markup import escape
    from rich.table import Table

    table = Table("what if", "frame, ms", "fps", "latency, ms", "always fed, ms", "dropped", "holds")
    for answer in answers:
        rate = answer.get("rate")
        table.add_row(
            escape(without_controls(answer["what_if"])) or "the file",
            _digits(answer["frame_time_ms"]["mean"]),
            f"{answer['fps']:.1f}",
            _digits(answer["latency_ms"]["mean"]),
            _digits(answer["needs_ms"]["mean"]),
            f"{sum(answer['frames']['dropped'].values())}",
            "-" if rate is None else rate["sentence"].partition(": ")[2].partition(";")[0],
        )
    return table
