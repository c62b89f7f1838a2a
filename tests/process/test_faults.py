"""Units that are killed and stopped in real processes of mock units: every frame is counted, nothing is left."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from support import faults
from support.doubles import pipeline_of_doubles as doubles
from support.faults import Signals

pytestmark = pytest.mark.usefixtures("nothing_left")


@pytest.mark.parametrize(("unit", "most"), [("cpu", 2), ("gpu", 1), ("dsp", 1)])
def test_a_unit_that_is_killed_again_and_again_costs_a_frame_each_time(unit: str, most: int) -> None:
    """A unit holds two jobs. The first is lost; the second is done again, but for a pose, which no edge keeps."""
    kills = [(0.3, signal.SIGKILL), (1.2, signal.SIGKILL)]
    row = faults.run_under(Signals(unit, kills), doubles(infer=5), 100, 50, 60)
    assert (row["signals"], row["restarts"], row["ended"]) == (2, 2, "all frames")
    assert row["lost_per_death"] <= most
    assert (row["uncounted"], row["dropped"], row["left"]) == (0, 0, 0)


def test_a_unit_that_is_stopped_goes_on_and_nothing_is_lost() -> None:
    moments = [(0.2, signal.SIGSTOP), (1.0, signal.SIGCONT)]
    row = faults.run_under(Signals("gpu", moments), doubles(), 80, 50, 60)
    assert (row["signals"], row["restarts"], row["presented"], row["ended"]) == (1, 0, 80, "all frames")


def test_what_other_programs_keep_in_shared_memory_is_not_left_by_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Names that come while the run goes on; only a name of Trilane's own is left by it."""
    monkeypatch.setattr(faults, "SHM", tmp_path)
    for name, left in (("psm_other", 0), ("trilane-slots", 1)):
        signals = Signals("cpu", [])
        monkeypatch.setattr(signals, "start", (tmp_path / name).touch)
        monkeypatch.setattr(signals, "join", lambda: None)
        assert faults.run_under(signals, doubles(), 4, 50, 60)["left"] == left
