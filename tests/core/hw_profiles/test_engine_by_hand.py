"""A tensor engine's layers and their times, worked out by hand; and what has to hold for every network."""

from __future__ import annotations

from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from trilane.hw_profiles.network_work import count_work
from trilane.hw_profiles.operators import INDEX, NAMES, EngineLayer, Layers
from trilane.hw_profiles.profile_files import load_profile, profile_names
from trilane.hw_profiles.reference_networks import NetworkSpec, network_work
from trilane.hw_profiles.unit_times import EngineNumbers, engine_time, join, numbers_of, spilled, time_on


def layers_of_nodes(nodes: list[Any], shapes: dict[str, tuple[int, ...]]) -> tuple[EngineLayer, ...]:
    """Layers of a chain of nodes from `x` to `y`; other shapes are weights where they begin with w."""
    values = {n: helper.make_tensor_value_info(n, TensorProto.FLOAT, shape) for n, shape in shapes.items()}
    inputs = [value for name, value in values.items() if name == "x" or name.startswith("w")]
    others = [value for name, value in values.items() if value not in inputs and name != "y"]
    graph = helper.make_graph(nodes, "g", inputs, [values["y"]], value_info=others)
    return count_work(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)])).layers.layers


def node(kind: str, sources: str, result: str, **attributes: Any) -> Any:
    return helper.make_node(kind, sources.split(" "), [result], name=result, **attributes)


def test_a_network_of_three_layers() -> None:
    """A picture's 3x3 convolution with a ReLU, a depthwise one of stride 2 with a clip, and a sum.

    Channels: 3 count as 16, 20 outputs as 32; activations of 20 as 24, of 3 as 8. 8x8 places, then 4x4.
    """
    first, middle, last = layers_of_nodes(
        [
            node("Conv", "x w0", "a", kernel_shape=[3, 3], pads=[1] * 4),
            node("Relu", "a", "b"),
            node("Conv", "b w1", "c", kernel_shape=[3, 3], pads=[1] * 4, strides=[2, 2], group=20),
            node("Clip", "c", "d"),
            node("Add", "d d", "y"),
        ],
        {
            **{"x": (1, 3, 8, 8), "w0": (20, 3, 3, 3), "w1": (20, 1, 3, 3)},
            **{"a": (1, 20, 8, 8), "b": (1, 20, 8, 8)},
            **dict.fromkeys("cdy", (1, 20, 4, 4)),
        },
    )
    weights = {"operator": 1, "weights": 20 * 27}
    assert first.amounts == {**weights, "first": 64 * 9 * 16 * 32, "moved": 64 * (8 + 24)}
    products = 16 * 9 * 32
    assert middle.amounts == {
        **{"operator": 1, "weights": 20 * 9, "depthwise": products, "depthwise_stride": products},
        **{"moved_depthwise": (64 + 16) * 24, "clip": 2 * 16 * 24},
    }
    assert (middle.reads, middle.writes) == (("a",), "c")
    assert last.amounts == {}, "a sum is free"


def test_what_is_folded_and_what_is_not() -> None:
    """x times its own sigmoid is one layer; a reshape is none; a second reader keeps a ReLU apart."""
    shape = (1, 8, 4, 4)
    kinds = layers_of_nodes(
        [
            *(node("Sigmoid", "x", "a"), node("Mul", "x a", "b"), node("Identity", "b", "c")),
            *(node("Conv", "c w0", "d", kernel_shape=[1, 1]), node("Relu", "d", "e"), node("Mul", "d e", "y")),
        ],
        {**dict.fromkeys(("x", *"abcdey"), shape), "w0": (8, 8, 1, 1)},
    )
    assert [(layer.op_type, sorted(layer.amounts)) for layer in kinds] == [
        ("Mul", ["operator", "swish"]),
        ("Conv", ["convolution", "moved", "operator", "weights"]),
        ("Relu", ["activation", "operator"]),
        ("Mul", ["elementwise", "operator"]),
    ]
    assert kinds[0].amounts["swish"] == 3 * 128 - 0, "x, its sigmoid, and the result"


