"""Work of a graph and its time: counts by loops and published values, times by the terms of the formula."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from trilane.errors import BadInputError
from trilane.hw_profiles.application import isolated_job_time, split_work
from trilane.hw_profiles.fit_engines import PUBLISHED_MS, check_published, resnet18_work, unet_work
from trilane.hw_profiles.network_work import Operator, Work, count_work, one_after_the_other
from trilane.hw_profiles.operators import CLASSES, has_rule
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.reference_networks import (
    LAYOUTS,
    NetworkSpec,
    build_network,
    network_work,
    reference_network,
)
from trilane.hw_profiles.schema import CORNERS, corners_of
from trilane.hw_profiles.unit_times import UnitNumbers, job_time, machine_of, time_on
from trilane.training.quantising.quantise import Quantised
from trilane.unet_tables import ENCODERS, NORMS
from trilane.units import UnitName


def convolution(
    op: str, source: tuple[int, ...], weight: tuple[int, ...], result: tuple[int, ...], **attributes: Any
) -> onnx.ModelProto:
    """A graph of one convolution with a bias."""
    tensors = [
        helper.make_tensor("w", TensorProto.FLOAT, weight, np.zeros(weight, np.float32).tobytes(), raw=True),
        helper.make_tensor("b", TensorProto.FLOAT, (result[1],), np.zeros(result[1], np.float32).tobytes(), raw=True),
    ]
    node = helper.make_node(op, ["x", "w", "b"], ["y"], "only", **attributes)
    ends = [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in (("x", source), ("y", result))]
    return helper.make_model(helper.make_graph([node], "g", [ends[0]], [ends[1]], tensors))


def products_of_convolution(
    source: tuple[int, ...], weight: tuple[int, ...], result: tuple[int, ...], groups: int
) -> int:
    """By counting: for every element of the result, the weights that meet it."""
    count = 0
    for out_channel, _row, _column in product(*map(range, result[1:])):
        group = out_channel // (result[1] // groups)
        inputs = [c for c in range(source[1]) if c // (source[1] // groups) == group]
        assert len(inputs) == weight[1]
        count += len(inputs) * weight[2] * weight[3]
    return count


CONVOLUTIONS = {
    "plain": ((1, 6, 5, 7), (4, 6, 3, 3), (1, 4, 5, 7), 1, {"pads": [1] * 4}, "convolution"),
    "stride 2": ((1, 6, 8, 8), (4, 6, 3, 3), (1, 4, 4, 4), 1, {"pads": [1] * 4, "strides": [2, 2]}, "convolution"),
    "pointwise": ((1, 6, 5, 7), (4, 6, 1, 1), (1, 4, 5, 7), 1, {}, "pointwise"),
    "depthwise": ((1, 6, 5, 7), (6, 1, 3, 3), (1, 6, 5, 7), 6, {"pads": [1] * 4, "group": 6}, "depthwise"),
    "depthwise, two each": ((1, 3, 5, 7), (6, 1, 3, 3), (1, 6, 5, 7), 3, {"pads": [1] * 4, "group": 3}, "depthwise"),
    "two groups": ((1, 6, 5, 7), (4, 3, 3, 3), (1, 4, 5, 7), 2, {"pads": [1] * 4, "group": 2}, "convolution"),
}


@pytest.mark.parametrize("name", CONVOLUTIONS)
def test_products_are_counted_one_by_one(name: str) -> None:
    source, weight, result, groups, attributes, kind = CONVOLUTIONS[name]
    (operator,) = count_work(convolution("Conv", source, weight, result, **attributes)).operators
    assert operator.macs == products_of_convolution(source, weight, result, groups)
    assert operator.kind == kind
    assert operator.weights == np.prod(weight) + result[1]
    assert operator.moved == np.prod(source) + np.prod(result)
    assert (operator.c_in, operator.c_out) == (source[1] // groups, result[1] // groups)
    assert (operator.out, operator.live) == (np.prod(result), np.prod(result))


def test_a_transposed_convolution_multiplies_every_input_with_every_weight() -> None:
    """Each of the 5 * 7 inputs of each of 6 channels meets 4 * 2 * 2 weights."""
    model = convolution("ConvTranspose", (1, 6, 5, 7), (6, 4, 2, 2), (1, 4, 10, 14), strides=[2, 2])
    (operator,) = count_work(model).operators
    assert operator.macs == 5 * 7 * 6 * 4 * 2 * 2
    assert operator.kind == "convolution"


def test_a_small_graph_is_counted_by_hand() -> None:
    """x (1,2,4,4) -> instance norm a -> pool b (1,2,2,2) -> resize c (1,2,4,4) -> concat of a and c: d (1,4,4,4).

    Elements: x, a, c 32, b 8, d 64. The norm reads x twice. After the norm a lives (32); after the pool a and b (40);
    after the resize a and c (64); after the concat d alone.
    """
    nodes = [
        helper.make_node("InstanceNormalization", ["x", "s", "s"], ["a"], "norm"),
        helper.make_node("MaxPool", ["a"], ["b"], "pool", kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("Resize", ["b", "", "scales"], ["c"], "resize"),
        helper.make_node("Concat", ["a", "c"], ["d"], "concat", axis=1),
        helper.make_node("Relu", ["d"], ["y"], "relu"),
    ]
    weights = [
        helper.make_tensor("s", TensorProto.FLOAT, (2,), [1, 1]),
        helper.make_tensor("scales", TensorProto.FLOAT, (4,), [1, 1, 2, 2]),
    ]
    sizes = {"a": (1, 2, 4, 4), "b": (1, 2, 2, 2), "c": (1, 2, 4, 4), "d": (1, 4, 4, 4)}
    infos = [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in sizes.items()]
    source = helper.make_tensor_value_info("x", TensorProto.FLOAT, (1, 2, 4, 4))
    target = helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, 4, 4, 4))
    graph = helper.make_graph(nodes, "g", [source], [target], weights, value_info=infos)
    work = count_work(helper.make_model(graph))
    rows = [(o.name, o.kind, o.macs, o.moved, o.out, o.live) for o in work.operators]
    assert rows == [
        ("norm", "normalisation", 0, 2 * 32 + 32, 32, 32),
        ("pool", "resize", 0, 32 + 8, 8, 32 + 8),
        ("resize", "resize", 0, 8 + 32, 32, 32 + 32),
        ("concat", "resize", 0, 32 + 32 + 64, 64, 64),
    ]
    assert (work.input_elements, work.input_tensors, work.output_elements) == (32, 1, 64)


@pytest.mark.parametrize(
    ("nodes", "tensors"),
    [
        ("Concat a b -> y", 2),
        ("QuantizeLinear a w0 -> q; DequantizeLinear q w0 -> d; Concat d b -> y", 2),
        ("Relu a -> r; Concat r b -> y", 1),  # what an encoder hands to a decoder
        ("Concat a b -> c; Relu a -> r; Concat c r -> y", 1),
        ("Relu a -> y", 1),
    ],
)
def test_a_picture_in_several_tensors_and_inputs_that_are_none(nodes: str, tensors: int) -> None:
    made = []
    for text in nodes.split("; "):
        kind, *sources, _, result = text.split()
        made.append(helper.make_node(kind, sources, [result], **({"axis": 1} if kind == "Concat" else {})))
    names = sorted({name for node in made for name in node.input} & {"a", "b"})
    infos = {name: helper.make_tensor_value_info(name, TensorProto.FLOAT, (1, 2, 4, 4)) for name in "abcqdry"}
    weights = [helper.make_tensor("w0", TensorProto.FLOAT, (), [1.0])]
    graph = helper.make_graph(made, "g", [infos[n] for n in names], [infos["y"]], weights, value_info=infos.values())
    assert count_work(helper.make_model(graph)).input_tensors == tensors


#: Powers of two, so that the sums below are exact.
MACHINE = UnitNumbers(
    arithmetic=np.array([1024.0, 2048.0, 512.0, np.inf, np.inf, np.inf, np.inf]),
    traffic=np.array([256.0, 128.0, 64.0, 32.0, 16.0, 8.0, 4.0]),
    stream=128.0,
    element_bytes=2,
    block=4.0,
    job=1.0,
    operator=0.5,
    input=0.25,
    permute=3.0,
    fallback=frozenset({"Odd"}),
    fallback_job=5.0,
    fallback_element=0.125,
)


def work_of(*operators: Operator, inputs: int = 1) -> Work:
    return Work(operators, 8, inputs, 8)


#: (operator, its class, seconds): arithmetic with padded channels against traffic, whichever is larger.
OPERATORS = {
    # 3 channels in and 5 out are 4 and 8 of a block: 960 * 4/3 * 8/5 = 2048 products in 2 s; 64 * 2 bytes take 0.5 s.
    "bound by arithmetic": (Operator("a", "Conv", "convolution", 960, 64, 0, 3, 5, 8), 2.0),
    # 2048 products take 1 s; 96 * 2 bytes at 128 a second 1.5 s.
    "bound by traffic": (Operator("b", "Conv", "pointwise", 2048, 96, 0, 4, 4, 8), 1.5),
    # Depthwise channels are not padded: 512 products take 1 s, not 16.
    "depthwise": (Operator("c", "Conv", "depthwise", 512, 16, 0, 1, 1, 8), 1.0),
    "without products": (Operator("d", "Add", "elementwise", 0, 8, 0, 0, 0, 8), 2.0),
    "permuted": (Operator("e", "Transpose", "permute", 0, 8, 0, 0, 0, 8), 4.0),
}


@pytest.mark.parametrize("name", OPERATORS)
def test_an_operator_takes_the_larger_of_arithmetic_and_traffic(name: str) -> None:
    operator, seconds = OPERATORS[name]
    parts = job_time(work_of(operator), MACHINE).parts
    assert parts == {
        "fixed": 1000 * (1.0 + 0.5),
        "input": 1000 * 8 * 0.25,
        "weights": 0,
        "fallback": 0,
    } | {kind: 1000 * seconds * (kind == operator.kind) for kind in CLASSES}


def test_a_job_pays_for_weights_split_inputs_fallbacks_and_every_frame_of_a_batch() -> None:
    """16 weights of 2 bytes at 128 bytes a second: 0.25 s. The fallback: 5 s, and 8 results of 0.125 s a frame."""
    conv = Operator("a", "Conv", "convolution", 960, 64, 16, 3, 5, 8)
    odd = Operator("b", "Odd", "elementwise", 0, 1000, 0, 0, 0, 8)
    time = job_time(work_of(conv, odd, inputs=2), MACHINE, batch=3)
    assert {name: ms for name, ms in time.parts.items() if ms} == {
        "fixed": 1000 * (1.0 + 2 * 0.5 + 3.0),
        "input": 1000 * 3 * 8 * 0.25,
        "weights": 1000 * 0.25,
        "fallback": 1000 * (5.0 + 3 * 8 * 0.125),
        "convolution": 1000 * 3 * 2.0,
    }
    assert time.total_ms == 1000 * (5.0 + 6.0 + 0.25 + 8.0 + 6.0)


def test_a_machine_is_the_numbers_of_its_profile() -> None:
    """Every number of the unit has a value of its own here, so that none can be taken for another."""
    profile = load_profile("snapdragon-888")
    unit, memory = profile.units["dsp"], profile.memory

    def value(number: float) -> Any:
        return unit.job_fixed_ms.model_copy(update={"value": number})

    kinds = list(type(unit.efficiency).model_fields)
    efficiency = unit.efficiency.model_copy(update={kind: value(0.01 * (n + 1)) for n, kind in enumerate(kinds)})
    numbers = ("channel_block", "job_fixed_ms", "operator_fixed_us", "input_ns_per_element", "permute_fixed_ms")
    numbers += ("fallback_fixed_ms", "fallback_ns_per_element", "peak_int8_tmac_s")
    changed = {name: value(3.0 + n) for n, name in enumerate(numbers)}
    unit = unit.model_copy(update={**changed, "efficiency": efficiency, "precision": "int8", "fallback": ("A", "B")})
    memory = memory.model_copy(update={"bandwidth_gb_s": value(40.0), "application_use_fraction": value(0.25)})
    machine = machine_of(unit, memory, clock_fraction=0.5, contended=True)
    share = dict(zip(kinds, np.arange(1, len(kinds) + 1) * 0.01, strict=True))
    assert machine.arithmetic.tolist() == pytest.approx(
        [share[kind] * 10e12 * 0.5 for kind in ("convolution", "pointwise", "depthwise")] + [np.inf] * 4
    )
    keys = ("convolution_traffic", "pointwise_traffic", "depthwise_traffic")
    keys += ("normalisation", "resize", "elementwise", "permute")
    assert machine.traffic.tolist() == pytest.approx([share[key] * 30e9 for key in keys])
    assert machine.stream == pytest.approx(share["convolution_traffic"] * 30e9)
    assert (machine.element_bytes, machine.block, machine.fallback) == (1, 3.0, frozenset("AB"))
    fixed = (machine.job, machine.operator, machine.input, machine.permute)
    assert fixed == pytest.approx((4e-3, 5e-6, 6e-9, 7e-3))
    assert (machine.fallback_job, machine.fallback_element) == pytest.approx((8e-3, 9e-9))
    alone = machine_of(unit, memory)
    assert alone.traffic[0] == pytest.approx(share["convolution_traffic"] * 40e9)
    assert alone.arithmetic[0] == pytest.approx(share["convolution"] * 10e12)


@pytest.mark.parametrize(("precision", "bytes_each", "peak"), [("int8", 1, 3e12), ("fp16", 2, 4e12), ("fp32", 4, 5e12)])
def test_a_precision_has_its_own_peak_and_size(precision: str, bytes_each: int, peak: float) -> None:
    unit = load_profile("snapdragon-888").units["dsp"]
    peaks = {
        f"peak_{name}_tmac_s": unit.job_fixed_ms.model_copy(update={"value": number})
        for name, number in (("int8", 3.0), ("fp16", 4.0), ("fp32", 5.0))
    }
    unit = unit.model_copy(update={**peaks, "precision": precision})
    assert (unit.element_bytes, unit.peak_mac_s) == (bytes_each, pytest.approx(peak))


@pytest.mark.parametrize("busy", [0.0, 0.25, 1.0])
def test_power_is_the_busy_share_of_the_clocks_power_and_idle_power_else(busy: float) -> None:
    """4 W at the full clock, exponent 2: a clock of 0.5 takes 1 W busy, and 0.2 W idle."""
    unit = load_profile("snapdragon-888").units["dsp"]
    number = unit.idle_w
    values = {"power_max_w": 4.0, "power_exponent": 2.0, "idle_w": 0.2}
    changed: dict[str, Any] = {key: number.model_copy(update={"value": value}) for key, value in values.items()}
    changed["corners"] = {corner: number.model_copy(update={"value": 0.5}) for corner in CORNERS}
    assert unit.model_copy(update=changed).power_w("svs", busy) == pytest.approx(busy * 1.0 + (1 - busy) * 0.2)


SUSTAINED = "sustained_high_performance"


def spec(encoder: str = "resnet18", norm: str = "batch", side: int = 512, channels: int = 16) -> NetworkSpec:
    return NetworkSpec(encoder, norm, side, side, channels)


@pytest.mark.parametrize(
    ("encoder", "millions"),
    [("resnet18", 14.5), ("mobilenetv2", 6.6), ("mobilenetv3", 6.7), ("efficientnet-lite0", 6.1)],
)
def test_parameters_are_those_published(encoder: str, millions: float) -> None:
    assert network_work(spec(encoder)).weights / 1e6 == pytest.approx(millions, rel=0.05)


def test_published_networks_have_their_known_sizes() -> None:
    """U-Net: 31.0 M parameters; ResNet18: 11.7 M and 1.82 GMAC at 224x224."""
    assert unet_work().weights / 1e6 == pytest.approx(31.0, rel=0.01)
    assert resnet18_work().weights / 1e6 == pytest.approx(11.7, rel=0.01)
    assert resnet18_work().macs / 1e9 == pytest.approx(1.82, rel=0.01)


@pytest.mark.parametrize("encoder", ENCODERS)
@pytest.mark.parametrize("norm", ["batch", "instance"])
def test_shapes_of_the_generated_graphs_are_those_that_onnx_infers(encoder: str, norm: str) -> None:
    model = build_network(spec(encoder, norm, 64, 8))
    onnx.checker.check_model(model)
    stated = {v.name: [d.dim_value for d in v.type.tensor_type.shape.dim] for v in model.graph.value_info}
    bare = onnx.ModelProto()
    bare.CopyFrom(model)
    del bare.graph.value_info[:]
    inferred = onnx.shape_inference.infer_shapes(bare, strict_mode=True)
    for value in inferred.graph.value_info:
        inferred_shape = [d.dim_value for d in value.type.tensor_type.shape.dim]
        assert inferred_shape == stated[value.name], value.name


def test_graphs_equal_the_trained_networks() -> None:
    """Parameter counts against the PyTorch definition, for every encoder that it has."""
    pytest.importorskip("torch")
    from trilane.training.network import ENCODERS as TRAINED
    from trilane.training.network import UNet

    for encoder in sorted(set(TRAINED) & set(ENCODERS)):
        trained = sum(p.numel() for p in UNet(encoder, "instance", channels=16).parameters())
        assert network_work(spec(encoder, "instance")).weights == pytest.approx(trained, rel=0.001), encoder


@pytest.mark.parametrize("encoder", ENCODERS)
@pytest.mark.parametrize("shape", [(32, 32), (384, 192), (640, 640)])
def test_counts_of_any_size_are_those_of_its_graph(encoder: str, shape: tuple[int, int]) -> None:
    network = NetworkSpec(encoder, "instance", *shape, 12, "split")
    assert network_work(network) == count_work(build_network(network))


def test_a_quantised_avatar_counts_as_its_float_network(tiny_quantised: Quantised, tiny_float: onnx.ModelProto) -> None:
    """Bytes in and out, channels last: the transposes at the ends change the order of a file and cost nothing."""
    whole, plain = count_work(tiny_quantised.network.model), count_work(tiny_float)
    assert [o.kind for o in whole.operators] == [o.kind for o in plain.operators]
    assert (whole.macs, whole.weights, whole.input_elements) == (plain.macs, plain.weights, plain.input_elements)


def test_an_operator_without_a_rule_counts_as_movement() -> None:
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, (1, 4, 16, 16))
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, 4, 8, 8))
    graph = helper.make_graph([helper.make_node("Odd", ["x"], ["y"], name="odd", domain="mine")], "g", [x], [y])
    (operator,) = count_work(helper.make_model(graph)).operators
    assert operator == Operator("odd", "Odd", "elementwise", 0, 1024 + 256, 0, 0, 0, 256, 256, ruled=False)
    assert not has_rule("Odd", "mine") and not has_rule("Conv", "mine") and has_rule("Conv")


def test_a_dynamic_shape_is_refused() -> None:
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, (1, 4, "h", 16))
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, 4, "h", 16))
    graph = helper.make_graph([helper.make_node("Tanh", ["x"], ["y"])], "g", [x], [y])
    with pytest.raises(BadInputError, match="no static shape"):
        count_work(helper.make_model(graph))


@pytest.mark.parametrize(("key", "value"), [("encoder", "vgg"), ("norm", "layer"), ("layout", "loose")])
def test_unknown_words_are_named(key: str, value: str) -> None:
    with pytest.raises(BadInputError, match=value) as error:
        replace(spec(), **{key: value})  # type: ignore[arg-type]
    assert error.value.where == key


@pytest.mark.parametrize(("key", "value"), [("height", 100), ("width", 0), ("channels", 0), ("channels", 17)])
def test_numbers_out_of_range_are_named(key: str, value: int) -> None:
    with pytest.raises(BadInputError, match=str(value)) as error:
        replace(spec(), **{key: value})  # type: ignore[arg-type]
    assert (error.value.where, key in error.value.found) in {("size", True), ("channels", False)}


@settings(max_examples=12)
@given(
    encoder=st.sampled_from(ENCODERS),
    norm=st.sampled_from(NORMS),
    layout=st.sampled_from(LAYOUTS),
    side=st.integers(1, 31),
    channels=st.integers(4, 15),
    unit=st.sampled_from(["gpu", "dsp"]),
)
def test_more_to_do_never_takes_less_time(
    encoder: str, norm: str, layout: str, side: int, channels: int, unit: UnitName
) -> None:
    profile = load_profile("snapdragon-888")

    def ms(side: int, channels: int) -> float:
        network = reference_network(NetworkSpec(encoder, norm, 32 * side, 32 * side, channels, layout))
        return isolated_job_time(profile, network, unit, corners_of(profile, SUSTAINED)).total_ms

    least = ms(side, channels)
    assert 0 < least <= ms(side + 1, channels)
    assert least <= ms(side, channels + 1)


def test_a_batch_pays_fixed_costs_and_weights_once() -> None:
    profile = load_profile("snapdragon-888")
    machine = machine_of(profile.units["dsp"], profile.memory)
    one, four = (job_time(network_work(spec()), machine, batch) for batch in (1, 4))
    once = one.parts["fixed"] + one.parts["weights"]
    assert four.total_ms == pytest.approx(4 * one.total_ms - 3 * once)


def test_group_normalisation_falls_back_on_the_dsp_and_not_on_the_gpu() -> None:
    profile = load_profile("snapdragon-888")
    corners = corners_of(profile, SUSTAINED)
    assert isolated_job_time(profile, reference_network(spec(norm="group")), "dsp", corners).parts["fallback"] > 1000
    assert isolated_job_time(profile, reference_network(spec(norm="group")), "gpu", corners).parts["fallback"] == 0


@pytest.mark.parametrize("share", [0.01, 0.3, 0.9])
def test_both_parts_of_a_split_do_all_the_work(share: float) -> None:
    work = network_work(spec())
    head, tail = split_work(work, share)
    assert head.macs + tail.macs == work.macs
    assert head.macs >= share * work.macs
    assert head.output_elements == tail.input_elements > 0


def test_profiles_are_within_a_quarter_of_published_times_that_the_fit_has_seen() -> None:
    checks = [check for name in PUBLISHED_MS for check in check_published(name, load_profile(name))]
    assert len(checks) == sum(len(times) for networks in PUBLISHED_MS.values() for times in networks.values())
    for check in checks:
        assert abs(check.error) < 0.25, check
        assert not check.independent


def test_a_published_time_is_compared_with_the_runtime_that_it_is_of() -> None:
    """Rows of resnet18 on the QCS8450: 0.609 ms by tflite, 0.743 ms by qnn_dlc; 0.676 is the time of neither."""
    profile = load_profile("snapdragon-8-gen-1")
    unit = profile.units["dsp"]
    checks = {(check.network, check.runtime): check for check in check_published(profile.name, profile)}
    assert list(checks) == [(network, runtime) for network in ("unet", "resnet18") for runtime in ("tflite", "qnn_dlc")]
    first, second = checks["resnet18", "tflite"], checks["resnet18", "qnn_dlc"]
    assert (first.published_ms, second.published_ms) == (0.609, 0.743)
    assert first.predicted_ms == time_on(unit, profile.memory, resnet18_work()).total_ms
    engines = {"int8_tflite": unit.engines["int8_qnn_dlc"]}  # its numbers, under the other's name
    renamed = unit.model_copy(update={"engines": engines})
    assert second.predicted_ms == time_on(renamed, profile.memory, resnet18_work()).total_ms
    assert second.predicted_ms > 1.2 * first.predicted_ms
    left = profile.model_copy(update={"units": {**profile.units, "dsp": renamed}})
    assert [check.runtime for check in check_published(profile.name, left)] == ["tflite", "tflite"]
    assert check_published("snapdragon-865", profile) == []


@pytest.mark.parametrize("unit", ["gpu", "dsp"])
@pytest.mark.parametrize("chip", ["snapdragon-888", "snapdragon-8-gen-3"])
def test_networks_one_after_the_other_save_the_fixed_cost_of_a_job_and_nothing_else(chip: str, unit: UnitName) -> None:
    """Equal names of tensors in both do not meet: what is saved is the same for any pair, and once for each more."""
    profile = load_profile(chip)
    small, large = resnet18_work(), unet_work()

    def ms(*works: Work) -> float:
        return time_on(profile.units[unit], profile.memory, one_after_the_other(works)).total_ms

    saved = ms(small) + ms(large) - ms(small, large)
    assert 0 < saved < ms(small)
    assert 2 * ms(small) - ms(small, small) == pytest.approx(saved)
    assert 2 * ms(small) + ms(large) - ms(small, large, small) == pytest.approx(2 * saved)
    both = one_after_the_other([small, large])
    assert (both.macs, both.weights) == (small.macs + large.macs, small.weights + large.weights)
    assert one_after_the_other([small]) is small
