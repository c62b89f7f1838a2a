"""Predictions for a pipeline file on a chip: for the file as it is, and for the variant that each `--set` makes.

Rule: this module prints nothing and imports no Python of the file. `trilane.hw_profiles` computes the answers.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any, Final

from trilane.apps.check.port_types import port_types, read_networks
from trilane.apps.explain.explained_run import open_journal
from trilane.apps.predict.predict_options import PredictOptions
from trilane.apps.predict.predicted_verdict import pipeline_verdict
from trilane.apps.run.report import REPORT_FILE, read_report
from trilane.apps.run.verdict import Trust, trust_of
from trilane.errors import BadInputError
from trilane.hw_profiles.graph_file import GraphFile
from trilane.hw_profiles.network_time import Computes
from trilane.hw_profiles.pipeline_prediction import MeasuredStages, predict_file, prices_of, stages_without_time
from trilane.hw_profiles.profile_files import load_runnable
from trilane.hw_profiles.schema import Profile, corners_of
from trilane.pipeline.file_keys import MOST_SAMPLES, OnnxStage, StageTime
from trilane.pipeline.journal import Worked
from trilane.pipeline.pipeline_file import PipelineFile, assignments, read_pipeline
from trilane.units import HOST, INFER, NS_PER_MS, UnitName

NONE_SKIPS: Final = "no frame takes the bypass of {}: its table says neither share nor pattern"
ASSUMED: Final = (
    "networks whose file says no precision, and what is assumed because their unit computes so: {}; "
    "`precision` of the stage or --precision says another"
)
NO_BASE: Final = "the file as it is has no prediction, because only --set says the times of: {}"
FROM_HAND_OVER: Final = "measured times count from the hand-over of a job, with its waits for a core"
WITH_A_CORE: Final = "measured times leave out the waits for a core that this machine's kernel counted"
APART: Final = "networks are priced alone: units that work at once share memory and heat, which is not in these times"


def predict_asked_file(options: PredictOptions, path: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Return the document of `trilane predict FILE.toml --json`, which predicts the file `path` and its variants.

    `options`: options of the prediction. `say`: function that gets a message before an action that takes seconds.

    Raises BadInputError for an unknown chip, a file, change or measured run that cannot be used, or a stage without a
    time.
    """
    chips = _Chips(options, say)
    measured, of_run = MeasuredStages({}, "", chips.name), None
    if options.measured:
        measured, of_run = _measured(options.measured, chips.name), _trust_in(options.measured)
    file = _with_share(read_pipeline(path), measured)
    lacking = stages_without_time(file, measured) if options.changes else []
    variants = [] if lacking else [("", file)]
    variants += [(text, file.changed(assignments(text))) for text in options.changes]
    answers = []
    for text, each in variants:
        try:
            answers.append(_answer(each, text, options, chips, measured, of_run))
        except BadInputError as error:
            where = f"{error.where}, with --set {text}" if text else error.where
            raise BadInputError(where, error.found, error.expected, error.remedy) from None
    chip = chips.used
    return {
        "schema": 1,
        "clock": "virtual",
        "machine": {"profile": chip.name, "title": chip.title} if chip else None,
        "config": {"performance_profile": options.cap if chip else None, "seed": options.seed},
        "pipelines": answers,
        "notes": [
            *([APART] if chip else []),
            *([ASSUMED.format(", ".join(chips.assumed))] if chips.assumed else []),
            *_clock(measured),
            *_without_share(file),
            *_without_base(lacking),
        ],
    }


def _clock(measured: MeasuredStages) -> list[str]:
    """Return a list with a note that says which part of a job counts as its time; empty if no times were measured."""
    return [FROM_HAND_OVER if measured.chip == HOST else WITH_A_CORE] if measured.times else []


def _without_share(file: PipelineFile) -> list[str]:
    return [NONE_SKIPS.format(file.bypass[0])] if file.bypass and file.bypass[1].taken is None else []


def _without_base(lacking: Sequence[str]) -> list[str]:
    """Return a list with a note that only variants are predicted; empty if no stage lacks a time.

    `lacking`: names of the stages without a time in the file.
    """
    return [NO_BASE.format(", ".join(lacking))] if lacking else []