def test_a_batch_normalisation_behind_a_convolution_is_part_of_it() -> None:
    """The first stands behind a convolution whose only reader it is; the last, of a sum, is a layer."""
    shape = (1, 8, 4, 4)
    numbers = "w1 w2 w3 w4"
    kinds = layers_of_nodes(
        [
            *(node("Conv", "x w0", "a", kernel_shape=[1, 1]), node("BatchNormalization", f"a {numbers}", "b")),
            *(node("Relu", "b", "c"), node("Add", "c x", "d"), node("BatchNormalization", f"d {numbers}", "y")),
        ],
        {**dict.fromkeys(("x", *"abcdy"), shape), "w0": (8, 8, 1, 1), **dict.fromkeys(numbers.split(), (8,))},
    )
    assert [layer.op_type for layer in kinds] == ["Conv", "Add", "BatchNormalization"]
    assert kinds[-1].amounts == {"operator": 1, "batch_norm": 2 * 128}


@pytest.mark.parametrize("activation", ["Relu", "Clip"])
def test_a_batch_normalisation_behind_an_activation_is_a_layer(activation: str) -> None:
    """Its factors cannot go into the convolution's weights, which the activation follows."""
    nodes = [
        node("Conv", "x w0", "a", kernel_shape=[1, 1]),
        *(node(activation, "a", "b"), node("BatchNormalization", "b w1 w2 w3 w4", "y")),
    ]
    shapes = {
        **dict.fromkeys("xaby", (1, 8, 4, 4)),
        "w0": (8, 8, 1, 1),
        **dict.fromkeys(("w1", "w2", "w3", "w4"), (8,)),
    }
    assert [layer.op_type for layer in layers_of_nodes(nodes, shapes)] == ["Conv", "BatchNormalization"]


def test_a_batch_in_the_file_has_its_products_as_often() -> None:
    """Four pictures, each of 8x8 places by 9 by 16 by 32 products; the weights are read once."""
    (layer,) = layers_of_nodes(
        [node("Conv", "x w0", "y", kernel_shape=[3, 3], pads=[1] * 4)],
        {"x": (4, 16, 8, 8), "y": (4, 32, 8, 8), "w0": (32, 16, 3, 3)},
    )
    products = {"convolution": 4 * 64 * 9 * 16 * 32, "moved": 4 * 64 * (16 + 32)}
    assert layer.amounts == {**products, "weights": 32 * 16 * 9, "operator": 1}


@pytest.mark.parametrize(
    ("kind", "given", "attributes", "products"),
    [
        ("QLinearConv", "x s0 s0 w0 s0 s0 s0 s0", {"kernel_shape": [3, 3], "pads": [1] * 4}, 64 * 9 * 16 * 32),
        ("ConvInteger", "x w0", {"kernel_shape": [3, 3], "pads": [1] * 4}, 64 * 9 * 16 * 32),
        ("QLinearMatMul", "x s0 s0 w1 s0 s0 s0 s0", {}, 16 * 8 * 16 * 32),  # depth 8 as 16, width 24 as 32
        ("MatMulInteger", "x w1", {}, 16 * 8 * 16 * 32),
        ("Einsum", "x w1", {"equation": "bchw,wk->bchk"}, 16 * 8 * 16 * 32),
    ],
)
def test_products_of_integers_and_of_any_indices(
    kind: str, given: str, attributes: dict[str, Any], products: int
) -> None:
    """They are counted as those of a convolution or a matrix product of floats, and their weights with them."""
    out = (1, 32, 8, 8) if "Conv" in kind else (1, 16, 8, 24)
    nodes = [helper.make_node(kind, given.split(), ["y"])]
    nodes[0].attribute.extend(helper.make_attribute(key, value) for key, value in attributes.items())
    weights = {"w0": (32, 16, 3, 3), "w1": (8, 24)}
    used = {name: weights[name] for name in weights if name in given.split()}
    values = [helper.make_tensor_value_info(n, TensorProto.UINT8, s) for n, s in (("x", (1, 16, 8, 8)), ("y", out))]
    tensors = [helper.make_tensor(n, TensorProto.UINT8, s, bytes(int(np.prod(s))), raw=True) for n, s in used.items()]
    tensors += [helper.make_tensor("s0", TensorProto.FLOAT, (), [1.0])] * ("s0" in given)
    graph = helper.make_graph(nodes, "g", values[:1], values[1:], tensors)
    (layer,) = count_work(helper.make_model(graph)).layers.layers
    assert layer.amounts["convolution"] == products
    assert layer.amounts["weights"] == pytest.approx(np.prod(next(iter(used.values()))), abs=8), "its scales too"


