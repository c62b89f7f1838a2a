"""What all folders share, value by value: sizes, units, the version, what a cache keeps."""

from __future__ import annotations

import importlib.metadata
import os
from datetime import date
from pathlib import Path

import numpy as np
import pytest

import trilane
from trilane import cache, figure_sources, units
from trilane.shapes import checked_size, parse_shape, shape_buckets
from trilane.unexpected_value import UnexpectedValue, unexpected_in


def test_the_version_is_the_distributions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda name: f"that of {name}")
    assert trilane.__version__ == "that of trilane"

    def absent(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", absent)
    assert trilane.__version__ == "0.0.0"
    with pytest.raises(AttributeError, match="module 'trilane' has no attribute 'other'"):
        trilane.other  # noqa: B018


def test_units_and_stages_have_their_names_and_order() -> None:
    assert units.UNITS == ("cpu", "gpu", "dsp")
    names = ("burst", "sustained_high_performance", "high_performance", "balanced")
    assert (*names, "low_balanced", "power_saver", "low_power_saver") == units.PERFORMANCE_PROFILES
    assert (units.BURST, units.SUSTAINED) == ("burst", "sustained_high_performance")
    assert [*units.BEFORE_INFER, units.INFER, *units.AFTER_INFER] == [
        ("pose", "cpu"),
        ("raster", "gpu"),
        ("infer", "dsp"),
        ("composite", "gpu"),
        ("present", "cpu"),
    ]
    assert units.LATENCY_TO == "composite"


def test_the_words_for_sources() -> None:
    words = (figure_sources.MEASURED, figure_sources.COMPUTED, figure_sources.COMPARED, figure_sources.NO_FIGURES)
    assert words == ("measured in this run", "computed", "measured in this run, over computed", "no figures")
    assert figure_sources.from_validation(date(2026, 1, 2)) == "from the avatar's validation of 2026-01-02"


def test_one_shape_is_itself() -> None:
    assert parse_shape("96x1024") == (96, 1024)
    assert shape_buckets("32x4096") == [(32, 4096)]
    assert checked_size("32x4096") == "32x4096"


def test_shapes_of_an_area_by_hand() -> None:
    """Of at most 64 x 64 = 4096 pixels: 32 high 128 wide, 64 by 64, 96 by 32 (42) is inside 128 by 32."""
    assert shape_buckets("64") == [(32, 128), (64, 64), (128, 32)]
    assert shape_buckets("32") == [(32, 32)]


def test_shapes_of_an_area_are_all_that_fit_and_no_more() -> None:
    """Another way: every pair of sides is tried."""
    for side in (96, 128, 160):
        sides = range(32, 4 * side, 32)
        fit = [(h, w) for h in sides for w in sides if h * w <= side * side and max(h, w) <= 4 * min(h, w)]
        kept = [(h, w) for h, w in fit if not any((b, v) != (h, w) and b >= h and v >= w for b, v in fit)]
        assert shape_buckets(str(side)) == kept


@pytest.mark.parametrize("size", ["0", "31", "33", "4128", "64x4128", "0x64", "64x48"])
def test_sides_out_of_range(size: str) -> None:
    with pytest.raises(UnexpectedValue, match=r"^found side \d+, expected a multiple of 32 from 32 to 4096$"):
        checked_size(size)


@pytest.mark.parametrize("size", ["64 x 64", "64x", "x", "-64", "64x64x64", ""])
def test_what_is_no_size(size: str) -> None:
    with pytest.raises(UnexpectedValue) as refused:
        shape_buckets(size)
    assert str(refused.value) == f"found {size!r}, expected HEIGHTxWIDTH such as 256x256"


def test_an_unexpected_value_in_words() -> None:
    assert str(UnexpectedValue("a", "b")) == "found a, expected b"
    error = UnexpectedValue("a", "b", "do c")
    assert str(error) == "found a, expected b; do c"
    assert unexpected_in({"ctx": {"error": error}}) is error
    assert unexpected_in({"ctx": {"error": ValueError("x")}}) is None
    assert unexpected_in({}) is None


def test_a_cache_keeps_the_newest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache, "MAX_ENTRIES", 2)
    folder = tmp_path / "trilane" / "arrays"
    seen: list[set[str]] = []
    for number in range(4):
        cache.cached_arrays("told 1", [f"source {number}"], lambda: {"a": np.zeros(1)})
        for place, entry in enumerate(sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)):
            os.utime(entry, (1000 + 10 * number + place, 1000 + 10 * number + place))
        seen.append({entry.name for entry in folder.iterdir()})
    assert [len(names) for names in seen] == [1, 2, 2, 2]
    assert seen[0] < seen[1] and not seen[0] & seen[3] and len(seen[1] & seen[2]) == 1
    assert all(name.endswith(".npz") and len(name) == 44 for names in seen for name in names)


def test_names_and_texts_of_a_cache_are_kept_apart() -> None:
    """`ab` and `c` are not `a` and `bc`, nor is a name a source."""
    pairs = [("n", ["ab", "c"]), ("n", ["a", "bc"]), ("n", ["abc"]), ("nab", ["c"]), ("n", [])]
    arrays = [np.zeros(2, np.int32), np.zeros((2, 1), np.int32), np.zeros(2, np.float32), np.ones(2, np.int32)]
    digests = [cache._digest(*pair) for pair in pairs] + [cache._digest("n", [array]) for array in arrays]
    assert len(set(digests)) == len(digests) and {len(digest) for digest in digests} == {40}
    turned = np.arange(6).reshape(2, 3).T
    assert cache._digest("n", [turned]) == cache._digest("n", [turned.copy()])


def test_a_cache_without_a_home_or_a_right_to_write_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache.cache_dir("x") == tmp_path / ".cache" / "trilane" / "x"
    monkeypatch.setattr(os, "access", lambda folder, mode: (folder, mode) == (tmp_path / "x", os.R_OK))
    assert cache.cache_dir("x") is None

    def homeless() -> Path:
        raise RuntimeError("no home")

    monkeypatch.setattr(Path, "home", homeless)
    assert cache.cache_dir("x") is None
