"""Where the time of a run went, as a document and as a table of its jobs.

Rule: one pass over the journal of a live or finished run gives the figures, in bounded memory. The report of a finished
run says how the run ended. The table is written in a second pass. Its last columns are the metrics of the stages, which
are known only after the first pass.
"""

from __future__ import annotations

import csv
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, NamedTuple, get_type_hints

from trilane.apps.explain.reasons import MOST_SAMPLES, BudgetRow, ShownFrame, SlowFrames, Usual, advice, notes, reasons
from trilane.apps.run.report import REPORT_FILE, Report, read_report
from trilane.apps.run.verdict_facts import verdict_of
from trilane.apps.watch.followed_run import CUT_OFF, FollowedRun, RunState
from trilane.errors import BadInputError, MissingPartError
from trilane.pipeline.critical_path import WHATS, Taken
from trilane.pipeline.journal import NAME, Begun, Ended, Record, Said, Worked, config_of, journal_in, read_journal
from trilane.pipeline.reckoning import Reckoning, places_of
from trilane.pipeline.result import MOST_MESSAGES
from trilane.pipeline.timeline import ExplainedJob, Gone, Presented, Timeline
from trilane.pipeline.tracks import UNKNOWN
from trilane.pipeline.unit_history import PREEMPTED
from trilane.scheduler.events import Graph
from trilane.scheduler.ledger import JobRecord
from trilane.units import COMPUTED, HOST_CLOCK, MEASURED, NS_PER_MS
from trilane.writing import write_atomically

SCHEMA = 1
GOES_ON = "the run still goes on: the figures cover its frames so far"
#: Column -> its type, and its value for a job. Times are ns of the run's clock, durations ns; docs/explain.md explains
#: each column.
COLUMNS: dict[str, tuple[type, Callable[[ExplainedJob], Any]]] = {
    **{
        name: (get_type_hints(JobRecord)[name], attrgetter(f"job.{name}"))
        for name in dict.fromkeys(("frame", *JobRecord._fields))
    },
    "wait_ns": (int, lambda one: one.job.begin_ns - one.job.ready_ns),
    "wait_cause": (str, lambda one: one.cause),
    "wait_cause_ns": (int, lambda one: one.waits_ns.get(one.cause, 0)),
    "behind_stage": (str, lambda one: one.behind.stage if one.behind is not None else ""),
    "behind_frame": (int, lambda one: one.behind.frame if one.behind is not None else -1),
    "rung": (int, lambda one: one.rung),
    "skips": (bool, lambda one: one.skips),
}
ROWS_AT_ONCE: Final = 8192
ENDINGS = (".csv", ".parquet")


def open_journal(folder: Path) -> tuple[Begun, Iterator[Record]]:
    """Return (first record, iterator over the other records) of the journal in the run folder `folder`.

    Raises BadInputError for a folder without a journal, and for a broken journal. The iterator may also raise it.
    """
    path = journal_in(folder)
    if path is None:
        raise BadInputError(
            folder, f"no {NAME}", "the folder of a run", "a run of an older Trilane has none: run again"
        )
    records = read_journal(path)
    begun = next(records)
    assert isinstance(begun, Begun)  # the journal's reader makes sure of it
    return begun, records


class CoreTime(NamedTuple):
    """The use of a run's cores.

    `numbers`: numbers of the cores. `cpu_ms`: mean CPU time of a frame's jobs. `had_ms`: mean frame time, times the
    number of cores.
    """

    numbers: list[int]
    cpu_ms: float
    had_ms: float


