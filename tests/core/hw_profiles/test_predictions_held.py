"""What is predicted for every chip stays what it was, number for number: predictions.json.

Rule: these are no truths but what the model says today; how far it is from published times is tested elsewhere. Who
changes the model or a profile on purpose writes the file anew (`TRILANE_WRITE_PREDICTIONS=1`) and reads the difference.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from trilane.hw_profiles.application import Plan, Variant
from trilane.hw_profiles.network_work import Network
from trilane.hw_profiles.predict import predict, what_if
from trilane.hw_profiles.profile_files import load_profile, profile_names
from trilane.hw_profiles.reference_networks import NetworkSpec, reference_network
from trilane.units import PERFORMANCE_PROFILES, SUSTAINED, UnitName

FILE = Path(__file__).parents[1] / "predictions.json"
#: Chips that can be run; the host's profile is measured on every machine.
CHIPS = [name for name in profile_names() if name != "host" and not load_profile(name).template]
NETWORKS = {
    "resnet18 batch": NetworkSpec("resnet18", "batch", 512, 512, 16),
    "mobilenetv2 instance split": NetworkSpec("mobilenetv2", "instance", 384, 256, 12, "split"),
    "mobilenetv3 group": NetworkSpec("mobilenetv3", "group", 640, 640, 16),
    "efficientnet-lite0 batch": NetworkSpec("efficientnet-lite0", "batch", 256, 256, 8),
}
RUNTIMES: tuple[UnitName, ...] = ("gpu", "dsp")
#: Nine digits are kept; the same sums in another order differ by less.
CLOSE = 1e-7
#: What is kept of an answer: the rest follows from these, or is text.
KEPT = (
    "frame_time_ms.mean",
    "frame_time_ms.p90",
    "frame_time_ms.ema20_min",
    "latency_ms.mean",
    "efficiency",
    "power_w",
    "expected_error",
    "network.",
    "units.dsp.busy",
    "units.gpu.idle.starved",
    "temperature_c.",
    "caps.",
    "fps_",
    "timeline[-1].",
)


@cache
def network(name: str) -> Network:
    return reference_network(NETWORKS[name])


def numbers(data: Any, key: str = "") -> Iterator[tuple[str, float]]:
    """Every number of a prediction by its path; of a timeline the last moment alone."""
    if isinstance(data, dict):
        for name, value in data.items():
            yield from numbers(value, f"{key}.{name}" if key else str(name))
    elif isinstance(data, list):
        yield from numbers(data[-1] if data else 0, f"{key}[-1]")
    elif isinstance(data, int | float):
        yield key, float(f"{float(data):.9g}")


def predictions(chip: str) -> dict[str, dict[str, float]]:
    """By what was asked: settled on either runtime, under every performance profile, and over twelve minutes."""
    profile = load_profile(chip)
    found: dict[str, Any] = {}
    for name in NETWORKS:
        for runtime in RUNTIMES:
            found[f"{name}, {runtime}"] = predict(profile, Plan(network(name), runtime)).as_json()
    dsp = Plan(network("resnet18 batch"), "dsp", Variant("pipelined", "double"))
    for performance in PERFORMANCE_PROFILES:
        found[f"{performance}"] = predict(profile, dsp, performance).as_json()
    for governor in ("step_wise", "power_allocator"):
        found[f"burst, 12 minutes, {governor}"] = predict(profile, dsp, "burst", 12, governor).as_json()
    rows = what_if(profile, network("resnet18 batch"), "dsp", SUSTAINED)
    found["what if"] = {row["name"]: row["frame_ms"] for row in rows}
    return {asked: _kept(asked, answer) for asked, answer in found.items()}


def _kept(asked: str, answer: Any) -> dict[str, float]:
    kept = ("",) if asked == "what if" else KEPT
    return {key: value for key, value in numbers(answer) if key.startswith(kept)}


def test_the_file_has_every_chip() -> None:
    if "TRILANE_WRITE_PREDICTIONS" in os.environ:
        FILE.write_text(json.dumps({chip: predictions(chip) for chip in CHIPS}, indent=0) + "\n", encoding="utf-8")
    assert sorted(json.loads(FILE.read_text(encoding="utf-8"))) == CHIPS


@pytest.mark.parametrize("chip", CHIPS)
def test_predictions_are_those_of_the_file(chip: str) -> None:
    held = json.loads(FILE.read_text(encoding="utf-8"))[chip]
    found = predictions(chip)
    assert list(found) == list(held)
    for asked, answer in found.items():
        assert answer == pytest.approx(held[asked], rel=CLOSE, abs=1e-12), asked
