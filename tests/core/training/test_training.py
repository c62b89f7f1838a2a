"""Training: samples repeat, held-out poses stay unseen, losses and metrics mean what they say."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.avatars.bundle import bundle_folder  # noqa: E402
from trilane.body.joints import JOINT_INDEX  # noqa: E402
from trilane.errors import BadInputError  # noqa: E402
from trilane.scene.motion.builtin import BUILTIN  # noqa: E402
from trilane.training.clothing.layers import Layer  # noqa: E402
from trilane.training.first_texture import (  # noqa: E402
    eigenfunctions,
    fill_gaps,
    lay_out,
)
from trilane.training.image_error import ImageError, SampleError, image_error, summary  # noqa: E402
from trilane.training.network import UNet  # noqa: E402
from trilane.training.objective import loss_terms, total_loss  # noqa: E402
from trilane.training.random_poses import random_pose  # noqa: E402
from trilane.training.random_views import BANDS, ClothedSurface, View, look_at, perspective, random_view, vertex_reach  # noqa: E402
from trilane.training.sample_files import U16, batches, create_group, open_groups  # noqa: E402
from trilane.training.trainable_avatar import (  # noqa: E402
    NeuralTexture,
    TrainableAvatar,
    load_network,
    read_texture,
    save_network,
)

CHANNELS = 4
SHAPE = (32, 64)


@pytest.fixture
def groups(tmp_path):
    rng = np.random.default_rng(0)
    group = create_group(tmp_path / "data", SHAPE, np.zeros(6, np.int8))
    group.uv[:] = rng.integers(0, U16, group.uv.shape)
    group.covered[:, 8:24, 16:48] = 1
    group.rgba[:, 6:26, 14:50] = (200, 100, 50, 255)
    return tmp_path / "data"


def avatar():
    torch.manual_seed(0)
    start = np.random.default_rng(1).uniform(-0.5, 0.5, (64, 64, CHANNELS)).astype(np.float32)
    return TrainableAvatar(NeuralTexture(start, sides=(64, 32)), UNet(width=8, channels=CHANNELS))


def test_poses_repeat_and_differ():
    pose, same, other = (random_pose(np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert np.array_equal(pose, same) and not np.array_equal(pose, other)
    assert pose.shape == (55, 3) and np.isfinite(pose).all()


def test_knees_and_elbows_bend_one_way():
    for seed in range(200):
        pose = random_pose(np.random.default_rng(seed))
        assert pose[JOINT_INDEX["left_knee"], 0] >= 0 and pose[JOINT_INDEX["right_knee"], 0] >= 0
        assert pose[JOINT_INDEX["left_elbow"], 1] <= 0 <= pose[JOINT_INDEX["right_elbow"], 1]


def test_held_out_poses_are_not_trained_on():
    motion = BUILTIN["walk-wave-turn"]()
    held_out = np.array([motion.sample(t)[0] for t in np.linspace(0, motion.duration_s, 40)])
    trained = np.array([random_pose(np.random.default_rng((1, 1, number))) for number in range(400)])
    apart = np.abs(held_out[:, None, 1:22] - trained[None, :, 1:22]).max(axis=(2, 3))
    assert apart.min() > 0.1


def test_views_frame_what_the_band_says():
    joints = np.zeros((55, 3)) + np.random.default_rng(0).normal(size=(55, 3)) * 0.1
    for band, (_, least, most) in BANDS.items():
        view = random_view(np.random.default_rng(5), band, joints)
        distance = np.linalg.norm(np.linalg.inv(view.view)[:3, 3])
        framed = 2 * distance / view.projection[1, 1]
        assert 0.5 * least < framed < 2 * most


def test_batches_show_every_sample_once_an_epoch(groups):
    stream = batches(open_groups(groups), 2, np.random.default_rng(0))
    seen = np.concatenate([next(stream)[1] for _ in range(3)])
    assert sorted(seen) == list(range(6))


def test_texture_starts_as_it_is_told_and_reads_bilinearly():
    start = np.repeat(np.linspace(-0.5, 0.5, 32, dtype=np.float32)[:, None, None], 32, axis=1)
    smooth = NeuralTexture(np.repeat(np.repeat(start, 2, axis=0), 2, axis=1).repeat(3, axis=2), sides=(64, 32))
    assert (
        float((smooth.image().detach()[0, 0] - torch.from_numpy(start[..., 0].repeat(2, 0).repeat(2, 1))).abs().max())
        < 0.02
    )
    uv = torch.tensor([[[[0.5, 0.25], [0.5, 0.75]]]])
    read = read_texture(smooth.image(), uv, torch.tensor([[[True, False]]])).detach()
    assert read.shape == (1, 3, 1, 2)
    assert float(read[0, 0, 0, 0]) == pytest.approx(-0.25, abs=0.03)
    assert (read[0, :, 0, 1] == 0).all()


def test_a_perfect_picture_costs_nothing():
    target, behind = torch.zeros(1, 4, 32, 32), torch.rand(1, 3, 32, 32)
    target[:, :, 8:24, 8:24] = 1.0
    perfect = total_loss(loss_terms(target, target, behind))
    worse = total_loss(loss_terms(target * 0.8, target, behind))
    assert float(perfect) < 0.01 < float(worse)


def test_metrics_of_known_pictures():
    truth = np.zeros((32, 32, 4), np.uint8)
    truth[8:24, 8:24] = (128, 128, 128, 255)
    off = truth.copy()
    off[8:24, 8:24, :3] += 26
    error = image_error(off, truth)
    assert error.psnr_db == pytest.approx(-20 * np.log10(26 / 255), abs=0.01)
    assert error.iou == 1.0
    assert image_error(truth, np.zeros_like(truth)) is None


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


def test_points_reach_over_their_triangles():
    """The middle of an equilateral triangle of side 0.3 is 0.3 / sqrt(3) from its corners; a free vertex reaches 0."""
    vertices = np.array([[0, 0, 0], [0.3, 0, 0], [0.15, 0.3 * np.sqrt(0.75), 0], [9, 9, 9]], np.float64)
    reach = vertex_reach(vertices, np.array([[0, 1, 2]]))
    assert reach == pytest.approx([0.1732, 0.1732, 0.1732, 0.0], abs=1e-4)
    middle = vertices[:3].mean(axis=0)
    assert np.linalg.norm(vertices[:3] - middle, axis=1) == pytest.approx(reach[:3])


def test_a_camera_stands_clear_when_nothing_reaches_into_the_sphere_round_its_near_plane():
    """Half the height is 1 at 45 degrees, so a square screen's near corner is 0.05 * sqrt(3) = 0.0866 m away."""
    view = View(look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3)), perspective(np.pi / 2, 1.0), 1.0)
    assert view.near_reach_m == pytest.approx(0.0866, abs=1e-4)
    eye = np.array([0.0, 0.0, 2.0])
    layer = a_layer(np.array([[0.0, 0, 0], [0.03, 0, 0], [0, 0.03, 0]]))
    surface = ClothedSurface([layer])
    reach = 0.03 * np.sqrt(2) / np.sqrt(3)
    for distance, clear in ((0.0866 + reach + 0.001, True), (0.0866 + reach - 0.001, False)):
        points = eye + np.array([[distance, 0, 0], [5, 0, 0], [0, 5, 0]])
        assert surface.is_clear_of(view, points) == clear


