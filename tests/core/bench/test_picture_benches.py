"""`bench filters` and `several`, and what the benches of pictures share: clocks that are told, arrays that are held.

That they draw and paint is tested with the real avatar, in golden/test_avatar_benches.py.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.avatars.bundle import load_bundle
from trilane.bench import filters, several
from trilane.bench.lib import fixture
from trilane.bench.lib.interleaved_processes import INPUTS, SLOTS
from trilane.body.joints import JOINT_INDEX
from trilane.errors import BadInputError, MissingPartError

Held = Callable[[str, Any], None]


def test_variants_take_turns_and_the_warm_up_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """`a` takes 2 s, `b` 3 s, and each its round's number of milliseconds more; to prepare takes 7 s."""
    now, order = [0.0], list[str]()
    monkeypatch.setattr(fixture, "time", SimpleNamespace(perf_counter_ns=lambda: round(now[0] * 1e9)))

    def run(name: str, seconds: float, number: int) -> None:
        order.append(f"{name}{number}")
        now[0] += seconds + number / 1000

    variants = {"a": partial(run, "a", 2.0), "b": partial(run, "b", 3.0)}
    times = fixture.interleaved_ms(variants, 3, partial(run, "p", 7.0))
    assert order == [f"{name}{number}" for number in range(5 + 3) for name in "papb"]
    assert times["a"] == pytest.approx([2005, 2006, 2007])
    assert times["b"] == pytest.approx([3005, 3006, 3007])


def test_a_summary_is_median_minimum_and_ninetieth_percentile() -> None:
    assert fixture.summary_ms([float(n) for n in range(11)]) == {"median_ms": 5.0, "min_ms": 0.0, "p90_ms": 9.0}
    assert fixture.summary_ms([5.0, 1.0, 2.0, 4.0])["median_ms"] == 3.0


def test_the_standing_body_is_held(held: Held) -> None:
    found = fixture.standing(channels=3)
    for name in ("view", "projection", "texture"):
        held(name, getattr(found, name))
    held("joints", found.joints(0))
    places = [posed.joints[JOINT_INDEX["left_wrist"]] for posed in found.poses]
    assert len(places) == INPUTS and (np.diff([place[1] for place in places]) > 0.01).all()
    assert found.joints(INPUTS + 1) is found.joints(1) is not found.joints(0)
    assert {(n % INPUTS, n % SLOTS) for n in range(INPUTS * SLOTS)} == {
        (number, slot) for number in range(INPUTS) for slot in range(SLOTS)
    }
    held("weights", found.arrays.weight)
    clip = found.projection @ found.view
    world = np.array([0.0, fixture.HEIGHT_M + fixture.FRAME_M / 2, 0.0, 1.0])
    place = clip @ world
    assert place[1] / place[3] == pytest.approx(1.0), "the picture is as high as its frame"


@pytest.mark.parametrize(
    ("measure", "asked", "words"),
    [
        (filters.measure, {"sizes": (64, 33, 1)}, "--sizes: found 33, expected a multiple of 32 up to 2048"),
        (filters.measure, {"sizes": (2080,)}, "--sizes: found 2080, expected a multiple of 32 up to 2048"),
        (filters.measure, {"sizes": (0,)}, "--sizes: found 0, expected a multiple of 32 up to 2048"),
        (filters.measure, {"repeats": 0}, "--repeats: found 0, expected at least 1"),
        (several.measure, {"avatars": 0}, "--avatars: found 0, expected 1 to 7"),
        (several.measure, {"avatars": 8}, "--avatars: found 8, expected 1 to 7"),
        (several.measure, {"views": 0}, "--views: found 0, expected 1 to 10000"),
        (several.measure, {"views": 10_001}, "--views: found 10001, expected 1 to 10000"),
        (several.measure, {"margins": (4, 129, -1)}, "--margins: found 129, expected 0 to 128"),
        (several.measure, {"margins": (-1,)}, "--margins: found -1, expected 0 to 128"),
        (several.measure, {"size": "63"}, "--size: .*"),
    ],
)
def test_what_cannot_be_measured_is_refused(measure: Callable[..., Any], asked: dict[str, Any], words: str) -> None:
    with pytest.raises(BadInputError, match=f"^{words}$"):
        measure(**asked)


def test_a_row_for_each_margin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two views of two avatars each. Losses: 30 - 28, 20 - 19.5, 25 - 21 and 22 - 22."""
    figures = {"v1": [(28.0, 30.0, 1.0, 9.0, 100.0), (19.5, 20.0, 2.0, 5.0, 80.0)]}
    figures["v2"] = [(21.0, 25.0, 4.0, 7.0, 90.0), (22.0, 22.0, 0.0, 8.0, 60.0)]
    monkeypatch.setattr(several, "_CrowdFixture", lambda: SimpleNamespace(compare=lambda view: figures[view]))
    monkeypatch.setattr(several, "_views", lambda *_: iter(figures))
    result = several.measure(avatars=2, views=5, size="64", margins=(4, 0))
    row = {
        **{"loss_db_median": 1.25, "loss_db_worst": 4.0, "psnr_db_alone": 23.5},
        **{"bytes_mean": 1.75, "bytes_max": 9, "cell_height": 85.0},
    }
    assert result["rows"] == [{"margin": 4, **row}, {"margin": 0, **row}]
    assert result["config"] == {"avatars": 2, "views": 5, "size": "64", "output": [480, 640]}


def test_a_crowd_that_is_never_in_view_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    shaped = load_bundle("default").shaped_body()
    monkeypatch.setattr(several, "_CrowdFixture", lambda: SimpleNamespace(shaped=shaped))
    with pytest.raises(BadInputError, match=r"^--avatars 7, --views 2: found no moment with all avatars in view"):
        several.measure(avatars=7, views=2)


def test_the_moments_of_a_crowd_are_held(held: Held) -> None:
    fixture: Any = SimpleNamespace(shaped=load_bundle("default").shaped_body())
    seen = [*several._views(fixture, 2, 3, "256", 8)]
    assert len(seen) == 3 and all(len(view.joints) == 2 for view in seen)
    held("joints", [view.joints for view in seen])
    held("cameras", [[view.view, view.projection] for view in seen])
    held("crops", [[(*rect, *cell) for rect, cell in view.layout.crops] for view in seen])
    held("shapes", [view.layout.shape for view in seen])


def test_a_drawable_is_the_bundles_avatar() -> None:
    found, bundle = fixture.load_drawable("default"), load_bundle("default")
    packed = bundle.manifest.network.input
    assert (found.quantisation.scale, found.quantisation.zero_point) == (packed.scale, packed.zero_point)
    assert found.texture.dtype == np.float32 and found.texture.shape == bundle.read_texture().shape
    np.testing.assert_array_equal(found.texture, bundle.read_texture().astype(np.float32))
    assert found.arrays.position.shape[1] == 3
    with pytest.raises(BadInputError):
        fixture.load_drawable("nobody")


def test_ground_truth_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trilane.training.image_error", None)
    with pytest.raises(MissingPartError, match=r"ground truth needs trilane\.training\.image_error; .*train"):
        fixture.ground_truth(load_bundle("default"))
