"""Options of benches: a number out of range is refused by its name before anything is measured."""

from __future__ import annotations

import pytest

from trilane.apps.cli.bench import show
from trilane.apps.cli.bench_options import MEANINGS
from trilane.bench.lib.limits import LIMITS, check_limits
from trilane.errors import BadInputError


@pytest.mark.parametrize(
    "asked",
    [{"width": -3}, {"batch": 0}, {"repeats": 0}, {"threads": -1}, {"minutes": float("nan")}, {"sizes": (64, 0)}],
)
def test_a_number_out_of_range_is_refused_by_name(asked: dict[str, object]) -> None:
    def never(**_: object) -> dict[str, object]:
        raise AssertionError("measured")

    with pytest.raises(BadInputError, match=f"--{next(iter(asked))}: found .* expected .* to "):
        show("raster", never, asked, as_json=True)


def test_what_has_no_range_is_left_to_the_bench() -> None:
    check_limits({"network": "x.onnx", "spin": True, "size": ("256x256",), "repeats": 5})
    assert all(low < high for low, high in LIMITS.values())
    assert set(LIMITS) <= {name.split(" ")[-1] for name in MEANINGS}
