"""What stands for the numbers of a chip that nobody knows. Rule: each of them by hand."""

from __future__ import annotations

import math
from typing import Any

import pytest

from trilane.hw_profiles.governor import ThermalState, Throttle, headroom_k, power_allocator, step_wise
from trilane.hw_profiles.profile_files import load_profile, load_tables, parse_profile
from trilane.hw_profiles.schema import CORNERS, Profile
from trilane.hw_profiles.unit_times import machine_of
from trilane.units import UNITS


def unknown() -> Profile:
    """A chip of which no number is known."""
    data, path = load_tables("snapdragon-888")

    def emptied(table: Any) -> Any:
        if isinstance(table, dict) and "kind" in table:
            return {"kind": "unknown", "source": "s"}
        return {key: emptied(value) for key, value in table.items()} if isinstance(table, dict) else table

    return parse_profile(emptied(data), path)


def test_unknown_heat_is_that_of_a_usual_phone() -> None:
    """Ambient 25 °C, 5 K/W over 600 s, 1 K/W over 10 s for each junction, limits of 45 and 95 °C, no base power."""
    profile = unknown()
    state = ThermalState.at_rest(profile)
    assert state == ThermalState(25.0, dict.fromkeys(UNITS, 25.0))
    power: Any = {"cpu": 1.0, "gpu": 2.0, "dsp": 3.0}
    state.advance(profile, power, 60.0)
    device = 25 + 30 * (1 - math.exp(-0.1))
    assert state.device_c == pytest.approx(device) and state.rising
    for unit, watts in power.items():
        goal = device + watts
        assert state.junction_c[unit] == pytest.approx(goal + (25 - goal) * math.exp(-6))
    assert headroom_k(profile, ThermalState(40.0, dict.fromkeys(UNITS, 50.0))) == 5.0
    assert headroom_k(profile, ThermalState(20.0, dict.fromkeys(UNITS, 91.0))) == 4.0


def test_governors_of_an_unknown_chip() -> None:
    """Two kelvin of hysteresis; (45 - 25) / 5 = 4 W are shed, and a fifth of a watt for each kelvin of headroom."""
    profile = unknown()
    requested: Any = dict.fromkeys(UNITS, 0)
    power: Any = {"cpu": 1.0, "gpu": 1.5, "dsp": 2.5}
    for device, steps in ((43.5, 1), (43.0, 1), (42.9, 0)):
        throttle = Throttle({"cpu": 0, "gpu": 0, "dsp": 1})
        step_wise(profile, ThermalState(device, dict.fromkeys(UNITS, 30.0)), throttle, requested, power)
        assert throttle.steps["dsp"] == steps, device
    for device, steps in ((39.9, 0), (40.1, 1)):
        throttle = Throttle()
        power_allocator(profile, ThermalState(device, dict.fromkeys(UNITS, 30.0)), throttle, requested, power)
        assert throttle.steps == {"cpu": 0, "gpu": 0, "dsp": steps}, device


def test_unknown_speeds_and_powers() -> None:
    """A tenth of a tera of products, at a tenth of it; 10 GB/s, a tenth of them; 1 W by the cube of the clock."""
    profile = unknown()
    unit = profile.units["dsp"]
    machine = machine_of(unit, profile.memory, 0.5, contended=True)
    assert machine.arithmetic[:3].tolist() == pytest.approx([0.1 * 0.1e12 * 0.5] * 3)
    assert machine.traffic.tolist() == pytest.approx([1e9] * 7)
    fixed = (
        machine.job,
        machine.operator,
        machine.input,
        machine.permute,
        machine.fallback_job,
        machine.fallback_element,
    )
    assert fixed == (0,) * 6 and machine.block == 1
    assert unit.clock("svs") == 1.0 and unit.power_w("svs", 0.25) == 0.25
    known = load_profile("snapdragon-888").units["dsp"]
    half = known.idle_w.model_copy(update={"value": 0.5})
    slow = unit.model_copy(update={"corners": dict.fromkeys(CORNERS, half)})
    assert slow.power_w("svs", 1.0) == 0.125
