"""The cost model on networks small enough for paper: counts by loops, times by the terms of the formula."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from trilane.hw_profiles.governor import ThermalState, headroom_k
from trilane.hw_profiles.network_work import Operator, Work, count_work
from trilane.hw_profiles.operator_kinds import CLASSES
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.schema import CORNERS
from trilane.hw_profiles.unit_times import UnitNumbers, job_time, machine_of
from trilane.units import UNITS, UnitName


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


def test_temperatures_follow_their_differential_equation() -> None:
    """Against small Euler steps of T' = (T_below + R P - T) / tau, junctions on the device's final temperature."""
    profile = load_profile("snapdragon-888")
    thermal = profile.thermal
    power: dict[UnitName, float] = {"cpu": 0.5, "gpu": 1.0, "dsp": 2.0}
    state, step = ThermalState.at_rest(profile), 0.01
    device, seconds = thermal.ambient_c.or_else(0), 30.0
    state.advance(profile, power, seconds)
    watts = sum(power.values()) + thermal.base_power_w.or_else(0)
    for _ in range(round(seconds / step)):
        goal = thermal.ambient_c.or_else(0) + thermal.device_k_per_w.or_else(0) * watts
        device += step * (goal - device) / thermal.device_time_s.or_else(0)
    assert state.device_c == pytest.approx(device, abs=1e-3)
    for name in UNITS:
        unit, junction = profile.units[name], thermal.ambient_c.or_else(0)
        for _ in range(round(seconds / step)):
            goal = device + unit.junction_k_per_w.or_else(0) * power[name]
            junction += step * (goal - junction) / unit.junction_time_s.or_else(0)
        assert state.junction_c[name] == pytest.approx(junction, abs=0.01)
    assert state.rising


@pytest.mark.parametrize(
    ("device", "hottest", "left"),
    [(40.0, 60.0, "skin"), (30.0, 90.0, "junction")],
)
def test_headroom_is_to_the_nearer_limit(device: float, hottest: float, left: str) -> None:
    profile = load_profile("snapdragon-888")
    number = profile.thermal.ambient_c
    limits = {"skin_limit_c": 45.0, "junction_limit_c": 95.0}
    thermal = profile.thermal.model_copy(
        update={key: number.model_copy(update={"value": value}) for key, value in limits.items()}
    )
    state = ThermalState(device, {"cpu": 20.0, "gpu": hottest, "dsp": 20.0})
    expected = {"skin": 45.0 - device, "junction": 95.0 - hottest}[left]
    assert headroom_k(profile.model_copy(update={"thermal": thermal}), state) == expected


def test_the_batch_is_one_frame_when_nothing_is_said() -> None:
    operator, _ = OPERATORS["bound by traffic"]
    assert job_time(work_of(operator), MACHINE) == job_time(work_of(operator), MACHINE, batch=1)
    assert job_time(work_of(operator), replace(MACHINE, block=8.0)).parts["pointwise"] == 1000 * 4.0
