"""`bench accounts`: what it draws and asks of runs, and what it makes of results that are told."""

from __future__ import annotations

import random
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from trilane.bench import accounts
from trilane.errors import BadInputError
from trilane.hw_profiles.host import usable_cores

Held = Callable[[str, Any], None]


def report(unit: dict[str, float | None], restarts: int, difference: float, **more: Any) -> dict[str, Any]:
    idle = {"starved": 0.25, "overhead": 0.125, **unit}
    units = {"a": {"busy": 0.5, "idle": idle, "restarts": restarts}}
    return {"units": units, "accounts": {"largest_difference": difference}, **more}


def test_the_row_of_a_clock_by_hand() -> None:
    """Shares sum to 0.875 and 1.0625, the furthest off being 0.125; cores whose units have devices do not count."""
    first, second = report({"preempted": None}, 2, 0.25), report({"preempted": 0.1875}, 3, 0.5)
    plain = {"runs": 2, "largest_difference": 0.5, "sum_error": 0.125, "deaths": 5, "preempted": 0.1875}
    assert accounts._row("virtual", iter([first, second])) == {
        **plain,
        "clock": "virtual",
        "core_cpu": None,
        "core_busy": None,
    }
    uses = [{"cpu": 0.75, "busy": 0.5, "units": ["a"]}, {"cpu": 0.25, "busy": 1.5, "units": ["a", "b"]}]
    hosts = [first | {"core_shares": uses, "devices": {"b"}}, second | {"core_shares": uses[:1], "devices": set()}]
    assert accounts._row("host", hosts) == {**plain, "clock": "host", "core_cpu": 0.75, "core_busy": 0.5}
    assert accounts._row("virtual", [first])["preempted"] is None


def test_random_runs_are_held(monkeypatch: pytest.MonkeyPatch, held: Held) -> None:
    """What a seed draws, in virtual time and on four cores."""
    reports = [accounts.virtual_run(random.Random(f"4 {run}"), 40) for run in range(12)]
    for row in (report["frames"] for report in reports):
        assert row["requested"] == 40
    held(
        "frames",
        [[r["frames"]["presented"], r["frames"]["lost"], sum(r["frames"]["dropped"].values())] for r in reports],
    )
    held("shares", [[u["busy"], *(v or 0.0 for v in u["idle"].values())] for r in reports for u in r["units"].values()])
    monkeypatch.setattr(accounts, "usable_cores", lambda: (0, 1, 2, 3))
    drawn = [accounts.random_pipeline(random.Random(f"4 {run}")) for run in range(12)]
    held(
        "stages",
        [[s.settings["cpu_ms"], s.settings["sleep_ms"], s.settings["device"]] for p in drawn for s in p.stages],
    )
    held("units", [ord(stage.unit) for p in drawn for stage in p.stages])
    held("cores", [n for p in drawn for u in p.units.values() for n in (*u.cores, 10 * u.threads)])
    held("rules", [accounts.EDGES.index(e.rule) for p in drawn for e in p.edges])
    assert {edge.payload_bytes for p in drawn for edge in p.edges} == {4096}
    assert {stage.factory for p in drawn for stage in p.stages} == {"trilane.bench.lib.cpu_load:build"}


def test_a_run_on_the_host_is_asked_as_it_was_drawn(monkeypatch: pytest.MonkeyPatch, held: Held) -> None:
    asked: list[Any] = []

    def run_pipeline(*what: Any, **options: Any) -> Any:
        asked.append((what, options))
        return SimpleNamespace(report=SimpleNamespace(as_json=lambda: {"units": 1}), messages=("m",))

    monkeypatch.setattr(accounts, "run_pipeline", run_pipeline)
    reports = [accounts.host_run(random.Random(f"4 {run}"), 9, "starter") for run in range(12)]  # type: ignore[arg-type]
    for (drawn, frames), options in asked:
        assert (frames, options["starter"]) == (9, "starter")
        assert {s.unit for s in drawn.stages if s.settings["device"]} == reports.pop(0)["devices"]
    policies = list(accounts.POLICIES)
    held("asked", [[policies.index(o["policy"]), o["fps"], o["pace_fps"] or 0] for _, o in asked])
    dies_at = [options["on_progress"]._left for _, options in asked]
    held("deaths", dies_at)
    kills: list[Any] = []
    monkeypatch.setattr(accounts, "unit_process", lambda unit: SimpleNamespace(pid=f"process of {unit}"))
    monkeypatch.setattr(accounts.os, "kill", lambda *what: kills.append(what))
    for _, options in asked:
        for presented in range(10):
            options["on_progress"](presented, 9)
    assert [number for _, number in kills] == [9] * sum(at < 9 for at in dies_at)
    held("victims", [ord(who[-1]) for who, _ in kills])


def test_a_unit_is_killed_once_and_one_that_has_gone_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    kills: list[int] = []
    monkeypatch.setattr(accounts.os, "kill", lambda pid, _: kills.append(pid))
    killer = accounts._Killer(3, lambda: SimpleNamespace(pid=5))  # type: ignore[arg-type,return-value]
    for presented in (0, 2, 3, 4, 10):
        killer(presented, 10)
    assert kills == [5]

    def gone() -> psutil.Process:
        raise LookupError

    accounts._Killer(1, gone)(2, 10)


def test_the_accounts_have_a_row_for_each_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    told = report({"preempted": 0.125}, 1, 0.5)
    drawn: list[Any] = []
    monkeypatch.setattr(accounts, "virtual_run", lambda draw, frames: drawn.append((draw.random(), frames)) or told)
    monkeypatch.setattr(
        accounts, "host_run", lambda draw, frames, starter: drawn.append((draw.random(), frames, starter)) or told
    )

    class Starter:
        def __init__(self, modules: list[str]) -> None:
            self.modules = modules

        def __enter__(self) -> list[str]:
            return self.modules

        def __exit__(self, *_: object) -> None:
            drawn.append("closed")

    monkeypatch.setattr(accounts, "UnitStarter", Starter)
    result = accounts.measure(runs=2, frames=3, seed=6)
    draws = [random.Random(f"6 {run}") for run in range(2)]
    starter = ["trilane.bench.lib.cpu_load"]
    host = [(draw.random(), 3, starter) for draw in draws]
    assert drawn == [*host, "closed", *((draw.random(), 30) for draw in draws)]
    assert [row["clock"] for row in result["rows"]] == ["virtual", "host"]
    assert result["config"] == {"runs": 2, "frames": 3, "seed": 6, "cores": usable_cores()}
    for bad, words in (
        ({"runs": 0}, "--runs: found 0, expected at least 1"),
        ({"frames": 1}, "--frames: found 1, expected at least 2"),
    ):
        with pytest.raises(BadInputError, match=words):
            accounts.measure(**bad)
