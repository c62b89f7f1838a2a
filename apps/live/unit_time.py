"""Where a unit's time goes, now and over the whole run. Rule: the ledger's sums (scheduler/ledger.py), kept by spans.

Its states and jobs, told as they change and end, are spans of time. Those of the last seconds are kept and cut at the
window's edge, in proportion; of older ones the sums alone are kept. What was assigned but neither ran nor was preempted
is overhead.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

from trilane.apps.live.figures import Shares
from trilane.scheduler.accounts import BUSY, CAUSES, NAMES, OVERHEAD, PREEMPTED
from trilane.scheduler.events import JobDone
from trilane.scheduler.ledger import STARVED

ASSIGNED = "assigned"
PARTS = (ASSIGNED, *NAMES.values(), BUSY, PREEMPTED)


class Span(NamedTuple):
    """A piece of time of which `ns` count as `name`; where in it they lie is not known."""

    begin_ns: int
    end_ns: int
    name: str
    ns: int


class UnitTime:
    """The time of one unit from `begin_ns` on; spans are kept for `window_ns`."""

    def __init__(self, begin_ns: int, window_ns: int, account: int = STARVED) -> None:
        self._begin_ns, self._window_ns = begin_ns, window_ns
        self._state, self._since_ns = _name(account), begin_ns
        self._last_end_ns = 0
        self._spans: deque[Span] = deque()
        self._totals = dict.fromkeys(PARTS, 0)

    def enter(self, now_ns: int, account: int) -> None:
        """From `now_ns` on its time goes to `account`."""
        self._keep(self._since_ns, now_ns, self._state, now_ns - self._since_ns)
        self._state, self._since_ns = _name(account), now_ns

    def add_job(self, job: JobDone) -> None:
        """A job has ended; what was lost of the time before it was lost while the unit had it and did no other."""
        begin_ns, end_ns = job.t_begin_ns, job.t_end_ns
        held_from_ns = max(self._last_end_ns, self._since_ns)
        if begin_ns > held_from_ns:
            self._keep(held_from_ns, begin_ns, PREEMPTED, min(job.preempted_before_ns, begin_ns - held_from_ns))
        if end_ns > self._last_end_ns:
            begin_ns = max(begin_ns, self._last_end_ns)
            ran_ns = end_ns - begin_ns
            self._last_end_ns = end_ns
            self._keep(begin_ns, end_ns, BUSY, ran_ns - min(job.preempted_ns + job.asleep_ns, ran_ns))
            self._keep(begin_ns, end_ns, PREEMPTED, min(job.preempted_ns, ran_ns))

    def shares(self, now_ns: int, running_since_ns: int | None) -> tuple[Shares, Shares]:
        """Of the window, and of the run. `running_since_ns`: when the job that it holds was handed to it, if any."""
        opened = [Span(self._since_ns, now_ns, self._state, now_ns - self._since_ns)]
        if running_since_ns is not None:
            begin_ns = min(max(running_since_ns, self._last_end_ns, self._since_ns), now_ns)
            opened.append(Span(begin_ns, now_ns, BUSY, now_ns - begin_ns))
        from_ns = max(now_ns - self._window_ns, self._begin_ns)
        run, window = dict(self._totals), dict.fromkeys(PARTS, 0)
        for span in opened:
            run[span.name] += span.ns
        for begin_ns, end_ns, name, ns in (*self._spans, *opened):
            if begin_ns >= from_ns:
                window[name] += ns
            elif end_ns > from_ns:
                window[name] += ns * (end_ns - from_ns) // (end_ns - begin_ns)
        return _shares(window, now_ns - from_ns), _shares(run, now_ns - self._begin_ns)

    def _keep(self, begin_ns: int, end_ns: int, name: str, ns: int) -> None:
        if ns:
            self._totals[name] += ns
            self._spans.append(Span(begin_ns, end_ns, name, ns))
            while self._spans[0].end_ns < end_ns - self._window_ns:
                self._spans.popleft()


def _name(account: int) -> str:
    return NAMES.get(account, ASSIGNED)


def _shares(sums: Mapping[str, int], total_ns: int) -> Shares:
    if total_ns <= 0:
        return Shares(0.0, dict.fromkeys(CAUSES, 0.0))
    overhead_ns = max(sums[ASSIGNED] - sums[BUSY] - sums[PREEMPTED], 0)  # parts that were cut are rounded down
    idle_ns = {**sums, OVERHEAD: overhead_ns}
    return Shares(sums[BUSY] / total_ns, {cause: idle_ns[cause] / total_ns for cause in CAUSES})
