"""From weights to a bundle, by value: bytes of the texture, frames of the calibration, manifest, float painter."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import onnxruntime
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.avatars.bundle import load_bundle  # noqa: E402
from trilane.training import make_bundle, trainable_avatar  # noqa: E402
from trilane.training.dataset import U16, create_group  # noqa: E402
from trilane.training.network import UNet  # noqa: E402
from trilane.training.quantising.quantise import Quantised  # noqa: E402
from trilane.training.subject import Person  # noqa: E402
from trilane.training.surface import BodyArrays  # noqa: E402
from trilane.training.trainable_avatar import NeuralTexture, TrainableAvatar, save_network  # noqa: E402

CHANNELS = 3


def avatar(texture: np.ndarray) -> TrainableAvatar:
    torch.manual_seed(2)
    return TrainableAvatar(UNet(width=4, channels=CHANNELS, input_skip=True), NeuralTexture(texture, (64, 32)))


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.9, 0.9, (64, 64, CHANNELS)).astype(np.float32)


def test_a_texture_has_bytes_by_channel_and_nothing_where_no_face_is(monkeypatch):
    """One face covers the texels of the left half; three more round it count, and what lies beyond is 0."""
    flat = np.zeros((6, 3))
    uv = np.array([[0, 0], [0.5, 0], [0.5, 1], [0, 1]], float)
    corners = np.array([[0, 1, 2], [0, 2, 3]])
    body = BodyArrays(flat[:4], corners, uv, corners, np.zeros((4, 55)), np.zeros((55, 3)))
    monkeypatch.setattr(make_bundle, "body_arrays", {"shaped": body}.__getitem__)
    made = noise(3)
    made[:, 50:] = 0.95
    made[..., 2] = 0
    texture, scale, _ = make_bundle.byte_texture(avatar(made), "shaped")
    assert texture.dtype == np.int8 and scale.dtype == np.float32
    grown = np.zeros((64, 64), bool)
    grown[:, : 32 + 3] = True
    inside = np.where(grown[..., None], made, 0)
    found = texture != 0
    assert not found[:, 36:].any() and found[:, :31, :2].mean() > 0.98
    largest = np.abs(inside[:, :36]).max(axis=(0, 1))
    np.testing.assert_allclose(scale, np.maximum(largest, 1e-6) / 127, rtol=0.02)
    np.testing.assert_allclose(texture[:, :32] * scale, made[:, :32], atol=float(scale.max()) * 0.5 + 1e-4)
    assert np.abs(texture[..., :2]).max() == 127


def test_texels_that_no_frame_shows_are_filled_from_their_neighbours_on_the_body(monkeypatch):
    """A sheet of 8 x 8 squares over the left half, u + v at the seen texels: the plane goes on through the hole, and
    over the margin that bilinear reads at the body's border use."""
    x, y = np.meshgrid(np.arange(9.0), np.arange(9.0))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(81)])
    first = [9 * j + k for j in range(8) for k in range(8)]
    faces = np.array([[a, a + 1, a + 9] for a in first] + [[a + 1, a + 10, a + 9] for a in first])
    uv = points[:, :2] * [0.5 / 8, 1 / 8]
    body = BodyArrays(points, faces, uv, faces, np.zeros((81, 55)), np.zeros((55, 3)))
    monkeypatch.setattr(make_bundle, "body_arrays", {"shaped": body}.__getitem__)
    u, v = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(64) + 0.5) / 64)
    plane = np.repeat((0.6 * u + 0.3 * v)[..., None], CHANNELS, axis=2).astype(np.float32)
    unseen = np.zeros((32, 32), bool)
    unseen[10:16, 12:16] = True
    made = avatar(np.where(np.kron(unseen, np.ones((2, 2)))[..., None] > 0, -0.9, plane).astype(np.float32))
    texture, scale, _ = make_bundle.byte_texture(made, "shaped", unseen)
    steps = float(scale.max()) / 2
    np.testing.assert_allclose((texture * scale)[20:32, 24:30], plane[20:32, 24:30], atol=steps + 0.02)
    assert (texture[20:32, 32:34] > 0).all(), "the margin"
    left, _, _ = make_bundle.byte_texture(made, "shaped")
    assert (left[22:30, 26:30] < 0).all() and np.array_equal(left[40:, :30] > 0, texture[40:, :30] > 0)


