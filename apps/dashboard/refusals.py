"""What the server refused, and how often. Rule: nothing is refused in silence; the names are the label of a metric."""

from __future__ import annotations

from collections import Counter
from enum import StrEnum


class Refusal(StrEnum):
    """Why the server did not do what it was asked to."""

    WRONG_TOKEN = "wrong_token"  # noqa: S105 - the name of a count
    FOREIGN_HOST = "foreign_host"
    FOREIGN_ORIGIN = "foreign_origin"
    TOO_MANY_CLIENTS = "too_many_clients"
    OVERSIZED = "oversized"
    MALFORMED = "malformed"
    CONTROL = "control"
    SLOW_CLIENT = "slow_client"


class Refusals:
    """Counts of all refusals of a server, those that never happened included."""

    def __init__(self) -> None:
        self._counts: Counter[Refusal] = Counter(dict.fromkeys(Refusal, 0))

    def add(self, why: Refusal) -> None:
        self._counts[why] += 1

    def as_json(self) -> dict[str, int]:
        """Count by name."""
        return {why.value: count for why, count in self._counts.items()}
