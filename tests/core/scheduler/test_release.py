"""A policy's rate and deadline are the same on the clock of this machine and in virtual time."""

from __future__ import annotations

from typing import Any

import pytest

from trilane.errors import BadInputError
from trilane.hw_profiles.application import Variant, settings_of
from trilane.pipeline import run
from trilane.scheduler.events import HANG_NS, Settings
from trilane.scheduler.policy import POLICIES, run_settings
from trilane.unexpected_value import UnexpectedValue

MS = 1_000_000


def test_settings_by_hand() -> None:
    """A rate for those that need one, a forced rate for all, three periods to present a frame."""
    assert run_settings("pipelined", 7, 40 * MS) == Settings(7, "pipelined")
    assert run_settings("sequential", 7, 40 * MS) == Settings(7, "sequential")
    for policy in ("latest", "deadline"):
        expected = Settings(7, policy, period_ns=40 * MS, deadline_ns=120 * MS, hang_ns=5)
        assert run_settings(policy, 7, 40 * MS, hang_ns=5) == expected
    for policy in POLICIES:
        assert run_settings(policy, 7, 40 * MS, 10 * MS) == Settings(7, policy, period_ns=10 * MS, deadline_ns=30 * MS)
    with pytest.raises(UnexpectedValue, match="policy 'best'"):
        run_settings("best", 7, 40 * MS)


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("fps", [30.0, 24.0, 7.3])
def test_a_run_and_a_prediction_have_the_same_settings(policy: str, fps: float) -> None:
    here: Any = run._settings(policy, 90, fps, None, HANG_NS, 0.0, None)
    assert settings_of(Variant(policy, "double", fps=fps), 90, 1 * MS) == here


def test_a_run_at_a_pace_has_its_latch_and_its_limit_of_silence() -> None:
    expected = Settings(9, "pipelined", period_ns=20 * MS, deadline_ns=60 * MS, hang_ns=5, latch_ns=1_500_000)
    assert run._settings("pipelined", 9, 30.0, 50.0, 5, 1.5, None) == expected
    with pytest.raises(BadInputError, match=r"^the run's settings: found policy 'no', expected one of"):
        run._settings("no", 9, 30.0, None, 5, 0.0, None)


def test_a_display_or_a_batch_slows_a_scene_down() -> None:
    """At 50 a second: 20 ms, on a display of 25 ms that, and 40 ms for two frames a job."""
    for batch, display_ms, period_ms in ((1, 10, 20), (1, 25, 25), (2, 25, 40)):
        found = settings_of(Variant("latest", "double", batch, 50.0), 9, display_ms * MS)
        assert (found.period_ns, found.deadline_ns) == (period_ms * MS, 3 * period_ms * MS)
    assert settings_of(Variant(), 9, 25 * MS).period_ns == 0
    assert settings_of(Variant(), 9, 25 * MS, held=True).period_ns == 25 * MS
