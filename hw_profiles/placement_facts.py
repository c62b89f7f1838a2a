"""What is said of a placement in reports and notes. Rule: the same keys for a run and for a chip in virtual time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from trilane.scheduler.placement import Ranked
from trilane.scheduler.places import Place, Placement

SHOWN = 8  # placements, beside the one that was taken
NS_PER_MS = 1e6


def described(placement: Placement) -> str:
    """Such as `cpu 0, gpu 1, dsp 0,1 (2 threads)`."""
    return ", ".join(f"{unit} {_cores(place)}" for unit, place in placement.items())


def _cores(place: Place) -> str:
    listed = ",".join(map(str, place.cores))
    if len(place.cores) == 1:
        return listed
    return f"{listed} ({place.threads} thread{'s' if place.threads > 1 else ''})"


def unit_rows(placement: Placement) -> dict[str, Any]:
    """`cores` and `threads` of each unit, as JSON takes them."""
    return {unit: {"cores": list(place.cores), "threads": place.threads} for unit, place in placement.items()}


def placement_of(rows: Mapping[str, Any]) -> Placement:
    """What `unit_rows` made rows of."""
    return {unit: Place(tuple(row["cores"]), row["threads"]) for unit, row in rows.items()}


def predictions(best: Ranked, rule: Ranked, found: Sequence[Ranked]) -> dict[str, Any]:
    """The keys that were computed: frame times in ms of the placement that was taken, the rule's, and the next best."""
    others = [each for each in found if each.placement != best.placement][:SHOWN]
    return {
        "predicted_ms": best.frame_ns / NS_PER_MS,
        "rule_ms": rule.frame_ns / NS_PER_MS,
        "rule": unit_rows(rule.placement),
        "alternatives": [
            {"units": unit_rows(each.placement), "predicted_ms": each.frame_ns / NS_PER_MS} for each in others
        ],
    }
