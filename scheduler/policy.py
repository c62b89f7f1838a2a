"""The scheduling policies, and the settings of a run under one of them.

Rule: a policy is a row of the table; policies differ in their rows alone. Runs on this machine and runs in virtual time
take their settings from here, so that a policy means the same on both clocks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from trilane.scheduler.events import Settings
from trilane.unexpected_value import UnexpectedValue


class Candidate(NamedTuple):
    """A job that could start now.

    `position`: position of its stage in the chain.
    `deadline_ns`: deadline of its frame, or NEVER.
    """

    frame: int
    position: int
    deadline_ns: int


def oldest_frame(candidates: Sequence[Candidate]) -> Candidate:
    """Choose the frame that was begun first: along a chain this keeps the buffers drained and the latency low."""
    return min(candidates)


def furthest_stage(candidates: Sequence[Candidate]) -> Candidate:
    """Choose the stage nearest to the screen: newest-first would starve the later stages of a shared unit."""
    return max(candidates, key=lambda c: c.position)


def earliest_deadline(candidates: Sequence[Candidate]) -> Candidate:
    """Choose the earliest deadline; ties go to the older frame."""
    return min(candidates, key=lambda c: (c.deadline_ns, c.frame))


@dataclass(frozen=True)
class Policy:
    """One row of the table.

    `choose`: function that says which of its runnable jobs a shared unit takes.
    `in_flight`: limit of frames between admission and presentation; 0: no limit of its own.
    `newest`: whether a stage takes the newest waiting frame, and the others are stale.
    `drop_late`: whether a frame that cannot make its deadline is dropped before its next stage.
    `lead_ns`: time before the expected end of a unit's job at which the unit gets its next job; 0: as soon as there is
    one.
    `paced`: whether frames need a rate.
    """

    choose: Callable[[Sequence[Candidate]], Candidate]
    in_flight: int = 0
    newest: bool = False
    drop_late: bool = False
    lead_ns: int = 0
    paced: bool = False


POLICIES = {
    "sequential": Policy(oldest_frame, in_flight=1),
    "pipelined": Policy(oldest_frame),
    "latest": Policy(furthest_stage, newest=True, lead_ns=1_000_000, paced=True),
    "deadline": Policy(earliest_deadline, drop_late=True, lead_ns=1_000_000, paced=True),
}


def policy_named(name: str) -> Policy:
    """Return the row of `POLICIES`; raises UnexpectedValue for an unknown name."""
    if name not in POLICIES:
        raise UnexpectedValue(f"policy {name!r}", f"one of {', '.join(POLICIES)}")
    return POLICIES[name]


MOST_FRAMES = 1_000_000  # that a pipeline file may ask for
DEADLINE_PERIODS = 3  # from a frame's release until it must be presented


def run_settings(policy: str, frames: int, scene_period_ns: int, forced_period_ns: int = 0, **others: Any) -> Settings:
    """Return the settings of a run of `frames` frames.

    `scene_period_ns`: period of the scene's rate in ns. Under `latest` and `deadline`, which need a rate, it is the
    period of releases. Under other policies a frame is released as soon as it can be taken.
    `forced_period_ns`: period of releases under every policy; 0: as above.
    `others`: further fields of Settings.

    Raises UnexpectedValue for an unknown policy.
    """
    period_ns = forced_period_ns or (scene_period_ns if policy_named(policy).paced else 0)
    return Settings(frames, policy, period_ns=period_ns, deadline_ns=DEADLINE_PERIODS * period_ns, **others)
