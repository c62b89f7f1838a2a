"""What the core was told and what it answered, so that a run can be replayed. Rule: a recording is plain data."""

from dataclasses import dataclass


@dataclass
class Recording:
    """Written by RunResult.recording.write(path) as events.jsonl."""