class _Chips:
    """The chip of a prediction, with its units in the precision that each network needs.

    `options`, `say`: as in `predict_asked_file`.

    `name`: name of the requested chip. If no chip is requested, the name is HOST if the options name a measured run,
    and the default chip if they name no run.

    `used`: profile of the chip; None until the profile is loaded. It is loaded if it is requested, or when a network
    needs it.

    `assumed`: texts "STAGE PRECISION" as keys, in order, for networks whose file states no precision; the values are
    None.
    """

    def __init__(self, options: PredictOptions, say: Callable[[str], None]) -> None:
        self._options, self._say = options, say
        self._known: dict[Hashable, Profile] = {}
        is_asked = "profile" in options.model_fields_set
        self.assumed: dict[str, None] = {}
        self.used = load_runnable(options.profile) if is_asked else None
        self.name = self.used.name if self.used else HOST if options.measured else options.profile

    def chip_for(self, name: str, stage: OnnxStage, graph: GraphFile, unit: UnitName) -> Profile:
        """Return the chip whose unit `unit` has the precision and runtime of the network `graph` of `stage`.

        If the chip is this machine, `unit` is its unit for networks, and no precision is requested, calls of the
        network are measured first. `name`: name of `stage`.
        """
        options, asked = self._options, stage.precision or self._options.numbers
        key = graph.path, tuple(sorted(stage.shapes.items())), unit, asked, stage.runtime
        if key not in self._known:
            chip = self.used = self.used or load_runnable(self.name)
            chip = Computes(graph.numbers, asked, options.engine).on(chip, unit)
            if chip.name == HOST and unit == INFER[1] and asked is None:
                from trilane.apps.predict.this_machine import with_file

                chip = with_file(chip, graph, stage.shapes, self._say, runtime=stage.runtime)
            self._known[key] = chip
        if asked is None and graph.numbers == "not said":
            self.assumed[f"{name} {self._known[key].units[unit].precision}"] = None
        return self._known[key]


def _measured(folder: Path, chip: str) -> MeasuredStages:
    """Return the times of a run's jobs by stage, the first `MOST_SAMPLES` of each, to predict a run on a chip.

    On this machine, a job's time counts from the moment when the unit gets the job. If the core is busy with other
    work, the unit begins later, and this delay counts too. On a chip, other programs of this machine take no core.
    Therefore the time in which the unit had no core is left out for a chip. This time is exact for a unit with one
    thread (docs/decisions/preempted-time.md).

    `folder`: run folder. `chip`: name of the chip; HOST for this machine.

    Raises BadInputError for a folder without a journal, or a broken journal.
    """
    samples: dict[str, list[float]] = {}
    free_ns: dict[str, int] = {}
    for record in open_journal(folder)[1]:
        if isinstance(record, Worked):
            job = record.job
            handed_ns = max(job.dispatch_ns, free_ns.get(job.unit, 0))
            from_ns = handed_ns if chip == HOST else min(job.begin_ns + job.preempted_ns, job.end_ns)
            free_ns[job.unit] = job.end_ns
            samples.setdefault(job.stage, []).append((job.end_ns - from_ns) / NS_PER_MS)
    times = {name: StageTime(samples=tuple(each[:MOST_SAMPLES])) for name, each in samples.items()}
    return MeasuredStages(times, str(folder), chip)


def _trust_in(folder: Path) -> Trust:
    """Return whether the run in `folder` can be trusted, with reasons. A run without a report is not trusted.

    Raises BadInputError if the report cannot be read.
    """
    return trust_of(read_report(folder).as_json() if (folder / REPORT_FILE).exists() else {})


def _with_share(file: PipelineFile, measured: MeasuredStages) -> PipelineFile:
    """Return `file` with the measured share of frames that took the bypass.

    A file without a bypass, or with a share or pattern of its own, is returned unchanged. If the stage where the bypass
    begins has no measured jobs, the file is also returned unchanged.
    """
    if file.bypass is None or file.bypass[1].taken is not None:
        return file
    (begin, way), names = file.bypass, list(file.stages)
    skipped = names[names.index(begin) + 1]
    begun, done = (len(measured.times[name].samples) if name in measured.times else 0 for name in (begin, skipped))
    if not begun:
        return file
    return file.changed([f"stages.{begin}.bypass={{ to = '{way.to}', share = {max(0.0, 1 - done / begun):.6f} }}"])


def _answer(
    file: PipelineFile,
    text: str,
    options: PredictOptions,
    chips: _Chips,
    measured: MeasuredStages,
    of_run: Trust | None,
) -> dict[str, Any]:
    graphs = read_networks(file)
    port_types(file, graphs)

    def chip_for(name: str, graph: GraphFile, unit: UnitName) -> Profile:
        stage = file.stages[name]
        assert isinstance(stage, OnnxStage)
        return chips.chip_for(name, stage, graph, unit)

    prices = prices_of(file, graphs, chip_for, lambda chip: corners_of(chip, options.cap), measured)
    answer = predict_file(file, prices, options.frames or 0, options.seed)
    rests_on_run = any(each.is_measured for each in prices.values())
    return {"what_if": text, **answer, "verdict": pipeline_verdict(answer, of_run if rests_on_run else None).shown()}
