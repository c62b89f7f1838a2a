"""`trilane tune`: finds the fastest configuration of a grid within given limits, in few trials.

Rule: this file reads options and shows results; `trilane.apps.sweep.tuner` searches. A search has the same folder,
trials and engines as a sweep. With the engine `local`, predictions for a chip are computed in this process. Every
other trial has its own process.
"""

from __future__ import annotations

import io
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import print_json, print_line, say, stdout_console
from trilane.apps.cli.sweep import (
    ENDING,
    EngineName,
    EngineOption,
    ResumeOption,
    default_folder,
    described,
    engine_for,
    marked,
    of_file,
    of_words,
    progress,
    require_checks,
    text,
    words_text,
)
from trilane.apps.sweep.definition import COMMANDS, METRICS
from trilane.errors import BadInputError, did_you_mean
from trilane.signals import INTERRUPTED
from trilane.units import HOST, either

if TYPE_CHECKING:
    from trilane.apps.sweep.definition import Definition, Trial
    from trilane.apps.sweep.store import Engine, Store, TrialRecord
    from trilane.apps.sweep.tuner import Aim, Answer, Search, Space

app = Commands()
EPILOG = """\b
Examples:
  trilane tune docs/examples/chip-tune.toml --on snapdragon-888 --keep 'power<3W' --trials 60
  trilane tune latency --on snapdragon-8-gen-3 --axis size=128,192,256 --axis edge=single,double --keep 'fps>=30'
  trilane tune fps run --frames 60 --check 4 --axis size=128,192,256 --axis runtime=ort,openvino --keep 'psnr>=33'
  trilane tune fps,power docs/examples/chip-sweep.toml --trials 30 --seed 1
"""
NOTHING_KEEPS = 1

WordsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="[GOAL] [FILE|COMMAND]",
        help=f"GOAL: {either(METRICS)}, or several with commas; fps if not given. "
        "After it a sweep file, or a command with its options, as for sweep; run if none, predict with --on.",
    ),
]

KeepOption = Annotated[
    list[str] | None,
    typer.Option("--keep", help="A limit, such as 'psnr>=33', 'power<3W' or 'units.dsp.busy<0.9'. Repeat it."),
]

AxisOption = Annotated[
    list[str] | None, typer.Option("--axis", help="Values of an option, such as size=128,192,256. Repeat it.")
]

ChipOption = Annotated[
    str | None, typer.Option("--on", help="Search by predictions for this hardware profile, not by runs.")
]

TrialsOption = Annotated[int, typer.Option("--trials", min=1, help="Number of configurations to try.")]

SeedOption = Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of the search.")]

ShortOption = Annotated[
    int | None,
    typer.Option(
        "--short",
        min=1,
        help="With run: begin each trial with a run of this many frames; end it if this run is below the median.",
    ),
]

FolderOption = Annotated[
    Path | None, typer.Option("--out", help="Folder of the sweep; sweeps/tune-NAME-HASH if not given.")
]


@app.command(epilog=EPILOG, context_settings={"ignore_unknown_options": True})
def tune(
    words: WordsArgument,
    keep: KeepOption = None,
    on: ChipOption = None,
    axis: AxisOption = None,
    trials: TrialsOption = 40,
    seed: SeedOption = 0,
    short: ShortOption = None,
    engine: EngineOption = EngineName.LOCAL,
    resume: ResumeOption = False,
    out: FolderOption = None,
    as_json: JsonOption = False,
) -> None:
    """Search the axes of a sweep for the fastest configuration within given limits.

    The output is the best configuration with its figures and its command, the frontier, and what was not tried. The
    command writes the folder of a sweep: trilane report shows this folder, and trilane sweep --resume runs the trials
    that are left. The exit code is 1 if no configuration keeps the limits. docs/tune.md says more.
    """
    from trilane.apps.sweep.tuner import Aim, Search, keep_of

    goals, rest = _goals(words)
    aim = Aim(goals, tuple(map(keep_of, keep or ())))
    name, definition, space = _space(rest, axis or [], on)
    _check_short(short, definition, aim)
    search = Search(space, aim, seed)
    if engine is EngineName.RAY:
        from trilane.apps.sweep.engines import required_ray

        required_ray()
    else:
        require_checks(space.trials)
    folder = out or default_folder(f"tune-{name}", space.trials)
    found = _tune(search, folder, definition, engine, min(trials, len(space.trials)), short, resume)
    clock, keeps = space.trials[0].kind.clock, [str(each) for each in aim.keeps]
    if as_json:
        head = {"schema": 1, "clock": str(clock), "engine": str(engine), "folder": str(folder.absolute())}
        print_json({**head, "goal": list(goals), "keep": keeps, **found.as_json(), "seed": seed})
    else:
        _print_answer(found, keeps, list(definition.axes))
        _print_rest(found, list(definition.axes), clock)
    say(f"sweep folder: {folder}")
    raise typer.Exit(NOTHING_KEEPS if found.best is None else 0)


