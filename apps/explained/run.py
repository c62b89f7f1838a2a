"""`trilane explain RUN`: where the time of a run went, as a document; the figures come from its journal and its report.

Rule: everything is computed from the journal in one reading, in memory that does not grow with the run, whether or not
the run still goes on; the report of one that has ended says how it ended.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from trilane.apps.explained.advice import advice
from trilane.apps.explained.slow_frames import MOST_SAMPLES, Shown, SlowFrames, Usual, notes, reasons
from trilane.apps.live.followed_run import CUT_OFF, FollowedRun, RunState
from trilane.apps.report import Report, read_report
from trilane.errors import BadInputError
from trilane.figure_sources import COMPUTED, MEASURED
from trilane.pipeline.critical_path import WHATS, Part
from trilane.pipeline.journal import NAME, Begun, Ended, Record, config_of, journal_in, read_journal
from trilane.pipeline.reckoning import Reckoning, places_of
from trilane.pipeline.sharing import Taken
from trilane.pipeline.timeline import ExplainedJob, Timeline
from trilane.pipeline.unit_history import PREEMPTED
from trilane.scheduler.stats import NS_PER_MS

SCHEMA = 1
HOST = "host"
GOES_ON = "the run still goes on: what follows is of its frames so far"


def explained_jobs(begun: Begun, records: Iterable[Record]) -> Iterator[ExplainedJob]:
    """Every job of a journal with its wait explained. `records`: those that follow `begun`."""
    timeline = Timeline(begun.graph, begun.settings, waits=True)
    for record in records:
        yield from (fact for fact in timeline.add(record) if isinstance(fact, ExplainedJob))


def open_journal(folder: Path) -> tuple[Begun, Iterator[Record]]:
    """The first record of the journal of a run folder, and those that follow it.

    Raises BadInputError for a folder without one, and, also while it is read, for a file that is none.
    """
    path = journal_in(folder)
    if path is None:
        raise BadInputError(
            folder, f"no {NAME}", "the folder of a run", "a run of an older Trilane has none: run again"
        )
    records = read_journal(path)
    begun = next(records)
    assert isinstance(begun, Begun)  # the reader sees to it
    return begun, records


class Explanation:
    """Takes the records of a journal after the first; `document` is what follows from them.

    `begun`: the journal's first record. `report`: of the run, None while it goes on. `slowest`: frames to name.
    """

    def __init__(self, begun: Begun, report: Report | None, slowest: int) -> None:
        self._begun, self._report, self._places = begun, report, places_of(begun)
        self._timeline = Timeline(begun.graph, begun.settings, waits=True)
        self._reckoning = Reckoning(begun.graph, begun.settings, self._places, self._timeline.downs)
        self._slow = SlowFrames(begun.graph, self._reckoning.paths, self._reckoning.sharing, slowest)
        self._waits: dict[str, dict[str, int]] = {stage.name: {} for stage in begun.graph.stages}
        self._jobs = dict.fromkeys(self._waits, 0)
        self._frames, self._first_ns, self._last_ns = 0, 0, 0

    def add(self, record: Record) -> None:
        """The next record."""
        for fact in self._timeline.add(record):
            if isinstance(fact, ExplainedJob):
                self._count(fact)

    def _count(self, explained: ExplainedJob) -> None:
        job = explained.job
        self._reckoning.add(explained)
        self._slow.add(explained)
        self._jobs[job.stage] += 1
        sums = self._waits[job.stage]
        for cause, ns in explained.waits_ns.items():
            sums[cause] = sums.get(cause, 0) + ns
        if explained.presented is not None:
            self._frames += 1
            self._first_ns, self._last_ns = self._first_ns or job.end_ns, job.end_ns

    def document(self) -> dict[str, Any]:
        """After the last job: the keys of `trilane explain RUN --json`."""
        budget, taken, figures = self._reckoning.close()
        slowest, usual = self._slow.close()
        unit_of = {stage.name: stage.unit for stage in self._begun.graph.stages}
        intervals = max(self._frames - 1, 1)
        clock = str(self._begun.facts.get("clock", HOST))
        frame_ms = (self._last_ns - self._first_ns) / intervals / NS_PER_MS if self._frames > 1 else None
        rows = _budget_rows(budget, unit_of, intervals)
        shared = [self._shared(stage, row) for stage, row in taken.items() if row.preempted_ns]
        return {
            "schema": SCHEMA,
            "clock": clock,
            **self._of_run(),
            "frames": self._frames,
            "frame_ms": frame_ms,
            **figures,
            "cores": self._of_cores(frame_ms, figures["machine_efficiency"]),
            "nobodys_ms": sum(row["ms"] for row in rows if row["what"] == PREEMPTED),
            "budget": rows,
            "shared_cores": shared,
            "waits": [_wait_row(name, unit_of[name], self._jobs[name], self._waits[name]) for name in self._waits],
            "usual": {
                "frame_ms": usual.frame_ns / NS_PER_MS,
                "service_ms": {name: ns / NS_PER_MS for name, ns in usual.service_ns.items()},
            },
            "slowest": [_slow_row(shown, usual) for shown in slowest],
            "advice": advice(rows, self._begun.settings.policy, self._spare_cores(unit_of)),
            "sources": {
                "frames, waits_ms, service_ms, preempted_ms": MEASURED if clock == HOST else COMPUTED,
                "efficiency, core_efficiency, machine_efficiency, cores": "CPU time of the run's own jobs",
                "budget, bound": "the same times along the path that ends with the last frame",
                "taken_ms": "computed: whose jobs ran then on the same cores",
                "usual": f"medians of all frames, of at most {MOST_SAMPLES} evenly spaced ones in a long run",
            },
        }

    def _of_run(self) -> dict[str, Any]:
        """What the run said of itself before its first frame, and of its end."""
        facts, report = self._begun.facts, self._report
        return {
            "scene": config_of(self._begun).get("scene", {}).get("name"),
            "policy": self._begun.settings.policy,
            "edges": list(self._begun.graph.edges),
            "accuracy": facts.get("accuracy", {}),
            "interrupted": None if report is None else report.interrupted,
            "failure": None if report is None else report.failure,
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
        """CPU time of all jobs for a frame beside what the run's cores had; None where one of them is not known."""
        cores = sorted({core for place in self._places.values() for core in place.cores})
        if frame_ms is None or efficiency is None or not cores or len(self._places) < len(self._begun.graph.units):
            return None
        had_ms = len(cores) * frame_ms
        return {"numbers": cores, "cpu_ms": efficiency * had_ms, "had_ms": had_ms}

    def _spare_cores(self, unit_of: Mapping[str, str]) -> int:
        """How many cores the run might have used beyond one for each unit; negative: units must share."""
        cpu = self._begun.facts.get("machine", {}).get("cpu", {})
        return len(cpu.get("cores_allowed", ())) - len(set(unit_of.values()))


