"""What is wrong with a capture: all of it together, so that a person mends everything before trying again.

Rule: a fault names the file, what was found and what was expected; those that differ in the file alone are one entry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from trilane.errors import BadInputError
from trilane.unexpected_value import UnexpectedValue

#: Files that one entry of the list names; the number of all others stands behind them.
MOST_NAMED = 12


@dataclass(frozen=True)
class Fault:
    """`where`: the file, with key or number of the frame. `found`, `expected`, `remedy`: sentence parts."""

    where: str
    found: str
    expected: str
    remedy: str = ""

    @classmethod
    def of(cls, error: BadInputError) -> Fault:
        """What `error` says."""
        return cls(error.where, error.found, error.expected, error.remedy)


class FaultyCaptureError(BadInputError):
    """A capture with faults. Exit code 2; its details list all `faults`."""

    def __init__(self, folder: str, faults: Sequence[Fault]) -> None:
        count = "1 fault" if len(faults) == 1 else f"{len(faults)} faults"
        super().__init__(folder, count, "a capture without any", "mend what is listed")
        self.faults = tuple(faults)
        self.details = tuple(fault_lines(self.faults))

    def __str__(self) -> str:
        return f"{self.where}: {self.found}; nothing was started"


def fault_lines(faults: Sequence[Fault]) -> list[str]:
    """A line for each kind of fault, with the files that have it, in the order in which they were found."""
    kinds: dict[tuple[str, str, str], list[str]] = {}
    for fault in faults:
        kinds.setdefault((fault.found, fault.expected, fault.remedy), []).append(fault.where)
    return [f"  {_names(places)}: {UnexpectedValue(*kind)}" for kind, places in kinds.items()]


def _names(places: list[str]) -> str:
    more = len(places) - MOST_NAMED
    return ", ".join(places[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
