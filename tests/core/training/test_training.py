"""Training's parts against a second implementation in NumPy, values by hand, and what is held."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.scene.motion.builtin import BUILTIN  # noqa: E402
from trilane.training import objective, step_loop  # noqa: E402
from trilane.training.clothing import Layer  # noqa: E402
from trilane.training.dataset import ShapeGroup, batches  # noqa: E402
from trilane.training.network import (  # noqa: E402
    ENCODERS,
    NORMS,
    UNet,
    add_activation_noise,
    export_onnx,
)
from trilane.training.random_views import (  # noqa: E402
    ClothedSurface,
    View,
    look_at,
    perspective,
    random_pose,
    vertex_reach,
)
from trilane.training.trainable_avatar import (  # noqa: E402
    NeuralTexture,
    TrainableAvatar,
    read_texture,
)


def avatar() -> TrainableAvatar:
    torch.manual_seed(0)
    start = np.random.default_rng(1).uniform(-0.5, 0.5, (64, 64, 4)).astype(np.float32)
    return TrainableAvatar(UNet(width=8, channels=4), NeuralTexture(start, sides=(64, 32)))


@pytest.fixture
def pictures():
    """Two outputs and targets (2, 4, 24, 20); the persons are rectangles, one of which touches the edge."""
    random = np.random.default_rng(2)
    output, target = random.uniform(0.02, 0.98, (2, 2, 4, 24, 20))
    target[:, 3] = 0
    target[0, 3, 8:15, 6:13] = 1
    target[1, 3, 0:4, 0:3] = 1
    return output, target


BEHIND = np.random.default_rng(6).uniform(0, 1, (2, 3, 24, 20))


def terms_by_loops(output, target):
    """`loss_terms` again, pixel by pixel."""
    n, _, h, w = output.shape
    near = np.zeros((n, h, w))
    for k, y, x in np.ndindex(n, h, w):
        near[k, y, x] = target[k, 3, max(0, y - 5) : y + 6, max(0, x - 5) : x + 6].any()
    over = [image[:, :3] * image[:, 3:] + BEHIND * (1 - image[:, 3:]) for image in (output, target)]
    off = over[0] - over[1]
    pixels = 3 * near.sum() + 1
    decibels = [10 * math.log10(1 + (off[k] ** 2 * near[k]).sum() / (3 * near[k].sum() + 1) / 1e-5) for k in range(n)]
    coarse = sum(
        abs(off[k, c, y : y + 4, x : x + 4].mean()) * 16
        for k in range(n)
        for c in range(3)
        for y in range(0, h, 4)
        for x in range(0, w, 4)
    )
    mask, true = output[:, 3], target[:, 3]
    return {
        "composite": (np.abs(off) * (near[:, None] + 0.05)).sum() / pixels,
        "decibels": np.mean(decibels),
        "colour": (np.abs(output[:, :3] - target[:, :3]) * true[:, None]).sum() / pixels,
        "edges": (np.abs(np.diff(off, axis=3)).sum() + np.abs(np.diff(off, axis=2)).sum()) / pixels,
        "coarse": coarse / pixels,
        "mask": -(true * np.log(mask) + (1 - true) * np.log(1 - mask)).mean(),
        "background": -(np.log(1 - output[:, :3]) * (true == 0)[:, None]).mean(),
        "overlap": 1 - (2 * (mask * true).sum() + 1) / (mask.sum() + true.sum() + 1),
    }


def test_losses_are_their_formulas(pictures):
    output, target = pictures
    terms = objective.loss_terms(*map(torch.from_numpy, (output, target, BEHIND)))
    wanted = terms_by_loops(output, target)
    assert set(terms) == set(wanted) == set(objective.WEIGHTS)
    for name, value in wanted.items():
        assert float(terms[name]) == pytest.approx(value, rel=1e-6), name
    weights = {"composite": 0.4, "decibels": 0.03, "colour": 0.1, "edges": 0.2, "coarse": 0.2, "mask": 0.1}
    weights |= {"overlap": 0.1, "background": 0.05}
    total = sum(weights[name] * value for name, value in wanted.items())
    assert float(objective.total_loss(terms)) == pytest.approx(total, rel=1e-6)


@pytest.mark.parametrize(
    ("share", "rate"),
    [
        (0.0, 0.02),
        (0.01, 0.5),
        (0.02, 1.0),
        (0.51, 0.01 + 0.99 * 0.5),
        (1.0, 0.01),
    ],
)
def test_the_learning_rate_rises_and_falls_as_a_cosine(share, rate):
    assert step_loop.rate_share(share) == pytest.approx(rate)


def test_activation_noise_is_as_large_as_stated_and_only_where_a_relu_is_open():
    """Largest output 2, three steps: up to 3 * 2 / 255 either way; nothing in evaluation."""
    relu = torch.nn.Sequential(torch.nn.ReLU())
    add_activation_noise(relu, 3.0)
    values = torch.linspace(-1, 2, 3001)
    torch.manual_seed(0)
    noise = (relu.train()(values) - values.clamp(min=0)).numpy()
    largest = 3.0 * 2.0 / 255
    assert (noise[values.numpy() <= 0] == 0).all()
    assert 0.98 * largest < np.abs(noise).max() <= largest + 1e-6
    assert abs(noise.mean()) < 0.05 * largest
    assert torch.equal(relu.eval()(values), values.clamp(min=0))


@pytest.mark.parametrize("encoder", ENCODERS)
@pytest.mark.parametrize("norm", NORMS)
def test_networks_compute_what_they_did(held, encoder, norm):
    """In float64: a norm over few pixels amplifies float32's rounding, which differs between processors."""
    torch.manual_seed(0)
    network = UNet(encoder, norm, width=16, channels=4, input_skip=norm == "batch").double().eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.sin(torch.arange(parameter.numel()) * 1.3).reshape(parameter.shape) * 0.3)
        picture = network(torch.cos(torch.arange(4 * 64 * 32).double() * 0.9).reshape(1, 4, 64, 32))
        held("features", [feature.abs().mean() for feature in network.encoder(torch.ones(1, 4, 64, 32).double())])
    held("parameters", [p.numel() for p in network.parameters()])
    assert picture.shape == (1, 4, 64, 32)
    held("picture", picture)