def explain_run(folder: Path, slowest: int = 10) -> dict[str, Any]:
    """Where the time of the run in `folder` went, as plain data. `slowest`: how many frames are named.

    Raises BadInputError for a folder that is none, or whose journal or report cannot be read.
    """
    report = read_report(folder) if (folder / "report.json").exists() else None  # there is none while a run goes on
    begun, records = open_journal(folder)
    explanation, is_whole = Explanation(begun, report, slowest), False
    for record in records:
        explanation.add(record)
        is_whole = isinstance(record, Ended)
    goes_on = not is_whole and FollowedRun(folder).state is RunState.GOES_ON
    remark = "" if is_whole else GOES_ON if goes_on else CUT_OFF
    return {"run": str(folder), "remark": remark, **explanation.document()}


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
    causes = sorted(waits_ns.items(), key=lambda row: -row[1])
    return {
        "stage": stage,
        "unit": unit,
        "jobs": jobs,
        "wait_ms": sum(waits_ns.values()) / per_job,
        "causes_ms": {cause: ns / per_job for cause, ns in causes},
    }


def _slow_row(shown: Shown, usual: Usual) -> dict[str, Any]:
    return {
        "frame": shown.now.frame,
        "presented_ns": shown.now.end_ns,
        "frame_ms": shown.frame_ns / NS_PER_MS,
        "longer_ms": (shown.frame_ns - usual.frame_ns) / NS_PER_MS,
        "latency_ms": shown.now.latency_ns / NS_PER_MS,
        "why": [reason._asdict() for reason in reasons(shown, usual)],
        "notes": notes(shown),
    }
