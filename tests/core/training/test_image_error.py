"""The truth is changed by a known amount, and each figure of a picture's error moves as its formula says.

The person is a square of one colour that fills its box, so that every figure has a closed form.
"""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("skimage")

from trilane.arrays import U8
from trilane.training.image_error import (
    EDGE_PX,
    KINDS,
    SIDE,
    ImageError,
    SampleError,
    backgrounds,
    image_error,
    regions,
    scenes,
    summary,
)

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


# By hand, and their summary.


def test_psnr_in_the_box_and_of_the_body_alone_worked_out_by_hand():
    """A box of 2 x 4 pixels, three of which are background; one body pixel is wrong by 51 of 255 in every channel.

    In the box the mean square is 0.2**2 / 8 = 0.005, which is 23.01 dB; of the body's five pixels it is 0.2**2 / 5 =
    0.008, which is 20.97 dB.
    """
    truth = np.zeros((5, 6, 4), np.uint8)
    truth[1:3, 1:5] = (100, 100, 100, 255)
    truth[1, 2:5, 3] = 0
    picture = truth.copy()
    picture[2, 3, :3] = 151
    error = image_error(picture, truth)
    assert error.psnr_db == pytest.approx(23.0103, abs=1e-4)
    assert error.body_psnr_db == pytest.approx(20.9691, abs=1e-4)
    assert (error.background, error.iou) == (0.375, 1.0)


def test_what_is_painted_beside_the_body_counts_in_the_box_alone():
    """One background pixel of eight is painted white, alpha too: before black a square of 1 / 8, before white none."""
    truth = np.zeros((5, 6, 4), np.uint8)
    truth[1:3, 1:5] = (100, 100, 100, 255)
    truth[1, 2:4, 3] = 0
    picture = truth.copy()
    picture[1, 2] = 255
    error = image_error(picture, truth)
    assert error.by_background["black"] == pytest.approx(-10 * np.log10(1 / 8), abs=1e-6)
    assert error.by_background["white"] == 100.0
    assert error.psnr_db == pytest.approx(np.mean(list(error.by_background.values())), abs=1e-9)
    assert error.body_psnr_db == 100.0, "the body itself is exact"
    assert error.iou == pytest.approx(6 / 7)


def an_error(psnr_db, body_psnr_db, iou=1.0):
    before, shares = {"black": psnr_db - 2, "white": psnr_db + 2}, {"alpha_edge": 0.25, "alpha_outside": 0.125}
    return ImageError(
        psnr_db, body_psnr_db, before, 0.5, ssim=0.75, iou=iou, alpha_inside=iou / 8, **shares, see_through=iou / 4
    )


def test_a_summary_has_means_and_the_worst_sample_of_all_seeds():
    errors = [
        SampleError(1, 0, "far", an_error(30.0, 28.0)),
        SampleError(1, 24, "face", an_error(20.0, 19.0, iou=0.5)),
        SampleError(9, 0, "far", an_error(34.0, 30.0)),
        SampleError(9, 25, "face", an_error(22.0, 15.0)),
    ]
    facts = summary(errors)
    assert list(facts) == [
        *("psnr_db_by_band", "body_psnr_db_by_band", "see_through_by_band", "iou_by_band", "psnr_db_by_background"),
        *("psnr_db", "body_psnr_db", "see_through", "alpha_inside", "alpha_edge", "alpha_outside"),
        *("background", "iou", "ssim"),
        *("least_psnr_db", "least_body_psnr_db", "worst", "by_seed", "samples"),
    ]
    assert facts["psnr_db_by_band"] == {"far": 32.0, "face": 21.0}
    assert facts["body_psnr_db_by_band"] == {"far": 29.0, "face": 17.0}
    assert facts["iou_by_band"] == {"far": 1.0, "face": 0.75}
    assert facts["see_through_by_band"] == {"far": 0.25, "face": 0.1875}
    assert facts["psnr_db_by_background"] == {"black": 24.5, "white": 28.5}
    assert (facts["see_through"], facts["alpha_inside"]) == (0.2188, 0.1094)
    assert (facts["alpha_edge"], facts["alpha_outside"]) == (0.25, 0.125)
    assert (facts["psnr_db"], facts["body_psnr_db"], facts["samples"]) == (26.5, 23.0, 4)
    assert (facts["background"], facts["ssim"], facts["iou"]) == (0.5, 0.75, 0.875)
    assert (facts["least_psnr_db"], facts["least_body_psnr_db"]) == (20.0, 15.0)
    assert facts["worst"] == {"seed": 1, "number": 24, "band": "face", "psnr_db": 20.0, "body_psnr_db": 19.0}
    assert facts["by_seed"] == {
        "1": {"psnr_db": 25.0, "body_psnr_db": 23.5, "least_psnr_db": 20.0},
        "9": {"psnr_db": 28.0, "body_psnr_db": 22.5, "least_psnr_db": 22.0},
    }
