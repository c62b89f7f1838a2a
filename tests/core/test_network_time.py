"""A network's time by operator: the parts are the whole, and the interval lies around it."""

from __future__ import annotations

import pytest

from trilane.hw_profiles.application import isolated_job_time
from trilane.hw_profiles.load import load_profile
from trilane.hw_profiles.network_time import interval, price
from trilane.hw_profiles.performance_profiles import corners_of
from trilane.hw_profiles.reference_networks import NetworkSpec, reference_network


@pytest.mark.parametrize("unit", ["gpu", "dsp"])
def test_the_operators_and_the_job_are_the_whole_time(unit: str) -> None:
    profile = load_profile("snapdragon-888")
    network, corners = reference_network(NetworkSpec("resnet18", "group", 256, 256, 16)), corners_of(profile, "burst")
    time = price(profile, network.work, unit, corners)  # type: ignore[arg-type]
    assert time.total_ms == pytest.approx(isolated_job_time(profile, network, unit, corners).total_ms)  # type: ignore[arg-type]
    named = network.work.layers.layers if unit == "dsp" else network.work.operators
    assert [o.name for o in time.operators] == [o.name for o in named]
    around = interval(profile, network.work, time)
    assert around.low_ms < time.total_ms < around.high_ms
    assert around.why
