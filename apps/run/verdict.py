"""The verdict of a run or a prediction: does it hold its rate, what bounds it, can its times be trusted, what to try?

Rule: the functions are pure, and only this module judges. All commands, pages, notebooks and report.json show its
verdict. `verdict_facts.py` makes the facts of a run that the verdict rests on, `predicted_verdict.py` the facts of a
prediction.

The trust in a run is part of the verdict; sweeps and gates use the trust too. A run is not trusted if its machine was
not quiet, or if nobody knows whether the machine was quiet. Each reason states its figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from trilane.scheduler.stats import CONFIDENCE_TEXT, NEEDED
from trilane.units import HOST_CLOCK

#: Share of the cores' time. If other programs take more, the run is not trusted, and comparisons say so.
MOST_OTHERS = 0.05
#: Temperature in °C at which processors may slow down. Laptops and phones begin at 90 to 105 °C.
HOT_C = 90.0
#: Largest relative change of the processor's clock frequency, from begin to end, of a run that is trusted.
CLOCK_CHANGE = 0.1


class Trust(NamedTuple):
    """The judgement whether the times of a run can be trusted.

    `trusted`: whether the times can be trusted.
    `reasons`: reasons against trust, or the only reason for trust. Each is a sentence without a full stop.
    """

    trusted: bool
    reasons: tuple[str, ...]

    @property
    def said(self) -> str:
        """Return the judgement in one line, such as `UNSURE: other programs took 27 % of its cores`."""
        return ("" if self.trusted else "UNSURE: ") + "; ".join(self.reasons)


def trust_of(report: Mapping[str, Any]) -> Trust:
    """Return the judgement whether the times of a run can be trusted.

    A run is trusted if its machine was quiet, or if its times were computed in virtual time.
    `report`: mapping with the keys `clock`, `other_programs`, `processor` and `temperature_c` of report.json, as far as
    their values are known.
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
    """Return a share (0 to 1) as a text in percent, such as `0.4 %` or `27 %`; `unknown` for None.

    Values below 10 % have one decimal.
    """
    return "unknown" if share is None else f"{100 * share:.1f} %" if share < 0.1 else f"{100 * share:.0f} %"


#: Largest share of late, dropped and lost frames in a run that passes: 99 of 100 frames are in time.
MOST_LATE: Final = 0.01
#: Smallest share of a unit's time for which the verdict names a cause of idle time.
LEAST_NAMED: Final = 0.05
MOST_CAUSES: Final = 2
MOST_TRIES: Final = 3
LABELS: Final = ("PASS", "FAIL")
UNKNOWN: Final = "not known"
NO_RATE: Final = f"the rate is {UNKNOWN}: fewer than two frames were presented"
#: Words beside the figures of a live run, and of a prediction.
SO_FAR, COMPUTED = "so far", "computed"
#: Words beside a predicted rate that is only reached if the next frame is always ready.
ALWAYS_FED: Final = "if always fed"
#: Name of the bound if the refresh rate of the chip's display limits a prediction.
DISPLAY: Final = "display"
#: Name of a bound that is no unit -> explanation for a person.
MEANINGS: Final = {
    "release": "no frame was released yet: frames come no more often than was asked for",
    DISPLAY: "it shows no more frames a second",
    "other programs": "no job of this run had the core",
    "overhead": "messages and hand-overs",
    "held": "the policy or the order of frames",
}


class Rate(NamedTuple):
    """A rate in frames a second.

    `fps`: rate. `low`, `high`: ends of its interval; None if unknown. `share`: confidence of the interval, as a text.
    """

    fps: float
    low: float | None = None
    high: float | None = None
    share: str = CONFIDENCE_TEXT


class LateFrames(NamedTuple):
    """The numbers of frames that were not in time.

    `due`: number of frames that had to be in time. `late`, `dropped`, `lost`: numbers of frames that were presented
    late, dropped and lost. `replaced`: number of frames that newer frames replaced, which do not count as dropped. It
    is 0 if a fixed rate or random arrivals release the frames.
    """

    due: int
    late: int
    dropped: int = 0
    lost: int = 0
    replaced: int = 0

    @property
    def missed(self) -> int:
        return self.late + self.dropped + self.lost


class NamedBound(NamedTuple):
    """The bound of the frame time, as in the report's `bound`.

    `unit`: name of the unit, or a name in MEANINGS.
    `stages`: ms on the critical path, by stage; None if unknown. The stage that bounds comes first, followed by other
    stages of the unit. `share`: share of the unit in the critical path, 0 to 1.
    `cost`: relative growth of the frame time if the unit's jobs take 20 % longer; None if only the path is known.
    `rivals`: names of units that may bound as much. `of_unit`: names of all stages of `unit`.
    `path`: name of the unit with the largest share of the path; "" if this is `unit`, or unknown.
    """

    unit: str
    stages: Mapping[str, float | None]
    share: float
    cost: float | None = None
    rivals: Sequence[str] = ()
    of_unit: frozenset[str] = frozenset()
    path: str = ""


