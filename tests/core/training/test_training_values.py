"""Training's parts against a second implementation in NumPy, values by hand, and what they gave before."""

from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.training import objective, step_loop  # noqa: E402
from trilane.training.first_texture import (  # noqa: E402
    eigenfunctions,
    fill_gaps,
    first_texture,
    head_on,
    lay_out,
    mean_colours,
    used_texels,
)
from trilane.training.network import (  # noqa: E402
    ENCODERS,
    NORMS,
    UNet,
    add_activation_noise,
    export_onnx,
)
from trilane.training.sample_files import U16, ShapeGroup, batches  # noqa: E402
from trilane.training.step_loop import optimiser_of  # noqa: E402
from trilane.training.surface import BodyArrays  # noqa: E402
from trilane.training.trainable_avatar import (  # noqa: E402
    NeuralTexture,
    TrainableAvatar,
    read_texture,
)
from trilane.training.training_settings import parsed_settings  # noqa: E402


def avatar() -> TrainableAvatar:
    torch.manual_seed(0)
    start = np.random.default_rng(1).uniform(-0.5, 0.5, (64, 64, 4)).astype(np.float32)
    return TrainableAvatar(NeuralTexture(start, sides=(64, 32)), UNet(width=8, channels=4))


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


def test_masks_at_their_ends_cost_a_finite_amount():
    """A mask of 1 where none is wanted is taken as 1 - 1e-4, a colour of 1 likewise."""
    output, target = torch.ones(1, 4, 8, 8), torch.zeros(1, 4, 8, 8)
    terms = objective.loss_terms(output, target, torch.zeros(1, 3, 8, 8))
    assert float(terms["mask"]) == pytest.approx(-math.log(1e-4), rel=1e-3)
    assert float(terms["background"]) == pytest.approx(-math.log(1e-4), rel=1e-3)


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


def test_kernels_decay_and_the_texture_has_a_rate_of_its_own():
    made = avatar()
    config = parsed_settings({"network_rate": 0.25, "texture_rate": 0.5, "weight_decay": 0.75}, "a test")
    kernels, others, texture = optimiser_of(made, config).param_groups
    rates = [(group["lr"], group["weight_decay"]) for group in (kernels, others, texture)]
    assert rates == [(0.25, 0.75), (0.25, 0), (0.5, 0.75)]
    assert {p.ndim for p in kernels["params"]} == {4}
    assert {p.ndim for p in others["params"]} == {1}
    assert [tuple(p.shape) for p in texture["params"]] == [(1, 4, 64, 64), (1, 4, 32, 32)]
    assert sum(len(group["params"]) for group in (kernels, others, texture)) == len(list(made.parameters()))


def test_the_average_keeps_its_share():
    average, now = avatar(), avatar()
    name = "network.mask.3.bias"
    old = average.state_dict()[name].clone()
    with torch.no_grad():
        now.state_dict()[name] += 8.0
    step_loop.follow(average, now, keep=0.75)
    assert torch.allclose(average.state_dict()[name], old + 2.0)


@pytest.mark.parametrize("frozen", [False, True])
def test_frozen_norms_keep_their_statistics(frozen):
    made = avatar().eval()
    step_loop.set_mode(made, frozen)
    norms = [module for module in made.modules() if isinstance(module, torch.nn.BatchNorm2d)]
    assert norms and made.network.colour[0].training
    assert all(norm.training is not frozen for norm in norms)


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
    torch.manual_seed(0)
    network = UNet(encoder, norm, width=16, channels=4, input_skip=norm == "batch").eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.sin(torch.arange(parameter.numel()) * 1.3).reshape(parameter.shape) * 0.3)
        picture = network(torch.cos(torch.arange(4 * 64 * 32) * 0.9).reshape(1, 4, 64, 32))
        held("features", [feature.abs().mean() for feature in network.encoder(torch.ones(1, 4, 64, 32))])
    held("parameters", [p.numel() for p in network.parameters()])
    assert picture.shape == (1, 4, 64, 32)
    held("picture", picture.round(decimals=4))


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
    assert float(made.texture.scales[0].grad.abs().max()) > 0


def test_repeats_show_samples_of_a_band_more_often():
    group = ShapeGroup((1, 1), *(np.zeros((3, 1, 1, k)) for k in (2, 1, 4)), band=np.array([0, 1, 1], np.int8))
    stream = batches([group], 2, np.random.default_rng(0), (1, 2, 1, 1, 1))
    shown = [next(stream) for _ in range(2)]
    assert sorted(np.concatenate([index for _, index in shown])) == [0, 1, 1, 2, 2]
    assert all((np.diff(index) >= 0).all() for _, index in shown)


def test_pixels_are_weighted_by_how_the_surface_is_seen():
    """u = 0.01 x, v = t 0.01 y: singular values 0.01 and 0.01 t. At t = 1/2 the weight is (1/2)^3, and (1 / (s side))^2
    of that above a texel a pixel; nothing at the outline, and nothing where a pixel spans more than 0.03.
    """
    y, x = np.mgrid[:6, :7].astype(float)
    covered = np.ones((6, 7), bool)
    covered[3, 5] = False

    def weight(step, t, side):
        return head_on(np.stack([step * x, t * step * y], axis=2), covered, side)

    inner = weight(0.01, 0.5, 50)
    assert inner[2, 2] == pytest.approx(0.5**3)
    assert weight(0.01, 0.5, 400)[2, 2] == pytest.approx(0.5**3 / 16)
    assert (inner > 0).sum() == 4 * 5 - 4, "the frame has none, nor the gap in its last column and three beside it"
    assert not weight(0.04, 1.0, 50).any()
    assert weight(0.029, 1.0, 10)[2, 2] == pytest.approx(1.0)


