"""A camera and its background: order and time of pictures, photos by name, turns, cuts, loops, and what is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.camera_files import WRITERS, load
from trilane.scene.camera.path import CameraPath, Optics
from trilane.scene.footage import Footage, Stored, cut_note, film_of, filmed, in_order
from trilane.scene.lens import Known, Lens, centred
from trilane.scene.motion.motion import Wrap

LENS = centred(640, 480, 500)
OUTPUT = (480, 640)


def camera(count: int, pictures: tuple[str, ...] = (), lenses: tuple[Lens, ...] = (LENS,), **more: Any) -> CameraPath:
    """Poses one second apart, pose K at x = K."""
    quats, places = np.tile([1.0, 0, 0, 0], (count, 1)), np.zeros((count, 3))
    places[:, 0] = np.arange(count)
    optics = Optics(lenses, 0.1, 10.0)
    return CameraPath(np.arange(float(count)), quats, places, optics, (), pictures=pictures, **more)


def folder(*names: str, shape: tuple[int, int] = OUTPUT) -> Footage:
    return Footage(("folder",), ("30/s",), (Stored(shape),) * len(names), names, "/photos", 2.0)


def test_a_built_in_camera_has_its_own_lens_before_any_background() -> None:
    path = replace(camera(3), recorded=False)
    video = Footage(("video",), ("30/s",), (Stored((1920, 1080)),), period_s=2.5)
    assert filmed(path, video, OUTPUT) == (
        path,
        (
            "video",
            "30/s",
            "2.50 s, then starts again",
            "shown at 640x480: 58% of its height cut off, equally at both ends",
        ),
    )


def test_photos_belong_to_their_views_and_missing_ones_are_skipped() -> None:
    """Of views a to e, b and d have no photo: the times of the others stay, from the first one that is there."""
    names = ("./images/b", "images/a.png", "images\\c.jpg", "d.png", "x/e.png")
    path, notes = filmed(camera(5, names), folder("a.png", "c.png", "e.png", "z.png"), OUTPUT)
    assert path.pictures == ("/photos/a.png", "/photos/c.png", "/photos/e.png")
    assert path.times_s.tolist() == [0, 1, 3]
    assert notes == (
        "folder",
        "3 of the camera's 5 views have their photo here, by name; each is held with it",
        "photos of 2 views are missing (b, d.png): these views are skipped",
        "shown at 640x480: all of it",
    )
    for t_s, x in ((0.0, 1), (0.4, 1), (0.6, 2), (1.9, 2), (2.1, 4), (3.0, 4), (3.9, 4), (4.1, 2), (5.9, 1), (6.2, 1)):
        assert path.pose(t_s)[1][0] == x == [1, 2, 4][path.nearest(t_s)], t_s
    assert path.wrap is Wrap.BOUNCE and path.repeat_s == 0


def test_each_photo_keeps_its_lens() -> None:
    lenses = tuple(centred(640, 480, focal) for focal in (100.0, 200.0, 300.0))
    path, _ = filmed(camera(3, ("a", "b", "c"), lenses), folder("a.png", "c.png"), OUTPUT)
    assert [path.lens(t_s, OUTPUT).fx for t_s in (0.0, 0.9, 1.1, 2.0)] == [100, 100, 300, 300]
    one, _ = filmed(camera(3, ("a", "b", "c")), folder("c.png"), OUTPUT)
    assert one.optics.lenses == (LENS,) and one.pose(0.0)[1][0] == 2


def test_photos_of_the_same_name_in_several_folders() -> None:
    """Only those are meant whose folder is called like the background's."""
    names = ("left/1.png", "photos/1.png", "left/2.png", "photos/2.png")
    path, _ = filmed(camera(4, names), folder("1.png", "2.png"), OUTPUT)
    assert path.places[:, 0].tolist() == [1, 3]
    path, notes = filmed(camera(2, ("left/1.png", "right/1.png")), folder("1.png"), OUTPUT)
    assert not path.is_held
    assert "it has none of the 2 photos that the camera's file names, such as 1.png" in notes


def test_pictures_that_the_camera_does_not_name_follow_each_other() -> None:
    path, notes = filmed(camera(3, ("a", "b", "c")), folder("1.png", "2.png"), OUTPUT)
    assert (path.is_held, path.repeat_s) == (False, 2.0)
    assert notes[:4] == (
        "folder",
        "30/s",
        "2.00 s, then starts again",
        "it has none of the 3 photos that the camera's file names, such as a",
    )


