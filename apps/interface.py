"""Trilane for programs and notebooks: `run`, `predict`, `load_run`, and their results (docs/python.md).

Rule: the command line uses the same functions. Nothing here prints or ends the program. A failure raises a
TrilaneError. Messages for people are in the report or go to a callback. A notebook shows a run or a prediction as an
HTML table, in which every value is escaped.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from trilane.apps.explain.explained_run import COLUMNS, explain_run, figure_names, job_rows, open_journal
from trilane.apps.old_names import in_new_name
from trilane.apps.predict.predict_options import OF_A_PIPELINE_ALONE, PredictOptions
from trilane.apps.predict.predicted_verdict import document_of, predicted_verdict
from trilane.apps.run.asked_run import run_asked
from trilane.apps.run.report import Report, read_report
from trilane.apps.run.verdict import Verdict
from trilane.apps.run.verdict_facts import verdict_of
from trilane.errors import BadInputError, MissingPartError, TrilaneError, did_you_mean
from trilane.hw_profiles.prediction import ApplicationPrediction, NetworkPrediction
from trilane.hw_profiles.schema import SHARE_TEXT
from trilane.options import EMPTY_PATH, Options
from trilane.pipeline.journal import Record, Stepped
from trilane.pipeline.timeline import Presented, Timeline
from trilane.pipeline.unit_history import IdleSlice
from trilane.scheduler.events import Event
from trilane.scheduler.stats import CONFIDENCE_TEXT
from trilane.signals import INTERRUPTED
from trilane.stages.run_options import RunOptions
from trilane.units import COMPUTED, MEASURED, NO_FIGURES

if TYPE_CHECKING:
    import pandas

#: Defaults of `run` that differ from the defaults of the command line.
DEFAULTS = {"baseline_frames": 0}
#: Options that `predict` accepts. The command line also has options that give several answers or write a file.
PREDICTED = PredictOptions.model_fields.keys() - (
    {"scene", "beside", "turns", "what_if", "plot", "trace", "table"} | OF_A_PIPELINE_ALONE
)
FRAME_TYPE = np.dtype(
    [("frame", np.int64), ("presented_ns", np.int64), ("frame_ns", np.int64), ("latency_ns", np.int64)]
)
#: A row of an HTML table: name, value, and source of the value.
Row = tuple[str, str, str]
TOO_SHORT = "too short to tell"


class Run:
    """A finished run.

    `folder`: run folder.
    `report`: content of report.json (docs/report.md), with facts about the machine and the avatars' error.
    `jobs`, `events` and `idle` are read from the journal at first use and stay in memory.
    """

    def __init__(self, folder: Path, report: Report) -> None:
        self.folder, self.report = folder, report

    def __repr__(self) -> str:
        return f"Run {self.folder}\n{self.verdict}"

    @cached_property
    def verdict(self) -> Verdict:
        """The verdict: whether the run holds its rate, what bounds the run, how quiet the machine was, what to try."""
        return verdict_of(self.report, str(self.folder))

    def _repr_html_(self) -> str:
        return run_html(self.report, str(self.folder))

    def records(self) -> Iterator[Record]:
        """Yield the records of the journal after the first record, in order.

        Raises BadInputError for a missing or broken journal.
        """
        return open_journal(self.folder)[1]

    @cached_property
    def jobs(self) -> NDArray[Any]:
        """All jobs in the order of their ends: a structured array of shape (jobs,), with the fields of docs/explain.md.

        Times are int64, ns; words are `str_`, flags are bool. A stage's metrics are float64, and NaN in the jobs of
        other stages.
        Raises BadInputError for a missing or broken journal.
        """
        figures = figure_names(self.folder)
        begun, _ = open_journal(self.folder)
        words = max(len(word) for stage in begun.graph.stages for word in (stage.name, stage.unit, "preempted"))
        kinds: dict[type, Any] = {int: np.int64, bool: np.bool_, str: f"U{words}"}
        fields = [(name, kinds[kind]) for name, (kind, _) in COLUMNS.items()]
        dtype = np.dtype([*fields, *((name, np.float64) for name in figures)])
        rows = (tuple(np.nan if value is None else value for value in row) for row in job_rows(self.folder, figures))
        return np.fromiter(rows, dtype)

    @cached_property
    def events(self) -> list[tuple[int, Event]]:
        """The events that the scheduler received, in order, each as (time in ns, event of `trilane.scheduler.events`).

        Raises BadInputError for a missing or broken journal.
        """
        return [(step.now_ns, event) for step in self.records() if isinstance(step, Stepped) for event in step.events]

    @cached_property
    def idle(self) -> list[IdleSlice]:
        """The idle slices of all units, in the order of their ends.

        Raises BadInputError for a missing or broken journal.
        """
        begun, records = open_journal(self.folder)
        timeline = Timeline(begun.graph, begun.settings, idle=True)
        facts = [fact for record in records for fact in timeline.add(record)]
        return [fact for fact in facts if isinstance(fact, IdleSlice)] + timeline.end()

    def frames(self) -> NDArray[Any]:
        """Return the presented frames, in order: a structured array of shape (frames,), all fields int64.

        `frame`: number of the frame.
        `presented_ns`: time of its presentation.
        `frame_ns`: time since the previous presented frame, -1 for the first presented frame.
        `latency_ns`: latency of the frame, -1 if the stage that ends the latency had no job for the frame.
        Raises BadInputError for a missing or broken journal.
        """
        begun, records = open_journal(self.folder)
        timeline = Timeline(begun.graph, begun.settings)
        shown = (fact for record in records for fact in timeline.add(record) if isinstance(fact, Presented))
        rows = [
            (one.frame, one.end_ns, *(-1 if ns is None else ns for ns in (one.interval_ns, one.latency_ns)))
            for one in shown
        ]
        return np.array(rows, FRAME_TYPE)

    def to_pandas(self) -> pandas.DataFrame:
        """Return `jobs` as a data frame: a row for each job, a column for each field.

        Raises MissingPartError without pandas, which the extra `table` installs, and BadInputError as `jobs` does.
        """
        try:
            import pandas
        except ImportError:
            raise MissingPartError("a data frame needs pandas", extra="table") from None
        return pandas.DataFrame({name: self.jobs[name] for name in self.jobs.dtype.names or ()})

    def explain(self, slowest: int = 10) -> dict[str, Any]:
        """Return the document of `trilane explain RUN --json --slowest N` (docs/explain.md).

        `slowest`: number N of slowest frames to name.
        Raises BadInputError for a missing or broken journal.
        """
        return explain_run(self.folder, slowest).as_json()


class RunFailedError(TrilaneError):
    """A run ended early.

    `run`: the run, with all data until its end.
    `exit_code`: exit code that `trilane run` has in this case.
    """

    def __init__(self, message: str, run: Run, exit_code: int) -> None:
        super().__init__(message)
        self.run, self.exit_code = run, exit_code


def load_run(folder: str | Path) -> Run:
    """Load the run in `folder`. Raises BadInputError if `folder` does not exist or has no complete report."""
    if isinstance(folder, str) and not folder.strip():
        raise BadInputError("load_run", *EMPTY_PATH)
    place = Path(folder)
    if not place.is_dir():
        raise BadInputError(place, "no folder", "the folder of a run")
    return Run(place, read_report(place))


def run(
    scene: str | Path = "default",
    *,
    on_progress: Callable[[str, int, int], None] | None = None,
    on_message: Callable[[str], None] | None = None,
    **options: Any,
) -> Run:
    """Run a scene or a pipeline file, with a process for each unit, and return the finished run.

    `scene`: a scene file, the name of a bundled scene, or a pipeline file.
    `options`: fields of `trilane.stages.run_options.RunOptions`; `trilane run --help` explains them. None means the
    scene's own value. `cores` may be a mapping, such as {"dsp": [0, 1]}. A baseline, which is a `sequential` run of the
    same scene, follows only if `baseline_frames` is above 0.
    `on_progress(what, done, total)`: function that gets the progress, in the caller's thread. `what` is the policy, or
    `check` during the check; `done` and `total` are numbers of frames.
    `on_message(text)`: function that gets messages for a person, in the caller's thread.
    Raises BadInputError or MissingPartError if the run cannot begin. Raises RunFailedError if the run ended early but
    left its folder, TrilaneError if no frame was presented. After an interrupt, raises KeyboardInterrupt as soon as the
    folder is complete; there is no folder if no frame was presented.
    """
    from trilane.apps.run.run_job import Hooks
    from trilane.pipeline.pipeline_file import is_pipeline_file

    parameters = inspect.signature(run).parameters
    given = _bound(run, scene, options)
    asked = RunOptions.checked(given if is_pipeline_file(Path(scene)) else DEFAULTS | given)
    told = (f"{name}={value!r}" for name, value in given.items() if value != parameters[name].default)
    hooks = Hooks(on_progress or (lambda *_: None), on_message or (lambda _: None))
    outcome = run_asked(asked, lambda: nullcontext(hooks), ("trilane.run", *told))
    done = Run(outcome.folder, outcome.report)
    if outcome.exit_code == INTERRUPTED:
        raise KeyboardInterrupt(f"what was done is in {outcome.folder}")
    if outcome.exit_code:
        message = outcome.report.failure or "the run ended early"
        raise RunFailedError(f"{message}; what was done is in {outcome.folder}", done, outcome.exit_code)
    return done


def _signature(
    function: Callable[..., Any], model: type[Options], names: Iterable[str], defaults: Mapping[str, Any] | None = None
) -> inspect.Signature:
    """Return the signature of `function`, with a keyword parameter for each option in place of `**options`.

    `function`: `run` or `predict`.
    `model`: class of the options.
    `names`: names of the options to include.
    `defaults`: defaults by name that replace the defaults of `model`; None to keep all defaults.
    """
    signature = inspect.signature(function, eval_str=True)
    first, *told, _ = signature.parameters.values()
    options = [
        inspect.Parameter(
            name, first.KEYWORD_ONLY, default=(defaults or {}).get(name, field.default), annotation=field.annotation
        )
        for name, field in model.model_fields.items()
        if name in names and name != first.name
    ]
    return signature.replace(parameters=[first, *options, *told])


run.__signature__ = _signature(run, RunOptions, RunOptions.model_fields, DEFAULTS)  # type: ignore[attr-defined]


@dataclass(frozen=True, repr=False)
class Prediction:
    """A prediction of an application or a network on a chip; every figure is computed.

    `answer`: prediction as a typed record.
    `profile`: name of the hardware profile.
    `what`: the avatar, the network file or the published network.
    `frame_ms`: mean frame time.
    `low_ms`, `high_ms`: ends of the 80 % interval of `frame_ms`, None if the model's error is unknown.
    `latency_ms`: mean latency, None for a network by itself.
    `power_w`: power of the whole device.
    """

    answer: ApplicationPrediction | NetworkPrediction
    profile: str
    what: str
    frame_ms: float
    low_ms: float | None
    high_ms: float | None
    latency_ms: float | None
    power_w: float

    @cached_property
    def document(self) -> Mapping[str, Any]:
        """The document of `trilane predict --json`."""
        return document_of(self.answer)

    @property
    def fps(self) -> float:
        """Return the frame rate, in frames a second."""
        return 1e3 / self.frame_ms

    @property
    def is_display_capped(self) -> bool:
        """Return whether the frame rate is limited by the display or by the requested rate, and not by the chip."""
        return isinstance(self.answer, ApplicationPrediction) and self.answer.is_capped_throughout

    @property
    def units(self) -> Mapping[str, Any]:
        """Return the shares of each unit's time, by the unit's name. The result is empty for a network by itself.

        Each value is a mapping: `busy` is the busy share, `idle` maps each cause to its idle share.
        """
        found: Mapping[str, Any] = self.document.get("units", {})
        return found

    def __repr__(self) -> str:
        return f"{self.what} on {self.profile}\n{self.verdict}"

    @cached_property
    def verdict(self) -> Verdict:
        """The verdict: whether the chip holds the rate, what bounds the frame time, how sure that is, what to try."""
        return predicted_verdict(self.answer)

    def _repr_html_(self) -> str:
        busy = ", ".join(f"{unit} {row['busy']:.0%}" for unit, row in self.units.items())
        around = "" if self.low_ms is None else f" ({SHARE_TEXT}: {self.low_ms:.2f} to {self.high_ms:.2f})"
        rows = dict(self.verdict.lines()) | {
            "frame time": f"{self.frame_ms:.2f} ms{around}",
            "rate": f"{self.fps:.1f} frames a second{', as the display shows them' if self.is_display_capped else ''}",
            "latency": "" if self.latency_ms is None else f"{self.latency_ms:.1f} ms",
            "power": f"{self.power_w:.1f} W",
            "busy": busy,
        }
        title = f"{self.what} on {self.profile}"
        return prediction_html(title, {name: text for name, text in rows.items() if text})


def predict(
    profile: str | Path = "snapdragon-888", *, on_message: Callable[[str], None] | None = None, **options: Any
) -> Prediction:
    """Predict frame time, idleness, heat and energy on a chip.

    `profile`: hardware profile, by name or file.
    `options`: fields of `trilane.apps.predict.predict_options.PredictOptions` in `PREDICTED`; `trilane predict --help`
    explains them. `avatar` selects the avatar whose network the application runs, by default the avatar `default`.
    `network` is an ONNX file. This network is predicted by itself or, with `application`, in place of the avatar's
    network. `encoder`, `norm`, `size` and `channels` select the published application.
    `on_message(text)`: function that gets a message before this machine is measured for the profile `host`. The
    measurement may take half a minute.
    Raises BadInputError for an unknown profile, and for options that are wrong or do not fit together.
    """
    from trilane.apps.predict import asked_prediction as asked
    from trilane.avatars.bundle import DEFAULT
    from trilane.hw_profiles.profile_files import load_runnable

    given = _bound(predict, profile, options)
    wanted = PredictOptions.checked({name: value for name, value in given.items() if value is not None})
    wanted.check_together()
    chip, say = load_runnable(wanted.profile), on_message or (lambda _: None)
    if wanted.is_bare:
        answers = asked.predict_networks(chip, wanted, say)
        if len(answers) != 1:
            raise BadInputError("network", f"{len(answers)} networks", "one")
        what, alone = str(wanted.network[0]), answers[0]
        return Prediction(alone, chip.name, what, *alone.frame, None, alone.power.w)
    chip, plan = asked.application_of(chip, wanted, say)
    answer = asked.answer_of(chip, plan, wanted)
    published = f"{wanted.encoder}, {wanted.size}" if wanted.is_published else wanted.avatar or DEFAULT
    what = str(wanted.network[0]) if wanted.network else published
    return Prediction(answer, chip.name, what, *answer.frame, answer.latency_ms.mean, answer.power_w)


predict.__signature__ = _signature(predict, PredictOptions, PREDICTED)  # type: ignore[attr-defined]


def _bound(function: Callable[..., Any], first: str | Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a call, by the present names of the parameters.

    `function`: `run` or `predict`, which was called.
    `first`: value of the first parameter.
    `options`: other arguments by name. An old name causes a DeprecationWarning.
    Raises TypeError for an unknown name, with the most similar option.
    """
    command, signature = function.__name__, inspect.signature(function)
    warned = partial(warnings.warn, category=DeprecationWarning, stacklevel=4)  # at the caller of `run` or `predict`
    named = {}
    for given, value in options.items():
        name = in_new_name(command, given, value, warned)  # no comprehension, which is a level before Python 3.12
        if name not in signature.parameters:
            meant = "".join(f"; {text}" for text in [did_you_mean(name, signature.parameters)] if text)
            raise TypeError(f"{command}() got an unexpected keyword argument {name!r}{meant}")
        named[name] = value
    return signature.bind(first, **named).arguments


