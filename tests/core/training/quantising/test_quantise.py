"""Quantisation: bytes at both ends, real zero exact, small error, weights that cannot overflow, named errors."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from trilane.errors import BadInputError
from trilane.training.quantising import quantise as table
from trilane.training.quantising.calibration import saturated, share_ranges, widen
from trilane.training.quantising.noise_model import _sqnr_db, layer_report
from trilane.training.quantising.quantise import equalised, plot_calibrations, quantise
from trilane.units import CALIBRATION_METHODS


def run(model, feed):
    onnxruntime.set_default_logger_severity(3)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {session.get_inputs()[0].name: feed})[0]


def test_bytes_are_the_picture(tiny_float, tiny_frames, tiny_quantised):
    network = tiny_quantised.network
    frame = tiny_frames[0]
    tensor = np.clip(np.round(frame / network.input.scale) + network.input.zero_point, 0, 255).astype(np.uint8)
    wanted = run(tiny_float, frame.transpose(2, 0, 1)[None])[0].transpose(1, 2, 0)
    picture = run(network.model, tensor[None])[0]
    assert picture.dtype == np.uint8 and picture.shape == (64, 64, 4)
    assert np.abs(picture / 255 - wanted).mean() < 2.5 / 255  # weights of 6 bits
    assert network.output.scale == pytest.approx(1 / 255) and network.output.zero_point == 0


def test_saturated_frames_have_all_values_at_the_ends_of_their_common_range():
    frames = [np.array([-1, 0, 0.5], np.float32), np.array([0.1, -3, 4], np.float32)]
    assert [frame.tolist() for frame in saturated(frames)] == [[-3, 0, 4], [4, -3, 4]]
    assert saturated([np.array([1, 2], np.float32)])[0].tolist() == [2, 2]


@pytest.mark.parametrize("norm", ["InstanceNormalization", "Relu"])
def test_what_a_norm_reads_is_not_cut_off_at_the_strongest_contrast(norm):
    """Inputs are -1 to 1 but mostly +-0.1, and the sum of two of them is at most 0.3 where both are small.

    Saturated, the sum is -2 to 2, which a norm's input holds; without a norm 3/4 of the frames' range.
    """
    frame = np.full((8, 8, 2), 0.1, np.float32)
    frame[::2] = -0.1
    frame[0, 0], frame[7, 7] = (-1, 0.7), (1, -0.7)
    model = summing_network(norm)
    quantised = quantise(model, [frame]).network.model
    known = {tensor.name: numpy_helper.to_array(tensor) for tensor in quantised.graph.initializer}
    store = next(n for n in quantised.graph.node if n.op_type == "QuantizeLinear" and n.input[0] in ("sum", "read"))
    scale, zero = (float(known[name]) for name in store.input[1:])
    low, high = -zero * scale, (255 - zero) * scale
    if norm == "Relu":
        assert low == 0 and 0.2 <= high <= 0.4
    else:
        assert low == pytest.approx(-2, abs=0.02) and high == pytest.approx(2, abs=0.02)


def summing_network(norm):
    """The sum of two channels, `norm` and a last sigmoid."""
    kernels = {"w1": np.ones((1, 2, 1, 1)), "w2": np.ones((4, 1, 1, 1)), "gain": np.ones(1), "offset": np.zeros(1)}
    nodes = [
        helper.make_node("Conv", ["tensor", "w1"], ["sum"], "first"),
        helper.make_node(norm, ["sum", "gain", "offset"] if norm != "Relu" else ["sum"], ["read"], "norm"),
        helper.make_node("Conv", ["read", "w2"], ["logits"], "second"),
        helper.make_node("Sigmoid", ["logits"], ["rgba"], "last"),
    ]
    weights = [numpy_helper.from_array(value.astype(np.float32), name) for name, value in kernels.items()]
    ends = [("tensor", 2), ("rgba", 4)]
    source, target = (helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, c, 8, 8]) for n, c in ends)
    graph = helper.make_graph(nodes, "sum", [source], [target], weights)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


@pytest.mark.parametrize("method", CALIBRATION_METHODS)
def test_every_method_calibrates(tiny_float, tiny_frames, method):
    result = quantise(tiny_float, tiny_frames, method)
    assert result.facts["method"] == method and result.facts["calibration_frames"] == len(tiny_frames)


@pytest.mark.parametrize(("reduce_range", "limit"), [(True, 64), (False, 127)])
def test_weights_have_seven_bits_when_reduced(tiny_float, tiny_frames, reduce_range, limit):
    model = quantise(tiny_float, tiny_frames, reduce_range=reduce_range).network.model
    weights = [numpy_helper.to_array(t) for t in model.graph.initializer if t.name.endswith(".w_quantized")]
    assert len(weights) == 4
    assert limit // 2 < max(np.abs(w.astype(int)).max() for w in weights) <= limit


def test_a_layer_can_stay_in_float(tiny_float, tiny_frames):
    result = quantise(tiny_float, tiny_frames, keep_float=["stem"])
    assert result.facts["float_layers"] == ["stem"]
    assert run(result.network.model, np.zeros((1, 64, 64, 5), np.uint8)).shape == (1, 64, 64, 4)


@pytest.mark.parametrize(
    ("frames", "method", "message"),
    [
        ([], "minmax", "0 frames"),
        ([np.zeros((64, 32, 5), np.float32)], "minmax", "frame 0"),
        ([np.full((64, 64, 5), np.nan)], "minmax", "finite"),
        ([np.zeros((64, 64, 5), np.float32)], "median", "median"),
    ],
)
def test_wrong_frames_and_methods_are_named(tiny_float, frames, method, message):
    with pytest.raises(BadInputError, match=message):
        quantise(tiny_float, frames, method)


def test_a_network_without_sigmoid_is_refused(tiny_float, tiny_frames):
    model = copy.deepcopy(tiny_float)
    model.graph.node[-1].op_type = "Tanh"
    with pytest.raises(BadInputError, match="Sigmoid"):
        quantise(model, tiny_frames)
    assert isinstance(tiny_float, onnx.ModelProto)


def test_a_concat_moves_bytes(tiny_quantised):
    """Inputs and output of a Concat have one scale, so its bytes do not change, whichever runtime fuses it."""
    model = tiny_quantised.network.model
    values = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    makers = {out: node for node in model.graph.node for out in node.output}
    users = {name: node for node in model.graph.node for name in node.input}
    concat = next(node for node in model.graph.node if node.op_type == "Concat")
    ends = [makers[name] for name in concat.input] + [users[concat.output[0]]]
    assert len({(float(values[end.input[1]]), int(values[end.input[2]])) for end in ends}) == 1


# Parts of the quantiser by value: equalised weights by hand, tables of calibrations computed again, layers' noise.

Kernels = dict[str, Any]


def chain(kernels: Kernels, nodes: list[tuple[str, list[str], str, dict[str, Any]]]) -> onnx.ModelProto:
    """A network of `nodes` (operator, inputs, output, attributes) with 1 x 1 kernels (O, I) and biases (O,)."""
    constants = [
        numpy_helper.from_array(np.asarray(value, np.float32)[(...,) + (None,) * (2 * (np.ndim(value) == 2))], name)
        for name, value in kernels.items()
    ]
    made = [helper.make_node(kind, inputs, [output], output, **more) for kind, inputs, output, more in nodes]
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 2, 4, 4]) for name in ("x", nodes[-1][2])]
    return helper.make_model(helper.make_graph(made, "chain", ends[:1], ends[1:], constants))


def weights_of(model: onnx.ModelProto) -> Kernels:
    return {tensor.name: np.squeeze(numpy_helper.to_array(tensor)) for tensor in model.graph.initializer}


def test_every_concat_whose_tensors_may_have_one_range_gets_one() -> None:
    """The second is left alone, since `relu` would lose its clamp; the one before it and the one after it are joined,
    the last through a Resize."""
    nodes = [
        helper.make_node("Conv", ["x", "k"], ["a"]),
        helper.make_node("Concat", ["a", "x"], ["first"], axis=1),
        helper.make_node("Relu", ["a"], ["relu"]),
        helper.make_node("Concat", ["relu", "x"], ["second"], axis=1),
        helper.make_node("Sigmoid", ["first"], ["s"]),
        helper.make_node("Resize", ["s"], ["large"]),
        helper.make_node("Concat", ["large", "far"], ["third"], axis=1),
    ]
    model = helper.make_model(helper.make_graph(nodes, "g", [], []))
    told = {"a": (-3, 2), "x": (-1, 4), "first": (-2, 1), "relu": (0, 9), "second": (-1, 8), "s": (0, 1)}
    told |= {"large": (0.1, 0.9), "far": (0.5, 3), "third": (0.2, 2)}
    ranges = {name: SimpleNamespace(lowest=low, highest=high) for name, (low, high) in told.items()}
    share_ranges(model, ranges)
    joined = dict.fromkeys(("a", "x", "first"), (-3, 4)) | dict.fromkeys(("s", "large", "far", "third"), (0, 3))
    assert {name: (each.lowest, each.highest) for name, each in ranges.items()} == told | joined


def test_a_range_is_widened_on_both_sides_where_the_other_is_wider() -> None:
    ranges = {name: SimpleNamespace(lowest=-1.0, highest=1.0) for name in "abc"}
    wider = {
        "a": SimpleNamespace(lowest=-2.0, highest=0.5),
        "b": SimpleNamespace(lowest=-0.5, highest=3.0),
        "c": SimpleNamespace(lowest=-9.0, highest=9.0),
    }
    widen(ranges, {"a", "b", "absent"}, wider)
    found = {name: (each.lowest, each.highest) for name, each in ranges.items()}
    assert found == {"a": (-2, 1), "b": (-1, 3), "c": (-1, 1)}


PLAIN = [
    ("Conv", ["x", "a", "b"], "first", {}),
    ("Relu", ["first"], "relu", {}),
    ("Conv", ["relu", "c", "d"], "second", {}),
]


KERNELS: Kernels = {"a": [[8, -4], [0.5, 1]], "b": [6, 3], "c": [[2, 9], [-1, 3]], "d": [5, 7]}


@pytest.mark.parametrize("of_conv", [{}, {"group": 1}])
def test_neighbours_meet_at_the_root_of_their_ranges(of_conv: dict[str, int]) -> None:
    """Channel 0: made with 8, read with 2, so s = sqrt(8 / 2) = 2; channel 1: 1 and 9, s = 1/3. The last bias stays."""
    model = chain(KERNELS, [(kind, *ends, of_conv if kind == "Conv" else {}) for kind, *ends, _ in PLAIN])
    found = weights_of(equalised(model))
    np.testing.assert_allclose(found["a"], [[4, -2], [1.5, 3]], rtol=1e-6)
    np.testing.assert_allclose(found["b"], [3, 9], rtol=1e-6)
    np.testing.assert_allclose(found["c"], [[4, 3], [-2, 1]], rtol=1e-6)
    assert found["d"].tolist() == [5, 7]
    assert {name: value.tolist() for name, value in weights_of(model).items()} == KERNELS, "the network is a copy"


def test_dead_channels_stay_and_no_factor_of_a_round_is_beyond_a_hundred() -> None:
    """Channel 0 is not read, channel 1 is made 1e16 times as large as it is read: s = 1e8, but 100 in each round."""
    nodes = [*PLAIN[:2], ("Conv", ["relu", "c"], "second", {})]
    found = weights_of(equalised(chain({"a": [[3, 1], [1e8, 0]], "b": [1, 5], "c": [[0, 1e-8], [0, 0]]}, nodes)))
    assert found["a"].tolist()[0] == [3, 1] and found["b"][0] == 1
    np.testing.assert_allclose(found["a"][1, 0], 1e2, rtol=1e-5)
    np.testing.assert_allclose(found["c"][0, 1], 1e-2, rtol=1e-5)


def test_three_layers_are_equalised_three_times() -> None:
    random = np.random.default_rng(1)
    kernels = {name: random.uniform(0.1, 9, (2, 2)) for name in "ace"}
    nodes = [
        *PLAIN[:2],
        ("Conv", ["relu", "c"], "second", {}),
        ("Relu", ["second"], "again", {}),
        ("Conv", ["again", "e"], "third", {}),
    ]
    nodes[0] = ("Conv", ["x", "a"], "first", {})
    found = weights_of(equalised(chain(kernels, nodes)))
    wanted = {name: value.copy() for name, value in kernels.items()}
    for _ in range(3):
        for first, second in (("a", "c"), ("c", "e")):
            made, read = wanted[first], wanted[second]
            scale = np.sqrt(made.max(axis=1) / read.max(axis=0))
            wanted[first], wanted[second] = made / scale[:, None], read * scale[None]
    for name, value in wanted.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-5)


OTHER_CHAINS = {
    "another reader": [*PLAIN, ("Relu", ["first"], "other", {})],
    "no rectifier": [PLAIN[0], ("Sigmoid", ["first"], "relu", {}), PLAIN[2]],
    "groups": [PLAIN[0], PLAIN[1], ("Conv", ["relu", "c", "d"], "second", {"group": 2})],
    "a shared weight": [PLAIN[0], PLAIN[1], ("Conv", ["relu", "a", "d"], "second", {})],
    "a shared bias": [PLAIN[0], PLAIN[1], ("Conv", ["relu", "c", "b"], "second", {})],
    "a weight that is computed": [PLAIN[0], PLAIN[1], ("Conv", ["relu", "x", "d"], "second", {})],
}


@pytest.mark.parametrize("case", OTHER_CHAINS)
def test_other_chains_are_left_alone(case: str) -> None:
    found = weights_of(equalised(chain(KERNELS, OTHER_CHAINS[case])))
    assert {name: value.tolist() for name, value in found.items()} == KERNELS


# --- the table of calibrations ------------------------------------------------------------------------------------


def test_calibrations_are_judged_on_the_last_five_frames(tiny_float: Any, tiny_frames: Any) -> None:
    frames = [frame * np.float32(1 + 0.1 * k) for k, frame in enumerate([*tiny_frames] * 2)][:9]
    rows = list(table.calibration_table(tiny_float, frames, ("minmax",), (3, 4, 5)))
    assert [(row["method"], row["count"]) for row in rows] == [("minmax", 3), ("minmax", 4)]
    for row in rows:
        network = quantise(tiny_float, frames[: row["count"]], "minmax").network
        off = []
        for frame in frames[4:]:
            wanted = 255 * run(tiny_float, np.ascontiguousarray(frame.transpose(2, 0, 1)[None]))
            tensor = np.clip(np.round(frame / network.input.scale) + network.input.zero_point, 0, 255)
            picture = run(network.model, tensor.astype(np.uint8)[None])
            off.append(np.abs(wanted.transpose(0, 2, 3, 1) - picture).astype(np.float64))
        decibels = [10 * math.log10(255**2 / np.mean(each**2)) for each in off]
        assert row["psnr_db"] == pytest.approx(np.mean(decibels), abs=1e-4)
        assert row["mean"] == pytest.approx(np.mean(off), rel=1e-5)
        assert row["largest"] == pytest.approx(np.max(off), rel=1e-6)


@pytest.mark.parametrize(
    ("rows", "chosen"),
    [
        ([("a", 5, 30.0), ("a", 50, 30.05), ("b", 100, 30.09)], ("a", 5)),
        ([("a", 5, 30.0), ("a", 50, 30.2), ("b", 100, 30.25)], ("a", 50)),
        ([("a", 10, 30.0), ("b", 10, 30.05)], ("b", 10)),
        ([("a", 5, 20.0), ("b", 100, 30.0)], ("b", 100)),
    ],
)
def test_the_fewest_frames_within_a_tenth_of_a_decibel_are_recommended(
    rows: list[tuple[str, int, float]], chosen: tuple[str, int]
) -> None:
    told = [{"method": method, "count": count, "psnr_db": psnr} for method, count, psnr in rows]
    row = table.recommended(told)
    assert (row["method"], row["count"]) == chosen
    assert table.recommendation(told).startswith(f"{chosen[0]} on {chosen[1]} frames: {row['psnr_db']:.2f} dB, ")


def test_a_plot_of_calibrations_is_a_picture(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    rows = [{"method": "minmax", "count": count, "psnr_db": 30.0 + count} for count in (5, 10)]
    plot_calibrations(rows, "a line", tmp_path / "c.svg")
    assert "<svg" in (tmp_path / "c.svg").read_text(encoding="utf-8")


def test_equal_pictures_have_a_finite_psnr() -> None:
    """Equal pictures have 100 dB, as in every other place that states a PSNR."""
    same = [np.zeros((1, 2, 2, 4), np.float32)]
    found = table._errors(same, [np.zeros((1, 2, 2, 4), np.uint8)])
    assert found == {"psnr_db": 100.0, "mean": 0.0, "largest": 0.0}


@pytest.mark.parametrize(
    ("frames", "methods", "message"),
    [
        (9, ("minmax",), "frames: found 9 of them, expected at least 10"),
        (10, ("mean",), "--method: found 'mean', expected one of minmax, percentile, entropy"),
    ],
)
def test_tables_that_cannot_be_made_are_refused(
    tiny_float: Any, tiny_frames: Any, frames: int, methods: tuple[str, ...], message: str
) -> None:
    with pytest.raises(BadInputError) as caught:
        next(table.calibration_table(tiny_float, ([*tiny_frames] * 2)[:frames], methods))
    assert str(caught.value) == message


# --- the noise of layers ------------------------------------------------------------------------------------------


def test_the_noise_of_each_layer(held: Any, tiny_float: Any, tiny_frames: Any, tiny_quantised: Any) -> None:
    rows = layer_report(tiny_float, tiny_quantised, tiny_frames[2])
    assert all(row["op_type"] == "Conv" for row in rows)
    assert [row["sqnr_db"] for row in rows] == sorted(row["sqnr_db"] for row in rows)
    by_name = {row["name"]: round(row["sqnr_db"], 3) for row in rows}
    assert by_name.keys() == {"stem", "deep", "level", "head"}
    held("decibels", [by_name[name] for name in ("stem", "deep", "level", "head")])


@pytest.mark.parametrize(
    ("exact", "rounded", "decibels"),
    [
        ([3.0, 4.0], [3.0, 4.5], 20.0),
        ([3.0, 4.0], [3.0, 4.0], 200.0),
        ([0.0, 0.0], [0.0, 0.0], 200.0),
        ([0.0, 0.0], [0.0, 1.0], -200.0),
        ([1e-12, 0.0], [1e12, 0.0], -200.0),
        ([1e12, 0.0], [1e12, 1e-12], 200.0),
    ],
)
def test_a_ratio_is_in_decibels_and_has_ends(exact: list[float], rounded: list[float], decibels: float) -> None:
    """25 over 0.25 is a hundred, which is 20 dB."""
    assert _sqnr_db(np.array(exact, np.float32), np.array(rounded, np.float32)) == pytest.approx(decibels)
