"""The host as three units."""

from __future__ import annotations

from pathlib import Path

import pytest

from trilane import machine
from trilane.hw_profiles.host import RATES, cgroup_quota, host_tables, host_units, split_cores, usable_cores
from trilane.machine import Machine


@pytest.mark.parametrize("count", range(1, 33))
def test_every_unit_has_cores_and_shares_only_when_it_must(count: int) -> None:
    split = split_cores(tuple(range(count)))
    assert set(split) == {"cpu", "gpu", "dsp"}
    assert all(split.values())
    cores = [core for own in split.values() for core in own]
    assert set(cores) == set(range(count))
    assert len(cores) == len(set(cores)) or count < 3
    assert len(split["dsp"]) >= len(split["gpu"]) >= len(split["cpu"])


def test_threads_spin_only_on_cores_of_their_own() -> None:
    assert {unit: settings.spin for unit, settings in host_units((0, 1)).items()} == {
        "cpu": False,
        "gpu": False,
        "dsp": True,
    }
    assert not any(settings.spin for settings in host_units((5,)).values())
    assert all(settings.spin for settings in host_units((0, 1, 2, 3)).values())
    assert host_units((0, 1, 2, 3))["dsp"].threads == 2


@pytest.fixture
def groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the control groups of a machine that has nothing else."""
    monkeypatch.setattr(machine, "here", Machine(tmp_path))
    folder = tmp_path / "sys/fs/cgroup"
    folder.mkdir(parents=True)
    return folder


@pytest.mark.parametrize(("text", "quota"), [("max 100000", None), ("150000 100000", 1.5), ("x", None), ("", None)])
def test_the_quota_of_a_control_group(groups: Path, text: str, quota: float | None) -> None:
    (groups / "cpu.max").write_text(text)
    assert cgroup_quota() == quota


@pytest.mark.parametrize(("limit", "quota"), [("-1", None), ("200000", 2.0)])
def test_the_quota_of_the_older_control_groups(groups: Path, limit: str, quota: float | None) -> None:
    (groups / "cpu").mkdir()
    (groups / "cpu" / "cpu.cfs_quota_us").write_text(limit)
    (groups / "cpu" / "cpu.cfs_period_us").write_text("100000\n")
    assert cgroup_quota() == quota


def test_a_quota_takes_the_last_cores_away(groups: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A CPU and a half of time is worth two cores; one core is left whatever the quota."""
    monkeypatch.setattr(machine.here, "cores", lambda: (2, 3, 5))
    assert usable_cores() == (2, 3, 5)
    for quota, cores in (("150000", (2, 3)), ("1", (2,)), ("900000", (2, 3, 5))):
        (groups / "cpu.max").write_text(f"{quota} 100000")
        assert usable_cores() == cores


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 8, 16])
def test_the_profile_gives_the_network_the_threads_that_a_run_gives_it(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(machine.here, "cores", lambda: tuple(range(count)))
    dsp = host_tables()["units"]["dsp"]
    assert dsp["threads"] == host_units()["dsp"].threads
    assert dsp["peak_int8_tmac_s"]["source"].startswith(f"{dsp['threads']} cores x ")


def test_multiplications_in_a_cycle_follow_from_the_width_of_an_instruction() -> None:
    """FP32: two fused multiply-adds a cycle of 16, 8, 8 and 4 numbers, as two such units have; half of that in scalar.

    INT8: a dot product of bytes has four in the place of one FP32 number; AVX2 without it multiplies and adds in two.
    """
    numbers = {"avx512_vnni": 2 * 16, "avx_vnni": 2 * 8, "avx2": 2 * 8, "asimddp": 2 * 4, "": 4}
    assert {flag: fp32 for flag, (_, fp32) in RATES.items()} == numbers
    dot_product = {"avx512_vnni", "avx_vnni", "asimddp"}
    assert all(int8 == fp32 * (4 if flag in dot_product else 2) for flag, (int8, fp32) in RATES.items())
