"""The truth is changed by a known amount, and each figure of a picture's error moves as its formula says.

The person is a square of one colour that fills its box, so that every figure has a closed form.
"""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("skimage")

from trilane.arrays import U8
from trilane.training.backgrounds import KINDS, SIDE, background, backgrounds, scenes
from trilane.training.image_error import EDGE_PX, ImageError, image_error, regions

SIZE, START, SIDE_PX = 96, 16, 64
#: The person's colour, in bytes and as a share.
BYTE = 204
COLOUR = BYTE / 255
BODY = np.s_[START : START + SIDE_PX, START : START + SIDE_PX]


def person(red: int = BYTE) -> U8:
    truth = np.zeros((SIZE, SIZE, 4), np.uint8)
    truth[BODY] = (red, BYTE, BYTE, 255)
    return truth


def error(picture: U8, truth: U8) -> ImageError:
    found = image_error(picture, truth)
    assert found is not None
    return found


def db(difference: float, share: float = 1.0) -> float:
    """PSNR of pictures that differ by `difference` on a `share` of the pixels."""
    return float(-10 * np.log10(difference**2 * share))


def alpha_times(factor: float) -> U8:
    picture = person()
    picture[..., 3] = np.round(picture[..., 3] * factor)
    return picture


@pytest.mark.parametrize("kept", [0.95, 0.85, 0.7, 0.4])
def test_a_transparent_person_is_off_by_what_it_lets_through(kept: float) -> None:
    """Before a background that differs by d the error is (1 - alpha) d; alpha is a whole number of 255ths."""
    found = error(alpha_times(kept), person())
    through = 1 - round(255 * kept) / 255
    assert found.by_background["black"] == pytest.approx(db(through * COLOUR))
    assert found.by_background["white"] == pytest.approx(db(through * (1 - COLOUR)))
    # uniform noise: the mean of (c - b)^2 is (c - 1/2)^2 + 1/12; of 12288 numbers within 3 %, which is 0.13 dB
    spread = np.sqrt((COLOUR - 0.5) ** 2 + 1 / 12)
    assert found.by_background["noise"] == pytest.approx(db(through * spread), abs=0.13)
    assert found.psnr_db == pytest.approx(np.mean(list(found.by_background.values())))
    assert found.alpha_inside == pytest.approx(through)
    assert found.see_through == (1.0 if kept < 0.9 else 0.0)
    assert found.alpha_outside == 0.0


def test_alpha_of_seven_tenths_is_not_passed_where_one_grey_would_pass_it() -> None:
    """A person as grey as the one background has no error before it: IoU and that PSNR are those of a perfect one."""
    truth = person()
    truth[BODY][..., :3] = 128
    ghost = truth.copy()
    ghost[..., 3] = np.round(ghost[..., 3] * 0.7)
    grey = 128 / 255
    over = [
        image[..., :3] / 255 * (image[..., 3:] / 255) + grey * (1 - image[..., 3:] / 255) for image in (ghost, truth)
    ]
    assert np.abs(over[0] - over[1]).max() < 1e-9
    found = error(ghost, truth)
    assert found.iou == 1.0
    assert found.by_background["black"] < 17 and found.by_background["white"] < 17  # 0.3 of a half is 0.15: 16.5 dB
    assert found.psnr_db < 20 and found.see_through == 1.0


@pytest.mark.parametrize("by", [1, 2])
def test_a_shift_shows_in_the_box_and_at_the_edge(by: int) -> None:
    """`by` columns of the box lose the person; as many beside it gain one, all of them within the edge."""
    found = error(np.roll(person(), by, axis=1), person())
    assert found.by_background["black"] == pytest.approx(db(COLOUR, by / SIDE_PX))
    assert found.by_background["white"] == pytest.approx(db(1 - COLOUR, by / SIDE_PX))
    assert found.iou == pytest.approx((SIDE_PX - by) / (SIDE_PX + by))
    edge = (SIDE_PX + 2 * EDGE_PX) ** 2 - (SIDE_PX - 2 * EDGE_PX) ** 2
    assert found.alpha_edge == pytest.approx(2 * by * SIDE_PX / edge)
    assert (found.alpha_inside, found.alpha_outside, found.see_through) == (0.0, 0.0, 0.0)