def test_a_recurrent_layer_multiplies_in_every_step() -> None:
    """5 steps of 16 values by 4 gates of 32, and of the 32 before; its first result may be left out."""
    (layer,) = layers_of_nodes(
        [helper.make_node("LSTM", ["x", "w0", "w1"], ["", "y"], hidden_size=32)],
        {"x": (5, 1, 16), "w0": (1, 128, 16), "w1": (1, 128, 32), "y": (1, 1, 32)},
    )
    assert layer.amounts["convolution"] == 5 * 128 * (16 + 32)
    assert layer.amounts["weights"] == 128 * (16 + 32)
    assert layer.writes == "y"


def test_an_operator_of_another_domain_is_no_convolution() -> None:
    (layer,) = layers_of_nodes([node("Conv", "x", "y", domain="elsewhere")], {"x": (1, 8, 2, 2), "y": (1, 8, 2, 2)})
    assert layer.amounts == {"operator": 1, "other": 64}


def test_channels_last_at_the_ends_cost_nothing() -> None:
    """As other frameworks' graphs have them. A permutation of anything else is a shuffle."""
    shapes = {"x": (1, 8, 8, 16), "a": (1, 16, 8, 8), "b": (1, 32, 8, 8), "w0": (32, 16, 1, 1), "y": (1, 8, 8, 32)}
    nodes = [
        *(node("Transpose", "x", "a", perm=[0, 3, 1, 2]), node("Conv", "a w0", "b", kernel_shape=[1, 1])),
        node("Transpose", "b", "y", perm=[0, 2, 3, 1]),
    ]
    (layer,) = layers_of_nodes(nodes, shapes)
    assert (layer.op_type, layer.reads, layer.writes) == ("Conv", ("x",), "b")
    (other,) = layers_of_nodes([node("Transpose", "x", "y", perm=[0, 2, 1, 3])], {"x": (1, 8, 8, 2), "y": (1, 8, 8, 2)})
    assert other.amounts == {"operator": 1, "shuffle": 256}


def test_all_results_of_a_split_stay_on_the_chip() -> None:
    """Parts of 64, of which the product reads two: they need not come in, and only its result goes out."""
    parts = dict.fromkeys("abcy", (1, 8, 2, 4))
    nodes = [helper.make_node("Split", ["x"], ["a", "b", "c"], axis=1), node("Mul", "b c", "y")]
    model = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, (1, 24, 2, 4))],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, 8, 2, 4))],
        value_info=[helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in parts.items() if n != "y"],
    )
    layers = count_work(helper.make_model(model)).layers
    assert (layers.layers[0].writes, layers.layers[0].more) == ("a", ("b", "c"))
    assert layers.layers[0].amounts["shuffle"] == 192 + 3 * 64
    assert spilled(layers, 1000)[1] == 64, "the result"


@pytest.mark.parametrize(
    ("kind", "attributes", "term"),
    [
        ("Div", {}, "divide"),
        ("Sub", {}, "constant"),
        ("MaxPool", {"kernel_shape": [1, 1]}, "pool"),
        ("LeakyRelu", {}, "leaky"),
        ("Erf", {}, "activation"),
        ("Sin", {}, "other"),
    ],
)
def test_terms_of_operators(kind: str, attributes: dict[str, Any], term: str) -> None:
    sources = "x w0" if kind in ("Div", "Sub") else "x"
    (layer,) = layers_of_nodes(
        [node(kind, sources, "y", **attributes)], {"x": (1, 8, 2, 2), "y": (1, 8, 2, 2), "w0": (1, 8, 1, 1)}
    )
    assert layer.amounts == {"operator": 1, term: 64}