class ExplainedRun:
    """Where the time of the run in `folder` went.

    `begun`, `records`: first record, and other records, of the run's journal. `report`: report of the run; None for
    a run that goes on or was killed. `most`: number of slowest frames to describe.

    `remark`: sentence on a journal that ends before the run; empty for a whole journal.
    `messages`: messages of the run. `frames`: number of presented frames.
    `frame_ms`: mean frame time; None for fewer than two frames.
    `left`: numbers of dropped and lost frames by kind and cause. `figures`: `bottleneck`, `bound` and efficiencies.
    `cores`: use of the cores; None if the mean frame time, the efficiency or a unit's cores are unknown.
    `budget`: parts of the critical path, the largest first.
    `taken`: for each stage whose jobs lacked a core, the time without a core, and which stages had the core.
    `unit_of`, `jobs`: unit and number of jobs of each stage. `joins`: as `Joins.rows` returns them.
    `slowest`, `usual`: slowest frames, the slowest first, and medians over the run.
    """

    def __init__(
        self, folder: Path, begun: Begun, records: Iterable[Record], report: Report | None, most: int = 10
    ) -> None:
        self.folder, self.begun, self.report, self._places = folder, begun, report, places_of(begun)
        graph, settings, config = begun.graph, begun.settings, config_of(begun)
        self.unit_of = {stage.name: stage.unit for stage in graph.stages}
        self._waits_ns = {name: Counter[str]() for name in self.unit_of}
        self.clock, self.jobs = str(begun.facts.get("clock", HOST_CLOCK)), Counter[str]()
        self.left: dict[str, Counter[str]] = {}
        timeline = Timeline(graph, settings, waits=True)
        reckoning = Reckoning(graph, settings, self._places, timeline)
        slow = SlowFrames(graph, reckoning.paths, reckoning.sharing, most)
        joins, said = Joins(graph), deque[str](maxlen=MOST_MESSAGES)
        self.frames, first_ns, last_ns, record = 0, 0, 0, None
        for record in records:
            if isinstance(record, Said):
                said.append(record.text)
            for fact in timeline.add(record):
                if isinstance(fact, Gone):
                    self.left.setdefault(fact.kind, Counter())[fact.cause] += 1
                elif isinstance(fact, ExplainedJob):
                    for each in (reckoning, slow, joins):
                        each.add(fact)
                    self.jobs[fact.job.stage] += 1
                    self._waits_ns[fact.job.stage].update(fact.waits_ns)
                    if fact.presented is not None:
                        self.frames += 1
                        first_ns, last_ns = first_ns or fact.job.end_ns, fact.job.end_ns
        goes_on = not isinstance(record, Ended) and FollowedRun(folder).state is RunState.GOES_ON
        self.remark = "" if isinstance(record, Ended) else GOES_ON if goes_on else CUT_OFF
        self.messages = list(said if report is None else report.messages)
        budget, taken, self.figures = reckoning.close()
        self.slowest, self.usual = slow.close()
        self.taken = {stage: each for stage, each in taken.items() if each.preempted_ns}
        self.joins = joins.rows()
        intervals, total_ns = max(self.frames - 1, 1), max(sum(budget.values()), 1)
        self.frame_ms = (last_ns - first_ns) / intervals / NS_PER_MS if self.frames > 1 else None
        self.budget = [
            BudgetRow(stage, self.unit_of[stage], what, WHATS[what], ns / intervals / NS_PER_MS, ns / total_ns)
            for (what, stage), ns in sorted(budget.items(), key=lambda row: -row[1])
        ]
        spare = _cores_allowed(begun) - len(graph.units)
        self.advice = advice(self.budget, settings.policy, spare, "pipeline" in config)
        self.accuracy: Mapping[str, Mapping[str, Any]] = begun.facts.get("accuracy", {})
        self.source = MEASURED if self.clock == HOST_CLOCK else COMPUTED
        self.scene: str | None = config.get("scene", {}).get("name")
        self.nobodys_ms = sum(row.ms for row in self.budget if row.what == PREEMPTED)

    @property
    def cores(self) -> CoreTime | None:
        numbers = sorted({core for place in self._places.values() for core in place.cores})
        efficiency = self.figures["machine_efficiency"]
        is_placed = numbers and len(self._places) == len(self.begun.graph.units)
        if self.frame_ms is None or efficiency is None or not is_placed:
            return None
        had_ms = len(numbers) * self.frame_ms
        return CoreTime(numbers, efficiency * had_ms, had_ms)

    def waits(self, stage: str) -> tuple[float, dict[str, float]]:
        """Return (mean wait of a stage's jobs, its parts by cause, the longest first), in ms."""
        waits_ns, per_job = self._waits_ns[stage], max(self.jobs[stage], 1) * NS_PER_MS
        return sum(waits_ns.values()) / per_job, _causes_ms(waits_ns, per_job)

    def shared(self, unit: str, other: str) -> list[int]:
        """Return the numbers of the cores that `unit` shares with the unit of the stage `other`, ascending."""
        own = self._places[unit].cores if unit in self._places else ()
        return sorted(set(own) & set(self._places[self.unit_of[other]].cores))

    def as_json(self) -> dict[str, Any]:
        """Return the document of `trilane explain RUN --json`. docs/explain.md describes the keys."""
        report, usual = self.report, self.usual
        joins = [
            {"stage": stage, "inputs": {name: each._asdict() for name, each in inputs.items()}}
            for stage, inputs in self.joins.items()
        ]
        return {
            "run": str(self.folder),
            "remark": self.remark,
            "schema": SCHEMA,
            "clock": self.clock,
            "scene": self.scene,
            "policy": self.begun.settings.policy,
            "edges": list(self.begun.graph.edges),
            "accuracy": self.accuracy,
            "interrupted": None if report is None else report.interrupted,
            "failure": None if report is None else report.failure,
            "messages": self.messages,
            "verdict": None if report is None else verdict_of(report, str(self.folder)).shown(),
            "frames": self.frames,
            "left": {kind: dict(causes) for kind, causes in self.left.items()},
            "frame_ms": self.frame_ms,
            **self.figures,
            "cores": self.cores and self.cores._asdict(),
            "nobodys_ms": self.nobodys_ms,
            "budget": [row._asdict() for row in self.budget],
            "shared_cores": [self._shared_row(stage, each) for stage, each in self.taken.items()],
            "waits": [
                {"stage": stage, "unit": unit, "jobs": self.jobs[stage], "wait_ms": wait_ms, "causes_ms": causes_ms}
                for stage, unit in self.unit_of.items()
                for wait_ms, causes_ms in [self.waits(stage)]
            ],
            **({"joins": joins} if joins else {}),
            "usual": {
                "frame_ms": usual.frame_ns / NS_PER_MS,
                "service_ms": {name: ns / NS_PER_MS for name, ns in usual.service_ns.items()},
            },
            "slowest": [_slow_row(shown, usual) for shown in self.slowest],
            "advice": self.advice,
            "sources": {
                "frames, waits_ms, service_ms, preempted_ms": self.source,
                "efficiency, core_efficiency, machine_efficiency, cores": "CPU time of the run's own jobs",
                "budget, bound": "the same times along the path that ends with the last frame",
                "taken_ms": "computed: whose jobs ran then on the same cores",
                "usual": f"medians of all frames, of at most {MOST_SAMPLES} evenly spaced ones in a long run",
            },
        }

    def _shared_row(self, stage: str, taken: Taken) -> dict[str, Any]:
        per_job = taken.jobs * NS_PER_MS
        return {
            "stage": stage,
            "unit": taken.unit,
            "cores": list(self._places[taken.unit].cores) if taken.unit in self._places else [],
            "service_ms": taken.service_ns / per_job,
            "preempted_ms": taken.preempted_ns / per_job,
            "taken_ms": {other: ns / per_job for other, ns in taken.of.items()},
            "shared": {other: self.shared(taken.unit, other) for other in taken.of},
            "others_ms": taken.other_ns / per_job,
        }


