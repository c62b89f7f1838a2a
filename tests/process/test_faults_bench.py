"""Units that are killed and stopped in real processes of mock units: everything is counted, the pace comes back."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from trilane.bench import faults
from trilane.bench.faults import Signals
from trilane.errors import BadInputError
from trilane.testing.doubles import pipeline_of_doubles as doubles

MS = 1_000_000
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


def test_pace_is_back_with_the_first_of_frames_that_keep_it() -> None:
    presented = [n * 10 * MS for n in range(10)] + [1000 * MS, 1100 * MS] + [(1200 + 10 * n) * MS for n in range(10)]
    assert faults.back_to_pace_ms([95 * MS], presented, 10 * MS) == [1105.0]
    assert faults.back_to_pace_ms([95 * MS, 1205 * MS], presented, 10 * MS) == [5.0]
    assert faults.back_to_pace_ms([], presented, 10 * MS) == []


@pytest.mark.parametrize(
    "asked",
    [
        {"unit": ("npu",)},
        {"fault": ("x",)},
        {"times": 0},
        {"seconds": 0.0},
        {"fps": float("nan")},
        {"stop_s": 99.0, "fault": ("stop",)},
    ],
)
def test_faults_that_cannot_be_are_refused(asked: dict[str, object]) -> None:
    with pytest.raises(BadInputError, match="expected"):
        faults.measure(**asked)  # type: ignore[arg-type]
