"""Whether the machine let a run be measured: the judgement that verdicts, sweeps and gates share.

Rule: a pure function of the report's facts. A run is not trusted if its machine was not quiet, or if nobody knows.
Every reason is said with its figure. The frames themselves are not judged here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from trilane.units import HOST_CLOCK

#: Share of the cores' time above which other programs spoil a measurement.
MOST_OTHERS = 0.05
#: Degrees Celsius from which processors slow themselves down: laptops and phones do so from 90 to 105.
HOT_C = 90.0
#: Share by which the clock may differ between the begin and the end of a run.
CLOCK_CHANGE = 0.1


class Trust(NamedTuple):
    """The judgement of one run.

    `trusted`: whether nothing else changed its times: the machine was quiet, or a model computed them.
    `reasons`: sentences without a full stop: why it is not trusted, or the one fact that it rests on.
    """

    trusted: bool
    reasons: tuple[str, ...]

    @property
    def said(self) -> str:
        """The judgement in one line, such as `UNSURE: other programs took 27 % of its cores`."""
        return ("" if self.trusted else "UNSURE: ") + "; ".join(self.reasons)


def trust_of(report: Mapping[str, Any]) -> Trust:
    """Return whether a run can be trusted.

    `report`: the report as JSON, or as much of it as is known: `clock`, `other_programs`, `processor`, `temperature_c`.
    """
    if report.get("clock", HOST_CLOCK) != HOST_CLOCK:
        return Trust(True, ("computed in virtual time",))
    processor, others = report.get("processor") or {}, report.get("other_programs")
    found = (
        _of_others(others),
        _of_throttles(processor.get("throttles")),
        _of_clock(processor.get("clock_begin_ghz"), processor.get("clock_end_ghz")),
        _of_heat((report.get("temperature_c") or {}).get("sensor")),
    )
    reasons = tuple(reason for reason in found if reason)
    return Trust(False, reasons) if reasons else Trust(True, (f"quiet machine (other programs {percent(others)})",))


def _of_others(share: float | None) -> str:
    if share is None:
        return "nobody knows what other programs took of its cores"
    return f"other programs took {percent(share)} of its cores" if share > MOST_OTHERS else ""


def _of_throttles(count: int | None) -> str:
    if not count:
        return ""
    return f"heat slowed its cores down {count} {'time' if count == 1 else 'times'}"


def _of_clock(begin_ghz: float | None, end_ghz: float | None) -> str:
    if not begin_ghz or not end_ghz or abs(end_ghz / begin_ghz - 1) <= CLOCK_CHANGE:
        return ""
    return f"the clock of its cores changed from {begin_ghz:.2f} to {end_ghz:.2f} GHz"


def _of_heat(celsius: float | None) -> str:
    return f"the hottest sensor had {celsius:.0f} °C at the end" if celsius is not None and celsius >= HOT_C else ""


def percent(share: float | None) -> str:
    """Return a share in percent with two digits at least, such as `0.4 %` and `27 %`."""
    return "unknown" if share is None else f"{100 * share:.1f} %" if share < 0.1 else f"{100 * share:.0f} %"
