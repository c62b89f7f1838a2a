"""The shares of a unit's time a second time: the timeline's jobs and idle slices, added up. Rule: no ledger is asked.

Also runs in virtual time drawn at random, for which both must be the same.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping
from typing import Any

from trilane.pipeline.journal import records_of
from trilane.pipeline.timeline import Timeline
from trilane.pipeline.unit_history import BUSY, OVERHEAD, PREEMPTED, UNEXPLAINED, IdleSlice
from trilane.scheduler.events import Event, Graph, SetDuty, Settings, StageSpec
from trilane.scheduler.ledger import JobRecord, idle_causes
from trilane.scheduler.policy import POLICIES
from trilane.scheduler.recording import Recording
from trilane.scheduler.virtual import Simulation, simulate

MS = 1_000_000
CAUSES = idle_causes(joins=True)
EDGES = ("single", "double", "triple", "fifo:1", "fifo:3", "orphan", "orphan:4")
UNITS = ("a", "b", "c")


def idle_slices(recording: Recording, jobs: Iterable[JobRecord]) -> tuple[list[IdleSlice], int]:
    """Every idle slice of a run that is in memory, in the order of their ends; and how long the run was, ns."""
    timeline = Timeline(recording.graph, recording.settings, idle=True)
    facts = [fact for record in records_of(recording, jobs) for fact in timeline.add(record)]
    slices = [fact for fact in facts if isinstance(fact, IdleSlice)] + timeline.end()
    return slices, timeline.span.end_ns - timeline.span.begin_ns if timeline.span is not None else 0


def second_accounts(recording: Recording, jobs: Iterable[JobRecord]) -> dict[str, dict[str, float]]:
    """Of each unit the share of `busy` and of each cause; time that nothing explains is missing."""
    ended = list(jobs)
    slices, total_ns = idle_slices(recording, ended)
    parts = [(job.unit, PREEMPTED, job.preempted_ns) for job in ended]
    parts += [(job.unit, OVERHEAD, job.asleep_ns) for job in ended]
    parts += [(job.unit, BUSY, job.end_ns - job.begin_ns - job.preempted_ns - job.asleep_ns) for job in ended]
    parts += [(piece.unit, PREEMPTED, piece.preempted_ns) for piece in slices]
    parts += [(piece.unit, piece.cause, piece.end_ns - piece.begin_ns - piece.preempted_ns) for piece in slices]
    sums = {unit: dict.fromkeys((BUSY, *CAUSES, UNEXPLAINED), 0) for unit, _, _ in parts}
    for unit, cause, ns in parts:
        sums[unit][cause] += ns
    return {unit: {cause: row[cause] / max(total_ns, 1) for cause in (BUSY, *CAUSES)} for unit, row in sums.items()}


def largest_difference(units: Mapping[str, Mapping[str, Any]], second: Mapping[str, Mapping[str, float]]) -> float:
    """Between the `units` of a report and the second accounts, over every unit and share; 1 for a unit that lacks."""
    if units.keys() != second.keys():
        return 1.0
    rows = [(unit, {BUSY: row["busy"], **row["idle"]}) for unit, row in units.items()]
    return float(max(abs(share - second[unit][name]) for unit, row in rows for name, share in row.items()))


def drawn_run(draw: random.Random, frames: int) -> Simulation:
    """A run of any chain, policy, edges, rates, caps and deaths of units."""
    units = [draw.choice(UNITS) for _ in range(draw.randint(1, 6))]
    graph = Graph(
        tuple(StageSpec(f"s{index}", unit) for index, unit in enumerate(units)),
        tuple(draw.choice(EDGES) for _ in units[1:]),
        f"s{draw.randrange(len(units))}",
    )
    policy = draw.choice(list(POLICIES))
    is_paced = POLICIES[policy].paced or draw.random() < 0.5
    settings = Settings(
        frames,
        policy,
        period_ns=draw.randint(5, 25) * MS if is_paced else 0,
        deadline_ns=60 * MS,
        in_flight=draw.randint(0, 4),
        in_queue=draw.randint(0, 3),
        queue_timeout_ns=draw.choice((0, 30 * MS)),
        latch_ns=draw.choice((0, 0, 2 * MS)),
        hang_ns=draw.choice((12 * MS, 200 * MS)),
        max_failures=frames,
    )
    longest_ns = {f"s{index}": draw.randint(1, 14) * MS for index in range(len(units))}
    duties: list[tuple[int, Event]] = [
        (draw.randint(0, frames * 10 * MS), SetDuty(draw.choice(units), draw.randint(300, 1000)))
        for _ in range(draw.randint(0, 3))
    ]
    return simulate(
        graph,
        settings,
        lambda stage, _unit, _frame, _begin_ns: draw.randint(MS // 20, longest_ns[stage]),
        message_delay_ns=draw.choice((0, 50_000)),
        restart_ns=draw.randint(10, 300) * MS,
        faults=[(draw.randint(0, frames * 10 * MS), draw.choice(units)) for _ in range(draw.randint(0, 4))],
        inputs=duties,
        keep=True,
    )
