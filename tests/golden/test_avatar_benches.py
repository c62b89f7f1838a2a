"""The benches that judge the default avatar against ground truth: what they answer, and what they refuse."""

from __future__ import annotations

import pytest

pytest.importorskip("skimage")

from trilane.bench import filters, several
from trilane.errors import BadInputError
from trilane.scene.crop import MARGIN_PX
from trilane.stages.gpu.raster import FILTERS


def test_neighbours_cost_less_than_the_bound() -> None:
    """Three avatars in one tensor, at the pipeline's own margin: none loses half a decibel."""
    found = several.measure(avatars=3, views=1, size="256", margins=(MARGIN_PX,))
    (row,) = found["rows"]
    assert found["config"] == {"avatars": 3, "views": 1, "size": "256", "output": [480, 640]}
    assert (row["margin"], found["margin_px"], found["bound_db"]) == (MARGIN_PX, MARGIN_PX, 0.5)
    assert row["loss_db_worst"] <= found["bound_db"]
    assert row["psnr_db_alone"] > 15
    assert row["cell_height"] > 64


def test_every_filter_is_measured_and_linear_is_what_the_others_are_set_against() -> None:
    rows = filters.measure(sizes=(64,), repeats=1)["rows"]
    assert [row["filter"] for row in rows] == list(FILTERS)
    assert rows[0]["steps_mean"] == 0
    assert all(row["steps_mean"] > 0 and row["psnr_db"] > 10 for row in rows[1:])


@pytest.mark.parametrize(
    ("measure", "asked"),
    [
        (several.measure, {"avatars": 0}),
        (several.measure, {"avatars": 9}),
        (several.measure, {"views": 0}),
        (several.measure, {"size": "63"}),
        (several.measure, {"margins": (-1,)}),
        (filters.measure, {"sizes": (33,)}),
        (filters.measure, {"repeats": 0}),
    ],
)
def test_settings_out_of_range_are_refused(measure, asked) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BadInputError):
        measure(**asked)