#: Name -> (nodes, shapes beside x and y of 1x8x4x4, terms of the last layer beside `operator`).
SINGLE: dict[str, tuple[list[Any], dict[str, tuple[int, ...]], dict[str, float]]] = {
    "transposed: by the places of its input": (
        [node("ConvTranspose", "x w0", "y", kernel_shape=[2, 2], strides=[2, 2])],
        {"w0": (8, 40, 2, 2), "y": (1, 40, 8, 8)},
        {"convolution": 16 * 4 * 16 * 64, "moved": 16 * 8 + 64 * 40, "weights": 8 * 40 * 4},
    ),
    "stride and dilation count besides": (
        [node("Conv", "x w0", "y", kernel_shape=[3, 3], strides=[1, 2], dilations=[2, 1], pads=[2, 1, 2, 1])],
        {"w0": (33, 8, 3, 3), "y": (1, 33, 4, 2)},
        {
            **dict.fromkeys(("convolution", "stride", "dilation"), 8 * 9 * 16 * 64),
            **{"moved": 16 * 8 + 8 * 40, "weights": 33 * 72},
        },
    ),
    "a picture with a stride": (
        [node("Conv", "x w0", "y", kernel_shape=[2, 2], strides=[2, 2])],
        {"x": (1, 4, 4, 4), "w0": (8, 4, 2, 2), "y": (1, 8, 2, 2)},
        {"first": 4 * 4 * 16 * 32, "moved": 16 * 8 + 4 * 8, "weights": 8 * 16},
    ),
    "five channels are no picture": (
        [node("Conv", "x w0", "y", kernel_shape=[1, 1])],
        {"x": (1, 5, 4, 4), "w0": (8, 5, 1, 1)},
        {"convolution": 16 * 16 * 32, "moved": 2 * 16 * 8, "weights": 40},
    ),
    "groups of two": (
        [node("Conv", "x w0", "y", kernel_shape=[1, 1], group=4)],
        {"w0": (8, 2, 1, 1)},
        {"grouped": 16 * 16 * 32, "moved": 2 * 16 * 8, "weights": 16},
    ),
    "a depthwise one without a stride": (
        [node("Conv", "x w0", "y", kernel_shape=[3, 3], group=8, pads=[1] * 4)],
        {"w0": (8, 1, 3, 3)},
        {"depthwise": 16 * 9 * 32, "moved_depthwise": 2 * 16 * 8, "weights": 72},
    ),
    "rows by a matrix": (
        [node("MatMul", "x w0", "y")],
        {"x": (5, 17), "w0": (17, 33), "y": (5, 33)},
        {"convolution": 5 * 32 * 64, "moved": 5 * 17 + 5 * 33, "weights": 17 * 33},
    ),
    "nearest": ([node("Resize", "x  w0", "y", mode="nearest")], {"w0": (4,)}, {"nearest": 256}),
    "bilinear": ([node("Resize", "x  w0", "y", mode="linear")], {"w0": (4,)}, {"bilinear": 256}),
    "usually nearest": ([node("Resize", "x  w0", "y")], {"w0": (4,)}, {"nearest": 256}),
    "two pictures": ([node("Sub", "x x", "y")], {}, {"elementwise": 3 * 128}),
    "a constant": ([node("Mul", "x w0", "y")], {"w0": (1,)}, {"constant": 256}),
    "divided": ([node("Div", "x x", "y")], {}, {"divide": 3 * 128}),
    "a clip behind what takes none": ([node("Tanh", "x", "a"), node("Clip", "a", "y")], {}, {"activation": 256}),
    "a clip behind a pool": (
        [node("MaxPool", "x", "a", kernel_shape=[1, 1]), node("Clip", "a", "y")],
        {},
        {"pool": 256, "clip": 256},
    ),
    "two relus behind a sum": (
        [node("Add", "x x", "a"), node("Relu", "a", "b"), node("Relu", "b", "y")],
        {},
        {"elementwise": 384},
    ),
    "a sigmoid that two read": (
        [node("Sigmoid", "x", "a"), node("Mul", "x a", "b"), node("Add", "a b", "y")],
        {},
        {"elementwise": 384},
    ),
}


@pytest.mark.parametrize("name", SINGLE)
def test_layers_by_hand(name: str) -> None:
    """Inputs of convolutions count to the next 16 channels, outputs to the next 32, what is moved to the next 8."""
    nodes, shapes, terms = SINGLE[name]
    own = dict.fromkeys(("x", "a", "b", "y"), (1, 8, 4, 4))
    names = {"x", *(result for one in nodes for result in one.output)}
    last = layers_of_nodes(nodes, {**{key: shape for key, shape in own.items() if key in names}, **shapes})[-1]
    assert last.amounts == {"operator": 1, **terms}