@pytest.fixture
def groups(tmp_path):
    """Two shapes; the samples of the second are what the network is calibrated on."""
    found = []
    for number, (shape, count) in enumerate((((32, 32), 2), ((64, 32), 7))):
        group = create_group(tmp_path / "data", shape, np.zeros(count, np.int8))
        rng = np.random.default_rng(number)
        group.uv[:] = rng.integers(0, U16, group.uv.shape)
        group.covered[:] = rng.integers(0, 2, group.covered.shape)
        found.append(group)
    return found


def read_by_hand(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear, (h, w, C), of `image` (S, S, C) at `uv` (h, w, 2); beyond the border the last texel repeats."""
    at = (uv * len(image) - 0.5).clip(0, len(image) - 1)
    low = np.floor(at).astype(int)
    high, share = np.minimum(low + 1, len(image) - 1), at - low
    (x0, y0), (x1, y1), (sx, sy) = (np.moveaxis(a, -1, 0) for a in (low, high, share))
    sx, sy = sx[..., None], sy[..., None]
    upper = image[y0, x0] * (1 - sx) + image[y0, x1] * sx
    return upper * (1 - sy) + (image[y1, x0] * (1 - sx) + image[y1, x1] * sx) * sy


def test_the_float_network_and_its_inputs_are_written(monkeypatch, groups, tmp_path):
    """The file computes what the network does; the inputs are those that it was calibrated on, to half floats."""
    monkeypatch.setattr(make_bundle, "CALIBRATION_SHAPE", (64, 32))
    monkeypatch.setattr(make_bundle, "WRITTEN_FRAMES", 3)
    made = avatar(noise(1))
    made.network.eval()
    names = make_bundle.write_float_network(tmp_path, made, groups, 9)
    assert names == {"float_network": str(tmp_path / "network.onnx"), "frames": str(tmp_path / "frames.npy")}
    frames, image = np.load(tmp_path / "frames.npy"), made.textures[0].image().detach()[0].permute(1, 2, 0).numpy()
    assert (frames.shape, frames.dtype) == ((3, 64, 32, CHANNELS), np.float16)
    chosen, group = sorted(np.random.default_rng(9).permutation(7)[:3]), groups[1]
    for frame, number in zip(frames, chosen, strict=True):
        wanted = read_by_hand(image, group.uv[number] / 65535) * (group.covered[number] == 1)[..., None]
        np.testing.assert_allclose(frame, wanted, atol=1e-3)
    planes = np.ascontiguousarray(frames[:1].astype(np.float32).transpose(0, 3, 1, 2))
    session = onnxruntime.InferenceSession(tmp_path / "network.onnx", providers=["CPUExecutionProvider"])
    with torch.no_grad():
        wanted = made.network(torch.from_numpy(planes)).numpy()
    np.testing.assert_allclose(session.run(None, {"tensor": planes})[0], wanted, atol=1e-4)


def test_the_network_is_calibrated_on_chosen_samples_of_one_shape(monkeypatch, groups):
    asked = []

    def quantise(model, frames):
        asked.append((model, frames))
        return Quantised(SimpleNamespace(name="made"), {"a": 1}, {})

    monkeypatch.setattr(make_bundle, "CALIBRATION_SHAPE", (64, 32))
    monkeypatch.setattr(make_bundle, "CALIBRATION_FRAMES", 4)
    monkeypatch.setattr(make_bundle, "quantise", quantise)
    monkeypatch.setattr(make_bundle, "export_onnx", lambda network, *shape: (network, shape))
    monkeypatch.setattr(make_bundle, "reshaped", lambda network, *shape: (network.name, shape))
    made = avatar(noise(1))
    assert make_bundle.integer_network(made, groups, 9) == Quantised(("made", (256, 256)), {"a": 1}, {})
    ((model, frames),) = asked
    assert model == (made.network, (64, 32))
    chosen = sorted(np.random.default_rng(9).permutation(7)[:4])
    image = made.textures[0].image().detach()[0].permute(1, 2, 0).numpy()
    for frame, number in zip(frames, chosen, strict=True):
        group = groups[1]
        wanted = read_by_hand(image, group.uv[number] / 65535) * (group.covered[number] == 1)[..., None]
        assert frame.shape == (64, 32, CHANNELS)
        np.testing.assert_allclose(frame, wanted, atol=1e-4)


def test_the_network_of_several_people_is_calibrated_on_all_of_them(monkeypatch, groups):
    """The second person's samples are read from the second texture."""
    monkeypatch.setattr(make_bundle, "CALIBRATION_SHAPE", (64, 32))
    torch.manual_seed(2)
    network, images = UNet(width=4, channels=CHANNELS, input_skip=True), (noise(1), noise(2))
    made = TrainableAvatar(network, *(NeuralTexture(image, (64, 32)) for image in images))
    both = [groups[1], replace(groups[1], person=1)]
    _, frames = make_bundle._calibration(made, both, 9, 14)
    assert len(frames) == 14
    for number, frame in enumerate(frames):
        image = made.levels(number // 7)[0].detach()[0].permute(1, 2, 0).numpy()
        wanted = read_by_hand(image, groups[1].uv[number % 7] / 65535)
        wanted = wanted * (groups[1].covered[number % 7] == 1)[..., None]
        np.testing.assert_allclose(frame, wanted, atol=1e-4)


def test_the_manifest_says_how_the_avatar_was_made(tiny_quantised, tiny_bundle, tmp_path):
    texture = np.arange(4 * 4 * 5, dtype=np.int8).reshape(4, 4, 5)
    scale = np.arange(1, 6, dtype=np.float32)
    quantised = make_bundle.QuantisedAvatar(tiny_quantised, texture, scale)
    names = {"name": "somebody", "training_command": "python -m x"}
    person = Person(tiny_bundle / "body.npz", (0.5, -1.0), (2.0,))
    make_bundle.write_avatar(tmp_path / "out", person, quantised, 8, {"steps": 3}, names)
    bundle = load_bundle(tmp_path / "out")
    np.testing.assert_array_equal(bundle.read_texture(), texture * scale)
    assert (tmp_path / "out" / "body.npz").read_bytes() == (tiny_bundle / "body.npz").read_bytes()
    assert bundle.read_network().digest == tiny_quantised.network.digest
    written = json.loads((tmp_path / "out" / "manifest.json").read_text())
    ends = [
        {"scale": end.scale, "zero_point": end.zero_point}
        for end in (tiny_quantised.network.input, tiny_quantised.network.output)
    ]
    assert written == {
        "schema_version": 1,
        "name": "somebody",
        "body": "body.npz",
        "offsets": None,
        "mesh_levels": None,
        "texture": "texture.npz",
        "betas": [0.5, -1.0],
        "expression": [2.0],
        "network": {
            "file": "network.onnx", "encoder": "resnet18", "norm": "batch", "width": 8, "channels": 5,
            "input": ends[0], "output": ends[1],
        },
        "training_command": "python -m x",
        "provenance": {"steps": 3},
        "quantisation": tiny_quantised.facts,
        "validation": None,
    }  # fmt: skip


def test_a_painter_in_floats_reads_the_texture_and_rounds_the_picture(tmp_path):
    made = avatar(noise(4)).eval()
    uv = np.random.default_rng(0).uniform(0, 1, (32, 64, 3)).astype(np.float32)
    uv[:, 40:, 2] = 0
    image = made.textures[0].image().detach()
    x = read_by_hand(image[0].permute(1, 2, 0).numpy(), uv[..., :2]) * (uv[..., 2:] > 0)
    with torch.no_grad():
        output = made.network(torch.from_numpy(x.transpose(2, 0, 1)[None].astype(np.float32)))
    wanted = np.round(output[0].permute(1, 2, 0).numpy() * 255)
    made.network.train()
    found = trainable_avatar.float_painter(made.network, image)(None, uv)
    assert found.dtype == np.uint8 and found.shape == (32, 64, 4)
    assert np.abs(found - wanted).max() <= 1 and (found != wanted).mean() < 0.01

    save_network(made, tmp_path / "n.npz")
    entry = SimpleNamespace(encoder="resnet18", norm="batch", width=4, channels=CHANNELS)
    texture = image[0].permute(1, 2, 0).numpy()
    parts = {"read_texture": lambda: texture, "read_levels": lambda: None}
    bundle = SimpleNamespace(manifest=SimpleNamespace(network=entry), **parts)
    again = trainable_avatar.float_painter_of(bundle, tmp_path / "n.npz")(None, uv)
    assert np.abs(again.astype(int) - found).max() <= 2, "weights in half precision"
