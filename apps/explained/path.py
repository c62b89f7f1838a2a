"""What bounds the frame time: the path of jobs and waits that ends with a presented frame, walked backwards.

Rule: a job begins when the last thing that it needs is there: its input, its unit, a slot or room in flight, or its
frame's release. The path goes on with the job that brought that thing, and what lies between is no job's: overhead, a
cap, a restart. So the pieces of a path follow each other without gap, and their sum is the time that it spans.

Which thing was last is known, not guessed: a job that was handed over while its unit did another waited for that one;
any other waited for one of the ends that the scheduler heard of in the step in which it handed the job over.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterator, Reversible
from typing import Final, NamedTuple

from trilane.apps.explained.waits import (
    DOWN,
    HELD,
    KEPT,
    LOST,
    OVERHEAD,
    PREEMPTED,
    THROTTLED,
    UNKNOWN,
    Down,
    ExplainedJob,
    Key,
)
from trilane.scheduler.events import Graph, Settings
from trilane.scheduler.ledger import JobRecord

WORK, ASLEEP, RELEASE = "work", "asleep", "release"
#: What a piece of a path can be, and what it means.
WHATS = {
    WORK: "the stage worked",
    PREEMPTED: "the stage's unit had the job, but another thread had its core",
    ASLEEP: "the stage slept in its job, and no device of its own worked for it",
    OVERHEAD: "messages and hand-over before the stage's job",
    THROTTLED: "the unit's cap held the stage's job",
    LOST: "the unit was at a job that was lost with its process",
    DOWN: "a unit's process was down",
    HELD: "the policy, or the order of frames, held the stage's job",
    RELEASE: "no frame was released yet: the rate from outside",
    UNKNOWN: "before what is known",
}
#: Of a gap between two jobs, in the order in which it is divided; the rest is overhead.
OF_GAPS = (LOST, DOWN, THROTTLED, HELD, PREEMPTED)
MARGIN: Final = 32  # presented frames after which paths that end with different frames have met


class Piece(NamedTuple):
    """A part of a path. `job`: whose it is, or before which it lies. `stage`: its, or one of a unit that was down."""

    what: str
    stage: str
    job: JobRecord
    begin_ns: int
    end_ns: int


class Paths:
    """Keeps the last jobs of a run, and walks back through them.

    `graph`, `settings`: of the run. `downs`: of its units so far, as `Waits` notes them. `kept`: jobs.
    """

    def __init__(self, graph: Graph, settings: Settings, downs: Reversible[Down] = (), kept: int = KEPT) -> None:
        names = [stage.name for stage in graph.stages]
        self._first, self._last = names[0], names[-1]
        self._next = {name: [*names[place + 1 : place + 2], self._last] for place, name in enumerate(names)}
        if graph.bypass is not None:
            self._next[graph.bypass[0]].append(graph.bypass[1])
        self._paced = bool(settings.period_ns or settings.arrivals_ns or settings.asked)
        self._latches = settings.latch_ns > 0
        self._stage_of = {stage.unit: stage.name for stage in reversed(graph.stages)}
        self._downs, self._kept = downs, kept
        self._jobs: OrderedDict[Key, ExplainedJob] = OrderedDict()
        self._before: dict[Key, Key] = {}  # the job that the same unit did before
        self._last_of_unit: dict[str, Key] = {}
        self._input: dict[Key, Key] = {}
        self._last_of_frame: dict[int, Key] = {}
        self._presented: deque[Key] = deque(maxlen=kept)

    def add(self, explained: ExplainedJob) -> None:
        """The next job of the run that has ended."""
        job, key = explained.job, explained.key
        self._jobs[key] = explained
        if before := self._last_of_unit.get(job.unit):
            self._before[key] = before
        self._last_of_unit[job.unit] = key
        if before := self._last_of_frame.pop(job.frame, None):
            self._input[key] = before
        if job.stage == self._last:
            self._presented.append(key)
        else:
            self._last_of_frame[job.frame] = key
        while len(self._jobs) > self._kept:
            self._forget(self._jobs.popitem(last=False)[0])

    def _forget(self, key: Key) -> None:
        for kept in (self._before, self._input):
            kept.pop(key, None)
        if self._last_of_frame.get(key[1]) == key:
            del self._last_of_frame[key[1]]

    def is_presented(self, explained: ExplainedJob) -> bool:
        """Whether it is the job that presents its frame."""
        return explained.job.stage == self._last

    def job(self, key: Key) -> ExplainedJob | None:
        """The job of a stage and frame, where it is kept."""
        return self._jobs.get(key)

    def walk(self, last: ExplainedJob, until_ns: int) -> Iterator[Piece]:
        """The pieces from the end of `last` back to `until_ns`, the last first."""
        now: ExplainedJob | None = last
        end_ns = last.job.end_ns
        while now is not None and end_ns > until_ns:
            job = now.job
            yield Piece(WORK, job.stage, job, max(job.begin_ns, until_ns), end_ns)
            before, released = self._bound_by(now)
            from_ns = until_ns if before is None else max(min(before.job.end_ns, job.begin_ns), until_ns)
            for piece in self._gap(now, from_ns, released, before is None):
                yield from _clipped(piece, until_ns)
            now, end_ns = before, from_ns

    def _gap(self, now: ExplainedJob, from_ns: int, released: bool, is_first: bool) -> Iterator[Piece]:
        """The pieces between `from_ns` and the begin of `now`, the last first."""
        job = now.job
        if released:
            ready_ns = min(max(job.ready_ns, from_ns), job.begin_ns)
            yield from _divided(now, ready_ns, OVERHEAD)
            yield from self._unreleased(job, from_ns, ready_ns)
        elif is_first:
            yield Piece(UNKNOWN, job.stage, job, from_ns, job.begin_ns)
        else:
            is_latched = self._latches and job.stage == self._first and not now.after
            yield from _divided(now, from_ns, HELD if is_latched else OVERHEAD)

    def _unreleased(self, job: JobRecord, from_ns: int, end_ns: int) -> Iterator[Piece]:
        """The time before a frame was released; a unit that was down then is why no frame before it got through."""
        for down in reversed(self._downs):
            if end_ns <= from_ns or down.end_ns <= from_ns:
                break
            begin_ns = max(down.begin_ns, from_ns)
            if begin_ns < end_ns:
                until_ns = min(down.end_ns, end_ns)
                yield Piece(RELEASE, job.stage, job, until_ns, end_ns)
                yield Piece(DOWN, self._stage_of[down.unit], job, begin_ns, until_ns)
                end_ns = begin_ns
        yield Piece(RELEASE, job.stage, job, from_ns, end_ns)

    def _bound_by(self, now: ExplainedJob) -> tuple[ExplainedJob | None, bool]:
        """The job whose end let `now` begin, and whether `now` had to wait for its release after that."""
        key, job = now.key, now.job
        own = [self._before.get(key), self._input.get(key)]
        mine = self._jobs.get(own[0]) if own[0] else None
        if mine is not None and mine.job.end_ns > job.dispatch_ns:
            return mine, False
        heard = [other for other in now.after if other in own or other[0] in self._next[job.stage]]
        found = self._latest(heard, job) or self._latest([each for each in own if each], job)
        if self._paced and job.stage == self._first and (found is None or found.job.end_ns <= job.ready_ns):
            return self._shown_by(job.ready_ns), True
        return found, False

    def _shown_by(self, by_ns: int) -> ExplainedJob | None:
        """The job that presented the last frame before that time."""
        shown = (self._jobs[key] for key in reversed(self._presented) if key in self._jobs)
        return next((each for each in shown if each.job.end_ns <= by_ns), None)

    def _latest(self, keys: list[Key], job: JobRecord) -> ExplainedJob | None:
        """Of some jobs the one that ended last before `job` began."""
        ended = [self._jobs[key] for key in keys if key in self._jobs and self._jobs[key].job.end_ns <= job.begin_ns]
        return max(ended, key=lambda each: each.job.end_ns, default=None)


def _divided(now: ExplainedJob, from_ns: int, rest: str) -> Iterator[Piece]:
    """The gap before a job by its causes. Where in it each lay is not kept: `rest`, of what has no other, is last."""
    end_ns = now.job.begin_ns
    left_ns = end_ns - from_ns
    taken: list[tuple[str, int]] = []
    for cause in OF_GAPS:
        ns = min(now.waits_ns.get(cause, 0), max(left_ns, 0))
        left_ns -= ns
        taken.append((cause, ns))
    for cause, ns in [(rest, left_ns), *taken]:
        if ns > 0:
            yield Piece(cause, now.job.stage, now.job, end_ns - ns, end_ns)
            end_ns -= ns


def _clipped(piece: Piece, until_ns: int) -> Iterator[Piece]:
    if piece.end_ns > max(piece.begin_ns, until_ns):
        yield piece._replace(begin_ns=max(piece.begin_ns, until_ns))


#: What a piece is, and of which stage.
Part = tuple[str, str]


def parts(piece: Piece, begin_ns: int, end_ns: int) -> dict[Part, int]:
    """The ns of a piece between two times, by what they are and of which stage.

    Where in a job it was preempted or asleep is not known: each part of the job has the same share of it.
    """
    ns = min(piece.end_ns, end_ns) - max(piece.begin_ns, begin_ns)
    if ns <= 0:
        return {}
    job = piece.job
    if piece.what != WORK:
        return {(piece.what, piece.stage): ns}
    length_ns = job.end_ns - job.begin_ns
    preempted_ns = ns * min(job.preempted_ns, length_ns) // length_ns
    asleep_ns = ns * min(job.asleep_ns, length_ns - min(job.preempted_ns, length_ns)) // length_ns
    found = {
        (WORK, job.stage): ns - preempted_ns - asleep_ns,
        (PREEMPTED, job.stage): preempted_ns,
        (ASLEEP, job.stage): asleep_ns,
    }
    return {part: ns for part, ns in found.items() if ns}


class Budget:
    """What bounded a whole run: the path that ends with its last frame, in time that does not grow with the run.

    A path is walked back from every `step`-th presented frame, but for what lies in the last MARGIN frames before it:
    paths that end with different frames meet. `total_ns` and `ns_of` are of the time from the first presented frame.
    """

    def __init__(self, paths: Paths, step: int = MARGIN) -> None:
        self._paths, self._step = paths, step
        self._since: deque[int] = deque()
        self._from_ns: int | None = None
        self._newest: ExplainedJob | None = None
        self.ns_of: dict[Part, int] = {}

    def present(self, shown: ExplainedJob) -> None:
        """The job that presented the next frame."""
        self._newest = shown
        if self._from_ns is None:
            self._from_ns = shown.job.end_ns
        self._since.append(shown.job.end_ns)
        if len(self._since) >= MARGIN + self._step:
            self._cut(self._since[-MARGIN - 1])
            while len(self._since) > MARGIN:
                self._since.popleft()

    def close(self) -> dict[Part, int]:
        """After the last frame: ns by what they are and of which stage."""
        if self._newest is not None:
            self._cut(self._newest.job.end_ns)
        return self.ns_of

    def _cut(self, until_ns: int) -> None:
        """Count the path between what is counted already and `until_ns`."""
        if self._newest is None or self._from_ns is None or until_ns <= self._from_ns:
            return
        for piece in self._paths.walk(self._newest, self._from_ns):
            for part, ns in parts(piece, self._from_ns, until_ns).items():
                self.ns_of[part] = self.ns_of.get(part, 0) + ns
        self._from_ns = until_ns