def test_a_tint_shows_before_every_background_alike_and_not_in_alpha() -> None:
    """Red is off by 30 of 255: a third of the squares."""
    found = error(person(BYTE - 30), person())
    assert set(found.by_background) == set(KINDS)
    for value in (*found.by_background.values(), found.psnr_db, found.body_psnr_db):
        assert value == pytest.approx(db(30 / 255, 1 / 3))
    assert (found.alpha_inside, found.alpha_edge, found.alpha_outside, found.see_through) == (0.0, 0.0, 0.0, 0.0)


def test_a_haze_round_the_person_counts_outside() -> None:
    picture = person()
    far = np.s_[:4, :]
    picture[far] = (0, 0, 0, 51)
    _, _, outside = regions(person()[..., 3])
    found = error(picture, person())
    assert found.alpha_outside == pytest.approx(0.2 * 4 * SIZE / outside.sum())
    assert (found.alpha_inside, found.alpha_edge, found.iou) == (0.0, 0.0, 1.0)


def test_the_regions_of_a_square_at_the_border() -> None:
    """Two pixels on both sides of each change of alpha are the edge; where the picture ends nothing changes."""
    alpha = np.zeros((12, 14), np.uint8)
    alpha[:6, :7] = 255
    alpha[5, :7] = 128  # half covered: within the edge, as its neighbours are
    inside, edge, outside = regions(alpha)
    wanted = np.zeros((12, 14), np.uint8)  # 1 edge, 2 inside
    wanted[:8, :9] = 1
    wanted[:3, :5] = 2
    assert (inside == (wanted == 2)).all() and (edge == (wanted == 1)).all() and (outside == (wanted == 0)).all()


def test_backgrounds_are_those_of_the_truth_alone() -> None:
    """All painters stand before the same ones, and another truth has others."""
    one, again, other = error(alpha_times(0.7), person()), error(alpha_times(0.7), person()), person()
    other[0, 0, 0] = 1
    assert one == again
    assert error(alpha_times(0.7), other).by_background["noise"] != one.by_background["noise"]


# --- the backgrounds ----------------------------------------------------------------------------------------------


def test_each_sample_has_a_background_of_its_own() -> None:
    """Of 200 draws each of four kinds has 50 in the mean, with a deviation of 6.1."""
    drawn = backgrounds(200, (8, 12), np.random.default_rng(3))
    assert drawn.shape == (200, 8, 12, 3) and drawn.dtype == np.float32
    assert drawn.min() >= 0 and drawn.max() <= 1
    plain = drawn.reshape(200, -1)
    black, white = ((plain == level).all(axis=1).sum() for level in (0, 1))
    assert all(abs(count - 50) < 4 * 6.1 for count in (black, white))
    others = [each for each in plain if each.min() < each.max()]
    assert len({each.tobytes() for each in others}) == len(others) > 200 - black - white - 12
    assert (backgrounds(200, (8, 12), np.random.default_rng(3)) == drawn).all()


def test_scenery_has_the_spectrum_of_photographs() -> None:
    """Amplitudes of natural pictures fall about as 1 / f: the exponent is 0.7 to 1.5 (Field 1987; Tolhurst 1992)."""
    slopes = []
    for scene in scenes():
        grey = scene.mean(axis=2) - scene.mean()
        amplitude = np.abs(np.fft.fft2(grey))
        frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(SIDE), np.fft.fftfreq(SIDE)))
        rings = [(frequency >= low) & (frequency < 2 * low) for low in 2.0 ** np.arange(-7, -2)]
        means = [amplitude[ring].mean() for ring in rings]
        slopes.append(np.polyfit(np.arange(len(means)), np.log2(means), 1)[0])
    assert 0.7 < -np.mean(slopes) < 1.5, slopes
    assert len({scene.tobytes() for scene in scenes()}) == len(scenes())


def test_scenery_larger_than_a_scene_goes_on() -> None:
    drawn = background("scenery", (SIDE + 40, SIDE + 8), np.random.default_rng(1))
    assert drawn.shape == (SIDE + 40, SIDE + 8, 3)
    assert (drawn[SIDE:] == drawn[:40]).all() and (drawn[:, SIDE:] == drawn[:, :8]).all()
