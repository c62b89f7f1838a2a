"""The host as three units."""

from __future__ import annotations

from pathlib import Path

import pytest

from trilane.hw_profiles.host import cgroup_quota, host_units, split_cores, usable_cores


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


@pytest.mark.parametrize(("text", "quota"), [("max 100000", None), ("150000 100000", 1.5), ("x", None), ("", None)])
def test_the_quota_of_a_control_group(tmp_path: Path, text: str, quota: float | None) -> None:
    (tmp_path / "cpu.max").write_text(text)
    assert cgroup_quota(tmp_path) == quota


@pytest.mark.parametrize(("limit", "quota"), [("-1", None), ("200000", 2.0)])
def test_the_quota_of_the_older_control_groups(tmp_path: Path, limit: str, quota: float | None) -> None:
    (tmp_path / "cpu").mkdir()
    (tmp_path / "cpu" / "cpu.cfs_quota_us").write_text(limit)
    (tmp_path / "cpu" / "cpu.cfs_period_us").write_text("100000\n")
    assert cgroup_quota(tmp_path) == quota


def test_this_machine_has_cores() -> None:
    assert usable_cores()