def test_a_group_norm_is_pytorchs():
    torch.manual_seed(0)
    ours = NORMS["group"](8)
    peer = torch.nn.GroupNorm(ours.num_groups, 8)
    with torch.no_grad():
        for parameter in (ours.weight, ours.bias):
            parameter.uniform_(-1, 1)
    peer.load_state_dict(ours.state_dict())
    x = torch.randn(2, 8, 6, 5)
    assert torch.allclose(ours(x), peer(x), atol=1e-5)


def test_an_export_names_its_ends_and_has_one_head():
    model = export_onnx(UNet(width=8, channels=5), 64, 96)
    shape = [[d.dim_value for d in end.type.tensor_type.shape.dim] for end in (*model.graph.input, *model.graph.output)]
    assert [end.name for end in (*model.graph.input, *model.graph.output)] == ["tensor", "rgba"]
    assert shape == [[1, 5, 64, 96], [1, 4, 64, 96]]
    assert model.opset_import[0].version == 17
    last = [node.op_type for node in model.graph.node][-4:]
    assert last == ["Conv", "Relu", "Conv", "Sigmoid"]


def test_a_texture_is_a_pyramid_of_differences():
    """Sides 4 and 2: the coarse scale is the mean of each four texels, the fine one what is missing."""
    start = np.random.default_rng(0).uniform(-0.9, 0.9, (4, 4, 1)).astype(np.float32)
    texture = NeuralTexture(start, sides=(2, 4))
    fine, coarse = (scale.detach().numpy()[0, 0] for scale in texture.scales)
    np.testing.assert_allclose(coarse, start[..., 0].reshape(2, 2, 2, 2).mean(axis=(1, 3)), atol=1e-6)
    np.testing.assert_allclose(texture.image().detach()[0, 0], start[..., 0], atol=1e-6)
    assert fine.shape == (4, 4)
    with torch.no_grad():
        texture.scales[1] += 2.0
        assert float(texture.image().max()) == 1.0
        texture.scales[1] -= 4.0
        assert float(texture.image().min()) == -1.0


def test_a_texture_is_read_between_texel_centres():
    """Texels 0, 1 / 2, 3 of a 2 x 2 texture: their centres are at 0.25 and 0.75."""
    image = torch.tensor([[[[0.0, 1.0], [2.0, 3.0]]]])
    uv = torch.tensor([[[[0.25, 0.25], [0.75, 0.25]], [[0.5, 0.5], [0.0, 1.0]]]])
    covered = torch.tensor([[[True, True], [True, True]]])
    assert read_texture(image, uv, covered)[0, 0].tolist() == [[0.0, 1.0], [1.5, 2.0]]
    covered[0, 0, 1] = False
    assert read_texture(image, uv, covered)[0, 0].tolist() == [[0.0, 0.0], [1.5, 2.0]]


