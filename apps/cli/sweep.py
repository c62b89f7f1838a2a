"""`trilane sweep`: tries many configurations of one command, and keeps the results in a folder.

Rule: this file reads options and shows results; `trilane.apps.sweep` defines and runs sweeps. On a terminal, stderr
shows a bar with the remaining time. Without a terminal, stderr gets a line for each trial that ends.
"""

from __future__ import annotations

import hashlib
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import timedelta
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import print_json, print_line, say, stderr_console, stdout_console, stdout_kept
from trilane.errors import BadInputError
from trilane.signals import INTERRUPTED

if TYPE_CHECKING:
    from trilane.apps.cli.sweep_options import SweptCommand
    from trilane.apps.sweep.definition import Definition, Trial
    from trilane.apps.sweep.store import Engine, Store, SweepSummary, TrialRecord

app = Commands()
EPILOG = """\b
Examples:
  trilane sweep run --size 128 --size 256 --runtime ort --runtime openvino --check 4
  trilane sweep predict --policy pipelined --edge double --edge triple --dry-run
  trilane sweep predict --channels 8 --channels 16 --size 256 --size 512 --random 3 --seed 1
  trilane sweep docs/examples/chip-sweep.toml --out sweeps/chips
  trilane sweep docs/examples/chip-sweep.toml --out sweeps/chips --resume
  trilane sweep docs/examples/chip-sweep.toml --engine ray
"""
ENDING = ".toml"
SOME_FAILED = 1
#: Column of the summary -> keys that lead to its figure in a trial's result.
FIGURES = {"fps": ("fps",), "frame ms": ("frame_time_ms", "mean")}
#: The same for the further columns of a sweep with `--check`.
ERRORS = {"PSNR, dB": ("check", "psnr_db"), "worst": ("check", "worst_psnr_db"), "1st pct.": ("check", "p1_psnr_db")}


class EngineName(StrEnum):
    """The machines that run trials: this machine (`local`), or the machines of a Ray cluster (`ray`)."""

    LOCAL = "local"
    RAY = "ray"


WordsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="FILE|COMMAND",
        help="A sweep file (TOML), or run, predict, quality or bench NAME with its own arguments and options. "
        "An option that is given several times is an axis.",
    ),
]

EngineOption = Annotated[EngineName, typer.Option(help="local: this machine; ray: the machines of a Ray cluster.")]

ResumeOption = Annotated[bool, typer.Option("--resume", help="Resume a sweep that was interrupted or killed.")]

FolderOption = Annotated[Path | None, typer.Option("--out", help="Folder of the sweep; sweeps/NAME-HASH if not given.")]

ListOption = Annotated[
    bool, typer.Option("--list", help="Combine the first values of all axes, then the second values, and so on.")
]

RandomOption = Annotated[
    int | None, typer.Option("--random", min=1, help="Draw this many of the combinations at random.")
]

SeedOption = Annotated[int | None, typer.Option(help="Seed of --random; 0 if not given.")]

DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Print the trials and run none.")]