def _goals(words: Sequence[str]) -> tuple[tuple[str, ...], list[str]]:
    """Return the goals, and the words after the goals: a sweep file, or a command with its options.

    `words`: arguments as typed. Without a goal, the goal is `fps`. Raises BadInputError if the first word is neither
    goals, nor a sweep file, nor a command.
    """
    first = words[0]
    goals = tuple(dict.fromkeys(first.split(",")))
    if all(goal in METRICS for goal in goals):
        return goals, list(words[1:])
    if first.endswith(ENDING) or first in COMMANDS:
        return ("fps",), list(words)
    expected = f"a goal ({', '.join(METRICS)}), a command ({', '.join(COMMANDS)}) or a sweep file ({ENDING})"
    raise BadInputError("goal", repr(first), expected, did_you_mean(first, [*METRICS, *COMMANDS]))


def _space(words: Sequence[str], axes: Sequence[str], chip: str | None) -> tuple[str, Definition, Space]:
    """Return the name of a sweep, its definition, and the space of its configurations.

    `words`: sweep file, or command with its options; if empty, the command is `run`, or `predict` with a chip.
    `axes`: values of --axis, as typed. `chip`: value of --on; None if not given.

    Raises BadInputError for a wrong or repeated --axis, and for a chip with another command than `predict`.
    """
    from trilane.apps.sweep.tuner import Space
    from trilane.hw_profiles.profile_files import load_runnable

    words = words or ["run" if chip is None else "predict"]
    is_file = words[0].endswith(ENDING)
    name, definition, command = (of_file if is_file else of_words)(words, False, None, None)
    if chip is not None:
        if definition.command != ("predict",) or "profile" in definition.axes:
            found = "an axis profile" if "profile" in definition.axes else f"the command {' '.join(definition.command)}"
            raise BadInputError("--on", found, "predict without it", "a chip is predicted, not run")
        load_runnable(chip)  # refuses an unknown chip before a trial does
        definition = replace(definition, options={**definition.options, "profile": command.converted("profile", chip)})
    added: dict[str, list[str]] = {}
    for each in axes:
        option, sign, values = each.partition("=")
        if not sign or not values:
            raise BadInputError("--axis", repr(each), "an option and its values, such as size=128,192,256")
        if option in added:
            raise BadInputError("--axis", f"{option} twice", "each axis once")
        added[option] = values.split(",")
    named = command.in_new_names(added, "--axis")
    typed = {option: [command.converted(option, value) for value in values] for option, values in named.items()}
    definition = replace(definition, axes={**definition.axes, **typed})
    return name, definition, Space(definition, command.words_of)


def _check_short(short: int | None, definition: Definition, aim: Aim) -> None:
    from trilane.apps.sweep.tuner import FRAMES

    if short is None:
        return
    if definition.command != ("run",) or FRAMES in definition.axes:
        raise BadInputError("--short", f"{' '.join(definition.command)}", "run, whose frames are no axis")
    if len(aim.goals) > 1:
        raise BadInputError("--short", f"{len(aim.goals)} goals", "one goal", "a median of several goals is none")


def _tune(
    search: Search,
    folder: Path,
    definition: Definition,
    engine: EngineName,
    budget: int,
    short: int | None,
    resume: bool,
) -> Answer:
    """Search for the best configuration, keep the trials in `folder`, and return the answer.

    `search`: goals, limits and configurations. `definition`: sweep that the folder belongs to. `engine`: machines that
    run the trials. `budget`: number of configurations to try. `short`: frames of the short run before each trial; None
    for no short runs. `resume`: whether to resume a search that was interrupted.

    Raises typer.Exit if the search is interrupted.
    """
    from trilane.apps.run.report_facts import made_facts
    from trilane.apps.sweep.store import Store, run_sweep
    from trilane.apps.sweep.tuner import answer, tune

    space = search.space
    about = {"made": made_facts(("trilane", *sys.argv[1:])), "definition": described(definition)}
    steps = budget * (1 if short is None else 2)
    with Store(folder, space.trials, about, resume=resume) as store:

        def do(trials: Sequence[Trial]) -> Mapping[str, TrialRecord]:
            run_sweep(trials, store, engine_of, told)
            return {trial.id: store.done[trial.id] for trial in trials}

        try:
            with progress(steps, steps) as told, _engine(engine, store, space.trials) as (engine_of, together):
                tune(search, do, budget, together, short)
        except KeyboardInterrupt:
            say(f"interrupted: {len(search.tried)} of {budget} configurations are tried; --resume goes on ({folder})")
            raise typer.Exit(INTERRUPTED) from None
        return answer(search, store.done)


