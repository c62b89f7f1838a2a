"""What somebody may do to a run from the page. Rule: a table; what a value must be stands in its row alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from trilane.stages.run_options import RunOptions, option_of

ACTION, CHOICE, NUMBER, DRAG = "action", "choice", "number", "drag"
LEAST_ZOOM, MOST_ZOOM = 0.25, 4.0
MOST_DRAG_DEG: Final = 360.0
#: Controls that the server itself answers, by the window.
OF_THE_CAMERA: Final = ("orbit", "zoom", "recentre")
#: Controls for which a run begins anew.
OF_A_NEW_RUN: Final = tuple(
    name for name, field in RunOptions.model_fields.items() if option_of(field).offered is not None
)

Value = str | float | list[float] | None


@dataclass(frozen=True)
class Control:
    """One control.

    `kind`: action, choice, number or drag. `live`: whether the run goes on; else it begins anew.
    `choices`: of a choice. `min`, `max`: of a number, and of both numbers of a drag. `why_not`: why it cannot be used
    now, "" when it can.
    """

    name: str
    kind: str
    live: bool
    choices: tuple[str, ...] = ()
    min: float | None = None
    max: float | None = None
    why_not: str = ""

    def refusal(self, value: Value) -> str:
        """Why it cannot have `value`, "" when it can."""
        if self.why_not:
            return self.why_not
        if self.kind == ACTION:
            return "" if value is None else "found a value, expected none"
        if self.kind == CHOICE:
            return "" if value in self.choices else f"found {value!r}, expected one of {', '.join(self.choices)}"
        numbers = value if self.kind == DRAG else [value]
        if isinstance(numbers, list) and all(self._has_room_for(number) for number in numbers):
            return ""
        found = "two numbers" if self.kind == DRAG else "a number"
        return f"found {value!r}, expected {found} from {self.min:g} to {self.max:g}"

    def _has_room_for(self, number: Any) -> bool:
        assert self.min is not None and self.max is not None
        is_number = isinstance(number, int | float) and not isinstance(number, bool)
        return is_number and self.min <= number <= self.max

    def as_json(self, value: Any) -> dict[str, Any]:
        """Its row in the hello, with the value in force."""
        return {**asdict(self), "value": value}


def control_of(row: Mapping[str, Any]) -> Control:
    """The control that was sent as `asdict` has it."""
    return Control(**{**row, "choices": tuple(row["choices"])})


def controls_of_run(
    units: Sequence[str], choices: Mapping[str, Sequence[str]], why_not: Mapping[str, str]
) -> tuple[Control, ...]:
    """The controls of a run with these `units`. `choices`, `why_not`: of those of OF_A_NEW_RUN, by name."""
    live = (
        Control("play", ACTION, True),
        Control("pause", ACTION, True),
        Control("step", ACTION, True),
        Control("orbit", DRAG, True, min=-MOST_DRAG_DEG, max=MOST_DRAG_DEG),
        Control("zoom", NUMBER, True, min=LEAST_ZOOM, max=MOST_ZOOM),
        Control("recentre", ACTION, True),
        Control("kill", CHOICE, True, choices=tuple(units)),
    )
    anew = (
        Control(name, CHOICE, False, choices=tuple(choices[name]), why_not=why_not.get(name, ""))
        for name in OF_A_NEW_RUN
    )
    return (*live, *anew)