def table(title: str, rows: Iterable[Row]) -> str:
    """Return an HTML table with the caption `title`. All texts are escaped.

    `rows`: (name, value, source) of each figure.
    """
    body = "".join(
        f"<tr><th style='text-align:left'>{escape(name)}</th><td style='text-align:left'>{escape(value)}</td>"
        f"<td style='text-align:left'><small>{escape(source)}</small></td></tr>"
        for name, value, source in rows
    )
    caption = f"<caption style='text-align:left'><b>{escape(title)}</b></caption>"
    return f"<table>{caption}<tbody>{body}</tbody></table>"


def run_html(report: Report, folder: str) -> str:
    """Return an HTML table of a run: verdict, most important figures, error of the avatars, and machine.

    `report`: report of the run.
    `folder`: path of the run folder, for the caption.
    """
    verdict = [(label, text, "") for label, text in verdict_of(report, folder).lines()]
    return table(f"Run {folder}", [*verdict, *_run_rows(report)])


def _run_rows(report: Report) -> Iterable[Row]:
    measured = MEASURED if report.clock == "host" else COMPUTED
    times, latency, frames = report.frame_time_ms, report.latency_ms, report.frames
    if report.failure:
        yield "failed", report.failure, ""
    if frames.presented > 1:
        yield "frame time", f"{times.mean:.2f} ms ({_between(times.mean_low, times.mean_high)})", measured
        yield "rate", f"{report.fps:.1f} frames a second ({_between(report.fps_low, report.fps_high)})", measured
    for name, facts in report.accuracy.items():
        yield (f"error of {name}", *_error(facts))
    if latency.p50 is not None:
        yield "latency", f"p50 {latency.p50:.1f} ms, p95 {latency.p95:.1f} ms", measured
    counts = f"{frames.presented} presented, {frames.lost} lost, {sum(frames.dropped.values())} dropped"
    yield "frames", counts + (f", {frames.not_begun} not begun" if frames.not_begun else ""), measured
    for unit, shares in report.units.items():
        idle = ", ".join(f"{cause} {share:.0%}" for cause, share in shares.idle if share)
        yield unit, f"busy {shares.busy:.0%}; {idle}", measured
    scene = report.config["scene"]
    size = f"tensor size {scene['size']}, " if "size" in scene else ""
    yield "scene", f"{scene['name']}, {size}{report.policy}, {report.edge}", ""
    yield "machine", report.machine.cpu.model, ""


def _between(low: float | None, high: float | None) -> str:
    return TOO_SHORT if low is None or high is None else f"{CONFIDENCE_TEXT}: {low:.2f} to {high:.2f}"


def _error(facts: Mapping[str, Any]) -> tuple[str, str]:
    """Return two texts about an avatar's error: the PSNR of each band of zoom, and the source of these figures.

    For an avatar without figures, the texts are `NO_FIGURES` and the reason. `facts`: the avatar's entry in `accuracy`
    of report.json.
    """
    if "psnr_db_by_band" not in facts:
        return NO_FIGURES, str(facts.get("why", ""))
    bands = ", ".join(f"{band} {value:.1f}" for band, value in facts["psnr_db_by_band"].items())
    return f"PSNR {bands} dB", str(facts.get("source", ""))


def prediction_html(title: str, rows: Mapping[str, str]) -> str:
    """Return an HTML table of a prediction.

    `title`: caption of the table.
    `rows`: texts by name; the source of each is `COMPUTED`.
    """
    return table(title, ((name, value, COMPUTED) for name, value in rows.items()))
