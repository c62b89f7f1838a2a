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
from typing import Any, Final, get_type_hints

from trilane.apps.explain.reasons import MOST_SAMPLES, ShownFrame, SlowFrames, Usual, advice, notes, reasons
from trilane.apps.run.report import Report, read_report
from trilane.apps.run.verdict_facts import verdict_of
from trilane.apps.watch.followed_run import CUT_OFF, FollowedRun, RunState
from trilane.errors import BadInputError, MissingPartError
from trilane.pipeline.critical_path import WHATS, Part, Taken
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


def _explained_jobs(begun: Begun, records: Iterable[Record]) -> Iterator[ExplainedJob]:
    """Yield every job of a journal with the causes of its wait, in the order of the jobs' ends.

    `begun`: first record of the journal. `records`: records after the first.
    """
    timeline = Timeline(begun.graph, begun.settings, waits=True)
    for record in records:
        yield from (fact for fact in timeline.add(record) if isinstance(fact, ExplainedJob))


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


class RunExplanation:
    """Explains where the time of a run went.

    `begun`: first record of the run's journal. `report`: report of the run; None while the run goes on.
    `slowest`: number of slowest frames to describe. `name`: folder of the run, for the verdict.
    """

    def __init__(self, begun: Begun, report: Report | None, slowest: int, name: str = "") -> None:
        self._begun, self._report, self._places, self._name = begun, report, places_of(begun), name
        self._timeline = Timeline(begun.graph, begun.settings, waits=True)
        self._reckoning = Reckoning(begun.graph, begun.settings, self._places, self._timeline)
        self._slow = SlowFrames(begun.graph, self._reckoning.paths, self._reckoning.sharing, slowest)
        self._waits: dict[str, dict[str, int]] = {stage.name: {} for stage in begun.graph.stages}
        self._jobs = dict.fromkeys(self._waits, 0)
        self._joins = Joins(begun.graph)
        self._frames, self._first_ns, self._last_ns = 0, 0, 0
        self._left: dict[str, Counter[str]] = {}
        self._said: deque[str] = deque(maxlen=MOST_MESSAGES)

    def add(self, record: Record) -> None:
        """Take the next record of the journal; the first call takes the record after `begun`."""
        if isinstance(record, Said):
            self._said.append(record.text)
        for fact in self._timeline.add(record):
            if isinstance(fact, ExplainedJob):
                self._count(fact)
            elif isinstance(fact, Gone):
                self._left.setdefault(fact.kind, Counter())[fact.cause] += 1

    def _count(self, explained: ExplainedJob) -> None:
        job = explained.job
        self._reckoning.add(explained)
        self._slow.add(explained)
        self._joins.add(explained)
        self._jobs[job.stage] += 1
        sums = self._waits[job.stage]
        for cause, ns in explained.waits_ns.items():
            sums[cause] = sums.get(cause, 0) + ns
        if explained.presented is not None:
            self._frames += 1
            self._first_ns, self._last_ns = self._first_ns or job.end_ns, job.end_ns

    def document(self) -> dict[str, Any]:
        """Return the document of `trilane explain RUN --json` without `run` and `remark`.

        Call it once, after the last record.

        docs/explain.md describes the keys.
        """
        budget, taken, figures = self._reckoning.close()
        slowest, usual = self._slow.close()
        unit_of = {stage.name: stage.unit for stage in self._begun.graph.stages}
        intervals = max(self._frames - 1, 1)
        clock = str(self._begun.facts.get("clock", HOST_CLOCK))
        frame_ms = (self._last_ns - self._first_ns) / intervals / NS_PER_MS if self._frames > 1 else None
        rows = _budget_rows(budget, unit_of, intervals)
        shared = [self._shared(stage, row) for stage, row in taken.items() if row.preempted_ns]
        return {
            "schema": SCHEMA,
            "clock": clock,
            **self._of_run(),
            "verdict": None if self._report is None else verdict_of(self._report, self._name).shown(),
            "frames": self._frames,
            "left": {kind: dict(causes) for kind, causes in self._left.items()},
            "frame_ms": frame_ms,
            **figures,
            "cores": self._of_cores(frame_ms, figures["machine_efficiency"]),
            "nobodys_ms": sum(row["ms"] for row in rows if row["what"] == PREEMPTED),
            "budget": rows,
            "shared_cores": shared,
            "waits": [_wait_row(name, unit_of[name], self._jobs[name], self._waits[name]) for name in self._waits],
            **({"joins": joins} if (joins := self._joins.rows()) else {}),
            "usual": {
                "frame_ms": usual.frame_ns / NS_PER_MS,
                "service_ms": {name: ns / NS_PER_MS for name, ns in usual.service_ns.items()},
            },
            "slowest": [_slow_row(shown, usual) for shown in slowest],
            "advice": advice(
                rows,
                self._begun.settings.policy,
                self._spare_cores(unit_of),
                is_of_file="pipeline" in config_of(self._begun),
            ),
            "sources": {
                "frames, waits_ms, service_ms, preempted_ms": MEASURED if clock == HOST_CLOCK else COMPUTED,
                "efficiency, core_efficiency, machine_efficiency, cores": "CPU time of the run's own jobs",
                "budget, bound": "the same times along the path that ends with the last frame",
                "taken_ms": "computed: whose jobs ran then on the same cores",
                "usual": f"medians of all frames, of at most {MOST_SAMPLES} evenly spaced ones in a long run",
            },
        }

    def _of_run(self) -> dict[str, Any]:
        """Return the part of the document that describes the run itself and how it ended.

        The run's facts are `scene`, `policy`, `edges` and `accuracy`. Its end is described by `interrupted` and
        `failure`, both None while the run goes on, and by `messages`.
        """
        facts, report = self._begun.facts, self._report
        return {
            "scene": config_of(self._begun).get("scene", {}).get("name"),
            "policy": self._begun.settings.policy,
            "edges": list(self._begun.graph.edges),
            "accuracy": facts.get("accuracy", {}),
            "interrupted": None if report is None else report.interrupted,
            "failure": None if report is None else report.failure,
            "messages": list(self._said if report is None else report.messages),
        }

    def _shared(self, stage: str, taken: Taken) -> dict[str, Any]:
        per_job = taken.jobs * NS_PER_MS
        unit_of = {each.name: each.unit for each in self._begun.graph.stages}
        cores = self._places[taken.unit].cores if taken.unit in self._places else ()
        return {
            "stage": stage,
            "unit": taken.unit,
            "cores": list(cores),
            "service_ms": taken.service_ns / per_job,
            "preempted_ms": taken.preempted_ns / per_job,
            "taken_ms": {other: ns / per_job for other, ns in taken.of.items()},
            "shared": {other: sorted(set(cores) & set(self._places[unit_of[other]].cores)) for other in taken.of},
            "others_ms": taken.other_ns / per_job,
        }

    def _of_cores(self, frame_ms: float | None, efficiency: float | None) -> dict[str, Any] | None:
        """Return figures of the run's cores; None if the mean frame time, the efficiency or a unit's cores are unknown.

        Keys:
        `numbers`: numbers of the cores.
        `had_ms`: mean frame time multiplied by the number of cores.
        `cpu_ms`: CPU time of all jobs of a mean frame.

        `frame_ms`: mean frame time. `efficiency`: machine efficiency.
        """
        cores = sorted({core for place in self._places.values() for core in place.cores})
        if frame_ms is None or efficiency is None or not cores or len(self._places) < len(self._begun.graph.units):
            return None
        had_ms = len(cores) * frame_ms
        return {"numbers": cores, "cpu_ms": efficiency * had_ms, "had_ms": had_ms}

    def _spare_cores(self, unit_of: Mapping[str, str]) -> int:
        """Return how many more cores than units the run had. A negative number means that units had to share cores.

        `unit_of`: unit of each stage.
        """
        cpu = self._begun.facts.get("machine", {}).get("cpu", {})
        return len(cpu.get("cores_allowed", ())) - len(set(unit_of.values()))


