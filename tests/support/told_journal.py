"""A journal of two frames, made by hand, of which every figure can be worked out. Rule: nothing in it is random."""

from __future__ import annotations

from trilane.pipeline.journal import SCHEMA, Accounted, Begun, Record, Said, Sampled, Stepped, Worked
from trilane.scheduler.events import Dispatch, Job, JobDone, Settings, UnitReady, chain
from trilane.scheduler.ledger import ASSIGNED, BLOCKED, STARVED, JobRecord

MS = 1_000_000
TWO = chain((("a", "u"), ("b", "v")), "double", "b")


def told_journal() -> tuple[Begun, list[Record]]:
    """Two frames through a on u and b on v. Times in ms of a clock that shows 1000 at the start.

    u: does a0 0-20 and a1 25-50, of which 5 are preempted, and waits 10 more until it is told at 60 that none is left.
    v: starved until 20, b0 20-40, starved 40-50, b1 from 50 on, which has not ended at 70.
    """
    t = 1000 * MS

    def job(number: int, stage: str, frame: int) -> Dispatch:
        return Dispatch(Job(number, "u" if stage == "a" else "v", stage, frame, -1, 0, 0))

    def done(number: int, unit: str, begin: int, end: int, sampled: int = 0, preempted: int = 0) -> JobDone:
        times = (t + begin * MS, t + end * MS, t + sampled * MS if unit == "u" else 0)
        return JobDone(unit, number, *times, preempted_ns=preempted * MS)

    def worked(stage: str, frame: int, begin: int, end: int, **figures: float) -> Worked:
        unit = "u" if stage == "a" else "v"
        return Worked(JobRecord(stage, unit, frame, t, t, t + begin * MS, t + end * MS), figures)

    begun = Begun(
        SCHEMA,
        TWO,
        Settings(9),
        {
            "clock": "host",
            "began_at": "2026-11-22T10:00:00+00:00",
            "accuracy": {"default": {"source": "no figures", "why": "never validated"}},
        },
    )
    return begun, [
        Stepped(t, (UnitReady("u"), UnitReady("v")), (job(0, "a", 0),)),
        Accounted(t, "u", ASSIGNED),
        Accounted(t, "v", STARVED),
        Stepped(t + 20 * MS, (done(0, "u", 0, 20, sampled=2),), (job(1, "a", 1), job(2, "b", 0))),
        Accounted(t + 20 * MS, "v", ASSIGNED),
        worked("a", 0, 0, 20, bytes_written=100.0, visible=1.0),
        Sampled(
            t + 30 * MS,
            {"temperature_c.device": 31.5, "duty.u": 0.5, "temperature_c.sensor": 60.0, "memory_bytes.u": 2e6},
        ),
        Stepped(t + 40 * MS, (done(2, "v", 20, 40),), ()),
        Accounted(t + 40 * MS, "v", STARVED),
        worked("b", 0, 20, 40, bytes_read=100.0, bytes_written=7.0),
        Stepped(t + 50 * MS, (done(1, "u", 25, 50, sampled=26, preempted=5),), (job(3, "b", 1),)),
        Accounted(t + 50 * MS, "v", ASSIGNED),
        worked("a", 1, 25, 50, bytes_written=300.0),
        Stepped(t + 60 * MS, (), ()),
        Accounted(t + 60 * MS, "u", BLOCKED),
        Said(t + 60 * MS, "so it is"),
    ]