def _cores_allowed(begun: Begun) -> int:
    """Return how many cores the run could use; 0 if the journal does not say."""
    match begun.facts.get("machine"):
        case {"cpu": {"cores_allowed": [*cores]}}:
            return len(cores)
    return 0


def explain_run(folder: Path, slowest: int = 10) -> ExplainedRun:
    """Return where the time of the run in `folder` went.

    `slowest`: number of slowest frames to describe.

    Raises BadInputError if `folder` is no run folder, or if its journal or report cannot be read.
    """
    report = read_report(folder) if (folder / REPORT_FILE).exists() else None  # there is none while a run goes on
    return ExplainedRun(folder, *open_journal(folder), report, slowest)


class FrameJob(NamedTuple):
    """A job of an explained frame. Its begin counts from the frame's release.

    `took_ms`: service time. `wait_ms`: time from when the job was ready until its begin. `causes_ms`: parts of this
    wait by cause, the longest first.
    """

    stage: str
    unit: str
    begin_ms: float
    took_ms: float
    wait_ms: float
    causes_ms: dict[str, float]


class ExplainedFrame(NamedTuple):
    """What became of a frame of a run.

    `schema`: version of the keys in JSON. `run`: folder of the run. `frame`: number of the frame.
    `outcome`: `presented`, `dropped`, `lost` or `under way`.
    `cause`: key of the report that counts the dropped or lost frame; None for any other frame.
    `after_ms`: time from the frame's release until it was presented, dropped or lost; None for a frame under way.
    `latency_ms`: latency; None if not known.
    `jobs`: jobs of the frame. For a frame under way, their begins count from when the first of them was ready.
    """

    schema: int
    run: str
    frame: int
    outcome: str
    cause: str | None
    after_ms: float | None
    latency_ms: float | None
    jobs: list[FrameJob]

    def as_json(self) -> dict[str, Any]:
        """Return the document of `trilane explain RUN --frame N --json`."""
        return self._asdict() | {"jobs": [job._asdict() for job in self.jobs]}


