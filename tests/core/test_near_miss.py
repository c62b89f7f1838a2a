"""What is suggested for a misspelt word."""

from __future__ import annotations

from trilane.errors import did_you_mean


def test_the_nearest_word_is_suggested_and_none_that_is_far() -> None:
    """difflib's ratio is twice the letters in common over the letters of both words; 0.6 and more are near."""
    known = ["single", "double", "triple"]
    assert did_you_mean("tripel", known) == "did you mean 'triple'?"  # 2 * 5 / 12
    assert did_you_mean("doub", known) == "did you mean 'double'?"  # 2 * 4 / 10
    assert did_you_mean("dbl", known) == "did you mean 'double'?"  # 2 * 3 / 9
    assert did_you_mean("lifo", known) == ""  # at most 2 * 1 / 10
    assert did_you_mean("", known) == did_you_mean("single", []) == ""
    assert did_you_mean("f", known) == did_you_mean("", ["f"]) == ""
    assert did_you_mean("fov", ["fov_y_deg", "far_m"]) == "did you mean 'fov_y_deg'?"  # 2 * 3 / 12, but its beginning
    assert did_you_mean("wa", ["wave-and-turn", "walk-and-turn"]) == ""  # the beginning of both
    assert did_you_mean("fra", ["far", "orbit"], "builtin:") == "did you mean 'builtin:far'?"  # 2 * 2 / 6