def a_layer(vertices):
    """One triangle that the root joint moves."""
    count = len(vertices)
    weights = np.eye(1, 55).repeat(count, axis=0)
    ones = np.ones(count)
    return Layer("skin", vertices, np.array([[0, 1, 2]]), vertices, weights, vertices, ones, ones)


def test_fields_are_smooth_and_gaps_filled():
    grid = np.array([[x, y, 0.0] for x in range(6) for y in range(6)], np.float64)
    corner = [(6 * x + y, 6 * x + y + 6, 6 * x + y + 1) for x in range(5) for y in range(5)]
    faces = np.array(corner + [(b, b + 1, c) for _, b, c in corner])
    fields = eigenfunctions(grid, faces, 3)
    assert fields.shape == (36, 3) and np.abs(fields).max() == pytest.approx(1.0)
    image, known = lay_out(fields, faces, grid[:, :2] / 10 + 0.1, faces, 32)
    filled = fill_gaps(image, known)
    assert known.any() and not known.all()
    assert np.allclose(filled[known], image[known]) and np.isfinite(filled).all()


def test_the_network_alone_comes_back_in_half_precision(tmp_path):
    made, path = avatar(), tmp_path / "network.npz"
    save_network(made, path)
    again = load_network(avatar().network, path)
    for name, value in made.network.state_dict().items():
        if value.is_floating_point():
            assert torch.allclose(again.state_dict()[name], value, atol=1e-3, rtol=1e-3), name


def test_the_kept_network_of_the_default_avatar_loads():
    load_network(
        UNet(width=16, channels=16, input_skip=True),
        bundle_folder("default").parents[1] / "training" / "default-network.npz",
    )


def test_a_network_of_another_width_is_refused(tmp_path):
    path = tmp_path / "network.npz"
    save_network(avatar(), path)
    with pytest.raises(BadInputError, match="size mismatch"):
        load_network(UNet(width=16, channels=CHANNELS), path)


def kept_weights(path, **changes):
    """A file of the network's weights, changed: None takes one out."""
    arrays = {f"network.{name}": value.numpy() for name, value in avatar().network.state_dict().items()} | changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def test_counters_of_batches_may_be_missing(tmp_path):
    path = kept_weights(tmp_path / "a.npz", **{"network.mask.1.num_batches_tracked": None})
    made = load_network(UNet(width=8, channels=CHANNELS), path).state_dict()
    assert all(torch.equal(made[name], value) for name, value in avatar().network.state_dict().items())


@pytest.mark.parametrize(
    ("changes", "found"),
    [({"network.mask.3.bias": None}, "no mask.3.bias"), ({"network.another": np.zeros(1)}, "also another")],
)
def test_weights_that_are_not_all_there_are_refused(tmp_path, changes, found):
    path = kept_weights(tmp_path / "a.npz", **changes)
    with pytest.raises(BadInputError) as caught:
        load_network(UNet(width=8, channels=CHANNELS), path)
    assert str(caught.value) == f"{path}: found {found}, expected weights that this network's training saved"


def test_a_file_that_is_no_archive_is_refused(tmp_path):
    (tmp_path / "b.npz").write_text("no archive")
    with pytest.raises(BadInputError, match=r"b\.npz: found .*, expected weights that this network's training saved"):
        load_network(UNet(width=8, channels=CHANNELS), tmp_path / "b.npz")
