"""The two questions about bodies are answered in full, and bad questions are refused."""

from __future__ import annotations

import json

import pytest

from trilane.bench import crop, joints
from trilane.errors import BadInputError


def test_crop_compares_every_way_on_the_same_views() -> None:
    """Our crop cuts nothing and wastes less than any square that cuts nothing."""
    report = crop.measure(views=30)
    json.dumps(report, allow_nan=False)
    ours, plain, *widened = report["rows"]
    assert ours["cuts_mesh"] == 0.0
    assert plain["cuts_mesh"] > 0.0
    assert all(ours["wasted_median"] < row["wasted_median"] for row in widened)
    assert ours["wasted_median"] <= 0.20


def test_joints_report_their_limit() -> None:
    """Figures in microseconds beside the limit that they are held to."""
    report = joints.measure(repeats=3)
    json.dumps(report, allow_nan=False)
    assert 0 < report["best_us"] <= report["median_us"] <= report["p90_us"]
    assert report["limit_us"] == 200.0


def test_bad_questions() -> None:
    """No views, no repeats, a side that is no multiple of 32."""
    for ask in (lambda: crop.measure(views=0), lambda: crop.measure(size="100"), lambda: joints.measure(repeats=0)):
        with pytest.raises(BadInputError):
            ask()
