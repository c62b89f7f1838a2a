"""Where a figure comes from, in the words that every report, table and bench has. Rule: each phrase stands once."""

from __future__ import annotations

import datetime

MEASURED = "measured in this run"
COMPUTED = "computed"
#: Of two figures, one measured and one computed.
COMPARED = "measured in this run, over computed"
#: In place of a figure that is not this avatar's.
NO_FIGURES = "no figures"


def from_validation(date: datetime.date | None) -> str:
    """The source of a figure that an avatar's validation of `date` brought."""
    return f"from the avatar's validation of {date}"
