"""The order of a folder's pictures, and what its numbers say of time."""

from __future__ import annotations

import pytest

from trilane.scene.footage import film_of, in_order

FILMS: dict[str, tuple[list[str], list[int], int, str]] = {
    "whole": (["f_1.png", "f_2.png", "f_3.jpg"], [0, 1, 2], 3, ""),
    "one": (["a.png"], [0], 1, ""),
    "two": (["a7.png", "a9.png"], [0, 1], 2, ""),  # in steps of 2
    "a hole": (
        [f"f{k:04}.png" for k in (3, 4, 5, 8, 9)],
        [0, 1, 2, 5, 6],
        7,
        "2 numbers missing (6 to 7): the picture before is held",
    ),
    "holes": (
        [f"f{k}.png" for k in (0, 1, 2, 4, 5, 7, 8, 9, 11, 12, 13, 14, 17, 18)],
        [0, 1, 2, 4, 5, 7, 8, 9, 11, 12, 13, 14, 17, 18],
        19,
        "5 numbers missing (3, 6, 10 and others): the picture before is held",
    ),
    "every tenth": (
        [f"f{k}.png" for k in (10, 20, 40, 50)],
        [0, 1, 3, 4],
        5,
        "1 numbers missing (30): the picture before is held",
    ),
    "photos of a day": (["IMG_2031.jpg", "IMG_2077.jpg", "IMG_2101.jpg", "IMG_2102.jpg"], [0, 1, 2, 3], 4, ""),
    "far apart": (["f1.png", "f2.png", "f3.png", "f900.png"], [0, 1, 2, 3], 4, ""),
    "no numbers": (["a.png", "b.png", "d.png"], [0, 1, 2], 3, ""),
    "two series": (["a1.png", "a2.png", "b1.png", "b4.png"], [0, 1, 2, 3], 4, ""),
    "twice": (["f1.jpg", "f1.png", "f2.png", "f3.png"], [0, 1, 2, 3], 4, ""),
    "off the step": (["f0.png", "f10.png", "f20.png", "f30.png", "f35.png"], [0, 1, 2, 3, 4], 5, ""),
    "a rate in the name": (
        ["run30_1.png", "run30_2.png", "run30_4.png"],
        [0, 1, 3],
        4,
        "1 numbers missing (3): the picture before is held",
    ),
}


@pytest.mark.parametrize("name", FILMS)
def test_what_numbers_say_of_time(name: str) -> None:
    names, frames, count, note = FILMS[name]
    film = film_of(names, 10.0)
    assert film.times_s == pytest.approx([frame / 10 for frame in frames])
    assert film.period_s == pytest.approx(count / 10)
    assert film.rate == (("10/s", note) if note else ("10/s",))
    held = [max(number for number, frame in enumerate(frames) if frame <= t % count) for t in range(3 * count)]
    assert [film.number_at(t / 10) for t in range(3 * count)] == held


@pytest.mark.parametrize(
    ("names", "began"),
    [
        (["1305031102.175304.png", "1305031102.211214.png", "1305031102.275326.png"], 1305031102.175304),
        (["1403636579763555584.png", "1403636579799465584.png", "1403636579863577584.png"], 1403636579.7635556),
    ],
)
def test_names_that_are_times(names: list[str], began: float) -> None:
    """TUM's and EuRoC's: steps of 35.91 and 64.112 ms, of which the usual one is 50.011 in the middle."""
    film = film_of(names, 10.0)
    assert film.times_s == pytest.approx([0, 0.03591, 0.100022], abs=1e-6)
    assert film.began_s == pytest.approx(began, abs=1e-6)
    assert film.period_s == pytest.approx(0.100022 + 0.050011, abs=1e-6)
    assert film.rate == ("20/s by the times that are their names",)
    gap = film_of([*names, names[-1].replace("1102.2", "1102.9").replace("9863", "9999")], 10.0)
    assert gap.rate[1].startswith("1 gaps, the longest ")


def test_numbers_that_are_no_times_of_a_clock() -> None:
    for names in (["0000000001.5.png", "0000000002.5.png"], ["1234567890123456789012.png"] * 2, ["1305031102.1.png"]):
        assert film_of(names, 10.0).began_s is None


def test_numbers_are_compared_as_numbers() -> None:
    assert in_order(["f10.png", "f2.png", "f1.png"]) == ["f1.png", "f2.png", "f10.png"]
    assert in_order(["b.png", "a.jpg", "007.png", "08.png"]) == ["007.png", "08.png", "a.jpg", "b.png"]
    assert in_order(["f01.png", "f1.png", "f²3.png"]) == ["f01.png", "f1.png", "f²3.png"]