def test_pictures_with_times_are_put_to_the_clock_of_the_camera() -> None:
    """The camera began at 1e9 + 10 and moves by 1 m/s; of pictures at 9.5, 10.5, 11.25 and 14 s two are of its 3 s."""
    names = tuple(f"{1_000_000_000 + t:.6f}.png" for t in (9.5, 10.5, 11.25, 14.0))
    clock = tuple(1e9 + t for t in (9.5, 10.5, 11.25, 14.0))
    photos = Footage(("folder",), ("1/s",), (Stored(OUTPUT),) * 4, names, "/photos", 5.0, clock)
    path, notes = filmed(camera(4, began_s=1e9 + 10), photos, OUTPUT)
    assert path.pictures == tuple(f"/photos/{name}" for name in names[1:3])
    assert path.times_s == pytest.approx([0, 0.75])
    assert path.places[:, 0] == pytest.approx([0.5, 1.25])
    assert (path.is_held, path.began_s) == (True, 1e9 + 10.5)
    assert notes[1].startswith(
        "2 of its 4 pictures were taken during the camera's recording, by the clock, the first 0.5"
    )
    other, _ = filmed(camera(4, began_s=1.2e9), photos, OUTPUT)
    unknown, _ = filmed(camera(4), photos, OUTPUT)
    assert (other.is_held, unknown.is_held, unknown.repeat_s) == (False, False, 5.0)
    lenses = tuple(centred(640, 480, focal) for focal in (100.0, 200.0, 300.0, 400.0))
    own, _ = filmed(camera(4, lenses=lenses, began_s=1e9 + 10), photos, OUTPUT)
    assert [own.lens(t_s, OUTPUT).fx for t_s in (0.0, 0.75)] == pytest.approx([150, 225])


def test_when_a_camera_was_recorded(tmp_path: Path) -> None:
    """TUM and EuRoC: seconds and nanoseconds since 1970; the first pose, without a place, is left out. Others: no."""
    turns, places = np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3))
    places[0] = np.nan
    for kind, began in (("tum", 1305031098.5), ("euroc", 1403636580.838555648)):
        path = load(WRITERS[kind](tmp_path, turns, places), up_axis="z")
        assert path.began_s == pytest.approx(began + 1 / 30, abs=1e-6)
    assert load(WRITERS["arkit"](tmp_path, turns, places), format="arkit").began_s is None
    (tmp_path / "since start.txt").write_text("7.5 0 0 0 0 0 0 1\n")
    assert load(tmp_path / "since start.txt").began_s is None


def test_camera_and_video_start_again_together() -> None:
    """The video lasts 1.5 s, the path 2 s: at 1.75 s both are where they were at 0.25 s."""
    path, notes = filmed(camera(3), Footage(("video",), ("30/s",), (Stored(OUTPUT),), period_s=1.5), OUTPUT)
    for t_s, x in ((0.25, 0.25), (1.49, 1.49), (1.5, 0.0), (1.75, 0.25), (4.6, 0.1)):
        assert path.pose(t_s)[1][0] == pytest.approx(x)
    assert notes[-1] == "the camera's recording lasts 2.00 s: they may not belong together"
    _, notes = filmed(camera(3), Footage(("video",), ("30/s",), (Stored(OUTPUT),), period_s=2.03), OUTPUT)
    assert notes == ("video", "30/s", "2.03 s, then starts again", "shown at 640x480: all of it")


def test_a_still_behind_a_moving_camera_is_said() -> None:
    picture = Footage(("picture",), (), (Stored(OUTPUT),), ("a.png",), "/photos")
    assert filmed(camera(3), picture, OUTPUT)[1][-1] == "it does not follow the camera, which moves by up to 2.0 m"
    assert filmed(camera(1), picture, OUTPUT)[1] == ("picture", "stands still", "shown at 640x480: all of it")
    path, _ = filmed(camera(3, ("b", "a", "c")), picture, OUTPUT)
    assert path.pose(0.0)[1][0] == 1 == path.pose(9.9)[1][0]


UPRIGHT = LENS.turned(1)
PHONE = replace(UPRIGHT, known=Known.LONG)