def explain_run(folder: Path, slowest: int = 10) -> dict[str, Any]:
    """Return the document of `trilane explain RUN --json` for the run in `folder`: where its time went.

    `slowest`: number of slowest frames to describe.

    Raises BadInputError if `folder` is no run folder, or if its journal or report cannot be read.
    """
    report = read_report(folder) if (folder / "report.json").exists() else None  # there is none while a run goes on
    begun, records = open_journal(folder)
    explanation, is_whole = RunExplanation(begun, report, slowest, str(folder)), False
    for record in records:
        explanation.add(record)
        is_whole = isinstance(record, Ended)
    goes_on = not is_whole and FollowedRun(folder).state is RunState.GOES_ON
    remark = "" if is_whole else GOES_ON if goes_on else CUT_OFF
    return {"run": str(folder), "remark": remark, **explanation.document()}


def explain_frame(folder: Path, number: int) -> dict[str, Any]:
    """Return what became of frame `number` of the run in `folder`, as plain data.

    Keys:
    `schema`: version of the keys.
    `run`: folder of the run.
    `frame`: number of the frame.
    `outcome`: `presented`, `dropped`, `lost` or `under way`.
    `cause`: key of the report that counts the dropped or lost frame; None for any other frame.
    `after_ms`: time from the frame's release until it was presented, dropped or lost; None for a frame under way.
    `latency_ms`: latency; None if not known.
    `jobs`: a row for each job of the frame. Its `begin_ms` counts from the frame's release. For a frame under way, it
    counts from when the frame's first job was ready.

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
    return {
        "schema": SCHEMA,
        "run": str(folder),
        "frame": number,
        "outcome": "presented" if presented is not None else gone.kind if gone is not None else "under way",
        "cause": None if gone is None else gone.cause,
        "after_ms": None if end_ns is None else (end_ns - release_ns) / NS_PER_MS,
        "latency_ms": None if presented is None or presented.latency_ns is None else presented.latency_ns / NS_PER_MS,
        "jobs": [_job_row(one, release_ns) for one in jobs],
    }


def _job_row(one: ExplainedJob, release_ns: int) -> dict[str, Any]:
    job = one.job
    return {
        "stage": job.stage,
        "unit": job.unit,
        "begin_ms": (job.begin_ns - release_ns) / NS_PER_MS,
        "took_ms": (job.end_ns - job.begin_ns) / NS_PER_MS,
        "wait_ms": (job.begin_ns - job.ready_ns) / NS_PER_MS,
        "causes_ms": _causes_ms(one.waits_ns, NS_PER_MS),
    }


def _causes_ms(waits_ns: Mapping[str, int], per: float) -> dict[str, float]:
    return {cause: ns / per for cause, ns in sorted(waits_ns.items(), key=lambda row: -row[1])}


def _budget_rows(budget: Mapping[Part, int], unit_of: Mapping[str, str], intervals: int) -> list[dict[str, Any]]:
    total_ns = max(sum(budget.values()), 1)
    return [
        {
            "stage": stage,
            "unit": unit_of[stage],
            "what": what,
            "why": WHATS[what],
            "ms": ns / intervals / NS_PER_MS,
            "share": ns / total_ns,
        }
        for (what, stage), ns in sorted(budget.items(), key=lambda row: -row[1])
    ]


def _wait_row(stage: str, unit: str, jobs: int, waits_ns: Mapping[str, int]) -> dict[str, Any]:
    per_job = max(jobs, 1) * NS_PER_MS
    return {
        "stage": stage,
        "unit": unit,
        "jobs": jobs,
        "wait_ms": sum(waits_ns.values()) / per_job,
        "causes_ms": _causes_ms(waits_ns, per_job),
    }


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

    A row has the values of COLUMNS, then the values of `figures`. If the job's stage lacks a metric, its value is None.

    `figures`: names of metrics of the stages. Raises BadInputError as `open_journal` does.
    """
    values = [value for _, value in COLUMNS.values()]
    for one in _explained_jobs(*open_journal(folder)):
        yield (*(value(one) for value in values), *(one.figures.get(name) for name in figures))