@app.command(epilog=EPILOG, context_settings={"ignore_unknown_options": True})
def sweep(
    words: WordsArgument,
    engine: EngineOption = EngineName.LOCAL,
    resume: ResumeOption = False,
    out: FolderOption = None,
    as_list: ListOption = False,
    random: RandomOption = None,
    seed: SeedOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Try many configurations of run, predict, quality or a bench, and keep every result.

    Every combination of the axes is a trial, which runs in its own process. The trial's line in trials.jsonl has the
    command's whole --json document. Trials on the host clock run one at a time, predictions on all cores. Finished
    trials are not repeated. docs/sweeps.md says more.
    """
    if words[0].endswith(ENDING):
        name, definition, command = of_file(words, as_list, random, seed)
    else:
        name, definition, command = of_words(words, as_list, random, seed)
    trials = _trials(words[0], definition, command)
    if dry_run:
        _print_planned(trials, as_json)
        return
    if engine is EngineName.RAY:
        from trilane.apps.sweep.engines import required_ray

        required_ray()
    else:
        require_checks(trials)
    folder = out or default_folder(name, trials)
    failed = _run(trials, folder, definition, engine, resume, as_json)
    raise typer.Exit(SOME_FAILED if failed else 0)


def of_file(
    words: Sequence[str], as_list: bool, random: int | None, seed: int | None
) -> tuple[str, Definition, SweptCommand]:
    from trilane.apps.cli.sweep_options import SweptCommand
    from trilane.apps.sweep.definition import read_sweep

    path = Path(words[0])
    if len(words) > 1:
        raise BadInputError("options", f"{' '.join(words[1:])} beside {path}", "it in the file", "it has all options")
    if as_list or random is not None or seed is not None:
        raise BadInputError("options", f"--list, --random or --seed beside {path}", "kind, count and seed in the file")
    file = read_sweep(path)
    command = SweptCommand(file.command)
    fixed = command.in_new_names({name: (value,) for name, value in file.options.items()}, f"{path}: options")
    options = {name: command.converted(name, value, f"{path}: options") for name, (value,) in fixed.items()}
    axes = {
        name: [command.converted(name, value, f"{path}: axes") for value in values]
        for name, values in command.in_new_names(file.axes, f"{path}: axes").items()
    }
    return path.stem, replace(file, command=command.words, options=options, axes=axes), command


def of_words(
    words: Sequence[str], as_list: bool, random: int | None, seed: int | None
) -> tuple[str, Definition, SweptCommand]:
    from trilane.apps.cli.sweep_options import SweptCommand
    from trilane.apps.sweep.definition import Definition, SweepKind

    if as_list and random is not None:
        raise BadInputError("options", "--list and --random", "one of them")
    if seed is not None and random is None:
        remedy = "the seed of a bench is given in a file (docs/sweeps.md)"
        raise BadInputError("options", "--seed without --random", "both or neither", remedy)
    count = 2 if words[0] == "bench" else 1
    command = SweptCommand(words[:count])
    values = command.values_of(words[count:])
    options = {name: several[0] for name, several in values.items() if len(several) == 1}
    axes = {name: several for name, several in values.items() if len(several) > 1}
    kind = SweepKind.LIST if as_list else SweepKind.RANDOM if random is not None else SweepKind.GRID
    return "-".join(command.words), Definition(command.words, options, axes, kind, random, seed or 0), command


def _trials(first: str, definition: Definition, command: SweptCommand) -> list[Trial]:
    """Return the trials of the sweep `definition`.

    `first`: first word after `sweep` on the command line. If this word is a sweep file, errors name the file.
    `command`: command that the trials run. Raises BadInputError for options or axes that do not fit each other.
    """
    from trilane.apps.sweep.definition import trials_of

    try:
        return trials_of(definition, command.words_of)
    except BadInputError as error:
        if not first.endswith(ENDING):
            raise
        raise BadInputError(f"{first}: {error.where}", error.found, error.expected, error.remedy) from None


def require_checks(trials: Sequence[Trial]) -> None:
    """Raise MissingPartError if a trial of `run` has the option `check`, and a library for this check is missing.

    A wrong scene or avatar of a trial raises no error here, because the trial itself reports it.
    """
    from trilane.apps.run.run_job import require_parts
    from trilane.avatars.bundle import load_bundle
    from trilane.stages.configure import requested_scene
    from trilane.stages.run_options import RunOptions

    runs = [trial.options for trial in trials if trial.command == ("run",) and trial.options.get("check")]
    for scene, avatar in {(options.get("scene", "default"), options.get("avatar")) for options in runs}:
        with suppress(BadInputError):
            asked = RunOptions.checked({"scene": scene, "avatar": avatar})
            require_parts(load_bundle(each.bundle) for each in requested_scene(asked).avatars)


def default_folder(name: str, trials: Sequence[Trial]) -> Path:
    """Return the folder of a sweep without `--out`: `sweeps/NAME-HASH`.

    The hash comes from the trials. Therefore the same sweep gets the same folder again, with its finished trials.
    """
    digest = hashlib.sha256("".join(sorted(trial.id for trial in trials)).encode()).hexdigest()
    return Path("sweeps") / f"{name}-{digest[:8]}"


def _run(
    trials: Sequence[Trial], folder: Path, definition: Definition, engine: EngineName, resume: bool, as_json: bool
) -> bool:
    """Run the trials that have not ended yet, and print a summary. Return whether any trial has failed or was lost.

    Raises typer.Exit if the sweep is interrupted.
    """
    from trilane.apps.run.report_facts import made_facts
    from trilane.apps.sweep.store import Store, run_sweep

    about = {"made": made_facts(("trilane", *sys.argv[1:])), "definition": described(definition)}
    with Store(folder, trials, about, resume=resume) as store:
        before = store.ended
        left = len(trials) - len(before)
        try:
            with progress(left, len(trials)) as told, engine_for(engine, store) as engine_of:
                run_sweep(trials, store, engine_of, told)
        except KeyboardInterrupt:
            _say_interrupted(trials, store)
            raise typer.Exit(INTERRUPTED) from None
        ended = store.summary(before)
    clock = trials[0].kind.clock
    if as_json:
        print_json({"schema": 1, "clock": str(clock), "engine": str(engine), **ended.as_json()})
    else:
        print_summary(ended, definition, clock)
    say(f"sweep folder: {folder}")
    return bool(ended.counts["failed"] or ended.counts["lost"])


@contextmanager
def engine_for(name: EngineName, store: Store) -> Iterator[Engine]:
    if name is EngineName.RAY:
        from trilane.apps.sweep.engines import cluster

        with stdout_kept(), cluster(store.folder) as engine:  # Ray prints messages about dead machines on stdout
            yield engine
        return
    from trilane.apps.sweep.engines import TrialPlace, run_here

    yield partial(run_here, place=TrialPlace(store.folder), inherited=(store.lock,))


def described(definition: Definition) -> dict[str, Any]:
    return {
        "command": list(definition.command),
        "options": dict(definition.options),
        "axes": {name: list(values) for name, values in definition.axes.items()},
        "kind": str(definition.kind),
        "count": definition.count,
        "seed": definition.seed,
        "repeats": definition.repeats,
    }


def _say_interrupted(trials: Sequence[Trial], store: Store) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # only the message below is left to do
    ended = store.ended.intersection(trial.id for trial in trials)
    say(f"interrupted: {len(ended)} of {len(trials)} trials are done; --resume goes on ({store.folder})")


def _print_planned(trials: Sequence[Trial], as_json: bool) -> None:
    from trilane.apps.sweep.store import planned

    if as_json:
        print_json({"schema": 1, "trials": [planned(trial).row() for trial in trials]})
        return
    for trial in trials:
        sys.stdout.write(f"{trial.id}  {trial.line}\n")


@contextmanager
def progress(left: int, whole: int) -> Iterator[Callable[[TrialRecord], None]]:
    """Show the progress of a sweep on stderr. Yield a function to call with the record of each trial that ends.

    `left`: number of trials that have not ended yet. `whole`: number of all trials.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    console = stderr_console()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[left]}"))
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("trials", total=whole, completed=whole - left, left="")
        begin, ended = time.monotonic(), 0

        def told(record: TrialRecord) -> None:
            nonlocal ended
            ended += 1
            seconds = (time.monotonic() - begin) / ended * (left - ended)
            remaining = f"{timedelta(seconds=round(seconds))} left"
            done = whole - left + ended
            if not console.is_terminal:
                console.print(f"{done}/{whole} {_line(record)}; {remaining}", soft_wrap=True)
            elif record.status != "done":
                console.print(_line(record), soft_wrap=True)
            bar.update(task, completed=done, left=remaining)

        yield told


