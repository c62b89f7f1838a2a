"""Finds what bounds the frame time: the critical path, walked backwards from a presented frame.

Rule: a job begins when the last of its conditions is met. The conditions are its input, its unit, a free slot, a free
place among the frames in flight, and its frame's release. If a job has several inputs, the last input counts. The path
goes on with the job whose end met the last condition. The time between these two jobs belongs to neither: it is
overhead, throttling, a restart or another wait. Therefore the pieces of a path follow each other without gaps, and add
up to the time from the path's begin to its end.

The job that met the last condition is known, not guessed. If a job was handed over while its unit did another job, it
waited for that other job. Otherwise it waited for a job whose end the scheduler heard of in the step of the hand-over.

Units that share cores slow each other down, although neither needs the other's result. Therefore time in which a job on
the path had no core belongs to the stage whose job had the core (`Sharing`). The kernel counted how long a job had no
core. `Sharing` computes which stage had the core, from the other jobs that ran then on cores of the job's unit. If no
job explains a part of this time, another program had the core, or a thread of a unit between two jobs.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, OrderedDict, deque
from collections.abc import Iterator, Mapping, Reversible, Sequence
from operator import attrgetter
from typing import Any, Final, NamedTuple

from trilane.pipeline.timeline import Down, ExplainedJob, Span
from trilane.pipeline.unit_history import DOWN, HELD, KEPT, LOST, OVERHEAD, PREEMPTED, THROTTLED, UNKNOWN, Key
from trilane.scheduler.events import Graph, Settings
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.stats import LEAST_FRAMES, batch_interval

DELAY: Final = 256  # number of later jobs after which every job that overlaps a job has ended


class Taken(NamedTuple):
    """Sums over all jobs of a stage, in ns.

    `unit`: unit of the stage.
    `jobs`: number of the jobs.
    `service_ns`: time from begin to end of the jobs.
    `preempted_ns`: time in which the jobs had no core.
    `of`: part of `preempted_ns` in which a job of another stage had the core, by the other stage's name.
    `other_ns`: part of `preempted_ns` that no job of the run explains.
    """

    unit: str
    jobs: int
    service_ns: int
    preempted_ns: int
    of: Mapping[str, int]

    @property
    def other_ns(self) -> int:
        return self.preempted_ns - sum(self.of.values())


class Sharing:
    """Computes which stages had a core while the jobs of another stage had none.

    `cores`: numbers of the cores of each unit; a unit whose cores are not known is missing.
    """

    def __init__(self, cores: Mapping[str, Sequence[int]]) -> None:
        self._beside = {
            unit: [other for other in cores if other != unit and set(cores[other]) & set(own)]
            for unit, own in cores.items()
        }
        self._waiting: deque[JobRecord] = deque()
        self._jobs: dict[str, list[JobRecord]] = {unit: [] for unit in cores}
        self._sums: dict[str, Taken] = {}

    def add(self, job: JobRecord) -> None:
        """Add a job that has ended; call this in the order of the jobs' ends."""
        if self._beside.get(job.unit):
            of_unit = self._jobs[job.unit]
            of_unit.append(job)
            if len(of_unit) > 4 * DELAY:
                del of_unit[: 2 * DELAY]
        self._waiting.append(job)
        if len(self._waiting) > DELAY:
            self._count(self._waiting.popleft())

    def close(self) -> dict[str, Taken]:
        """Return the sums over the jobs of each stage, by the stage's name; called after the last job."""
        while self._waiting:
            self._count(self._waiting.popleft())
        return self._sums

    def taken(self, unit: str, begin_ns: int, end_ns: int, lacked_ns: int) -> dict[str, int]:
        """Return, for each stage, the time in ns in which the stage's jobs had the core that `unit` lacked.

        The unit's time without a core is divided among the stages. Each stage's part is proportional to the time that
        its jobs ran between `begin_ns` and `end_ns`, and is not longer than this time.

        `lacked_ns`: time in ns between `begin_ns` and `end_ns` in which the unit had no core.
        """
        if not lacked_ns:
            return {}
        ran_ns: dict[str, int] = {}
        for other in self._beside.get(unit, ()):
            of_other = self._jobs[other]
            for job in of_other[bisect_right(of_other, begin_ns, key=attrgetter("end_ns")) :]:
                if job.begin_ns >= end_ns:
                    break
                ns, length_ns = min(job.end_ns, end_ns) - max(job.begin_ns, begin_ns), job.end_ns - job.begin_ns
                # The job's sleep, and its time without a core, are assumed to be spread evenly over the job.
                ran = ns * max(length_ns - job.preempted_ns - job.asleep_ns, 0) // length_ns if ns > 0 else 0
                ran_ns[job.stage] = ran_ns.get(job.stage, 0) + ran
        total_ns = sum(ran_ns.values())
        of_others_ns = min(lacked_ns, total_ns)
        return {stage: of_others_ns * ns // total_ns for stage, ns in ran_ns.items() if ns}

    def _count(self, job: JobRecord) -> None:
        was = self._sums.get(job.stage, Taken(job.unit, 0, 0, 0, {}))
        taken = self.taken(job.unit, job.begin_ns, job.end_ns, job.preempted_ns)
        self._sums[job.stage] = Taken(
            job.unit,
            was.jobs + 1,
            was.service_ns + job.end_ns - job.begin_ns,
            was.preempted_ns + job.preempted_ns,
            {stage: was.of.get(stage, 0) + taken.get(stage, 0) for stage in {**was.of, **taken}},
        )


WORK, TAKEN, ASLEEP, RELEASE, STOPPED, STALLED = "work", "taken", "asleep", "release", "stopped", "stalled"
#: The kinds of a piece of a path, and what each means.
WHATS = {
    WORK: "the stage worked",
    TAKEN: "the stage worked, on the core that a stage on the path waited for",
    PREEMPTED: "the stage's unit had the job, but no core: no job of this run had it",
    ASLEEP: "the stage slept in its job, and no device of its own worked for it",
    OVERHEAD: "messages and hand-over before the stage's job",
    THROTTLED: "the unit's cap held the stage's job",
    STOPPED: "a signal had stopped the stage's unit",
    STALLED: "the scheduler itself did not run: a signal had stopped it, or it had no core",
    LOST: "the unit was at a job that was lost with its process",
    DOWN: "a unit's process was down",
    HELD: "the policy, or the order of frames, held the stage's job",
    RELEASE: "no frame was released yet: the rate from outside",
    UNKNOWN: "before what is known",
}
#: The causes into which a gap between two jobs is divided, in this order. The rest is mostly overhead (`_overhead`).
OF_GAPS = (LOST, DOWN, THROTTLED, HELD, PREEMPTED)
MARGIN: Final = 32  # number of presented frames within which paths that end with different frames meet
STEP: Final = 3 * LEAST_FRAMES
MOST_BLOCKS: Final = 128
#: Kinds of pieces whose time belongs to the stage and its unit. All other time is named after its kind.
OF_STAGES = frozenset({WORK, TAKEN, ASLEEP, THROTTLED, LOST, DOWN})
OTHER_PROGRAMS = "other programs"


class Piece(NamedTuple):
    """A piece of a path.

    `what`: kind of the piece, a key of `WHATS`.
    `stage`: stage of `job`; for DOWN, a stage of the unit that was down.
    `job`: job that contains the piece; for a piece between two jobs, the later job.
    `begin_ns`, `end_ns`: begin and end of the piece, in ns of the run's clock.
    `asleep`: kind of the job's sleep, ASLEEP or STOPPED.
    """

    what: str
    stage: str
    job: JobRecord
    begin_ns: int
    end_ns: int
    asleep: str = ASLEEP


class Paths:
    """Keeps the last jobs of a run, and walks back through them.

    `graph`, `settings`: graph and settings of the run.
    `downs`: times so far in which units were down (`Timeline.downs`).
    `stalls`: times so far in which the scheduler did not run (`Timeline.stalls`).
    `kept`: number of jobs that are kept.
    """

    def __init__(
        self,
        graph: Graph,
        settings: Settings,
        downs: Reversible[Down] = (),
        stalls: Reversible[Span] = (),
        kept: int = KEPT,
    ) -> None:
        streams = graph.streams
        ends = [stage.name for stage in graph.stages if stage.name not in streams]
        self._next = {stage.name: [*streams.get(stage.name, ()), *ends] for stage in graph.stages}
        if graph.bypass is not None:
            self._next[graph.bypass[0]].append(graph.bypass[1])
        self._is_chain, self._last = graph.is_chain, ends[-1]
        reads = {stage.name: graph.inputs_of(place) for place, stage in enumerate(graph.stages)}
        self._reads = {name: [each.stage for each in inputs if not each.latest] for name, inputs in reads.items()}
        self._firsts = {name for name, read in self._reads.items() if not read}
        self._paced = bool(settings.period_ns or settings.arrivals_ns or settings.asked)
        self._latches = settings.latch_ns > 0
        self._stage_of = {stage.unit: stage.name for stage in reversed(graph.stages)}
        self._downs, self._stalls, self._kept = downs, stalls, kept
        self._jobs: OrderedDict[Key, ExplainedJob] = OrderedDict()
        self._before: dict[Key, Key] = {}  # the unit's job before each job
        self._last_of_unit: dict[str, Key] = {}
        self._input: dict[Key, Key] = {}
        self._last_of_frame: dict[int, Key] = {}
        self._presented: deque[Key] = deque(maxlen=kept)

    def add(self, explained: ExplainedJob) -> None:
        """Add a job; call this in the order of the jobs' ends."""
        job, key = explained.job, explained.key
        self._jobs[key] = explained
        if before := self._last_of_unit.get(job.unit):
            self._before[key] = before
        self._last_of_unit[job.unit] = key
        if self._is_chain:
            if before := self._last_of_frame.pop(job.frame, None):
                self._input[key] = before
            if job.stage != self._last:
                self._last_of_frame[job.frame] = key
        elif read := [each for stage in self._reads[job.stage] if (each := (stage, job.frame)) in self._jobs]:
            self._input[key] = max(read, key=lambda each: self._jobs[each].job.end_ns)
        if explained.presented is not None or (self._is_chain and job.stage == self._last):
            self._presented.append(key)
        while len(self._jobs) > self._kept:
            self._forget(self._jobs.popitem(last=False)[0])

    def _forget(self, key: Key) -> None:
        for kept in (self._before, self._input):
            kept.pop(key, None)
        if self._last_of_frame.get(key[1]) == key:
            del self._last_of_frame[key[1]]

    def walk(self, last: ExplainedJob, until_ns: int) -> Iterator[Piece]:
        """Yield the pieces of the path from the end of the job `last` back to `until_ns`, the latest piece first."""
        now: ExplainedJob | None = last
        end_ns = last.job.end_ns
        while now is not None and end_ns > until_ns:
            job = now.job
            asleep = STOPPED if job.begin_ns < now.stopped_ns <= job.end_ns else ASLEEP
            yield Piece(WORK, job.stage, job, max(job.begin_ns, until_ns), end_ns, asleep)
            before, released = self._bound_by(now)
            from_ns = until_ns if before is None else max(min(before.job.end_ns, job.begin_ns), until_ns)
            for piece in self._gap(now, from_ns, released, before is None):
                if piece.end_ns > max(piece.begin_ns, until_ns):
                    yield piece._replace(begin_ns=max(piece.begin_ns, until_ns))
            now, end_ns = before, from_ns

    def _gap(self, now: ExplainedJob, from_ns: int, released: bool, is_first: bool) -> Iterator[Piece]:
        """Yield the pieces of the gap before the job `now`, the latest piece first.

        `from_ns`: begin of the gap.
        `released`: whether the job also waited for its frame's release.
        `is_first`: whether the path ends here, because the job before the gap is not known.
        """
        job = now.job
        if released:
            ready_ns = min(max(job.ready_ns, from_ns), job.begin_ns)
            yield from _divided(now, ready_ns, self._overhead(now, ready_ns))
            yield from self._unreleased(job, from_ns, ready_ns)
        elif is_first:
            yield Piece(UNKNOWN, job.stage, job, from_ns, job.begin_ns)
        else:
            is_latched = self._latches and job.stage in self._firsts and not now.after
            yield from _divided(now, from_ns, HELD if is_latched else self._overhead(now, from_ns))

    def _overhead(self, now: ExplainedJob, from_ns: int) -> str:
        """Return the kind of the time before `now` that no cause of `OF_GAPS` explains: STALLED, STOPPED or OVERHEAD.

        `from_ns`: begin of the time, which ends when `now` begins.
        """
        begin_ns = now.job.begin_ns
        for stall in reversed(self._stalls):
            if stall.end_ns <= from_ns:
                break
            if stall.begin_ns < begin_ns:
                return STALLED
        return STOPPED if from_ns < now.stopped_ns <= begin_ns else OVERHEAD

    def _unreleased(self, job: JobRecord, from_ns: int, end_ns: int) -> Iterator[Piece]:
        """Yield the pieces of the time before a frame's release, the latest piece first.

        Time in which a unit was down is of kind DOWN, because it explains why no earlier frame was presented. All other
        time is of kind RELEASE.

        `job`: first job of the frame.
        `from_ns`, `end_ns`: begin of the time, and its end: the frame's release. Both are ns of the run's clock.
        """
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
        """Return (job whose end let `now` begin; whether `now` also waited for its frame's release).

        The job is None if it is unknown.
        """
        key, job = now.key, now.job
        own = [self._before.get(key), self._input.get(key)]
        mine = self._jobs.get(own[0]) if own[0] else None
        # The job was handed over while its unit did another job, so it waited for the end of that job.
        if mine is not None and mine.job.end_ns > job.dispatch_ns:
            return mine, False
        heard = [other for other in now.after if other in own or other[0] in self._next[job.stage]]
        found = self._latest(heard, job) or self._latest([each for each in own if each], job)
        if self._paced and job.stage in self._firsts and (found is None or found.job.end_ns <= job.ready_ns):
            return self._shown_by(job.ready_ns), True
        return found, False

    def _shown_by(self, by_ns: int) -> ExplainedJob | None:
        """Return the last job that presented a frame at `by_ns` or earlier; None if this job is not kept."""
        shown = (self._jobs[key] for key in reversed(self._presented) if key in self._jobs)
        return next((each for each in shown if each.job.end_ns <= by_ns), None)

    def _latest(self, keys: list[Key], job: JobRecord) -> ExplainedJob | None:
        """Return the job of `keys` that ended last before `job` began; None if none did."""
        ended = [self._jobs[key] for key in keys if key in self._jobs and self._jobs[key].job.end_ns <= job.begin_ns]
        return max(ended, key=lambda each: each.job.end_ns, default=None)


def _divided(now: ExplainedJob, from_ns: int, rest: str) -> Iterator[Piece]:
    """Yield one piece for each cause of the gap from `from_ns` to the begin of job `now`, the latest piece first.

    The true order of the causes is not known. The time without a cause is of kind `rest`, and becomes the latest piece.
    """
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


#: The kind of a piece, and its stage.
Part = tuple[str, str]


def parts(piece: Piece, begin_ns: int, end_ns: int, sharing: Sharing | None = None) -> dict[Part, int]:
    """Return the time in ns of a piece between `begin_ns` and `end_ns`, by (kind, stage).

    The moments at which a unit was preempted or asleep in a job are not known. Therefore preempted time and sleep are
    spread evenly over the job.

    `sharing`: object that says which stages had the core that a job lacked; None: no job of the run had this core.
    """
    ns = min(piece.end_ns, end_ns) - max(piece.begin_ns, begin_ns)
    if ns <= 0:
        return {}
    job = piece.job
    if piece.what == PREEMPTED:
        lacked_ns = piece.end_ns - piece.begin_ns
        taken = sharing.taken(job.unit, piece.begin_ns, piece.end_ns, lacked_ns) if sharing is not None else {}
        return _divided_preempted(job.stage, ns, taken, lacked_ns)
    if piece.what != WORK:
        return {(piece.what, piece.stage): ns}
    length_ns = job.end_ns - job.begin_ns
    lacked_ns = min(job.preempted_ns, length_ns)
    preempted_ns = ns * lacked_ns // length_ns
    asleep_ns = ns * min(job.asleep_ns, length_ns - lacked_ns) // length_ns
    taken = sharing.taken(job.unit, job.begin_ns, job.end_ns, lacked_ns) if sharing is not None else {}
    found = {(WORK, job.stage): ns - preempted_ns - asleep_ns, (piece.asleep, job.stage): asleep_ns}
    found |= _divided_preempted(job.stage, preempted_ns, taken, lacked_ns)
    return {part: ns for part, ns in found.items() if ns}


def _divided_preempted(stage: str, ns: int, taken: Mapping[str, int], lacked_ns: int) -> dict[Part, int]:
    """Divide `ns` of the `lacked_ns` in which a job of `stage` had no core; return ns by (kind, stage).

    `taken`: part of `lacked_ns` in which each other stage had the core, in ns. Each gets the same share of `ns` as
    of `lacked_ns`. Time that no stage explains counts as preempted.
    """
    found = {(TAKEN, other): ns * of_other // lacked_ns for other, of_other in taken.items()}
    left_ns = ns - sum(found.values())
    return {part: ns for part, ns in (found | {(PREEMPTED, stage): left_ns}).items() if ns}


class Budget:
    """The critical path of a whole run, as time by kind and stage.

    A path is walked back from every STEP-th presented frame. The MARGIN frames before this frame are left to the next
    walk, because paths that end with different frames meet within MARGIN frames. Therefore the cost per frame does not
    grow with the run.

    `paths`: jobs of the run so far.
    `sharing`: object that says which stages had a core that a job lacked; None: no job of the run had this core.
    `ns_of`: time of the path in ns by (kind, stage), from the first presented frame on.
    """

    def __init__(self, paths: Paths, sharing: Sharing | None = None) -> None:
        self._paths, self._sharing = paths, sharing
        self._since: deque[int] = deque()
        self._from_ns: int | None = None
        self._newest: ExplainedJob | None = None
        self._blocks: list[Counter[Part]] = []  # in order, each over the same number of frames
        self._merged = 1  # number of blocks that were merged into one
        self._open: list[Counter[Part]] = []
        self.ns_of: Counter[Part] = Counter()

    def present(self, shown: ExplainedJob) -> None:
        """Add the job that presented the next frame."""
        self._newest = shown
        if self._from_ns is None:
            self._from_ns = shown.job.end_ns
        else:
            self._since.append(shown.job.end_ns)
        if len(self._since) >= MARGIN + STEP:
            self._cut([self._since.popleft() for _ in range(STEP)][LEAST_FRAMES - 1 :: LEAST_FRAMES])

    def close(self) -> dict[Part, int]:
        """Count the part of the path that is not counted yet, and return `ns_of`; called after the last frame."""
        if self._newest is not None and self._since:
            ends_ns = [*self._since][LEAST_FRAMES - 1 :: LEAST_FRAMES]
            is_whole = len(self._since) % LEAST_FRAMES == 0
            self._cut(ends_ns if is_whole else [*ends_ns, self._since[-1]], is_whole=is_whole)
            self._since.clear()
        return self.ns_of

    def names(self, unit_of: Mapping[str, str]) -> dict[str, dict[Part, str]]:
        """Return two maps from (kind, stage) to a name.

        The map `unit` names the unit of each part of the path. A part that belongs to no unit is named after its kind:
        other programs, release, overhead, held. The map `stage` names the stage, and has only the parts of stages.

        `unit_of`: unit of each stage.
        """
        stages = {part: part[1] for part in self.ns_of if part[0] in OF_STAGES}
        names = {PREEMPTED: OTHER_PROGRAMS}
        units = {part: unit_of[stages[part]] if part in stages else names.get(part[0], part[0]) for part in self.ns_of}
        return {"unit": units, "stage": stages}

    def largest(self, name_of: Mapping[Part, str]) -> dict[str, Any] | None:
        """Return the result of `share` for the name with the largest share of the path, and the key `rivals`.

        Rivals are the names whose share may be as large: the 95 % interval of the difference contains 0. `rivals` is
        None if there are too few frames for an interval. Without a path, return None. Called after `close`.

        `name_of`: name of each part of the path, from `names`.
        """
        sums = _by_name(self.ns_of, name_of)
        if not sums:
            return None
        name = max(sums, key=sums.__getitem__)
        rivals = None
        if self._half_width(name_of, name) is not None:
            near = {other: (self._half_width(name_of, name, other) or 0) * sum(self.ns_of.values()) for other in sums}
            rivals = [other for other in sums if other != name and sums[name] - sums[other] <= near[other]]
        return {**self.share(name_of, name), "rivals": rivals}

    def share(self, name_of: Mapping[Part, str], name: str) -> dict[str, Any]:
        """Return `name`, its `share` of the path (0 to 1), and the bounds `share_low` and `share_high` of the share.

        The bounds form the 95 % interval; both are None if there are too few frames.

        `name_of`: name of each part of the path, from `names`.
        """
        share = _by_name(self.ns_of, name_of)[name] / sum(self.ns_of.values())
        half = self._half_width(name_of, name)
        low, high = (None, None) if half is None else (max(share - half, 0.0), min(share + half, 1.0))
        return {"name": name, "share": share, "share_low": low, "share_high": high}

    def shares(self, name_of: Mapping[Part, str]) -> dict[str, float]:
        """Return the share of each name in the path (0 to 1), the largest first. `name_of`: as for `share`."""
        total = sum(self.ns_of.values())
        return {name: ns / total for name, ns in _by_name(self.ns_of, name_of).most_common()}

    def _half_width(self, name_of: Mapping[Part, str], name: str, other: str = "") -> float | None:
        """Return half the 95 % interval of the share of `name`, or of this share minus the share of `other`.

        Return None if there are too few blocks.
        """
        blocks = [(_by_name(block, name_of), max(sum(block.values()), 1)) for block in self._blocks]
        return batch_interval([(ns.get(name, 0) - ns.get(other, 0)) / of for ns, of in blocks])

    def _cut(self, ends_ns: Sequence[int], *, is_whole: bool = True) -> None:
        """Count the path, in blocks, from the end of the part that is counted already to the last of `ends_ns`.

        `ends_ns`: end of each block, in ns.
        `is_whole`: whether the last block has as many frames as the other blocks.
        """
        assert self._newest is not None
        assert self._from_ns is not None
        bounds = [*zip([self._from_ns, *ends_ns], ends_ns, strict=False)]
        blocks: list[Counter[Part]] = [Counter() for _ in bounds]
        for piece in self._paths.walk(self._newest, self._from_ns):
            for block, (begin_ns, end_ns) in zip(blocks, bounds, strict=True):
                if piece.begin_ns < end_ns and piece.end_ns > begin_ns:
                    block.update(parts(piece, begin_ns, end_ns, self._sharing))
        for block in blocks:
            self.ns_of.update(block)
        self._from_ns = ends_ns[-1]
        self._open += blocks if is_whole else blocks[:-1]
        self._keep()

    def _keep(self) -> None:
        """Store whole blocks. When there are MOST_BLOCKS, merge them in pairs of neighbours."""
        while len(self._open) >= self._merged:
            block: Counter[Part] = Counter()
            for each in self._open[: self._merged]:
                block.update(each)
            del self._open[: self._merged]
            self._blocks.append(block)
            if len(self._blocks) == MOST_BLOCKS:
                for even, odd in zip(self._blocks[::2], self._blocks[1::2], strict=True):
                    even.update(odd)
                self._blocks = self._blocks[::2]
                self._merged *= 2


def _by_name(ns_of: Mapping[Part, int], name_of: Mapping[Part, str]) -> Counter[str]:
    sums: Counter[str] = Counter()
    for part, ns in ns_of.items():
        if part in name_of:
            sums[name_of[part]] += ns
    return sums