def test_the_layers_from_one_on() -> None:
    """What the others hand over is the input then; from one that is not there on there is none."""
    whole = chain(10, 30, 20, 5)
    part = whole.since("l1", 7)
    assert (part.layers, part.input, part.output, part.sizes) == (whole.layers[1:], 7, 5, whole.sizes)
    assert whole.since("none", 7).layers == ()


def chain(*sizes: int) -> Layers:
    """Layers from tensor 0 to tensor n, of so many elements."""
    layers = tuple(EngineLayer(f"l{i}", "Conv", {}, (str(i),), str(i + 1)) for i in range(len(sizes) - 1))
    return Layers(layers, {str(i): size for i, size in enumerate(sizes)}, sizes[0], sizes[-1])


def test_what_does_not_fit_goes_out_and_comes_back() -> None:
    """The input of 10 is read; of the 30 that follow, 20 fit, so 10 go out and come back; the result of 5 goes out."""
    assert spilled(chain(10, 30, 5), 20) == (10 + 10, 10 + 5)
    assert spilled(chain(10, 30, 5), 30) == (10, 5)


def test_what_is_read_last_goes_first() -> None:
    """Of `a` (8) and `b` (8), 12 fit. `a` is read by the last layer, so 4 of it go out when `b` comes, and return."""
    layers = (
        *(EngineLayer("0", "Conv", {}, ("x",), "a"), EngineLayer("1", "Conv", {}, ("a",), "b")),
        *(EngineLayer("2", "Conv", {}, ("b",), "c"), EngineLayer("3", "Add", {}, ("c", "a"), "y")),
    )
    network = Layers(layers, {"x": 1, "a": 8, "b": 8, "c": 1, "y": 1}, 1, 1)
    assert spilled(network, 12) == (1, 4, 0, 4 + 1)


def drawn_network(random: Random) -> Layers:
    """Ten layers, a few of them concatenations, each of up to three tensors that are there."""
    names, layers = ["x"], []
    for index in range(10):
        reads = tuple(random.sample(names, min(len(names), random.randint(1, 3))))
        layers.append(
            EngineLayer(f"l{index}", random.choice(["Conv", "Conv", "Add", "Concat"]), {}, reads, f"t{index}")
        )
        names.append(f"t{index}")
    return Layers(tuple(layers), {name: random.randint(0, 9) for name in names}, 1, 1)


def spilled_one_by_one(network: Layers, room: int) -> list[int]:
    """A second implementation: elements go out one after the other, each time of the tensor that is read last."""
    parts: dict[str, list[str]] = {}
    reads: list[list[str]] = []
    for layer in network.layers:
        whole = list(dict.fromkeys(part for name in layer.reads for part in parts.get(name, [name])))
        if layer.op_type == "Concat":
            parts[layer.writes] = whole
        reads.append([] if layer.op_type == "Concat" else whole)
    never = len(reads)
    held: dict[str, int] = {}
    moved = []

    def again(name: str, now: int) -> int:
        return min((later for later in range(now + 1, never) if name in reads[later]), default=never)

    for now, layer in enumerate(network.layers):
        if layer.op_type == "Concat":
            moved.append(0)
            continue
        count = sum(network.sizes[name] - held.get(name, 0) for name in reads[now])
        held = {name: own for name, own in held.items() if name not in reads[now] or again(name, now) < never}
        own, made = again(layer.writes, now), 0
        for _ in range(network.sizes[layer.writes]):
            there = [name for name in held if held[name]]
            last = max(there, key=lambda name: again(name, now), default="")
            if own < never and sum(held.values()) + made < room:
                made += 1
            elif own < never and last and again(last, now) > own:
                held[last] -= 1
                made, count = made + 1, count + 1
            else:
                count += 1
        if own < never:
            held[layer.writes] = made
        moved.append(count)
    return moved


@pytest.mark.parametrize("seed", range(60))
def test_drawn_networks_move_what_goes_out_one_by_one(seed: int) -> None:
    random = Random(seed)
    network = drawn_network(random)
    for room in (0, random.randint(1, 12), random.randint(12, 40)):
        assert list(spilled(network, room)) == spilled_one_by_one(network, room)


