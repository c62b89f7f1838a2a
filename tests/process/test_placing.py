"""Where a run's units are placed: measured once and kept, or as asked; with real units around a tiny network."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from trilane import machine
from trilane.errors import TrilaneError
from trilane.hw_profiles.host import rule_placement, usable_cores
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.placement import Times
from trilane.stages import PRELOAD, placing
from trilane.stages.blocks.network import calls_of
from trilane.stages.configure import Checked, configure
from trilane.stages.run_options import RunOptions

SEVERAL = pytest.mark.skipif(len(usable_cores()) < 2, reason="there is one core")


@pytest.fixture
def checked(drawable_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Checked:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    asked = RunOptions(avatar=str(drawable_bundle), size="64x64", frames=4, runtime="ort", skinning="cpu")
    return configure(asked, tmp_path)


@SEVERAL
def test_a_run_is_rehearsed_once_and_what_was_found_is_kept(
    checked: Checked, monkeypatch: pytest.MonkeyPatch, nothing_left: Path
) -> None:
    """However busy the machine is; one round of the placements is enough."""
    monkeypatch.setattr(placing, "LEAST_FRAMES", 4)
    for name, value in (("QUIET_ENOUGH", 9.0), ("ROUNDS", 1), ("LOOK_S", 0.0)):
        monkeypatch.setattr(placing, name, value)
    said: list[str] = []
    with UnitStarter(PRELOAD) as starter:
        first = placing.placed(checked, "pipelined", starter, "", said.append).placement
        monkeypatch.setattr(placing, "measured_times", None)  # whoever calls it fails
        monkeypatch.setattr(placing, "tried", None)
        again = placing.placed(checked, "pipelined", starter, "", said.append)
        one_at_a_time = placing.placed(checked, "sequential", starter, "", said.append).placement
    assert first is not None
    assert first == again.placement
    assert [text.split()[0] for text in said] == ["measuring", "trying"]
    assert first["how"] == "tried"
    frame_ms = {str(row["units"]): row["frame_ms"] for row in first["tried"]}
    assert frame_ms[str(first["units"])] <= 1.01 * min(frame_ms.values())
    assert str(first["rule"]) in frame_ms
    assert f"{frame_ms[str(first['units'])]:.1f} ms, the fastest of {len(frame_ms)} that were tried" in again.notes[-1]
    assert one_at_a_time is not None
    assert (one_at_a_time["how"], one_at_a_time["why"]) == ("measured", "the least predicted frame time")
    assert 0 < one_at_a_time["predicted_ms"] <= one_at_a_time["rule_ms"]
    assert {unit: {"cores": list(s.cores), "threads": s.threads} for unit, s in again.config.units.items()} == first[
        "units"
    ]
    rows = {(row["unit"], row["threads"]): row for row in first["times"]}
    assert {unit for unit, _ in rows} == {"cpu", "gpu", "dsp"}
    assert {threads for unit, threads in rows if unit == "dsp"} >= {1, 2}
    assert all(0 < row["core_ms"] <= row["ms"] for row in rows.values())
    assert "by times of" in again.notes[-1]
    assert not list(nothing_left.glob("trilane-rehearsal-*"))


def test_a_short_run_and_one_at_a_chips_pace_are_not_rehearsed(
    checked: Checked, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> Times:
        raise AssertionError("measured")

    monkeypatch.setattr(placing, "measured_times", never)
    rule = rule_placement(usable_cores())
    with UnitStarter() as starter:
        short = placing.placed(checked, "pipelined", starter)
        monkeypatch.setattr(placing, "LEAST_FRAMES", 1)
        held = placing.placed(checked.changed(pace_ns={"infer": 1}), "pipelined", starter)
    for run in (short, held):
        assert run.placement is not None
        assert run.placement["how"] == "rule"
        assert {unit: settings.cores for unit, settings in run.config.units.items()} == {
            unit: place.cores for unit, place in rule.items()
        }


def test_units_have_the_cores_that_were_asked_for(drawable_bundle: Path, tmp_path: Path) -> None:
    cores = list(machine.here.cores())
    wanted = {"cpu": [cores[-1]], "gpu": [cores[0]], "dsp": sorted({cores[0], cores[-1]})}
    options = [part for unit, own in wanted.items() for part in ("--cores", f"{unit}={','.join(map(str, own))}")]
    command = [sys.executable, "-m", "trilane.apps.cli.main", "run", "--avatar", str(drawable_bundle), *options]
    command += ["--size", "64x64", "--frames", "3", "--baseline", "0", "--runtime", "ort", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["placement"]["how"] == "asked"
    assert report["notes"][-1].endswith("(as asked)")
    assert {unit: row["cores"] for unit, row in report["units"].items()} == wanted
    assert {unit: row["threads"] for unit, row in report["units"].items()} == {u: len(own) for u, own in wanted.items()}
    assert {unit: row["spin"] for unit, row in report["units"].items()} == dict.fromkeys(wanted, False)
    assert report["core_efficiency"] > 0


@pytest.mark.usefixtures("nothing_left")
def test_calls_of_a_network_are_measured_in_a_process_of_their_own(
    drawable_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With one thread; a file that is cut short ends it with what is wrong, and nothing is kept of it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path, said = drawable_bundle / "network.onnx", list[int]()
    first = calls_of(path, {}, "ort", (1,), usable_cores(), lambda: said.append(1))
    assert first == calls_of(path, {}, "ort", (1,), usable_cores(), lambda: said.append(2))
    assert said == [1] and list(first.took_ns) == [1] and min(first.took_ns[1]) > 0
    short = tmp_path / "short.onnx"
    short.write_bytes(path.read_bytes()[:-400])
    with pytest.raises(TrilaneError, match=r"short\.onnx"):
        calls_of(short, {}, "ort", (1,), usable_cores(), lambda: said.append(3))
    assert said == [1, 3]
