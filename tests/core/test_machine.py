"""What is read of the machine, from files that a test writes in place of the kernel's."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from trilane.machine import Machine

X86 = """processor\t: 0
model name\t: Some: CPU 3000
flags\t\t: fpu avx2 fma

processor\t: 1
model name\t: Other
flags\t\t: fpu
"""


def with_cpuinfo(folder: Path, text: str) -> Machine:
    (folder / "proc").mkdir(exist_ok=True)
    (folder / "proc/cpuinfo").write_text(text, encoding="utf-8")
    return Machine(folder)


def test_the_first_core_tells_model_and_flags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    x86 = with_cpuinfo(tmp_path, X86)
    assert (x86.cpu_model(), x86.cpu_flags()) == ("Some: CPU 3000", {"fpu", "avx2", "fma"})
    monkeypatch.setattr("platform.processor", lambda: "")
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    arm = with_cpuinfo(tmp_path, "Features\t: asimd i8mm sve\n")
    assert (arm.cpu_model(), arm.cpu_flags()) == ("aarch64", {"asimd", "i8mm", "sve"})
    nothing = Machine(tmp_path / "none")
    assert (nothing.cpu_model(), nothing.cpu_flags(), nothing.cpu_fields()) == ("aarch64", frozenset(), {})


@pytest.mark.parametrize(
    ("told", "ghz"),
    [(None, 0.0), (SimpleNamespace(max=0.0, current=2600.0), 2.6), (SimpleNamespace(max=3000.0, current=1000.0), 3.0)],
)
def test_the_highest_clock_comes_first(monkeypatch: pytest.MonkeyPatch, told: Any, ghz: float) -> None:
    monkeypatch.setattr(psutil, "cpu_freq", lambda: told)
    assert Machine().clock_ghz() == ghz


def test_clock_and_throttling_are_those_of_the_cores_that_are_asked_for(tmp_path: Path) -> None:
    for core, (khz, count) in enumerate([(1_200_000, 3), (3_400_000, 4), (4_000_000, 100)]):
        for name, value in (("cpufreq/scaling_cur_freq", khz), ("thermal_throttle/core_throttle_count", count)):
            file = tmp_path / f"sys/devices/system/cpu/cpu{core}" / name
            file.parent.mkdir(parents=True)
            file.write_text(f"{value}\n", encoding="utf-8")
    machine = Machine(tmp_path)
    assert (machine.core_clock_ghz([0, 1]), machine.throttles([0, 1])) == (3.4, 7)
    assert (machine.core_clock_ghz([7]), machine.throttles([7])) == (None, None)


def test_the_hottest_sensor_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    chips = {"a": [SimpleNamespace(current=40.0), SimpleNamespace(current=55.5)], "b": [SimpleNamespace(current=50.0)]}
    for found, hottest in ((chips, 55.5), ({}, None)):
        monkeypatch.setattr(psutil, "sensors_temperatures", lambda found=found: found, raising=False)
        assert Machine().sensor_c() == hottest
    monkeypatch.delattr(psutil, "sensors_temperatures")
    assert Machine().sensor_c() is None


def test_packages_and_programs_are_found_and_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "explosive.py").write_text("raise SystemExit(1)")
    monkeypatch.syspath_prepend(tmp_path)
    assert Machine().package_file("explosive") == tmp_path / "explosive.py"
    assert Machine().has_package("explosive") and not Machine().has_package("antigravity_none")
    program = tmp_path / "some-tool"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", "/nowhere")
    assert Machine().program("some-tool") is None
    assert Machine().program("some-tool", first=tmp_path) == str(program)
    monkeypatch.setenv("PATH", f"/nowhere:{tmp_path}")
    assert Machine().program("some-tool") == str(program)


def test_the_date_is_in_utc_wherever_the_machine_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "Pacific/Auckland")
    now = Machine().now()
    assert now.utcoffset() is not None and not now.utcoffset()
    assert os.environ["TZ"] == "Pacific/Auckland"
