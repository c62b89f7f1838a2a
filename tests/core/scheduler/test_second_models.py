"""Second schedulers, written from the rules and not from the code, must do the same on random pipelines and graphs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import pytest

from support import plain_graph_scheduler
from support.plain_graph_scheduler import PlainGraphScheduler
from support.plain_scheduler import (
    RESTART_NS,
    PlainClock,
    PlainScheduler,
    PlainUnit,
    drawn,
    service_of,
    skips_of,
    with_bypass,
)
from trilane.scheduler.events import Dispatch, Graph, SetDuty, Settings, unpacked
from trilane.scheduler.virtual import VirtualDriver

CAUSES = ("starved", "blocked", "throttled", "join")


def driven(seed: int, graph: Graph, settings: Settings, delay_ns: int, faults: Any, duties: Any) -> VirtualDriver:
    """A driver whose core has run what a second scheduler is given."""
    driver = VirtualDriver(
        graph,
        settings,
        service_of(seed),
        message_delay_ns=delay_ns,
        restart_ns=RESTART_NS,
        faults=faults,
        inputs=[(0, SetDuty(name, duty)) for name, duty in duties.items()],
        skips=skips_of(seed),
        keep=True,
    )
    driver.run()
    return driver


@pytest.mark.parametrize("bypassed", [False, True])
@pytest.mark.parametrize("seed", range(120))
def test_the_core_does_what_a_plain_reading_of_the_rules_does(seed: int, bypassed: bool) -> None:
    graph, settings, delay_ns, faults, duties = drawn(seed)
    if bypassed:
        graph = with_bypass(seed, graph)
    model = PlainScheduler(graph, settings, service_of(seed), delay_ns, faults, duties, will_skip=skips_of(seed))
    model.run()
    driver = driven(seed, graph, settings, delay_ns, faults, duties)
    assert driver.recording is not None
    dispatched = [
        (now, a.job) for now, _, actions in driver.recording.steps for a in actions if isinstance(a, Dispatch)
    ]
    assert [(job.stage, job.unit, job.frame, now, job.epoch, job.fresh) for now, job in dispatched] == [
        (stage, unit, frame, at_ns, epoch, fresh) for stage, unit, frame, _, at_ns, _, _, epoch, fresh in model.jobs
    ]
    rows = [row[:7] for row in driver.jobs]
    assert [
        (stage, frame, end - begin, begin - ready, end) for stage, _, frame, ready, _, begin, end in rows
    ] == model.ended
    assert set(rows) <= {job[:7] for job in model.jobs}
    ledger = driver.core.ledger
    presented = zip(ledger.presented_frames, ledger.presented_ns, ledger.latency_ns, strict=True)
    assert list(presented) == [row[:3] for row in model.presented]
    assert ledger.lateness_ns == ([row[3] for row in model.presented] if settings.deadline_ns else [])
    assert (ledger.dropped_by_cause, ledger.lost_by_cause) == (dict(model.dropped), dict(model.lost))
    report = driver.core.report(clock="virtual", requested=settings.frames)
    assert report["duration_s"] == model.now_ns / 1e9
    assert report["deadline_misses"] == sum(late > 0 for late in ledger.lateness_ns)
    for spec in graph.stages:
        rows = [row for row in model.ended if row[0] == spec.name]
        row = report["stages"][spec.name]
        for key, values in (("service_ms", [r[2] for r in rows]), ("wait_ms", [r[3] for r in rows])):
            assert row[key]["mean"] == pytest.approx(sum(values) / max(len(values), 1) / 1e6, abs=1e-6)
            assert row[key]["max"] == pytest.approx(max(values, default=0) / 1e6, abs=1e-6)
    check_accounts(report, model)


@pytest.mark.parametrize("yields", [False, True])
@pytest.mark.parametrize("seed", range(110))
def test_the_core_does_on_graphs_what_a_plain_reading_of_the_rules_does(seed: int, yields: bool) -> None:
    """Jobs of one instant have no order: the rules do not say which unit is served first."""
    graph, settings, delay_ns, faults, duties = plain_graph_scheduler.drawn(seed, yields)
    model = PlainGraphScheduler(graph, settings, service_of(seed), delay_ns, faults, duties)
    model.run()
    driver = driven(seed, graph, settings, delay_ns, faults, duties)
    assert driver.recording is not None
    assert sorted(dispatched(graph, driver.recording.steps), key=repr) == sorted(
        (row[:5] for row in model.jobs), key=repr
    )
    assert [(job.stage, job.frame, job.begin_ns, job.end_ns) for job in driver.jobs] == model.ended
    assert {job[:7] for job in driver.jobs} <= {(*row[1:4], *row[5]) for row in model.jobs}
    ledger = driver.core.ledger
    assert list(zip(ledger.presented_frames, ledger.presented_ns, strict=True)) == model.presented
    assert list(ledger.latency_ns) == model.latencies
    assert ledger.lost_by_cause == dict(model.lost)
    assert drops(ledger.dropped_by_cause, settings.policy) == drops(model.dropped, settings.policy)
    check_accounts(driver.core.report(clock="virtual"), model)


def dispatched(graph: Graph, steps: Any) -> list[tuple[Any, ...]]:
    """Each job with the frames that lie in its input slots; None for no frame."""
    inputs = {stage.name: stage.inputs or () for stage in graph.stages}
    written: dict[tuple[str, int], int] = {}
    found = []
    for now_ns, _, actions in steps:
        for job in [action.job for action in actions if isinstance(action, Dispatch)]:
            read = inputs[job.stage]
            slots = unpacked(job.slot_in, len(read)) if read else []
            frames = [written.get((each.stage, slot)) for each, slot in zip(read, slots, strict=True)]
            found.append((now_ns, job.stage, job.unit, job.frame, tuple(frames)))
            written[job.stage, job.slot_out] = job.frame
    return found


def drops(counts: Mapping[str, int], policy: str) -> dict[str, int]:
    """By edge and cause; a late frame that waits for several stages is dropped before that which is looked at first."""
    found = Counter[str]()
    for key, count in counts.items():
        found[key.partition(":")[2] if policy == "deadline" else key] += count
    return dict(found)


def check_accounts(report: Any, model: PlainClock) -> None:
    for unit in model.units:
        check_account(report["units"][unit.name], unit, model.now_ns)


def check_account(row: dict[str, Any], unit: PlainUnit, total_ns: int) -> None:
    busy_ns, until_ns = 0, 0
    for begin_ns, end_ns in sorted(unit.busy):
        busy_ns += max(0, end_ns - max(begin_ns, until_ns))
        until_ns = max(until_ns, end_ns)
    idle = {cause: unit.times_ns[cause] / total_ns for cause in CAUSES}
    idle["overhead"] = (unit.times_ns["assigned"] - busy_ns) / total_ns
    assert row["busy"] == pytest.approx(busy_ns / total_ns)
    assert {cause: row["idle"].get(cause, 0) for cause in idle} == pytest.approx(idle, abs=1e-12)
    assert row["jobs"] == len(unit.busy)