@dataclass(frozen=True)
class Facts:
    """The facts that a verdict rests on.

    In all fields, None means that the value is unknown.
    `rate`: rate of presented frames; None for fewer than two frames. `target_fps`: rate to hold, frames a second.
    `lateness`: numbers of frames that were not in time. `trust`: judgement whether the times can be trusted.
    `is_held_to_rate`: whether a fixed rate releases the frames. In that case, `rate` proves nothing, and only
    `lateness` counts.
    `failure`: reason for an early end; "" for a run that did not fail.
    `frame_ms`: mean frame time. `slow`: result of `slow_percentile`. `latency_ms`: mean latency.
    `alone`: rate (fps) and mean latency (ms) with one frame at a time. `bound`: bound of the frame time.
    `idle`: (idle share, shares of the causes by cause) of each unit, by name. `image`: image error in words.
    `tries`: proposals, the most useful first.
    `source`: "" for a finished run, SO_FAR for a live run, COMPUTED for a prediction.
    """

    rate: Rate | None
    target_fps: float
    lateness: LateFrames | None
    trust: Trust
    is_held_to_rate: bool = False
    failure: str = ""
    frame_ms: float | None = None
    slow: tuple[str, float] | None = None
    latency_ms: float | None = None
    alone: tuple[float, float | None] | None = None
    bound: NamedBound | None = None
    idle: Mapping[str, tuple[float, Mapping[str, float]]] | None = None
    image: str = UNKNOWN
    tries: Sequence[str] = ()
    source: str = ""

    @property
    def is_computed(self) -> bool:
        return self.source == COMPUTED


@dataclass(frozen=True)
class Verdict:
    """The judgement of a run or a prediction.

    `facts`: facts that the judgement rests on. `passed`: whether the run passes. `why`: reasons in one line.
    """

    facts: Facts
    passed: bool
    why: str

    def as_json(self) -> dict[str, Any]:
        """Return the block `verdict` of report.json."""
        bound = self.facts.bound
        return {
            "pass": self.passed,
            "target_fps": self.facts.target_fps,
            "bound": bound and {"unit": bound.unit, "stages": list(bound.stages), "share": bound.share},
            "trusted": self.facts.trust.trusted,
            "why": self.why,
        }

    def lines(self) -> list[tuple[str, str]]:
        """Return the lines of the verdict for people, each as (label, text), such as ("TIME", "10.4 ms a frame")."""
        facts = self.facts
        found = (
            (LABELS[not self.passed], _held(facts)),
            ("TIME", _times(facts)),
            ("BOUND", _bound(facts)),
            ("IDLE", _idle(facts)),
            ("IMAGE", facts.image),
            ("TRUST", facts.trust.said),
            ("TRY", "; ".join(facts.tries[:MOST_TRIES])),
        )
        return [(label, text) for label, text in found if text]

    def shown(self) -> dict[str, Any]:
        """Return the result of `as_json` with a further key `lines`: the [label, text] of each line for people."""
        return {**self.as_json(), "lines": [list(line) for line in self.lines()]}

    def __str__(self) -> str:
        return "\n".join(f"{label:<5} {text}" for label, text in self.lines())


def judged(facts: Facts) -> Verdict:
    """Return the verdict on `facts`.

    A run passes if it did not fail, held its rate, and had at least 99 of 100 frames in time. If a fixed rate releases
    the frames, the measured rate does not count.
    """
    against = [reason for reason in (_ended(facts), _too_slow(facts), _too_late(facts)) if reason]
    said = against or [f"{_number(facts.target_fps)} fps are held"]
    rate = facts.rate
    if rate and rate.low is not None and rate.high is not None and rate.low < facts.target_fps <= rate.high:
        said.append(f"the interval of the rate holds {_number(facts.target_fps)} fps, so another run may differ")
    return Verdict(facts, not against, "; ".join([*said, *facts.trust.reasons]))


def _ended(facts: Facts) -> str:
    if facts.failure:
        return f"the run failed: {facts.failure}"
    return "" if facts.rate else NO_RATE


def _too_slow(facts: Facts) -> str:
    if facts.is_held_to_rate or facts.rate is None or facts.rate.fps >= facts.target_fps:
        return ""
    found, target = _apart(facts.rate.fps, facts.target_fps)
    return f"{found} of {target} fps"


def _too_late(facts: Facts) -> str:
    found = facts.lateness
    if found is None or found.missed <= MOST_LATE * found.due:
        return ""
    return f"{_late(found)} at {_number(facts.target_fps)} fps"


def _late(found: LateFrames) -> str:
    counts = {"dropped": found.dropped, "lost": found.lost, "replaced by newer ones": found.replaced}
    rest = "".join(f", {count} {what}" for what, count in counts.items() if count)
    return f"{found.late} of {found.due} frames late{rest}"