def explain_frame(folder: Path, number: int) -> ExplainedFrame:
    """Return what became of frame `number` of the run in `folder`.

    Raises BadInputError for a folder without a journal, for a broken journal, and for a frame that is not in the
    journal.
    """
    begun, records = open_journal(folder)
    timeline = Timeline(begun.graph, begun.settings, waits=True)
    jobs: list[ExplainedJob] = []
    presented: Presented | None = None
    gone: Gone | None = None
    last, untold = -1, 0
    for record in records:
        for fact in timeline.add(record):
            if isinstance(fact, ExplainedJob):
                last = max(last, fact.job.frame)
                if fact.job.frame == number:
                    jobs.append(fact)
                    presented = fact.presented or presented
            elif isinstance(fact, Gone):
                last, untold = max(last, fact.frame), untold + (fact.frame == UNKNOWN)
                gone = fact if fact.frame == number else gone
    if not jobs and gone is None:
        fix = f"{untold} lost frames of this run are not known by number" if untold else ""
        raise BadInputError("--frame", str(number), f"a frame that began, of 0 to {last}", fix)
    left = presented or gone
    release_ns = left.release_ns if left is not None else min(one.job.ready_ns for one in jobs)
    end_ns = presented.end_ns if presented is not None else gone.at_ns if gone is not None else None
    return ExplainedFrame(
        SCHEMA,
        str(folder),
        number,
        "presented" if presented is not None else gone.kind if gone is not None else "under way",
        None if gone is None else gone.cause,
        None if end_ns is None else (end_ns - release_ns) / NS_PER_MS,
        None if presented is None or presented.latency_ns is None else presented.latency_ns / NS_PER_MS,
        [_frame_job(one, release_ns) for one in jobs],
    )


def _frame_job(one: ExplainedJob, release_ns: int) -> FrameJob:
    job = one.job
    times_ns = (job.begin_ns - release_ns, job.end_ns - job.begin_ns, job.begin_ns - job.ready_ns)
    begin_ms, took_ms, wait_ms = (ns / NS_PER_MS for ns in times_ns)
    return FrameJob(job.stage, job.unit, begin_ms, took_ms, wait_ms, _causes_ms(one.waits_ns, NS_PER_MS))


def _causes_ms(waits_ns: Mapping[str, int], per: float) -> dict[str, float]:
    return {cause: ns / per for cause, ns in sorted(waits_ns.items(), key=lambda row: -row[1])}


def _slow_row(shown: ShownFrame, usual: Usual) -> dict[str, Any]:
    return {
        "frame": shown.now.frame,
        "presented_ns": shown.now.end_ns,
        "frame_ms": shown.frame_ns / NS_PER_MS,
        "longer_ms": (shown.frame_ns - usual.frame_ns) / NS_PER_MS,
        "latency_ms": None if shown.now.latency_ns is None else shown.now.latency_ns / NS_PER_MS,
        "why": [reason._asdict() for reason in reasons(shown, usual)],
        "notes": notes(shown),
    }


def figure_names(folder: Path) -> list[str]:
    """Return the names of the metrics that the stages of a run report, sorted. `folder`: run folder.

    Raises BadInputError as `open_journal` does.
    """
    _, records = open_journal(folder)
    return sorted({name for record in records if isinstance(record, Worked) for name in record.figures})


def job_rows(folder: Path, figures: Sequence[str]) -> Iterator[tuple[Any, ...]]:
    """Yield a row for each job of the run in `folder`, in the order of the jobs' ends.

    A row has the values of COLUMNS, then the values of `figures`. If a job lacks a metric, the value is None.

    `figures`: names of metrics, as from `figure_names`. Raises BadInputError as `open_journal` does.
    """
    values = [value for _, value in COLUMNS.values()]
    begun, records = open_journal(folder)
    timeline = Timeline(begun.graph, begun.settings, waits=True)
    for one in (fact for record in records for fact in timeline.add(record)):
        if isinstance(one, ExplainedJob):
            yield (*(value(one) for value in values), *(one.figures.get(name) for name in figures))


def check_ending(target: Path) -> None:
    """Raise BadInputError if the name of `target` ends in none of ENDINGS."""
    if target.suffix.lower() not in ENDINGS:
        raise BadInputError("--jobs", f"'{target}'", f"a name that ends in {' or '.join(ENDINGS)}")


