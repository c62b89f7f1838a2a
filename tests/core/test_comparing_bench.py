"""What the bench of `trilane compare` asks for and counts, with runs in virtual time in place of real ones."""

from __future__ import annotations

from math import log
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import pytest

from trilane.apps import asked_run
from trilane.apps.experiments import comparing
from trilane.errors import BadInputError
from trilane.stages.run_options import RunOptions
from trilane.testing.compared_runs import STAGES, simulated, write_run
from trilane.testing.run_report import SHARE


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[RunOptions, dict[str, int]]]:
    """Every run that is asked for; it is simulated, and a held stage takes as long as it is held."""
    seen: list[tuple[RunOptions, dict[str, int]]] = []

    def run(wanted: RunOptions, _hooks: Any, _command: Any, held_ns: dict[str, int]) -> None:
        seen.append((wanted, held_ns))
        assert wanted.out is not None
        factors = {stage: ns / 9e6 for stage, ns in held_ns.items()}
        done = simulated(len(seen), policy=wanted.policy, frames=wanted.frames or 0, factors=factors)
        cores = {"cpu": [0], "gpu": [1], "dsp": [0, 1]}
        units = {unit: {**SHARE, **row, "cores": cores[unit]} for unit, row in done.report["units"].items()}
        write_run(wanted.out, done, units=units, other_programs=0.25)

    monkeypatch.setattr(asked_run, "run_asked", run)
    return seen


def test_pairs_a_policy_and_a_held_stage(asked: list[tuple[RunOptions, dict[str, int]]]) -> None:
    said = comparing.measure(pairs=2, frames=80)
    assert (said["pairs"], said["starvation_named"], said["stage_named"]) == (2, True, True)
    assert said["outcomes"] == {"differs": 0, "no difference": 2, "cannot tell": 0}
    wanted = [stdev(log(typical(seed, stage)) for seed in range(2, 6)) for stage in STAGES]
    assert [*said["scatter"].values()] == pytest.approx(wanted) and [*said["scatter"]] == [*STAGES]
    assert [row["question"] for row in said["rows"]] == ["same", "same", "sequential", "held"]
    assert {row["others"] for row in said["rows"]} == {0.25}
    assert [wanted.policy for wanted, _ in asked].count("sequential") == 1
    assert asked[0][0].cores == ()
    assert {wanted.cores for wanted, _ in asked[1:]} == {("cpu=0", "gpu=1", "dsp=0,1")}
    base, longer = (held_ns["infer"] for _, held_ns in asked[-2:])
    assert (longer, said["config"]["held_ms"]) == (round(1.05 * base), base / 1e6)
    assert not any(Path(str(wanted.out)).exists() for wanted, _ in asked)


def typical(seed: int, stage: str) -> float:
    """The mean of the middle half of 80 jobs, of the run with this seed."""
    times = sorted(job.end_ns - job.begin_ns for job in simulated(seed, frames=80).jobs if job.stage == stage)
    return fmean(times[20:60])


def test_runs_that_are_too_short_to_tell_are_refused() -> None:
    with pytest.raises(BadInputError, match="--frames: found 50, expected at least 51"):
        comparing.measure(frames=50)
