"""A second scheduler, written from the rules and not from the code, must do the same on random pipelines."""

from __future__ import annotations

from typing import Any

import pytest

from support.plain_scheduler import RESTART_NS, PlainScheduler, PlainUnit, drawn, service_of, skips_of, with_bypass
from trilane.scheduler.events import Dispatch, SetDuty
from trilane.scheduler.virtual import VirtualDriver

CAUSES = ("starved", "blocked", "throttled", "overhead")


@pytest.mark.parametrize("bypassed", [False, True])
@pytest.mark.parametrize("seed", range(120))
def test_the_core_does_what_a_plain_reading_of_the_rules_does(seed: int, bypassed: bool) -> None:
    graph, settings, delay_ns, faults, duties = drawn(seed)
    if bypassed:
        graph = with_bypass(seed, graph)
    model = PlainScheduler(graph, settings, service_of(seed), delay_ns, faults, duties, skips_of(seed))
    model.run()
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
    for unit in model.units:
        check_account(report["units"][unit.name], unit, model.now_ns)


def check_account(row: dict[str, Any], unit: PlainUnit, total_ns: int) -> None:
    busy_ns, until_ns = 0, 0
    for begin_ns, end_ns in sorted(unit.busy):
        busy_ns += max(0, end_ns - max(begin_ns, until_ns))
        until_ns = max(until_ns, end_ns)
    idle = {cause: unit.times_ns[cause] / total_ns for cause in CAUSES[:3]}
    idle["overhead"] = (unit.times_ns["assigned"] - busy_ns) / total_ns
    assert row["busy"] == pytest.approx(busy_ns / total_ns)
    assert {cause: row["idle"][cause] for cause in CAUSES} == pytest.approx(idle, abs=1e-12)
    assert row["jobs"] == len(unit.busy)