@contextmanager
def _engine(name: EngineName, store: Store, trials: Sequence[Trial]) -> Iterator[tuple[Engine, int]]:
    """Yield a pair: the engine `name` for `trials`, and the number of trials that this engine runs at the same time.

    `store`: open folder of the sweep.
    """
    from trilane.apps.sweep.engines import at_once, at_once_on_ray, run_inside

    if name is EngineName.LOCAL and all(_is_of_chip(trial) for trial in trials):
        yield partial(run_inside, call=_called), 1
        return
    clock = trials[0].kind.clock
    with engine_for(name, store) as engine:
        yield engine, at_once_on_ray(clock) if name is EngineName.RAY else at_once(clock)


def _is_of_chip(trial: Trial) -> bool:
    return trial.command == ("predict",) and trial.options.get("profile") != HOST


def _called(words: list[str]) -> tuple[int, str, str]:
    """Run a command in this process, and return its exit code, stdout and stderr. `words`: command and arguments.

    Raises KeyboardInterrupt if the command was interrupted.
    """
    from trilane.apps.cli.main import command_of, describe

    out, messages = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(messages):
        try:
            code = command_of(words[0]).main(args=words[1:], prog_name=words[0], standalone_mode=False)
        except Exception as error:
            said, code = describe(error)
            messages.write(f"error: {said}\n")
    if code == INTERRUPTED:  # an interrupt ended the command, and shall end the search too
        raise KeyboardInterrupt
    return code or 0, out.getvalue(), messages.getvalue()


def _print_answer(found: Answer, keeps: Sequence[str], axes: Sequence[str]) -> None:
    """Print the best configuration and its command. If none keeps the limits, print the one nearest to the limits.

    `keeps`: limits as texts. `axes`: names of the axes.
    """
    shown, head = found.best, "best"
    if shown is None:
        shown = found.nearest
        if shown is None:
            print_line("no trial has the figures that are asked for")
            return
        print_line(f"no configuration that was tried keeps {', '.join(keeps)}")
        head = f"nearest, misses {', '.join(shown.misses)}"
    options = {name: shown.record.options[name] for name in axes}
    print_line(f"{head}: {words_text(options)}: {_figures(shown.metrics)}")
    print_line(shlex.join(shown.command))
    for reason in shown.record.unsure:
        print_line(f"UNSURE: {reason}")


def _print_rest(found: Answer, axes: Sequence[str], clock: str) -> None:
    """Print the frontier, and the numbers of failed and untried configurations.

    `axes`: names of the axes. `clock`: clock of the trials.
    """
    from rich.table import Table

    if found.frontier:
        table = Table(*axes, *map(_headed, found.weighed), "keeps", title="frontier")
        for trial in found.frontier:
            cells = [trial.record.options[name] for name in axes] + [trial.metrics[name] for name in found.weighed]
            table.add_row(*map(text, cells), marked("yes" if trial.keeps else "no", trial.record))
        stdout_console().print(table)
    untried = "".join(f"; no trial with {name} {', '.join(map(str, each))}" for name, each in found.not_tried.items())
    tried = f"{len(found.trials)} of {found.size} configurations tried"
    print_line(f"{tried}, {found.left} not{untried}; {clock} clock")
    for status in ("failed", "lost", "pruned"):
        these = [trial.record for trial in found.trials if trial.record.status == status]
        errors = "; ".join(dict.fromkeys(record.error for record in these if record.error))
        if these:
            print_line(f"{len(these)} {status}" + (f": {errors}" if errors else ""))


def _unit(name: str) -> str:
    """Return the unit of measure of the figure `name`; "" for a figure without a unit, or if `name` is the unit."""
    return METRICS[name].unit if name in METRICS and METRICS[name].unit != name else ""


def _headed(name: str) -> str:
    return f"{name}, {_unit(name)}" if _unit(name) else name


def _figures(metrics: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g} {_unit(name)}".strip() for name, value in metrics.items())
