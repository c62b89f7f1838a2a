"""Where a figure comes from, in words that all reports, tables and benches share. Rule: each phrase stands once."""

from __future__ import annotations

import datetime

MEASURED = "measured in this run"
COMPUTED = "computed"
#: Source of a ratio of a measured figure to a computed one.
COMPARED = "measured in this run, over computed"
#: Stands for a figure that is not this avatar's.
NO_FIGURES = "no figures"


def from_validation(date: datetime.date | None) -> str:
    """Return the source of a figure that an avatar's validation of `date` brought."""
    return f"from the avatar's validation of {date}"
