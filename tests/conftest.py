"""Fixtures that several folders of tests share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import HealthCheck, settings
from onnx import TensorProto, helper, numpy_helper

from trilane.avatars.bundle import bundle_folder, write_bundle
from trilane.avatars.manifest import Manifest, network_entry
from trilane.training.quantising.quantise import Quantised, quantise

#: Units and commands that tests start find `support` too.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(Path(__file__).parent), os.environ.get("PYTHONPATH"))))


def pytest_addoption(parser: pytest.Parser) -> None:
    """`make test-all` and `make test-device` use them."""
    parser.addoption("--slow", action="store_true", help="run the tests that are marked slow as well")
    parser.addoption("--runtime", action="append", help="a runtime for the conformance suite [those without a GPU]")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--slow"):
        return
    slow = [item for item in items if item.get_closest_marker("slow")]
    config.hook.pytest_deselected(items=slow)
    items[:] = [item for item in items if item not in slow]


# How long an example takes is the machine's matter. What a property test draws follows from its code, so a failure of
# `make test` is one of the change that was made; `make explore` draws something else each time.
for profile, is_fixed in (("repeatable", True), ("explore", False)):
    settings.register_profile(
        profile, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=is_fixed, print_blob=True
    )
settings.load_profile("explore" if "TRILANE_EXPLORE" in os.environ else "repeatable")

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Compiled networks of the tests stay out of the user's cache. A home that cannot be written has none to spare."""
    if os.access(Path("~").expanduser(), os.W_OK):
        os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real inputs that lie beside the checkout; the test is skipped where they do not."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip(f"no real inputs at {folder}")
    return folder


def tiny_float_network(channels: int = 5, side: int = 64, seed: int = 0) -> onnx.ModelProto:
    """A small U-Net of every layer kind the avatar's has: stride, pool, add, nearest x2, concat, sigmoid."""
    rng = np.random.default_rng(seed)
    weights: list[onnx.TensorProto] = [numpy_helper.from_array(np.array([1, 1, 2, 2], np.float32), "twice")]
    nodes = []

    def conv(name: str, source: str, c_in: int, c_out: int, stride: int = 1, relu: bool = True) -> str:
        kernel = rng.normal(0, (2 / (9 * c_in)) ** 0.5, (c_out, c_in, 3, 3)).astype(np.float32)
        bias = rng.normal(0, 0.1, c_out).astype(np.float32)
        weights.extend(numpy_helper.from_array(a, f"{name}.{k}") for a, k in ((kernel, "w"), (bias, "b")))
        inputs = [source, f"{name}.w", f"{name}.b"]
        nodes.append(helper.make_node("Conv", inputs, [name], name, pads=[1] * 4, strides=[stride] * 2))
        if relu:
            nodes.append(helper.make_node("Relu", [name], [f"{name}.relu"], f"{name}.relu"))
        return f"{name}.relu" if relu else name

    skip = conv("stem", "tensor", channels, 8, 2)
    nodes.append(
        helper.make_node("MaxPool", [skip], ["pool"], "pool", kernel_shape=[3, 3], pads=[1] * 4, strides=[2, 2])
    )
    deep = conv("deep", "pool", 8, 8)
    nodes.append(helper.make_node("Add", [deep, "pool"], ["sum"], "sum"))
    nodes.append(
        helper.make_node(
            "Resize",
            ["sum", "", "twice"],
            ["up"],
            "up",
            mode="nearest",
            nearest_mode="floor",
            coordinate_transformation_mode="asymmetric",
        )
    )
    nodes.append(helper.make_node("Concat", ["up", skip], ["joined"], "joined", axis=1))
    level = conv("level", "joined", 16, 8)
    nodes.append(
        helper.make_node(
            "Resize",
            [level, "", "twice"],
            ["full"],
            "full",
            mode="nearest",
            nearest_mode="floor",
            coordinate_transformation_mode="asymmetric",
        )
    )
    logits = conv("head", "full", 8, 4, relu=False)
    nodes.append(helper.make_node("Sigmoid", [logits], ["rgba"], "sigmoid"))
    ends = [("tensor", channels), ("rgba", 4)]
    source, target = (helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, c, side, side]) for n, c in ends)
    graph = helper.make_graph(nodes, "tiny", [source], [target], weights)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


@pytest.fixture(scope="session")
def tiny_float() -> onnx.ModelProto:
    """A float network with random weights, 5 channels, 64 x 64. For tests of machinery only."""
    return tiny_float_network()


@pytest.fixture(scope="session")
def tiny_float_network_of() -> Callable[..., onnx.ModelProto]:
    """Makes one of other channels, side or seed: `tiny_float_network`."""
    return tiny_float_network


@pytest.fixture(scope="session")
def tiny_frames() -> list[np.ndarray]:
    """Inputs of the tiny network: smooth values inside a rectangle, 0 outside. (64, 64, 5) float32."""
    rng = np.random.default_rng(1)
    frames = np.zeros((6, 64, 64, 5), np.float32)
    frames[:, 8:56, 16:48] = np.repeat(np.repeat(rng.normal(0, 1, (6, 6, 4, 5)), 8, 1), 8, 2)
    return list(frames)


@pytest.fixture(scope="session")
def tiny_quantised(tiny_float: onnx.ModelProto, tiny_frames: list[np.ndarray]) -> Quantised:
    """The tiny network in integers."""
    return quantise(tiny_float, tiny_frames)


@pytest.fixture(scope="session")
def tiny_bundle(tiny_quantised: Quantised, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle folder around the tiny network, with the default avatar's body and a random texture."""
    folder = tmp_path_factory.mktemp("bundle") / "tiny"
    entry = network_entry(tiny_quantised.network, "resnet18", "batch", 8)
    texture = np.random.default_rng(2).normal(0, 1, (32, 32, 5)).astype(np.float16)
    manifest = Manifest(name="tiny", network=entry, quantisation=tiny_quantised.facts)
    write_bundle(folder, manifest, bundle_folder("default") / "body.npz", texture, tiny_quantised.network)
    return folder


@pytest.fixture(scope="session")
def drawable_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle like `tiny_bundle` with 4 channels, which the GPU unit can pack: whole runs are made with it."""
    folder = tmp_path_factory.mktemp("bundle") / "drawable"
    frames = np.random.default_rng(1).normal(0, 1, (4, 64, 64, 4)).astype(np.float32)
    network = quantise(tiny_float_network(channels=4), list(frames))
    texture = np.random.default_rng(2).normal(0, 1, (32, 32, 4)).astype(np.float16)
    entry = network_entry(network.network, "resnet18", "batch", 8)
    manifest = Manifest(name="tiny", network=entry, quantisation=network.facts)
    write_bundle(folder, manifest, bundle_folder("default") / "body.npz", texture, network.network)
    return folder