def check_ending(target: Path) -> None:
    """Raise BadInputError if the name of `target` ends in none of ENDINGS."""
    if target.suffix.lower() not in ENDINGS:
        raise BadInputError("--jobs", f"'{target}'", f"a name that ends in {' or '.join(ENDINGS)}")


def write_jobs(folder: Path, target: Path) -> int:
    """Write every job of the run in `folder` to `target`, a .csv or .parquet file, and return the number of jobs.

    Raises BadInputError for another ending, a folder that is no run folder, and a file that cannot be written. Raises
    MissingPartError for .parquet if PyArrow is not installed.
    """
    check_ending(target)
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

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each stage with several inputs.

        Keys:
        `stage`: name of the stage.
        `inputs`: two figures of each input, by the name of the stage that writes it.

        The figures are:
        `last`: number of jobs in which this input came last.
        `after_ms`: in these jobs, the mean time by which it came after the input before it.
        """
        return [
            {
                "stage": stage,
                "inputs": {
                    name: {"last": last[name], "after_ms": self._after_ns[stage][name] / max(last[name], 1) / NS_PER_MS}
                    for name in self._reads[stage]
                },
            }
            for stage, last in self._last.items()
        ]


def join_text(row: dict[str, Any]) -> str:
    """Return a sentence about `row`, one of `Joins.rows`. The input that came last in most jobs is named first."""
    inputs = sorted(row["inputs"].items(), key=lambda each: -each[1]["last"])
    jobs = sum(each["last"] for _, each in inputs)
    found = [
        f"for {name} in {each['last']} of {jobs} jobs, {each['after_ms']:.2f} ms after the others"
        for name, each in inputs
        if each["last"]
    ]
    never = [name for name, each in inputs if not each["last"]]
    rest = f"; never for {', '.join(never)}" if never else ""
    return f"{row['stage']} waited {'; '.join(found) or 'for nothing'}{rest}"