def _line(record: TrialRecord) -> str:
    took = "" if record.seconds is None else f" in {record.seconds:.1f} s"
    why = f": {record.error}" if record.error else ""
    return f"{record.status} {words_text(record.options)}{took}{why}{_disturbed(record)}"


def _disturbed(record: TrialRecord) -> str:
    """Return how often a trial was repeated, and one reason why its result is unsure; "" if neither applies."""
    times = record.repeated
    again = f"; done again {times} {'time' if times == 1 else 'times'}, as the machine was not quiet" if times else ""
    return again + "".join(f"; UNSURE: {reason}" for reason in record.unsure[:1])


def words_text(options: Mapping[str, Any]) -> str:
    return " ".join(f"{name}={value}" for name, value in options.items())


def print_summary(ended: SweepSummary, definition: Definition, clock: str) -> None:
    """Print a table with a row for each trial, a line of counts, and a line for each error.

    If trials were repeated because the machine was not quiet, a line counts them.

    `definition`: definition of the sweep, with the axes. `clock`: clock of its trials.
    """
    from rich.table import Table

    from trilane.apps.sweep.definition import value_at

    axes = list(definition.axes)
    repeats = ["repeat"] if definition.repeats > 1 else []
    results = [_answer(record.result or {}) for record in ended.trials]
    shown = FIGURES | (ERRORS if any(result.get("check") for result in results) else {})
    table = Table(*axes, *repeats, "status", "seconds", *shown)
    for record, result in zip(ended.trials, results, strict=True):
        cells = [record.options[name] for name in axes] + [record.repeat for _ in repeats]
        figures = [value_at(result, path) for path in shown.values()]
        table.add_row(*(text(each) for each in [*cells, marked(record.status, record), record.seconds, *figures]))
    stdout_console().print(table)
    counts = ended.counts
    counted = ", ".join(f"{counts[key]} {key}" for key in ("trials", "done", "failed", "lost", "skipped"))
    stdout_console().print(f"{counted}; {clock} clock")
    if again := [record for record in ended.trials if record.repeated]:
        unsure = sum(bool(record.unsure) for record in again)
        print_line(f"the machine was not quiet: runs done again: {len(again)}, UNSURE still: {unsure}")
    errors = Counter((record.status, record.error) for record in ended.trials if record.error)
    for (status, error), count in errors.items():
        print_line(f"{count} {status}: {error}")


def _answer(result: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the part of a trial's `result` that has the figures, such as `fps`.

    For a prediction of a pipeline file, this part is the last predicted variant. Otherwise, it is the whole result.
    """
    pipelines = result.get("pipelines")
    last = pipelines[-1] if isinstance(pipelines, list) and pipelines else None
    return last if isinstance(last, dict) and "what_if" in last else result


def marked(word: str, record: TrialRecord) -> str:
    """Return `word`, followed by UNSURE if the machine was not quiet during the trial of `record`."""
    return f"{word}, UNSURE" if record.unsure else word


def text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
