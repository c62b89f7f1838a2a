"""How figures of a comparison are written, in tables and on the page. Rule: each is text here once, and plain."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Final

from trilane.apps.comparison.compared import Bounds
from trilane.apps.comparison.difference import Difference, Outcome
from trilane.apps.comparison.rows import BYTES, SHARE, Figure
from trilane.apps.explained.advice import bound_text

DASH: Final = "–"
MANY: Final = 10_000


def name_of(figure: Figure) -> str:
    """Such as `idle of dsp: starved`."""
    of = f" of {figure.of}" if figure.of else ""
    cause = f": {figure.cause}" if figure.cause else ""
    return f"{figure.measure}{of}{cause}"


def value_of(value: float, unit: str) -> str:
    """A value in its unit; of a share in percent."""
    if unit == BYTES:
        return f"{value:,.0f} {unit}"
    if unit == "" and abs(value) >= MANY:
        return f"{value:,.0f}"
    return f"{100 * value:.1f} %" if unit == SHARE else f"{value:.4g} {unit}".rstrip()


def change_of(row: Difference, unit: str) -> str:
    """Of a ratio in percent, of a share in points, else in the unit."""
    return _scaled(row.change, row, unit)


def interval_of(row: Difference, unit: str) -> str:
    """The 95 % interval of the change; a dash where nobody knows it."""
    if row.low is None or row.high is None:
        return DASH
    return f"{_scaled(row.low, row, unit, with_unit=False)} to {_scaled(row.high, row, unit, with_unit=False)}"


def _scaled(value: float, row: Difference, unit: str, *, with_unit: bool = True) -> str:
    if row.is_ratio or unit == SHARE:
        name = "%" if row.is_ratio else "points"
        return f"{100 * value:+.1f} {name}" if with_unit else f"{100 * value:+.1f}"
    return f"{value:+.4g} {unit}".rstrip() if with_unit else f"{value:+.4g}"


def bounds_text(bounds: Bounds) -> str:
    """What bounded the other side, and the base; empty where nobody knows either, such as of predictions."""
    if not any((*bounds.base, *bounds.other)):
        return ""
    changed = " changed" if bounds.outcome is Outcome.DIFFERS else ""
    unsure = ": whether it changed cannot be told" if bounds.outcome is Outcome.UNKNOWN else ""
    return f"bound{changed}: {_side(bounds.other)}; was {_side(bounds.base)}{unsure}"


def _side(bounds: Sequence[Mapping[str, Any] | None]) -> str:
    """Of one run with its shares; of several how many each unit bounded."""
    if len(bounds) == 1:
        return bound_text(bounds[0]) if bounds[0] else "not known"
    names = Counter(bound["unit"]["name"] if bound else "not known" for bound in bounds)
    return ", ".join(f"{name} in {count} of {len(bounds)} runs" for name, count in names.most_common())


def setting(value: Any) -> str:
    """The value of a setting; a dash where there is no such key."""
    return DASH if value is None else str(value)
