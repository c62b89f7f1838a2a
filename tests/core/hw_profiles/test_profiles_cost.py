"""Work of a graph and its time: counts against known values, times against their physics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from trilane.errors import BadInputError
from trilane.hw_profiles.application import isolated_job_time, split_work
from trilane.hw_profiles.network_work import Operator, count_work
from trilane.hw_profiles.operator_kinds import CLASSES, has_rule
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.published_times import PUBLISHED_MS, check_published, resnet18_work, unet_work
from trilane.hw_profiles.reference_networks import (
    LAYOUTS,
    NetworkSpec,
    build_network,
    network_work,
    parameters,
    reference_network,
)
from trilane.hw_profiles.schema import corners_of
from trilane.hw_profiles.unit_times import job_time, machine_of, time_on
from trilane.training.quantising.quantise import Quantised
from trilane.unet_tables import ENCODERS, NORMS
from trilane.units import UnitName

SUSTAINED = "sustained_high_performance"


def spec(encoder: str = "resnet18", norm: str = "batch", side: int = 512, channels: int = 16) -> NetworkSpec:
    return NetworkSpec(encoder, norm, side, side, channels)


@pytest.mark.parametrize(
    ("encoder", "millions"),
    [("resnet18", 14.5), ("mobilenetv2", 6.6), ("mobilenetv3", 6.7), ("efficientnet-lite0", 6.1)],
)
def test_parameters_are_those_published(encoder: str, millions: float) -> None:
    assert parameters(build_network(spec(encoder))) / 1e6 == pytest.approx(millions, rel=0.05)


def test_resnet18_at_512_does_the_published_products() -> None:
    assert network_work(spec()).macs / 1e9 == pytest.approx(65.9, abs=0.05)


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


@pytest.mark.parametrize("encoder", ENCODERS)
def test_group_and_instance_normalisation_have_the_same_shapes(encoder: str) -> None:
    """ONNX infers no shape through the group norm; the graph differs from the checked one in that operator alone."""
    rows = [
        [(o.op_type.removeprefix("Group").removeprefix("Instance"), o.moved, o.live) for o in work.operators]
        for work in (network_work(spec(encoder, norm, 64, 8)) for norm in ("group", "instance"))
    ]
    assert rows[0] == rows[1]


def test_graphs_equal_the_trained_networks() -> None:
    """Parameter counts against the PyTorch definition, for every encoder that it has."""
    pytest.importorskip("torch")
    from trilane.training.network import ENCODERS as TRAINED
    from trilane.training.network import UNet

    for encoder in sorted(set(TRAINED) & set(ENCODERS)):
        trained = sum(p.numel() for p in UNet(encoder, "instance", channels=16).parameters())
        assert parameters(build_network(spec(encoder, "instance"))) == pytest.approx(trained, rel=0.001), encoder


def test_products_grow_with_the_area() -> None:
    small, large = network_work(spec(side=256)), network_work(spec(side=512))
    assert large.macs == pytest.approx(4 * small.macs, rel=1e-3)
    assert large.weights == small.weights


@pytest.mark.parametrize("encoder", ENCODERS)
@pytest.mark.parametrize("shape", [(32, 32), (384, 192), (640, 640)])
def test_counts_of_any_size_are_those_of_its_graph(encoder: str, shape: tuple[int, int]) -> None:
    network = NetworkSpec(encoder, "instance", *shape, 12, "split")
    assert network_work(network) == count_work(build_network(network))


def test_quantised_graphs_count_as_their_float_ones() -> None:
    """Quantize and dequantize nodes around a convolution leave its products and weights as they are."""
    weight = helper.make_tensor("w8", TensorProto.INT8, (8, 4, 3, 3), np.zeros(288, np.int8).tobytes(), raw=True)
    scale = helper.make_tensor("s", TensorProto.FLOAT, (), [0.1])
    nodes = [
        helper.make_node("DequantizeLinear", ["x", "s"], ["xf"]),
        helper.make_node("DequantizeLinear", ["w8", "s"], ["wf"]),
        helper.make_node("Conv", ["xf", "wf"], ["y"], pads=[1, 1, 1, 1], name="conv"),
    ]
    source = helper.make_tensor_value_info("x", TensorProto.INT8, (1, 4, 16, 16))
    result = helper.make_tensor_value_info("y", TensorProto.FLOAT, (1, 8, 16, 16))
    graph = helper.make_graph(nodes, "g", [source], [result], [weight, scale])
    work = count_work(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 21)]))
    assert [o.kind for o in work.operators] == ["convolution"]
    assert work.macs == 16 * 16 * 9 * 4 * 8
    assert work.weights == 288
    assert (work.input_elements, work.output_elements) == (4 * 256, 8 * 256)


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


def test_time_is_the_sum_of_its_parts_and_falls_with_the_clock() -> None:
    profile = load_profile("snapdragon-888")
    work, unit = network_work(spec()), profile.units["dsp"]
    fast, slow = (job_time(work, machine_of(unit, profile.memory, clock)) for clock in (1.0, 0.5))
    assert fast.total_ms == pytest.approx(sum(fast.parts.values()))
    assert set(fast.parts) == {"fixed", "input", "weights", "fallback", *CLASSES}
    assert fast.total_ms < slow.total_ms < 2 * fast.total_ms + 1e-9


@settings(max_examples=25)
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


def test_contention_slows_what_memory_bounds() -> None:
    profile = load_profile("snapdragon-888")
    work = network_work(spec("mobilenetv2", "instance"))
    alone, beside = (job_time(work, machine_of(profile.units["gpu"], profile.memory, 1.0, c)) for c in (False, True))
    assert beside.parts["normalisation"] > alone.parts["normalisation"]
    assert beside.parts["input"] == alone.parts["input"]


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