def write_jobs(folder: Path, target: Path) -> int:
    """Write every job of the run in `folder` to `target`, a .csv or .parquet file, and return the number of jobs.

    Raises BadInputError as `open_journal` does, and for a file that cannot be written. Raises MissingPartError for
    .parquet if PyArrow is not installed.
    """
    figures = figure_names(folder)
    write = _write_parquet if target.suffix.lower() == ".parquet" else _write_csv
    with write_atomically(target) as draft:
        return write(draft, figures, job_rows(folder, figures))


def _write_csv(target: Path, figures: Sequence[str], rows: Iterator[tuple[Any, ...]]) -> int:
    count = 0
    with target.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*COLUMNS, *figures])
        for count, row in enumerate(rows, start=1):  # noqa: B007 - handed back
            writer.writerow([int(value) if isinstance(value, bool) else value for value in row])
    return count


def _write_parquet(target: Path, figures: Sequence[str], rows: Iterator[tuple[Any, ...]]) -> int:
    try:
        import pyarrow as arrow
        from pyarrow.parquet import ParquetWriter
    except ImportError as error:
        raise MissingPartError(f"a table as Parquet needs {error.name or 'pyarrow'}", extra="table") from None
    words = arrow.dictionary(arrow.int32(), arrow.string())
    kinds = {int: arrow.int64(), str: words, bool: arrow.bool_()}
    fields = [(name, kinds[kind]) for name, (kind, _) in COLUMNS.items()]
    schema = arrow.schema(fields + [(name, arrow.float64()) for name in figures])
    count = 0
    with ParquetWriter(target, schema) as writer:
        while some := list(islice(rows, ROWS_AT_ONCE)):
            count += len(some)
            by_column = zip(*some, strict=True)
            columns = [arrow.array(column, field.type) for column, field in zip(by_column, schema, strict=True)]
            writer.write_batch(arrow.record_batch(columns, schema=schema))
    return count


MOST_ENDS: Final = 1024  # frames whose ends are kept for each stage; far more than can be in flight


class JoinInput(NamedTuple):
    """An input of a stage with several inputs.

    `last`: number of jobs in which this input came last. `after_ms`: mean time in these jobs from the previous input to
    this one; 0 without such a job.
    """

    last: int
    after_ms: float


class Joins:
    """For stages with several inputs: which input of a frame came last, and how long after the input before it.

    An input comes when the job that writes it ends. Inputs with `sync = "latest"` do not count, because no job waits
    for them. `graph`: graph of the run.
    """

    def __init__(self, graph: Graph) -> None:
        reads = {stage.name: graph.inputs_of(place) for place, stage in enumerate(graph.stages)}
        by_frame = {name: [each.stage for each in inputs if not each.latest] for name, inputs in reads.items()}
        self._reads = {name: read for name, read in by_frame.items() if len(read) > 1}
        self._ends: dict[str, dict[int, int]] = {name: {} for read in self._reads.values() for name in read}
        self._last = {name: Counter[str]() for name in self._reads}
        self._after_ns = {name: Counter[str]() for name in self._reads}

    def add(self, explained: ExplainedJob) -> None:
        """Count a job. Jobs must come in the order of their ends."""
        job = explained.job
        if read := self._reads.get(job.stage):
            ends = sorted((self._ends[name].get(job.frame, -1), name) for name in read)
            if ends[0][0] >= 0:
                self._last[job.stage][ends[-1][1]] += 1
                self._after_ns[job.stage][ends[-1][1]] += ends[-1][0] - ends[-2][0]
        if (kept := self._ends.get(job.stage)) is not None:
            kept[job.frame] = job.end_ns
            if len(kept) > MOST_ENDS:
                del kept[next(iter(kept))]

    def rows(self) -> dict[str, dict[str, JoinInput]]:
        """Return the inputs of each stage with several inputs: by stage, then by the stage that writes the input."""
        return {
            stage: {
                name: JoinInput(last[name], self._after_ns[stage][name] / max(last[name], 1) / NS_PER_MS)
                for name in self._reads[stage]
            }
            for stage, last in self._last.items()
        }


def join_text(stage: str, inputs: Mapping[str, JoinInput]) -> str:
    """Return a sentence about a stage with several `inputs`. The input that came last in most jobs is named first."""
    by_last = sorted(inputs.items(), key=lambda each: -each[1].last)
    jobs = sum(each.last for each in inputs.values())
    found = [
        f"for {name} in {each.last} of {jobs} jobs, {each.after_ms:.2f} ms after the others"
        for name, each in by_last
        if each.last
    ]
    never = [name for name, each in by_last if not each.last]
    rest = f"; never for {', '.join(never)}" if never else ""
    return f"{stage} waited {'; '.join(found) or 'for nothing'}{rest}"
