"""Why a run takes its time, in words: its slowest frames with their reasons, what bounded it, and what to try.

Rule: each cause names its evidence. A frame's time is the critical path from the presentation of the frame before to
the frame's own presentation. The usual length of a part of the path is the median over the run's frames. Parts that
took longer than usual made the frame slow.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from heapq import heappop, heappush
from statistics import median
from typing import Any, Final, Generic, NamedTuple, TypeVar

from trilane.pipeline.critical_path import (
    ASLEEP,
    RELEASE,
    STALLED,
    STOPPED,
    TAKEN,
    WORK,
    Part,
    Paths,
    Sharing,
    parts,
)
from trilane.pipeline.timeline import ExplainedJob, Presented
from trilane.pipeline.unit_history import DOWN, HELD, LOST, OVERHEAD, PREEMPTED, THROTTLED
from trilane.scheduler.events import Graph
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.policy import works_on_one_frame
from trilane.units import NS_PER_MS

DELAY: Final = 16  # in presented frames; all jobs that ran beside a frame's jobs have ended by then
MOST_SAMPLES: Final = 4096
LEAST_LONGER: Final = 0.05  # share of the median; a frame that took hardly longer than usual has no reason
LEAST_SHARE: Final = 0.1  # share of a frame's extra time that a reason needs to be named
MOST_REASONS: Final = 3
#: Least share of the frame time for advice; a smaller part is not worth an attempt.
LEAST_ADVISED_SHARE: Final = 0.1
MOST_ADVICE: Final = 4

T = TypeVar("T")


class ShownFrame(NamedTuple):
    """A presented frame, and the frame that was presented before it.

    `now`, `before`: these two frames. `frame_ns`: time between their presentations. `parts_ns`: parts of this time.
    `longest`: for each part, the job with the longest piece of this part.
    """

    now: Presented
    before: Presented
    frame_ns: int
    parts_ns: Mapping[Part, int]
    longest: Mapping[Part, JobRecord]


class Usual(NamedTuple):
    """Medians over a run.

    `frame_ns`: frame time. `parts_ns`: time of each part of the path. `service_ns`: service time by stage. `unit_of`:
    unit of each stage.
    """

    frame_ns: float
    parts_ns: Mapping[Part, float]
    service_ns: Mapping[str, float]
    unit_of: Mapping[str, str]


class BudgetRow(NamedTuple):
    """A part of a run's critical path.

    `what`: kind of the part. `why`: the kind in words. `ms`: mean time in a frame. `share`: share of the path.
    """

    stage: str
    unit: str
    what: str
    why: str
    ms: float
    share: float


class Reason(NamedTuple):
    """A reason why a frame was slow: a part of its path took longer than usual.

    `cause`, `stage`: kind and stage of the part. `longer_ms`: time beyond the usual. `text`: the reason in words.
    """

    cause: str
    stage: str
    longer_ms: float
    text: str


class EvenSample(Generic[T]):
    """At most MOST_SAMPLES of the added values, evenly spaced; all of them if no more than MOST_SAMPLES were added.

    `values`: kept values, in the order of adding.
    """

    def __init__(self) -> None:
        self.values: list[T] = []
        self._stride = 1
        self._count = 0

    def add(self, value: T) -> None:
        if self._count % self._stride == 0:
            if len(self.values) == MOST_SAMPLES:
                del self.values[1::2]
                self._stride *= 2
            if self._count % self._stride == 0:
                self.values.append(value)
        self._count += 1


class SlowFrames:
    """Finds the slowest frames of a run.

    `graph`: graph of the run. `paths`, `sharing`: paths and core sharing of the jobs; the caller adds each job to these
    two before `add`. `most`: number of slowest frames to keep.
    """

    def __init__(self, graph: Graph, paths: Paths, sharing: Sharing, most: int) -> None:
        self._paths, self._sharing, self._most = paths, sharing, most
        self._unit_of = {stage.name: stage.unit for stage in graph.stages}
        self._waiting: deque[ExplainedJob] = deque()
        self._before: Presented | None = None
        self._slowest: list[tuple[int, int, ShownFrame]] = []
        self._frames: EvenSample[tuple[int, Mapping[Part, int]]] = EvenSample()
        self._services: dict[str, EvenSample[int]] = {stage.name: EvenSample() for stage in graph.stages}

    def add(self, explained: ExplainedJob) -> None:
        """Count a job. Jobs must come in the order of their ends."""
        job = explained.job
        self._services[job.stage].add(job.end_ns - job.begin_ns)
        if explained.presented is not None:
            self._waiting.append(explained)
        if len(self._waiting) > DELAY:
            self._look(self._waiting.popleft())

    def close(self) -> tuple[list[ShownFrame], Usual]:
        """Return (slowest frames, medians over the run). The slowest frame comes first. Call it after the last job."""
        while self._waiting:
            self._look(self._waiting.popleft())
        slowest = [shown for _, _, shown in sorted(self._slowest, reverse=True)]
        frames = self._frames.values
        kinds = {part for _, parts_ns in frames for part in parts_ns}
        return slowest, Usual(
            _median([frame_ns for frame_ns, _ in frames]),
            {part: _median([parts_ns.get(part, 0) for _, parts_ns in frames]) for part in kinds},
            {stage: _median(sample.values) for stage, sample in self._services.items()},
            self._unit_of,
        )

    def _look(self, shown: ExplainedJob) -> None:
        now = shown.presented
        assert now is not None
        before, self._before = self._before, now
        if before is None or now.interval_ns is None:
            return
        begin_ns, end_ns = before.end_ns, now.end_ns
        sums: dict[Part, int] = {}
        longest: dict[Part, tuple[int, JobRecord]] = {}
        for piece in self._paths.walk(shown, begin_ns):
            for part, ns in parts(piece, begin_ns, end_ns, self._sharing).items():
                sums[part] = sums.get(part, 0) + ns
                if ns > longest.get(part, (0, piece.job))[0]:
                    longest[part] = (ns, piece.job)
        frame_ns = end_ns - begin_ns
        self._frames.add((frame_ns, sums))
        if len(self._slowest) < self._most or self._slowest[0][0] < frame_ns:
            jobs = {part: job for part, (_, job) in longest.items()}
            heappush(self._slowest, (frame_ns, -now.frame, ShownFrame(now, before, frame_ns, sums, jobs)))
            if len(self._slowest) > self._most:
                heappop(self._slowest)


def _median(values: Sequence[int]) -> float:
    return float(median(values)) if values else 0.0


def reasons(shown: ShownFrame, usual: Usual) -> list[Reason]:
    """Return why a frame took longer than the median: at most `MOST_REASONS` reasons, the largest `longer_ms` first.

    If the frame hardly took longer, return no reason. `shown`: the frame. `usual`: medians over the run.
    """
    longer_ns = shown.frame_ns - usual.frame_ns
    found = [
        (ns - usual.parts_ns.get(part, 0.0), part)
        for part, ns in shown.parts_ns.items()
        if ns - usual.parts_ns.get(part, 0.0) > max(LEAST_SHARE * longer_ns, 0)
    ]
    if longer_ns <= LEAST_LONGER * usual.frame_ns:
        return []
    return [
        Reason(part[0], part[1], ns / NS_PER_MS, _text(shown, usual, part, ns))
        for ns, part in sorted(found, reverse=True)[:MOST_REASONS]
    ]


def notes(shown: ShownFrame) -> list[str]:
    """Return, in words, how a frame differs from the frame before: rung, bypass, and frames missing between the two.

    `shown`: both frames.
    """
    said = []
    now, before = shown.now, shown.before
    missing = now.frame - before.frame - 1
    if missing > 0:
        which = f"frame {before.frame + 1}" if missing == 1 else f"frames {before.frame + 1} to {now.frame - 1}"
        said.append(f"{which} before it {'was' if missing == 1 else 'were'} dropped or lost")
    if now.rung != before.rung:
        said.append(f"its work changed from rung {before.rung} to {now.rung}")
    if now.skips != before.skips:
        said.append("it took the bypass" if now.skips else "the frame before took the bypass, it did not")
    return said


def _text(shown: ShownFrame, usual: Usual, part: Part, longer_ns: float) -> str:
    what, stage = part
    job, unit = shown.longest[part], usual.unit_of[stage]
    whose = "" if job.frame == shown.now.frame else f" of frame {job.frame}"
    if what == WORK:
        return _work(shown, usual, job, longer_ns)
    if what == PREEMPTED:
        return f"{stage}{whose}: {unit} had no core, and no job of this run had it"
    if what == TAKEN:
        return f"{job.stage}{whose}: {stage} had its core"
    words = {
        ASLEEP: f"{stage}{whose} slept in its job",
        OVERHEAD: f"{stage}{whose} was handed over late",
        THROTTLED: f"the cap of {unit} held {stage}{whose}",
        LOST: f"a job of {unit} was lost with its process",
        DOWN: f"{unit} was restarted",
        HELD: f"the policy or the order of frames held {stage}{whose}",
        RELEASE: "its input was late: no frame was released yet",
        STOPPED: f"{unit} was stopped by a signal at {stage}{whose}",
        STALLED: f"the scheduler itself did not run when {stage}{whose} was to begin",
    }
    return words.get(what, "before what is known")


def _work(shown: ShownFrame, usual: Usual, job: JobRecord, longer_ns: float) -> str:
    """Return, in words, why the work of a job's stage took a larger part of the path.

    Either the job took longer than usual, or less of it overlapped with the frame before.

    `shown`, `usual`: as in `reasons`. `job`: the job. `longer_ns`: time of the part beyond the usual.
    """
    service_ns, usual_ns = job.end_ns - job.begin_ns, usual.service_ns.get(job.stage, 0.0)
    times = f"{service_ns / NS_PER_MS:.1f} ms, median {usual_ns / NS_PER_MS:.1f}"
    whose = "" if job.frame == shown.now.frame else f" of frame {job.frame}"
    if service_ns - usual_ns >= longer_ns / 2:
        return f"{job.stage}{whose} was slow: {times}"
    if whose:
        return f"it waited for {job.stage}{whose} ({times})"
    return f"less of its {job.stage} overlapped with the frame before ({times})"


def bound_text(bound: Mapping[str, Any]) -> str:
    """Return a report's `bound` in words: what slowing the unit and the stage costs, and their shares of the path.

    If another unit or stage has most of the path, the text ends with it.
    """
    named = ", and of stages most ".join(part_text(part) for part in (bound["unit"], bound["stage"]) if part)
    path = bound.get("path") or {}
    of_path = [part_text(part) for kind in ("unit", "stage") if (part := path.get(kind))]
    return "; most of the path: ".join([named, ", ".join(of_path)] if of_path else [named])


def part_text(part: Mapping[str, Any]) -> str:
    """Return a part of a report's `bound` in words: what slowing it costs, its share of the path, and its rivals.

    `part`: value of `unit` or `stage` in the `bound`, or in the `path` of the `bound`, which has no cost.
    """
    cost = part.get("cost")
    key, value = ("share", part["share"]) if cost is None else ("cost", cost)
    low, high = part[f"{key}_low"], part[f"{key}_high"]
    between = "" if low is None else f" ({low:.0%} to {high:.0%})"
    rivals = f", not surely more than {' or '.join(part['rivals'])}" if part.get("rivals") else ""
    if cost is None:
        return f"{part['name']} {value:.0%} of the path{between}{rivals}"
    return f"{part['name']} costs {value:.0%}{between} when 20% slower, {part['share']:.0%} of the path{rivals}"


#: Stage of the avatar's pipeline -> what makes its work shorter.
SHORTER = {
    "pose": "`--skinning gpu` takes the vertices off the CPU; `trilane plan SCENE` says what a scene models",
    "raster": "a smaller `--size` draws fewer texels",
    "infer": "a smaller `--size`, or another `--runtime`",
    "composite": "a smaller `--picture`",
    "present": "a smaller `--picture`: the picture is encoded there",
}

#: Replaces rows of `OF_CAUSES` for a pipeline file, whose run has no `--latch`.
OF_FILES = {HELD: "another `--policy` or `--edge` lets {stage} begin sooner (docs/policies-and-edges.md)"}
#: Part of the path that is no work -> what to try.
OF_CAUSES = {
    THROTTLED: "a performance profile with more power, such as `--performance-profile burst`, caps {unit} less",
    DOWN: "{unit} was restarted: the run's messages say why",
    STOPPED: "nothing: {unit} was stopped by a signal, from outside of Trilane",
    STALLED: "nothing, if a message of the run says that a signal stopped the scheduler; else end other programs",
    LOST: "{unit} was restarted: the run's messages say why",
    HELD: "another `--policy`, `--edge` or `--latch` lets {stage} begin sooner (docs/policies-and-edges.md)",
    ASLEEP: "{stage} sleeps in its jobs: what it waits for is outside of Trilane",
    OVERHEAD: "{stage} is handed over late: fewer, longer jobs, or fewer programs beside the run on this machine",
    RELEASE: "nothing: frames come as often as was asked for, and there is time to spare",
}


def advice(budget: Sequence[BudgetRow], policy: str, spare_cores: int, is_of_file: bool = False) -> list[str]:
    """Return sentences about what a user could try, each with its reason.

    The policy comes first, then time that other programs took, then the largest rows.

    `budget`: parts of the critical path, the largest first. `policy`: policy of the run.
    `spare_cores`: number of cores beyond one for each unit; negative if units share cores.
    `is_of_file`: whether a pipeline file was run. If not, the stages are the avatar's.
    """
    found = []
    works = [row for row in budget if row.what == WORK]
    if works_on_one_frame(policy) and len(works) > 1:
        found.append("one frame is worked on at a time: `--policy pipelined` lets the units work at once")
    nobodys = [row for row in budget if row.what == PREEMPTED]
    if sum(row.share for row in nobodys) >= LEAST_ADVISED_SHARE:
        found.append(
            f"{sum(row.ms for row in nobodys):.1f} ms a frame, {', '.join(row.stage for row in nobodys)} "
            f"({PREEMPTED}): no job of this run had the core: end other programs; threads that spin take it too"
        )
    found += [
        f"{row.ms:.1f} ms a frame, {row.stage} ({row.what}): {_try(row, spare_cores, is_of_file)}"
        for row in budget
        if row.share >= LEAST_ADVISED_SHARE and row.what != PREEMPTED
    ]
    return found[:MOST_ADVICE]


def _try(row: BudgetRow, spare_cores: int, is_of_file: bool) -> str:
    stage, unit = row.stage, row.unit
    if is_of_file and row.what in (WORK, TAKEN):
        own_core = row.what == TAKEN and spare_cores >= 0
        return (
            f"`cores` of {unit} in [units]: a core of its own" if own_core else f"less work in {stage}, or another unit"
        )
    if row.what == TAKEN and spare_cores >= 0:
        return f"this machine has a core for every unit: `--cores` gives {unit} one of its own"
    if row.what in (WORK, TAKEN):
        more_cores = ", or more cores for it (`--cores dsp=...`)" if stage == "infer" and spare_cores > 0 else ""
        return SHORTER.get(stage, f"shorter work of {stage}, or a unit of its own for it") + more_cores
    known = OF_CAUSES | OF_FILES if is_of_file else OF_CAUSES
    return known.get(row.what, "nothing: it is before what is known").format(stage=stage, unit=unit)
