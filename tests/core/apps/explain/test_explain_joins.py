"""What a run of a graph says of its joins: by hand, from jobs in virtual time."""

from __future__ import annotations

from trilane.apps.explain.explained_run import Joins, join_text
from trilane.pipeline.critical_path import WORK, Budget, Paths
from trilane.pipeline.journal import Stepped, Worked, journal_of
from trilane.pipeline.timeline import ExplainedJob, Timeline
from trilane.pipeline.unit_history import JOIN, IdleSlice
from trilane.scheduler.events import Graph, Input, Settings, StageSpec
from trilane.scheduler.virtual import Simulation, simulate

MS = 1_000_000
STAGES = (
    StageSpec("frame", "isp", ()),
    StageSpec("depth", "dsp", (Input("frame"),)),
    StageSpec("seg", "gpu", (Input("frame"),)),
    StageSpec("composite", "cpu", (Input("depth"), Input("seg"))),
)
GRAPH = Graph(STAGES, ("double",) * 3, "composite")
TIMES = {"frame": 2, "depth": 14, "seg": 10, "composite": 3}


def simulated(settings: Settings) -> Simulation:
    """A run in which every fifth frame takes seg 10 ms longer."""
    return simulate(
        GRAPH,
        settings,
        lambda stage, _unit, frame, _begin: (TIMES[stage] + 10 * (stage == "seg" and frame % 5 == 0)) * MS,
        keep=True,
    )


def explained(settings: Settings) -> tuple[list[ExplainedJob], Timeline]:
    """The jobs of such a run."""
    made = simulated(settings)
    assert made.recording is not None
    timeline = Timeline(GRAPH, made.recording.settings, waits=True)
    records = list(journal_of(made.recording, made.jobs, {}, made.report))
    assert any(isinstance(record, Worked) for record in records) and isinstance(records[1], Stepped)
    facts = [fact for record in records[1:] for fact in timeline.add(record)]
    return [fact for fact in facts if isinstance(fact, ExplainedJob)], timeline


def test_a_join_waited_for_what_came_last_of_each_frame() -> None:
    """Depth ends 4 ms after seg, but every fifth frame 6 ms before it."""
    jobs, _ = explained(Settings(40, period_ns=20 * MS))
    joins = Joins(GRAPH)
    for job in jobs:
        joins.add(job)
    (row,) = joins.rows()
    assert row == {
        "stage": "composite",
        "inputs": {"depth": {"last": 32, "after_ms": 4.0}, "seg": {"last": 8, "after_ms": 6.0}},
    }
    assert join_text(row) == (
        "composite waited for depth in 32 of 40 jobs, 4.00 ms after the others; "
        "for seg in 8 of 40 jobs, 6.00 ms after the others"
    )


def test_an_idle_unit_says_which_stage_its_join_waits_for() -> None:
    """The CPU waits from the end of what came first to the end of what came last: 4 ms for depth, or 6 ms for seg."""
    settings = Settings(10, "sequential", in_flight=1)
    made = simulated(settings)
    assert made.recording is not None
    timeline = Timeline(GRAPH, settings, idle=True)
    records = list(journal_of(made.recording, made.jobs, {}, made.report))
    facts = [*(fact for record in records[1:] for fact in timeline.add(record)), *timeline.end()]
    joins = [fact for fact in facts if isinstance(fact, IdleSlice) and fact.cause == JOIN]
    usual, fifth = ("cpu", "depth", 4 * MS), ("cpu", "seg", 6 * MS)
    assert [(each.unit, each.late, each.end_ns - each.begin_ns) for each in joins] == [fifth, *[usual] * 4] * 2


def test_the_critical_path_goes_on_with_the_input_that_came_last() -> None:
    """One frame at a time: the path works 14 ms in depth for frames that depth was last of, else 20 ms in seg."""
    settings = Settings(40, "sequential", in_flight=1)
    jobs, timeline = explained(settings)
    paths = Paths(GRAPH, settings, timeline.downs)
    budget = Budget(paths)
    for job in jobs:
        paths.add(job)
        if job.presented is not None:
            budget.present(job)
    ns = budget.close()
    work = {stage: of / MS for (what, stage), of in ns.items() if what == WORK}
    # The span is from the end of frame 0 to that of frame 39: it has the frames 1 to 39, of which 7 are fifth ones.
    assert work == {"frame": 2.0 * 39, "depth": 14.0 * 32, "seg": 20.0 * 7, "composite": 3.0 * 39}