@pytest.mark.parametrize(
    ("stored", "lens", "quarter", "turned", "shown"),
    [
        (Stored((480, 640)), LENS, 0, 0, (480, 640)),
        (Stored((480, 640), 1), UPRIGHT, 1, 1, (640, 480)),  # the phone was held upright, and its video says so
        (Stored((480, 640)), UPRIGHT, 1, 1, (640, 480)),  # the video does not say it, but has the sensor's shape
        (Stored((1440, 1920)), UPRIGHT, 3, 3, (1920, 1440)),
        (Stored((360, 640)), UPRIGHT, 1, 0, (360, 640)),  # it has another shape
        (Stored((480, 640)), PHONE, 1, 0, (480, 640)),  # the lens is a guess
        (Stored((640, 480)), UPRIGHT, 1, 0, (640, 480)),  # it was turned already
        (Stored((480, 640), 2), LENS, 0, 2, (480, 640)),
        (Stored((640, 480)), LENS, 0, 0, (640, 480)),  # nothing fits
        (Stored((480, 640), 3), UPRIGHT, 1, 3, (640, 480)),
    ],
)
def test_a_background_is_turned_as_the_camera_was_held(
    stored: Stored, lens: Lens, quarter: int, turned: int, shown: tuple[int, int]
) -> None:
    video = Footage(("video",), ("30/s",), (stored,), period_s=2.0)
    path, notes = filmed(camera(3, lenses=(lens,), quarter=quarter), video, OUTPUT)
    believed = () if turned == stored.turned else (turned,)  # its file is obeyed, which may mirror it as well
    assert (path.optics.turned, path.optics.filmed) == (believed, (shown,))
    assert ("turned with the camera's picture, and not as the file says" in notes) == (turned != stored.turned)
    across = [note for note in notes if note.endswith("turn it if it is on its side; else they do not fit")]
    assert len(across) == lens.lies_across(shown)
    if across:
        upright = "the camera was held upright and the background lies: "
        assert across[0].startswith(
            upright if lens is not LENS else "the camera was held level and the background stands"
        )


@pytest.mark.parametrize(
    ("stored", "lens", "quarter", "turned"),
    [
        (Stored((480, 640), 1), LENS, 0, 0),  # measured as stored, whatever its tag says
        (Stored((480, 640), 1), LENS.turned(1), 1, 1),  # likewise, and the whole scene was held upright
        (Stored((480, 640), 1), LENS.turned(1), 0, 1),  # measured as its tag says
        (Stored((480, 640), 1), LENS.turned(2), 1, 2),  # likewise, in a scene that was held aside
        (Stored((480, 480), 1), centred(480, 480, 500), 0, 0),
    ],
)
def test_a_photo_is_turned_as_its_lens_was_measured(stored: Stored, lens: Lens, quarter: int, turned: int) -> None:
    photos = Footage(("folder",), ("30/s",), (stored,), ("a.png",), "/photos", 1.0)
    path, _ = filmed(camera(1, ("a",), (lens,), quarter=quarter), photos, OUTPUT)
    assert path.optics.turned == (turned,)


def test_what_is_cut_off() -> None:
    assert cut_note([(1080, 1920)], (480, 640)) == "shown at 640x480: 25% of its width cut off, equally at both ends"
    assert cut_note([(480, 640), (960, 1280)], (480, 640)) == "shown at 640x480: all of it"
    assert cut_note([(480, 640), (64, 640)], (480, 640)) == "shown at 640x480: cut according to their shapes"


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
    assert gap.rate[1].startswith("1 gap, the longest ")


def test_numbers_that_are_no_times_of_a_clock() -> None:
    for names in (["0000000001.5.png", "0000000002.5.png"], ["1234567890123456789012.png"] * 2, ["1305031102.1.png"]):
        assert film_of(names, 10.0).began_s is None


def test_numbers_are_compared_as_numbers() -> None:
    assert in_order(["f10.png", "f2.png", "f1.png"]) == ["f1.png", "f2.png", "f10.png"]
    assert in_order(["b.png", "a.jpg", "007.png", "08.png"]) == ["007.png", "08.png", "a.jpg", "b.png"]
    assert in_order(["f01.png", "f1.png", "f²3.png"]) == ["f01.png", "f1.png", "f²3.png"]