def test_a_concatenation_moves_nothing() -> None:
    layers = (EngineLayer("0", "Concat", {}, ("x", "z"), "c"), EngineLayer("1", "Conv", {}, ("c",), "y"))
    assert spilled(Layers(layers, {"x": 5, "z": 6, "c": 11, "y": 2}, 11, 2), 100) == (0, 5 + 6 + 2)


def test_what_goes_on_at_once_is_joined_by_its_fourth_power() -> None:
    """3 of products, 2 of movement, 1 of spill: (81 + 16 + 1)^(1/4); 5 of weights and 7 of an operator add to it."""
    costs = np.zeros((1, len(NAMES)))
    for name, seconds in (("convolution", 3), ("moved", 2), ("spill", 1), ("weights", 5), ("operator", 7)):
        costs[0, INDEX[name]] = seconds
    by_bound, slopes = join(costs)
    whole = 98**0.25
    assert by_bound[0] == pytest.approx([whole * 81 / 98, whole * 16 / 98, whole / 98, 5, 7])
    assert slopes[0, INDEX["convolution"]] == pytest.approx((3 / whole) ** 3)
    assert slopes[0, INDEX["weights"]] == 1


def test_the_slopes_are_those_of_the_time() -> None:
    rng = np.random.default_rng(1)
    costs = rng.random((1, len(NAMES)))
    _, slopes = join(costs)
    for index in range(len(NAMES)):
        more = costs.copy()
        more[0, index] += 1e-6
        grown = (join(more)[0].sum() - join(costs)[0].sum()) / 1e-6
        assert slopes[0, index] == pytest.approx(grown, abs=1e-4)


def test_an_engine_at_half_its_clock_with_half_the_memory() -> None:
    """Spill and weights are the memory's, everything else is the clock's."""
    engine = load_profile("snapdragon-8-gen-2").units["dsp"].engines["fp16_tflite"]
    whole, half = numbers_of(engine), numbers_of(engine, 0.5)
    of_memory = np.isin(NAMES, ("spill", "weights"))
    assert half.seconds[~of_memory] == pytest.approx(2 * whole.seconds[~of_memory])
    assert half.seconds[of_memory] == pytest.approx(whole.seconds[of_memory])
    assert numbers_of(engine, 1, 0.25).seconds[of_memory] == pytest.approx(4 * whole.seconds[of_memory])
    rate = engine.rates.activation_gb_s.value or 0
    assert whole.seconds[INDEX["moved"]] == pytest.approx(2 / (rate * 1e9)), "two bytes an element"
    assert whole.room == 8 * 2**20 / 2


def test_a_batch_pays_weights_and_fixed_costs_once() -> None:
    network = network_work(NetworkSpec("resnet18", "batch", 64, 64, 8)).layers
    numbers = EngineNumbers(np.ones(len(NAMES)), 10**9)
    one, four = engine_time(network, numbers), engine_time(network, numbers, batch=4)
    assert four.layers[:, :3] == pytest.approx(4 * one.layers[:, :3])
    assert four.layers[:, 3:] == pytest.approx(one.layers[:, 3:])


@settings(max_examples=12)
@given(side=st.integers(1, 12), channels=st.integers(1, 15), room=st.integers(1, 2**22))
def test_more_to_do_and_less_room_never_take_less_time(side: int, channels: int, room: int) -> None:
    def seconds(side: int, channels: int, room: int) -> float:
        network = network_work(NetworkSpec("mobilenetv2", "instance", 32 * side, 32 * side, channels)).layers
        return engine_time(network, EngineNumbers(np.ones(len(NAMES)), room)).total

    least = seconds(side, channels, room)
    assert least <= seconds(side + 1, channels, room)
    assert least <= seconds(side, channels + 1, room)
    assert least <= seconds(side, channels, room // 2) * (1 + 1e-9)


def test_shares_add_up_and_every_engine_names_known_terms() -> None:
    work = network_work(NetworkSpec("resnet18", "batch", 64, 64, 8))
    for name in profile_names():
        profile = load_profile(name)
        for engine in profile.units["dsp"].engines.values():
            assert engine.factors.keys() <= INDEX.keys()
            assert engine_time(work.layers, numbers_of(engine)).shares.sum() == pytest.approx(1)
        job = time_on(profile.units["dsp"], profile.memory, work)
        assert job.total_ms == pytest.approx(sum(job.parts.values()))
        assert (job.unsure is None) == (profile.units["dsp"].engine is None)