def test_the_networks_input_is_rounded_and_its_gradient_is_not():
    made = avatar().eval()
    seen = []
    made.network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    uv = torch.rand(1, 32, 32, 2)
    made(uv, torch.ones(1, 32, 32, dtype=torch.bool)).sum().backward()
    steps = seen[0].detach() * 127
    assert torch.allclose(steps, steps.round(), atol=1e-4) and steps.abs().max() > 10
    assert float(made.textures[0].scales[0].grad.abs().max()) > 0


def test_repeats_show_samples_of_a_band_more_often():
    group = ShapeGroup((1, 1), *(np.zeros((3, 1, 1, k)) for k in (2, 1, 4)), band=np.array([0, 1, 1], np.int8))
    stream = batches([group], 2, np.random.default_rng(0), (1, 2, 1, 1, 1))
    shown = [next(stream) for _ in range(2)]
    assert sorted(np.concatenate([index for _, index in shown])) == [0, 1, 1, 2, 2]
    assert all((np.diff(index) >= 0).all() for _, index in shown)


def test_repeats_of_a_look_multiply_the_repeats_of_a_band():
    """Person 0 once, person 1 three times; the sample of the second band twice: 3 x 2 = 6 times."""
    arrays = [np.zeros((2, 1, 1, k)) for k in (2, 1, 4)]
    band = np.array([0, 1], np.int8)
    groups = [ShapeGroup((1, 1), *arrays, band=band, person=person) for person in (0, 1)]
    stream = batches(groups, 1, np.random.default_rng(0), (1, 2, 1, 1, 1), person_repeats=(1, 3))
    shown = Counter((group.person, int(index[0])) for group, index in (next(stream) for _ in range(12)))
    assert shown == {(0, 0): 1, (0, 1): 2, (1, 0): 3, (1, 1): 6}


def test_each_picture_of_a_batch_stands_before_a_background_of_its_own():
    """The seed of PyTorch alone decides them, so that a training that goes on draws what it would have drawn."""
    target = torch.zeros(32, 4, 8, 8)
    torch.manual_seed(2)
    first, second = objective.drawn_behind(target), objective.drawn_behind(target)
    torch.manual_seed(2)
    assert torch.equal(objective.drawn_behind(target), first) and not torch.equal(first, second)
    assert first.shape == (32, 3, 8, 8)
    drawn = {each.numpy().tobytes() for each in first}
    plain = [each for each in first if float(each.min()) == float(each.max())]
    assert len(drawn) == 32 - max(0, len(plain) - 2), "black and white are each one picture, all others differ"


def test_training_sees_a_person_as_grey_as_the_one_background_that_was():
    """Alpha of 0.7 before black and white: 0.15 in each colour of a person who fills the picture, 33.5 dB from none."""
    target = torch.cat((torch.full((2, 3, 16, 16), 0.5), torch.ones(2, 1, 16, 16)), dim=1)
    ghost = target.clone()
    ghost[:, 3] = 0.7
    behind = torch.stack((torch.zeros(3, 16, 16), torch.ones(3, 16, 16)))
    pixels = 2 * 3 * 16 * 16
    terms = objective.loss_terms(ghost, target, behind)
    assert float(terms["composite"]) == pytest.approx(0.15 * 1.05 * pixels / (pixels + 1), rel=1e-5)
    assert float(terms["decibels"]) == pytest.approx(10 * math.log10(1 + 0.15**2 / 1e-5 * 768 / 769), rel=1e-5)
    hidden = objective.loss_terms(ghost, target, torch.full((2, 3, 16, 16), 0.5))
    assert float(hidden["composite"]) == float(hidden["decibels"]) == 0


def test_held_out_poses_are_not_trained_on():
    motion = BUILTIN["walk-wave-turn"]()
    held_out = np.array([motion.sample(t)[0] for t in np.linspace(0, motion.duration_s, 40)])
    trained = np.array([random_pose(np.random.default_rng((1, 1, number))) for number in range(400)])
    apart = np.abs(held_out[:, None, 1:22] - trained[None, :, 1:22]).max(axis=(2, 3))
    assert apart.min() > 0.1


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