def test_a_texels_colour_is_the_weighted_mean_of_its_pixels():
    """One sample whose left half is red, right half green; u and v run over the texture once."""
    h = w = 200
    y, x = np.mgrid[:h, :w]
    uv = np.stack([(x + 0.5) / w, (y + 0.5) / h], axis=2)
    rgba = np.zeros((1, h, w, 4), np.uint8)
    rgba[0, :, : w // 2, 0] = 200
    rgba[0, :, w // 2 :, 1] = 100
    rgba[..., 3] = 255
    group = ShapeGroup(
        (h, w), np.round(uv * U16).astype(np.uint16)[None], np.ones((1, h, w), np.uint8), rgba, np.zeros(1)
    )
    colours = mean_colours([group], 8, sheet())
    np.testing.assert_allclose(colours[:, :4], np.broadcast_to([200 / 255, 0, 0], (8, 4, 3)), atol=1e-6)
    np.testing.assert_allclose(colours[:, 4:], np.broadcast_to([0, 100 / 255, 0], (8, 4, 3)), atol=1e-6)
    small = ShapeGroup((64, 64), group.uv[:, :64, :64], group.covered[:, :64, :64], rgba[:, :64, :64], np.zeros(1))
    assert not mean_colours([small], 8, sheet()).any()


def sheet() -> BodyArrays:
    """A flat sheet of 6 x 6 vertices, whose texture coordinates cover 0.1 to 0.6."""
    grid = np.array([[x, y, 0.0] for x in range(6) for y in range(6)], np.float64)
    corner = [(6 * x + y, 6 * x + y + 6, 6 * x + y + 1) for x in range(5) for y in range(5)]
    faces = np.array(corner + [(b, b + 1, c) for _, b, c in corner])
    return BodyArrays(grid, faces, grid[:, :2] / 10 + 0.1, faces, np.zeros((36, 55)), np.zeros((55, 3)))


def test_fields_of_a_square_are_cosines():
    """The smoothest functions of a square sheet with free edges are cos(pi x / L) and cos(pi y / L); a lone vertex has
    the value of its neighbour."""
    body = sheet()
    far = np.vstack([body.vertices, [[0.0, 0.0, 9.0]]])
    fields = eigenfunctions(far, body.faces, 2)
    cosines = np.cos(np.pi * body.vertices[:, :2] / 5)
    fit, *_ = np.linalg.lstsq(cosines, fields[:36], rcond=None)
    assert np.abs(cosines @ fit - fields[:36]).max() < 0.12
    assert np.abs(fields).max(axis=0) == pytest.approx([1.0, 1.0])
    assert np.array_equal(fields[36], fields[0])


def test_values_are_laid_out_at_texel_centres():
    """A field that is u itself is u at the centre of every texel inside; only texels of the sheet are known."""
    body = sheet()
    image, known = lay_out(body.uv[:, :1] * [[1.0]], body.faces, body.uv, body.uv_faces, 20)
    rows, columns = np.nonzero(known)
    np.testing.assert_allclose(image[rows, columns, 0], (columns + 0.5) / 20, atol=1e-9)
    assert known[2:12, 2:12].all() and not known[:1].any() and not known[13:].any()
    assert not image[~known].any()


def test_gaps_take_the_mean_of_the_known_texels_of_the_block_round_them():
    known = np.zeros((4, 4), bool)
    known[0, 0] = known[3, 3] = True
    image = np.zeros((4, 4, 1))
    image[0, 0], image[3, 3] = 2.0, 6.0
    filled = fill_gaps(image, known)[..., 0]
    assert filled[:2, :2].tolist() == [[2, 2], [2, 2]]
    assert filled[2:, 2:].tolist() == [[6, 6], [6, 6]]
    assert filled[:2, 2:].tolist() == filled[2:, :2].tolist() == [[4, 4], [4, 4]]


def test_used_texels_have_a_margin_on_every_side():
    body = sheet()
    _, known = lay_out(np.zeros((36, 1)), body.faces, body.uv, body.uv_faces, 32)
    grown = used_texels(body, 32, 2)
    rows, columns = np.nonzero(known)
    for y, x in np.ndindex(32, 32):
        assert grown[y, x] == (np.abs(rows - y) + np.abs(columns - x) <= 2).any()


def test_a_first_texture_is_colours_then_fields():
    body = sheet()
    texture = first_texture(body, [], 16, 5)
    assert texture.shape == (16, 16, 5) and texture.dtype == np.float32
    assert (texture[..., :3] == -1).all(), "no sample has a colour: 2 * 0 - 1"
    fields = eigenfunctions(body.vertices, body.faces, 2)
    image, known = lay_out(fields, body.faces, body.uv, body.uv_faces, 16)
    np.testing.assert_allclose(texture[..., 3:][known], np.clip(image[known], -1, 1), atol=1e-6)


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