def _held(facts: Facts) -> str:
    """Return the rate and the late frames as a text, such as `96 fps (92 to 102), at 30 fps 0 of 299 frames late`.

    For a run that failed, the text is the reason. If a fixed rate releases the frames, `shown` follows the measured
    rate. In a prediction that counts late frames, ALWAYS_FED follows the predicted rate.
    """
    if facts.failure:
        return f"the run ended early: {facts.failure}"
    if facts.rate is None:
        return NO_RATE
    found, target = _apart(facts.rate.fps, facts.target_fps)
    late = f"at {target} fps {_late(facts.lateness)}" if facts.lateness else f"asked for {target} fps"
    if facts.is_held_to_rate and facts.lateness:
        late = f"asked for {target} fps: {_late(facts.lateness)}"
    around = ""
    if facts.rate.low is not None and facts.rate.high is not None and facts.rate.low < facts.rate.high:
        share = "" if facts.rate.share == Rate._field_defaults["share"] else f", {facts.rate.share}"
        around = f" ({_number(facts.rate.low)} to {_number(facts.rate.high)}{share})"
    shown = "shown" if facts.is_held_to_rate else ""
    fed = ALWAYS_FED if facts.is_computed and facts.lateness else ""
    source = "".join(f" {each}" for each in (shown, facts.source, fed) if each)
    return f"{found} fps{around}{source}, {late}"


def _times(facts: Facts) -> str:
    latency = f", latency {_number(facts.latency_ms)} ms" if facts.latency_ms is not None else ""
    if facts.rate is None or facts.frame_ms is None:
        return f"{UNKNOWN}{latency}"
    slow = f" ({facts.slow[0]} {_ms(facts.slow[1])})" if facts.slow else ""
    alone = f"; one at a time: {_number(facts.alone[0])} fps, {_number(facts.alone[1])} ms" if facts.alone else ""
    return f"{_ms(facts.frame_ms)} ms a frame{slow}{latency}{alone}"


def _bound(facts: Facts) -> str:
    """Return a text on the bound: its name, its ms on the path, its cost if known, and units that may bound as much."""
    bound = facts.bound
    if bound is None:
        return UNKNOWN
    where = "a frame" if facts.is_computed else "on the critical path"
    of_path = f"of {_ms(facts.frame_ms)} ms {where}" if facts.frame_ms else "of the critical path"
    part = f"{_ms(bound.share * facts.frame_ms)} " if facts.frame_ms else ""
    parts = [f"{bound.unit}: {_stages(bound, is_own=True) or part}{of_path} ({_percent(bound.share)})"]
    if bound.unit in MEANINGS:
        parts.append(MEANINGS[bound.unit])
    if bound.cost is not None:
        parts.append(f"20 % slower, it costs {_percent(bound.cost)}")
    if bound.rivals:
        parts.append(f"perhaps {' or '.join(bound.rivals)}")
    if others := _stages(bound, is_own=False):
        parts.append(f"of stages most {others.rstrip()}")
    if bound.path:
        parts.append(f"most of the path is {bound.path}")
    return "; ".join(parts)


def _stages(bound: NamedBound, *, is_own: bool) -> str:
    """Return a text with stages of `bound` and their ms, such as `infer 9.1 `; "" if there are no such stages.

    `is_own`: whether the text has the stages of the bound's own unit; if not, the text has the stages of other units.
    Stages whose ms are rounded to 0 are left out.
    """
    rows = [(stage, ms) for stage, ms in bound.stages.items() if (stage in bound.of_unit) == is_own]
    rows = [(stage, ms) for stage, ms in rows if ms is None or _ms(ms) != _ms(0.0)]
    said = " + ".join(stage if ms is None else f"{stage} {_ms(ms)}" for stage, ms in rows)
    return f"{said} " if said else ""


def _ms(value: float) -> str:
    return f"{value:.2f}" if value < 1 else f"{value:.1f}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _idle(facts: Facts) -> str:
    return ", ".join(_idle_of(unit, *row) for unit, row in (facts.idle or {}).items())


def _idle_of(unit: str, share: float, causes: Mapping[str, float]) -> str:
    named = [cause for cause, part in sorted(causes.items(), key=lambda row: -row[1]) if part >= LEAST_NAMED]
    why = f" ({', '.join(named[:MOST_CAUSES])})" if named else ""
    return f"{unit} {_percent(share)}{why}"


def slow_percentile(times: Mapping[str, float | None]) -> tuple[str, float] | None:
    """Return (name, value in ms) of the highest percentile that has enough samples, such as ("p99", 12.5).

    If no percentile has enough samples, return the maximum, named `max`; None if the maximum is unknown.
    `times`: percentiles, `max` and `samples` of a frame time or a latency, as in the report.
    """
    samples, most = times["samples"], times["max"]
    for name, least in reversed(NEEDED.items()):
        value = times[name]
        if value is not None and (samples is None or samples >= least):
            return name, value
    return None if most is None else ("max", most)


def _apart(one: float, other: float) -> tuple[str, str]:
    """Return two numbers as texts of three digits. If these texts are equal, more digits show the difference."""
    texts = _number(one), _number(other)
    for digits in range(4, 17) if one != other else ():
        if texts[0] != texts[1]:
            break
        texts = f"{one:.{digits}g}", f"{other:.{digits}g}"
    return texts


def _number(value: float | None) -> str:
    """Return `value` as a text with three digits, such as `96.2` or `4.42`; UNKNOWN for None.

    Values from 100 on are rounded to whole numbers.
    """
    if value is None:
        return UNKNOWN
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
