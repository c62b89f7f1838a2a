"""The benches of the scheduler, with few repeats: they answer, agree with their peers, and say who is absent."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from trilane.bench import handoff, pipeline
from trilane.bench.lib import handoff_variants
from trilane.units import NO_FIGURES


def test_the_pipeline_is_set_against_its_stages_alone(drawable_bundle: Path) -> None:
    result = pipeline.measure(
        avatar=(str(drawable_bundle),), size=("64x64",), edge=("double", "orphan"), frames=20, rounds=1, runtime="ort"
    )
    rows = {(row["policy"], row["edge"]): row for row in result["rows"]}
    assert set(rows) == {("sequential", "double"), ("pipelined", "double"), ("pipelined", "orphan")}
    for row in rows.values():
        assert 0 < row["idle"] < 1
        assert row["idle"] == pytest.approx(row["starved"] + row["undispatched"] + row["overhead"])
        assert row["bound"] > 1
        assert row["of_bound_low"] <= row["gain_of_bound"] <= row["of_bound_high"]
        assert row["gain_of_bound"] == pytest.approx(row["gain"] / row["bound"])
    assert rows["sequential", "double"]["gain"] == 1
    (accuracy,) = result["accuracy"].values()
    assert accuracy["source"] == NO_FIGURES
    assert "never validated" in accuracy["why"]


def peers_files() -> set[Path]:
    """What iceoryx2 keeps in memory and on disk, but for the channels of other processes."""
    found = {*handoff_variants.SHM.glob("io*"), *Path("/tmp").glob("io*")}  # noqa: S108 - looked at
    own = f"iox-{os.getpid()}-"
    return {path for path in found if path.name.startswith(own) or not re.match(r"iox-\d+-", path.name)}


def test_every_way_hands_over_the_same_bytes() -> None:
    before = peers_files()
    result = handoff.measure(kib=(256,), frames=10, rounds=1)
    ways = {row["way"] for row in result["rows"]}
    assert {"slot", handoff.PIPELINE, "pickled queue"} <= ways
    assert ways | set(result["absent"]) == {*handoff.CHANNELS, handoff.PIPELINE}
    for row in result["rows"]:
        assert row["frames"] == 10
        assert 0 < row["p50_low_us"] <= row["p50_us"] <= row["p50_high_us"] <= row["max_us"]
        assert row["p99_us"] is row["read_p99_us"] is None  # of ten frames
        assert row["read_p50_us"] > row["p50_us"]
    assert result["met"] == {"slot": None, handoff.PIPELINE: None}
    assert peers_files() == before
