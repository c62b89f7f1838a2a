"""Sets the rate at which a run's frames are released, and by when each must be presented.

Rule: runs on this machine and runs in virtual time take their settings from here, so that a policy means the same on
both clocks.
"""

from __future__ import annotations

from typing import Any

from trilane.scheduler.events import Settings
from trilane.scheduler.policy import policy_named

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
